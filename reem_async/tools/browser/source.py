"""What the page can ask of a live server or of a recording, and the answers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, NamedTuple, Protocol

import numpy as np

from ...coordination.parameters import StoredParameter
from ...errors import BadKey, ReemError
from ...plan.paths import Path, check_top_key, parse, parse_suffix, suffix
from ...plan.placeholders import Unfetched
from ...plan.trees import is_addressable, walk
from .trees import Frame, described, leaves_size

# Paths in URLs and snippets: one text for each path, which leads back to exactly that path.


_LONGEST = 4096  # characters


def address(path: Path) -> str:
    """Return the text of a path: `foo.bar[2]`, or `["a.b"].c` where a key needs quotes; "" for the root."""
    return suffix(path).removeprefix(".")


def path_of(text: str) -> Path:
    """Return the path whose address is `text`, or which a user typed; raises BadKey for one such as `../etc`."""
    if len(text) > _LONGEST:
        raise BadKey(f"a path of {len(text)} characters is too long; shorten it to {_LONGEST}")
    path = parse_suffix(text if text[0] == "[" else "." + text) if '["' in text else parse(text)
    if path:
        check_top_key(path[0])
    return path


def snippets(path: Path, url: str, namespace: str, *, raw: bool = False) -> dict[str, str]:
    """Return Python that reads a path from a server, for both fronts; `raw` if it is of another program."""
    # As far as a path can lead; the rest is taken out of what was read, in Python.
    reach = next((index for index, key in enumerate(path) if index and not is_addressable(key)), len(path))
    reach = min(reach, 1) if raw else reach
    where, below = ("".join([f"[{key!r}]" for key in keys]) for keys in (path[:reach], path[reach:]))
    read = f"kvs{'.raw' if raw else ''}{where}.read()"
    awaited = f"(await {read}){below}" if below else f"await {read}"
    interface = f"RedisInterface({url!r}" + (f", namespace={namespace!r})" if namespace else ")")
    return {
        "blocking (reem)": "from reem import KeyValueStore, RedisInterface\n\n"
        f"kvs = KeyValueStore({interface})\nvalue = {read}{below}\n",
        "asyncio (reem_async)": "import asyncio\nfrom reem_async import KeyValueStore, RedisInterface\n\n"
        "async def main():\n"
        f"    async with {interface} as interface:\n"
        f"        kvs = KeyValueStore(interface)\n        return {awaited}\n\n"
        "value = asyncio.run(main())\n",
    }


LAYOUTS = "_layouts"  # the key of the layouts that pages saved, by their names

# Nodes: what one line of the tree shows.

LONGEST_TEXT = 200  # characters of a text that a line shows
_PREVIEW_ITEMS = 8  # items of a list that stand in its row
# Control characters, and those that turn the direction of what follows: shown as escapes, never obeyed.
_INVISIBLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff]"
)


def visible(text: str) -> str:
    """Return `text` with what cannot be seen, or reorders what can, as escapes."""
    return _INVISIBLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def shown_text(text: str, most: int = LONGEST_TEXT) -> str:
    """Return a string for one line: quoted, cut, nothing invisible in it."""
    short = text if len(text) <= most else text[:most] + "…"
    return '"' + visible(short).replace("\n", "\\n").replace("\t", "\\t") + '"'


@dataclass(frozen=True, slots=True)
class Node:
    """What is at one path, without what is below."""

    path: Path  # where, top-level key first
    kind: str  # "dict", "list", "str", "int", "float", "bool", "NoneType", or the label of a ship
    text: str = ""  # what to show of it: the value, shortened, or the summary of an array
    size: int | None = None  # bytes, of dicts and lists all that is in them; None if that is not known
    count: int | None = None  # how many items a dict or list has; None for anything else
    value: Any = None  # a number, bool or None as it is; else None
    time: float | None = None  # when it was last seen to change, in seconds since 1970; None if that is not known
    rate: float | None = None  # updates per second of late; None if that is not known
    raw: str = ""  # the Redis type, if it is of another program

    def stamped(self, when: float | None, rate: float | None) -> Node:
        return replace(self, time=when, rate=rate)

    def as_json(self) -> dict[str, Any]:
        key = self.path[-1] if self.path else ""
        return {
            "address": address(self.path),
            # A key with a dot looks like a path: it is shown as it is written in one.
            "label": visible(address((key,)) if isinstance(key, int) or "." in key else key),
            "kind": self.kind,
            "text": self.text,
            "size": self.size,
            "count": self.count,
            "time": self.time,
            "rate": self.rate,
            "raw": self.raw,
        }


@dataclass(frozen=True, slots=True)
class Page:
    """Some of the items of a dict or list, or of the top-level keys."""

    total: int
    start: int  # which the first is
    nodes: list[Node]


def node_of(path: Path, value: Any) -> Node:
    """Return the node of a value, an array or a `Unfetched`."""
    if isinstance(value, dict | list):
        return Node(path, type(value).__name__, _preview(value), leaves_size(value), len(value))
    if isinstance(value, str):
        return Node(path, "str", shown_text(value), len(value.encode(errors="replace")))
    if value is None or isinstance(value, bool | int | float):
        return Node(path, type(value).__name__, _plain(value), 8, None, value)
    leaf = described(value)
    return Node(path, leaf.label, visible(leaf.summary), leaf.size)


def _plain(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)


def _preview(value: dict[str, Any] | list[Any]) -> str:
    if isinstance(value, dict) or not 0 < len(value) <= _PREVIEW_ITEMS:
        return ""
    if not all(item is None or isinstance(item, bool | int | float) for item in value):
        return ""
    return "[" + ", ".join([_plain(item).removesuffix(".0") for item in value]) + "]"


_WALKED = 200_000  # places that are looked at for one search, so that the program answers others meanwhile


def matching(needle: str, names: Iterable[str], trees: Iterable[tuple[str, Any]], most: int) -> list[Path]:
    """Return paths with `needle` in them: keys first, then what is below these keys, each with its tree."""
    found: dict[Path, None] = {(name,): None for name in names if needle in address((name,)).lower()}
    places = (path for name, tree in trees for path, _ in walk(tree, (name,)) if len(path) > 1)
    for path in islice(places, _WALKED):
        if len(found) >= most:
            break
        if needle in address(path).lower():
            found[path] = None
    return list(found)[:most]


# The source.


class NotKept(ReemError):
    """What was there at that instant is not known: it was too large for the buffer, or too long ago."""


class Status(NamedTuple):
    start: float  # from when on its past can be shown, in seconds since 1970
    end: float  # the newest instant
    lost: str = ""  # why nothing can be read at the moment; empty if all is well
    note: str = ""  # what else is to be said of the past that is shown; usually empty
    part: float = 1.0  # how much is done of what is being read, from 0 to 1; 1 if nothing is


class Sample(NamedTuple):
    value: Any  # the value, arrays included; a `Preview` of an array of which no more is kept
    late: float = 0.0  # seconds by which it is older than it should be, since what came after was not kept
    age: float | None = None  # seconds from when it was read to the instant asked for; None if that is not known


class Loss(NamedTuple):
    start: float  # when the last update before it came, in seconds since 1970
    end: float  # when it was noticed, or over
    missed: int | None  # how many updates were lost; None if that is not known


class Series(NamedTuple):
    names: list[str]  # what each line is: one empty text, or the indexes of a list
    times: list[float]  # seconds since 1970
    lines: list[list[float | None]]  # for each name as many numbers as there are times, None where there was no number
    quiet: list[tuple[float, float]] | None = None  # see `silences`; None if times has all of them


class Source(Protocol):
    """What the page can ask. An instant is in seconds since 1970; None is now, or the end of a recording.

    What concerns a path is at it, above or below it. `most` is how many are returned at most.

    Attributes:
        title: Where it is from, without credentials.
        live: It goes on; else it is a recording.
        writable: `write` can work.
    """

    title: str
    live: bool
    writable: bool

    # Both are idempotent.
    async def start(self) -> None: ...
    async def close(self) -> None: ...
    def status(self) -> Status: ...

    # Waits until it is known from when to when there is a past.
    async def opened(self) -> None:
        return

    # Notes how many pages are open.
    def shown_on(self, pages: int) -> None: ...

    # Python that reads a path, by what to call it; no passwords in it.
    def snippets(self, path: Path, at: float | None) -> dict[str, str]: ...

    # None where nothing is; for the root, children are the top-level keys. `value` raises MissingKey or NotKept.
    async def nodes(self, paths: Sequence[Path], at: float | None) -> list[Node | None]: ...
    async def children(self, path: Path, start: int, count: int, at: float | None) -> Page: ...
    async def value(self, path: Path, at: float | None) -> Sample: ...
    async def search(self, text: str, at: float | None, most: int) -> list[Path]: ...
    # Returns what would have another type, in words, and writes nothing then unless `retype`. Whole numbers become
    # floats where floats are.
    async def write(self, path: Path, value: Any, *, retype: bool = False) -> list[str]: ...

    # Says what the bytes of another program are, such as "uint8[480,640,3]".
    def hint(self, path: Path, text: str) -> None: ...

    # What programs have declared at and below a path.
    async def parameters(self, path: Path) -> list[StoredParameter]:
        return []

    # What the servers of services say now, see `statistics` in coordination/calls.py.
    async def services(self) -> list[dict[str, Any]]:
        return []

    # Keeps a layout of the page in the store; None removes it, and raises MissingKey if there is none.
    async def save_layout(self, name: str, layout: dict[str, Any] | None) -> None: ...

    # Which paths were published or seen to change; which have another value at one instant than at another.
    async def changes(self, since: float, until: float, most: int) -> list[Path]: ...
    async def differing(self, since: float, until: float, most: int) -> set[Path]: ...

    # How many changes fall into each of `bins` equal parts of a span, and how the arrays of that part are kept: 2
    # whole, 1 as previews, 0 not. Empty if all are kept, or there are none.
    async def activity(self, start: float, end: float, bins: int, path: Path) -> list[int]: ...
    async def pictures(self, start: float, end: float, bins: int, path: Path) -> list[int]:
        return []

    async def series(self, path: Path, start: float, end: float) -> Series: ...

    # Where updates of a path were lost, or may have been.
    async def losses(self, path: Path, start: float, end: float) -> list[Loss]: ...


# Seconds before an instant in which updates are counted.
_RATE_SECONDS = 5.0
_SHORTEST_RATE = 1.0
"""Seconds: at the beginning of what is known, where there is no such span before an instant, it is the one after."""


def rate_span(at: float, start: float, end: float) -> tuple[float, float] | None:
    """Return the span in which updates are counted for the rate at an instant; None if too little is known.

    The past is known from `start` to `end`.
    """
    since = max(at - _RATE_SECONDS, start)
    until = max(at, since + _SHORTEST_RATE)
    return None if until > end else (since, until)


# Items of a list or vector up to which each is drawn as a line over time, and points of a line.
MOST_LINES = 16
MOST_POINTS = 1200
_LARGEST_VECTOR = 8 * MOST_LINES  # bytes


def numbers_in(samples: Iterable[tuple[float, Any]]) -> Series:
    """Return the numbers in a history of values: one line, or one for each item of a short list or vector."""
    pairs = [(when, _row(value)) for when, value in samples]
    # A value may have been a number and a list by turns: as many lines as the longest has items.
    width = max([len(row) for _, row in pairs if isinstance(row, list)], default=0)
    times = [when for when, _ in pairs]
    if not width:
        lines = [[finite(value) for _, value in pairs]]
    else:
        rows = [row if isinstance(row, list) else [row] for _, row in pairs]
        lines = [[finite(row[index]) if index < len(row) else None for row in rows] for index in range(width)]
    if all(number is None for line in lines for number in line):
        return Series([], [], [])
    return Series([f"[{index}]" for index in range(width)] if width else [""], times, lines)


# Silence is worth a mark from so many times the usual pause on, and so many seconds, where so many updates came.
_LONG_PAUSE, _SHORTEST_SILENCE, _FEWEST = 10, 0.5, 8


def silences(times: Sequence[float] | np.ndarray[Any, Any], end: float) -> list[tuple[float, float]]:
    """Return the spans in which nothing came of what usually comes more often, until `end`."""
    if len(times) <= _FEWEST:
        return []
    pauses = np.diff(np.append(times, max(end, times[-1])))
    # The first is the beginning of what is known, and no update.
    long = max(_LONG_PAUSE * float(np.median(pauses[1:-1])), _SHORTEST_SILENCE)
    places = np.flatnonzero(pauses > long).tolist()
    return [(float(times[place]), float(times[place] + pauses[place])) for place in places]


def thinned(columns: np.ndarray[Any, Any], most: int) -> list[int]:
    """Return about so many rows to draw, those where a column has its extremes among them; all if there are no more."""
    count, curves = columns.shape
    if count <= most:
        return list(range(count))
    step = -(-count * 2 * curves // most)
    chosen = {0, count - 1}
    for edge in range(0, count, step):
        piece = columns[edge : edge + step].astype(np.float64)
        for substitute, pick in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            chosen.update((edge + pick(np.where(np.isnan(piece), substitute, piece), axis=0)).tolist())
    return sorted(chosen)


def _row(value: Any) -> Any:
    """Return the items of a short list or vector, None for a longer one, and anything else as it is."""
    array = value.whole if isinstance(value, Frame) else value
    if isinstance(array, np.ndarray):
        return (
            array.tolist() if array.ndim == 1 and 0 < array.size <= MOST_LINES and array.dtype.kind in "biuf" else None
        )
    return (value if 0 < len(value) <= MOST_LINES else None) if isinstance(value, list) else value


def is_small_vector(value: Any) -> bool:
    """Return whether an array, or what is known of one, may be so small that its items are drawn over time."""
    return isinstance(value, Unfetched | Frame | np.ndarray) and described(value).size <= _LARGEST_VECTOR


def finite(value: Any) -> float | None:
    if type(value) is not float and not isinstance(value, bool | int | float):
        return None
    number = float(value)
    return number if math.isfinite(number) else None


def counted(times: Iterable[float] | np.ndarray[Any, Any], start: float, end: float, bins: int) -> list[int]:
    """Return how many of the times fall into each of `bins` equal parts of a span."""
    given = times if isinstance(times, np.ndarray) else np.fromiter(times, np.float64)
    inside = given[(given >= start) & (given <= end)]
    width = max(end - start, 1e-9) / bins
    # What happened at the very end belongs to the last part.
    places = np.minimum(((inside - start) / width).astype(np.int64), bins - 1)
    return [int(count) for count in np.bincount(places, minlength=bins)]
