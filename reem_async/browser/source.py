"""Source: what the page shows, be it a live server or a recording."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

from ..errors import ReemError
from ..plan.paths import Path
from .nodes import Node, Page

__all__ = ["NotKept", "Sample", "Series", "Source", "Status", "counted", "numbers_in"]


class NotKept(ReemError):
    """What was there at that instant is not known: it was too large for the buffer, or too long ago."""


class Status(NamedTuple):
    """How things are with a source.

    Attributes:
        start: From when on its past can be shown, in seconds since 1970.
        end: The newest instant.
        lost: Why nothing can be read at the moment; empty if all is well.
        note: What else is to be said of the past that is shown; usually empty.
    """

    start: float
    end: float
    lost: str = ""
    note: str = ""


class Sample(NamedTuple):
    """A value at an instant.

    Attributes:
        value: The value, arrays included.
        late: Seconds by which it is older than it should be, since what came after was not kept.
    """

    value: Any
    late: float = 0.0


class Series(NamedTuple):
    """Numbers over time.

    Attributes:
        names: What each line is: one empty text, or the indexes of a list.
        times: Seconds since 1970.
        lines: For each name as many numbers as there are times, None where there was no number.
    """

    names: list[str]
    times: list[float]
    lines: list[list[float | None]]


class Source(Protocol):
    """What the page can ask. An instant is in seconds since 1970; None is now, or the end of a recording.

    Attributes:
        title: Where it is from, without credentials.
        live: It goes on; else it is a recording.
        writable: `write` can work.
    """

    title: str
    live: bool
    writable: bool

    async def start(self) -> None:
        """Begin. Idempotent."""

    async def close(self) -> None:
        """End. Idempotent."""

    def status(self) -> Status:
        """Return the span of time that can be shown, and whether the source can be read."""

    def snippets(self, path: Path, at: float | None) -> dict[str, str]:
        """Return Python that reads a path, by what to call it; no passwords in it."""

    async def nodes(self, paths: Sequence[Path], at: float | None) -> list[Node | None]:
        """Return what is at each path, None where nothing is."""

    async def children(self, path: Path, start: int, count: int, at: float | None) -> Page:
        """Return some of what is directly below a path, the top-level keys for the root."""

    async def value(self, path: Path, at: float | None) -> Sample:
        """Return the value at a path; raises MissingKey or NotKept."""

    async def changes(self, since: float, until: float, most: int) -> list[Path]:
        """Return which paths changed, at most so many."""

    async def step(self, at: float, forward: bool, path: Path) -> float | None:
        """Return the instant of the next or previous change at, above or below a path."""

    async def activity(self, start: float, end: float, bins: int, path: Path) -> list[int]:
        """Return how many changes at, above or below a path fall into each of `bins` equal parts of a span."""

    async def series(self, path: Path, start: float, end: float) -> Series:
        """Return the number, or list of numbers, at a path over time."""

    async def search(self, text: str, at: float | None, most: int) -> list[Path]:
        """Return paths that have `text` in them, top-level keys first."""

    async def write(self, path: Path, value: Any) -> None:
        """Publish a value."""


_MOST_LINES = 16


def numbers_in(samples: Iterable[tuple[float, Any]]) -> Series:
    """Return the numbers in a history of values: one line, or one for each item of a short list."""
    pairs = list(samples)
    width = max([len(value) for _, value in pairs if _is_short_list(value)], default=0)
    times = [when for when, _ in pairs]
    if not width:
        lines = [[_number(value) for _, value in pairs]]
    else:
        rows = [value if _is_short_list(value) else [value] for _, value in pairs]
        lines = [[_number(row[index]) if index < len(row) else None for row in rows] for index in range(width)]
    if all(number is None for line in lines for number in line):
        return Series([], [], [])
    return Series([f"[{index}]" for index in range(width)] if width else [""], times, lines)


def _is_short_list(value: Any) -> bool:
    return type(value) is list and 0 < len(value) <= _MOST_LINES


def _number(value: Any) -> float | None:
    if type(value) is not float and not isinstance(value, bool | int | float):
        return None
    number = float(value)
    return number if math.isfinite(number) else None


def counted(times: Iterable[float], start: float, end: float, bins: int) -> list[int]:
    """Return how many of the times fall into each of `bins` equal parts of a span."""
    counts = [0] * bins
    width = max(end - start, 1e-9) / bins
    for when in times:
        if start <= when <= end:
            counts[min(int((when - start) / width), bins - 1)] += 1
    return counts
