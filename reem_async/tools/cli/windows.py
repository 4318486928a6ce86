"""The last updates of one path, and what they say: rate, bytes, delay."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from statistics import fmean, pstdev
from typing import TYPE_CHECKING, Any, NamedTuple

from reem_async.tools.cli.output import size_text

if TYPE_CHECKING:
    from reem_async.pubsub.monitor import Event

__all__ = ["ALL", "BANDWIDTH", "DELAY", "RATE", "Measure", "Spread", "Window", "spread"]


# Publishers of one path that are remembered; the one that was silent longest goes first.
_MOST_SPEAKERS = 16
_SPEAKER_SECONDS = 10.0
"""Who has not published for so long, while others did, has ended; likewise who has not used shared memory."""


class Window:
    """The last updates of one path.

    Args:
        length: How many of them count.

    Attributes:
        total: How many there were.
        lost: How many were lost on the way.
    """

    def __init__(self, length: int) -> None:
        self._length = length
        self.total = 0
        self.lost = 0
        self.received: deque[float] = deque(maxlen=length)
        self.delays: deque[float] = deque(maxlen=length)
        self.sizes: deque[int] = deque(maxlen=length)
        self._speakers: dict[str, list[float]] = {}
        self._last_local = 0.0

    def add(self, event: Event) -> None:
        """Enter an update."""
        self.total += 1
        self.lost += event.missed
        self.received.append(event.received)
        self.delays.append(event.received - event.time)
        self.sizes.append(event.size)
        if event.local:
            self._last_local = event.received
        # When each was heard first and last. A program that was started anew has another id.
        times = self._speakers.setdefault(event.publisher, [event.received, event.received])
        times[1] = event.received
        if len(self._speakers) > _MOST_SPEAKERS:
            del self._speakers[min(self._speakers, key=lambda name: self._speakers[name][1])]

    @property
    def publishers(self) -> int:
        """How many publish at the same time: one that took over from another, as after a restart, counts alone."""
        if not self._speakers:
            return 0
        # Who was heard after the newest one began publishes beside it; who was not has been replaced by it.
        newest = max(first for first, _ in self._speakers.values())
        since = max(newest, self.received[-1] - _SPEAKER_SECONDS)
        return sum(last >= since for _, last in self._speakers.values()) or 1

    @property
    def local(self) -> bool:
        """Whether programs on a publisher's host could take one of the last updates from its memory."""
        return bool(self._last_local) and self._last_local >= self.received[-1] - _SPEAKER_SECONDS

    @property
    def age(self) -> float:
        """Seconds since the last update was received."""
        return max(time.time() - self.received[-1], 0.0) if self.received else 0.0

    @property
    def duration(self) -> float:
        """Seconds from the first to the last update in the window, by this machine's clock."""
        return self.received[-1] - self.received[0] if self.received else 0.0

    def rate(self) -> float | None:
        """Updates a second; None of fewer than two."""
        # n updates have n - 1 intervals between them.
        return (len(self.received) - 1) / self.duration if self.duration > 0 else None

    def bandwidth(self) -> float | None:
        """Bytes a second; None of fewer than two updates."""
        # The first one's bytes came at the beginning of the span, those of the others in it.
        return (sum(self.sizes) - self.sizes[0]) / self.duration if self.duration > 0 else None

    def intervals(self) -> list[float]:
        """Seconds between updates."""
        times = list(self.received)
        return [later - earlier for earlier, later in pairwise(times)]


class Spread(NamedTuple):
    """Mean, least, greatest and standard deviation."""

    mean: float
    min: float
    max: float
    std: float


def spread(values: Sequence[float]) -> Spread | None:
    """Return how `values` are spread; None if there is none."""
    if not values:
        return None
    return Spread(fmean(values), min(values), max(values), pstdev(values))


class Measure(NamedTuple):
    """What a live command measures.

    Attributes:
        headers: Of the columns after the path; the last ones may be left out on a narrow terminal.
        cells: What stands in these columns.
        line: The same in a line.
        data: The same for programs.
        remark: What one should know to read it.
    """

    headers: tuple[str, ...]
    cells: Callable[[Window], tuple[str, ...]]
    line: Callable[[Window], str]
    data: Callable[[Window], dict[str, Any]]
    remark: str


def _ms(seconds: float) -> str:
    return f"{seconds * 1000:.2f}"


def _spread_cells(it: Spread | None, text: Callable[[float], str]) -> tuple[str, ...]:
    return tuple([text(value) for value in it]) if it else ("-",) * 4


def _spread_line(it: Spread, text: Callable[[float], str]) -> str:
    return f"mean {text(it.mean)} min {text(it.min)} max {text(it.max)} std {text(it.std)}"


def _spread_data(it: Spread | None) -> dict[str, float] | None:
    return it._asdict() if it else None


def _hertz(rate: float | None) -> str:
    return "-" if rate is None else f"{rate:.2f}"


def _rate_line(window: Window) -> str:
    it = spread(window.intervals())
    if it is None:
        return "one update so far"
    return f"{_hertz(window.rate())} Hz, interval in ms: {_spread_line(it, _ms)}"


def _bandwidth_text(window: Window) -> str:
    rate = window.bandwidth()
    return "-" if rate is None else f"{size_text(rate)}/s"


def _bandwidth_line(window: Window) -> str:
    it = spread(window.sizes)
    return f"{_bandwidth_text(window)}, per update: {_spread_line(it, size_text)}" if it else "-"


def _delay_line(window: Window) -> str:
    it = spread(window.delays)
    return f"delay in ms: {_spread_line(it, _ms)}" if it else "-"


RATE = Measure(
    ("Hz", "mean ms", "min ms", "max ms", "std ms"),
    lambda window: (_hertz(window.rate()), *_spread_cells(spread(window.intervals()), _ms)),
    _rate_line,
    lambda window: {"hz": window.rate(), "interval_s": _spread_data(spread(window.intervals()))},
    "",
)
BANDWIDTH = Measure(
    ("bytes/s", "mean", "min", "max", "std"),
    lambda window: (_bandwidth_text(window), *_spread_cells(spread(window.sizes), size_text)),
    _bandwidth_line,
    lambda window: {"bytes_per_s": window.bandwidth(), "bytes": _spread_data(spread(window.sizes))},
    "of values as they are published; += and append() do not say their size and count as 0 bytes",
)
DELAY = Measure(
    ("mean ms", "min ms", "max ms", "std ms"),
    lambda window: _spread_cells(spread(window.delays), _ms),
    _delay_line,
    lambda window: {"delay_s": _spread_data(spread(window.delays))},
    "received here minus published there: if these are two machines, the difference of their clocks is in it",
)


def _mean_delay(window: Window) -> float:
    return fmean(window.delays) if window.delays else 0.0


def _all_cells(window: Window) -> tuple[str, ...]:
    several = " !" if window.publishers > 1 else ""
    return (
        _hertz(window.rate()),
        _bandwidth_text(window),
        _ms(_mean_delay(window)),
        f"{window.age:.1f}",
        f"{window.publishers}{several}",
        "yes" if window.local else "-",
    )


def _all_line(window: Window) -> str:
    hertz, bandwidth, delay, age, publishers, _ = _all_cells(window)
    way = ", through shared memory too" if window.local else ""
    return f"{hertz} Hz, {bandwidth}, delay {delay} ms, age {age} s, publishers {publishers}{way}"


ALL = Measure(
    ("Hz", "bytes/s", "delay ms", "age s", "publishers", "shared"),
    _all_cells,
    _all_line,
    lambda window: {
        "hz": window.rate(),
        "bytes_per_s": window.bandwidth(),
        "delay_s": _mean_delay(window),
        "age_s": window.age,
        "publishers": window.publishers,
        "local": window.local,
    },
    "delay: mean, from publishing to receiving; between machines their clocks' difference is in it; "
    "shared: programs on the publisher's host take its arrays from shared memory",
)
"""What `reem top` shows of each key."""
