"""`reem top`, and its views `hz`, `bw` and `delay`: measured from notices, without fetching what they announce."""

from __future__ import annotations

import asyncio
import os
import sys
import termios
import textwrap
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from statistics import fmean, pstdev
from typing import Any, NamedTuple

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from ...connection import RedisInterface
from ...coordination.calls import statistics
from ...errors import RedisError, ReemError
from ...pubsub.monitor import Event
from .following import Ending, follow
from .options import DEFAULT_URL, AsJson, Count, Namespace, Patterns, Timeout, Url
from .output import emit, emit_json, is_terminal, note, size_text, typed
from .programs import HEADS, service_cells
from .running import run

_WINDOW = 1000  # updates of a path that count: five seconds of an IMU at 200 Hz, half a minute of a camera
_DRAW_SECONDS = 0.25  # people can read numbers that change four times a second
_MOST_PATHS = 10_000  # that are kept: a program may publish under ever new names
_MOST_PUBLISHERS = 16  # of one path that are remembered; the one that was silent longest goes first
_PUBLISHER_SECONDS = 10.0  # of silence, while others publish, after which a publisher has ended
_STALE_SECONDS = 2.0  # of silence after which a row is dimmed


class Window:
    """The last updates of one path, and how many there were and were lost in all."""

    def __init__(self) -> None:
        self.total = 0
        self.lost = 0
        self.received: deque[float] = deque(maxlen=_WINDOW)
        self.delays: deque[float] = deque(maxlen=_WINDOW)
        self.sizes: deque[int] = deque(maxlen=_WINDOW)
        self._publishers: dict[str, list[float]] = {}  # the times of the first and the last update of each
        self._last_local = 0.0

    def add(self, event: Event) -> None:
        self.total += 1
        self.lost += event.missed
        self.received.append(event.received)
        self.delays.append(event.received - event.time)
        self.sizes.append(event.size)
        if event.local:
            self._last_local = event.received
        times = self._publishers.setdefault(event.publisher, [event.received, event.received])
        times[1] = event.received
        if len(self._publishers) > _MOST_PUBLISHERS:
            del self._publishers[min(self._publishers, key=lambda name: self._publishers[name][1])]

    @property
    def publishers(self) -> int:
        """How many publish at the same time; a program that was restarted, and so has a new id, counts once."""
        if not self._publishers:
            return 0
        # Publishers that were active after the newest one began run beside it. The newest one replaced the others.
        newest = max(first for first, _ in self._publishers.values())
        since = max(newest, self.received[-1] - _PUBLISHER_SECONDS)
        return sum(last >= since for _, last in self._publishers.values()) or 1

    @property
    def local(self) -> bool:
        """Whether programs on a publisher's host could take one of the last updates from its memory."""
        return bool(self._last_local) and self._last_local >= self.received[-1] - _PUBLISHER_SECONDS

    @property
    def age(self) -> float:
        return max(time.time() - self.received[-1], 0.0) if self.received else 0.0

    @property
    def _duration(self) -> float:
        return self.received[-1] - self.received[0] if self.received else 0.0

    def rate(self) -> float | None:
        # n updates have n - 1 intervals between them.
        return (len(self.received) - 1) / self._duration if self._duration > 0 else None

    def bandwidth(self) -> float | None:
        # The bytes of the first update came at the beginning of the span, all others within it.
        return (sum(self.sizes) - self.sizes[0]) / self._duration if self._duration > 0 else None

    def intervals(self) -> list[float]:
        return [later - earlier for earlier, later in pairwise(self.received)]


def spread(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"mean": fmean(values), "min": min(values), "max": max(values), "std": pstdev(values)}


class View(NamedTuple):
    """What one of the commands shows of a window: columns after the path, the same for programs, and a remark."""

    headers: tuple[str, ...]
    cells: Callable[[Window], tuple[str, ...]]
    data: Callable[[Window], dict[str, Any]]
    remark: str = ""


def _ms(seconds: float) -> str:
    return f"{seconds * 1000:.2f}"


def _hertz(window: Window) -> str:
    rate = window.rate()
    return "-" if rate is None else f"{rate:.2f}"


def _bandwidth(window: Window) -> str:
    rate = window.bandwidth()
    return "-" if rate is None else f"{size_text(rate)}/s"


def _spread_cells(values: Sequence[float], text: Callable[[float], str]) -> tuple[str, ...]:
    it = spread(values)
    return tuple(map(text, it.values())) if it else ("-",) * 4


def _mean_delay(window: Window) -> float:
    return fmean(window.delays) if window.delays else 0.0


RATE = View(
    ("Hz", "mean ms", "min ms", "max ms", "std ms"),
    lambda window: (_hertz(window), *_spread_cells(window.intervals(), _ms)),
    lambda window: {"hz": window.rate(), "interval_s": spread(window.intervals())},
)
BANDWIDTH = View(
    ("bytes/s", "mean", "min", "max", "std"),
    lambda window: (_bandwidth(window), *_spread_cells(window.sizes, size_text)),
    lambda window: {"bytes_per_s": window.bandwidth(), "bytes": spread(window.sizes)},
    "of values as they are published; += and append() do not say their size and count as 0 bytes",
)
DELAY = View(
    ("mean ms", "min ms", "max ms", "std ms"),
    lambda window: _spread_cells(window.delays, _ms),
    lambda window: {"delay_s": spread(window.delays)},
    "received here minus published there: if these are two machines, the difference of their clocks is in it",
)
ALL = View(
    ("Hz", "bytes/s", "delay ms", "age s", "publishers", "shared"),
    lambda window: (
        _hertz(window),
        _bandwidth(window),
        _ms(_mean_delay(window)),
        f"{window.age:.1f}",
        f"{window.publishers}{' !' * (window.publishers > 1)}",
        "yes" if window.local else "-",
    ),
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


class Board:
    """The windows of all paths that were updated; in the view of `reem top`, of all top-level keys."""

    def __init__(self, view: View) -> None:
        self.view = view
        self.windows: dict[str, Window] = {}
        self.services: list[dict[str, Any]] = []  # of the view of `reem top`: what the servers say, see `statistics`
        self._reported: dict[str, int] = {}

    def take(self, event: Event, _: Ending | None = None) -> None:
        path = event.path[:1] if self.view is ALL else event.path
        shown = typed(path) + (f" (raw {event.raw})" if event.raw else " (stored)" * event.stored)
        if shown in self.windows or len(self.windows) < _MOST_PATHS:
            window = self.windows.setdefault(shown, Window())
            for _unused in range(min(event.changes, _WINDOW)):
                window.add(event)

    def rows(self) -> list[tuple[str, Window]]:
        return sorted(self.windows.items(), key=lambda row: row[0])

    def report(self, *, as_json: bool, final: bool = False) -> None:
        """Print a line for each path with new updates; at the end, for each."""
        for path, window in self.rows():
            if not final and self._reported.get(path) == window.total:
                continue
            self._reported[path] = window.total
            if as_json:
                numbers = {"updates": window.total, "lost": window.lost}
                emit_json({"path": path, **self.view.data(window), **numbers, "time": time.time(), "final": final})
            else:
                cells = zip(self.view.headers, self.view.cells(window), strict=True)
                texts = [f"{title} {cell}" for title, cell in cells]
                emit(f"{path}: {', '.join(texts)}, updates {window.total}, lost {window.lost}")
        for row in self.services:
            if as_json:
                emit_json({**row, "time": time.time(), "final": final})
            else:
                emit(", ".join([f"{head} {cell}" for head, cell in zip(HEADS, service_cells(row), strict=True)]))
        sys.stdout.flush()

    async def ask_services(self, interface: RedisInterface) -> None:
        """Ask the servers of services each second how they are doing."""
        while True:
            with suppress(ReemError, RedisError, OSError):  # a missing right, or an outage: the updates are shown
                self.services = await statistics(interface.session)
            await asyncio.sleep(1.0)

    def doubled(self) -> dict[str, int]:
        """Return the paths that several programs publish at the same time, and how many they are."""
        return {path: it.publishers for path, it in self.rows() if it.publishers > 1}

    def warnings(self) -> list[str]:
        return [
            f"{path} is published by {count} interfaces at once: each overwrites what the others wrote"
            for path, count in self.doubled().items()
        ]


def table(board: Board, waiting: str, width: int, height: int) -> Group:
    """Return the board as a table that fits into a terminal of this size; without updates, the line `waiting`."""
    if not board.windows:
        return Group(Text(f"{waiting} (q or Ctrl-C ends)", style="dim"))
    rows = board.rows()
    notes = [_line(line, "dim") for line in textwrap.wrap(board.view.remark, width)]
    if board.view is ALL and (doubled := board.doubled()):
        notes.insert(0, _line(f"! several publishers, each overwrites the others: {', '.join(doubled)}", "yellow"))
    # One line is the table's head, and one is left for the cursor. What lies lower is cut off.
    room = height - 2 - len(notes)
    if len(rows) > room:
        shown = max(room - 1, 1)
        notes.insert(0, _line(f"… {len(rows) - shown} more paths; give a pattern to see them", "dim"))
        rows = rows[:shown]
    drawn = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    drawn.add_column("path", style="bold")  # the one column that a narrow terminal makes shorter
    for title in (*board.view.headers, "lost"):
        drawn.add_column(title, justify="right", no_wrap=True)
    for path, window in rows:
        is_doubled = board.view is ALL and window.publishers > 1
        name = Text(path, "yellow" if is_doubled else "", no_wrap=True, overflow="ellipsis")
        lost = Text(str(window.lost), "red" if window.lost else "")
        drawn.add_row(name, *board.view.cells(window), lost, style="dim" if window.age > _STALE_SECONDS else "")
    return Group(drawn, *notes)


def services_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return a line for each server of each service."""
    drawn = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for place, head in enumerate(HEADS):
        drawn.add_column(head, no_wrap=True, justify="right" if place > 1 else "left")
    for row in rows:
        drawn.add_row(*map(Text, service_cells(row)), style="red" if row["errors"] else "")
    return drawn


def _line(text: str, style: str) -> Text:
    return Text(text, style=style, no_wrap=True, overflow="ellipsis")


@contextmanager
def _drawing(board: Board, waiting: str) -> Iterator[Callable[[Ending | None], None]]:
    """Give what draws the board in place; the last state stays on the screen."""
    console = Console()
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:

        def draw(_: Ending | None = None) -> None:
            below = [services_table(board.services)] if board.services else []
            room = console.height - sum(each.row_count + 1 for each in below)
            live.update(Group(table(board, waiting, console.width, room), *below), refresh=True)

        draw()
        yield draw
        draw()


@contextmanager
def _ended_by_q() -> Iterator[None]:
    """Cancel this task when `q` is typed, if this program may read from the terminal."""
    if not sys.stdin.isatty() or os.tcgetpgrp(fd := sys.stdin.fileno()) != os.getpgrp():
        yield
        return
    task, loop, before = asyncio.current_task(), asyncio.get_running_loop(), termios.tcgetattr(fd)

    def on_key() -> None:
        if b"q" in os.read(fd, 64).lower() and task is not None:
            task.cancel()

    tty.setcbreak(fd)  # keys come at once and are not shown; Ctrl-C stays a signal
    loop.add_reader(fd, on_key)
    try:
        yield
    finally:
        loop.remove_reader(fd)
        termios.tcsetattr(fd, termios.TCSADRAIN, before)


def _command(name: str, view: View, text: str, *, stored: bool = False) -> Callable[..., None]:
    """Return the command that shows a view of updates, also of `stored` changes; `text` is its help."""

    def command(
        patterns: Patterns = None,
        count: Count = None,
        timeout: Timeout = None,
        as_json: AsJson = False,
        url: Url = DEFAULT_URL,
        namespace: Namespace = "",
    ) -> None:
        board, wanted = Board(view), patterns or ()
        # With an end (--timeout, --count) a script wants one report; without one, a report each second.
        period = 1.0 if timeout is None and count is None else None

        async def followed(interface: RedisInterface, period: float | None, tick: Callable[[Ending], None]) -> Ending:
            raw = None if view is DELAY else 0  # nothing says when they were written
            ends: dict[str, Any] = {"count": count, "seconds": timeout}
            return await follow(interface, wanted, board.take, **ends, every=period, tick=tick, stored=stored, raw=raw)

        async def work(interface: RedisInterface) -> int:
            if view is ALL:
                interface.session.tasks.start(board.ask_services(interface), "reem top of services")
            if is_terminal() and not as_json:
                waiting = f"waiting for updates of {', '.join(wanted) or 'any key'}"
                with _ended_by_q(), _drawing(board, waiting) as draw:
                    ending = await followed(interface, _DRAW_SECONDS, draw)
                return ending.tell()
            ending = await followed(interface, period, lambda _: board.report(as_json=as_json))
            board.report(as_json=as_json, final=True)
            for line in board.warnings() if view is ALL else ():
                note(f"warning: {line}")
            if view.remark and not as_json:
                note(view.remark)
            return ending.tell()

        run(name, work, url, namespace, live=True)

    command.__name__, command.__doc__ = name, text
    return command


top = _command(
    "top",
    ALL,
    """Show what is published and served: live tables of keys and services, until q or Ctrl-C (exit code 0).

The columns of a top-level key: updates a second, bytes a second, delay, seconds since the last update, and how many
programs publish it. A key with several publishers at once is marked, since each overwrites the other. "shared" says
that large updates also go through shared memory, to programs on the publisher's host that asked for them. Nothing is
fetched. Writes of a KeyValueStore do not count. Keys of programs without REEM are marked with their Redis type, such as
(raw string). The table of services has a line for each server, as `reem services`.

Examples:
    reem top
    reem top 'cam_*' imu
    reem top --timeout 5 --json
""",
)

hz = _command(
    "hz",
    RATE,
    """Measure how often paths are published or stored, until Ctrl-C (exit code 0).

Updates a second, and the time between two: mean, least, greatest, standard deviation, of the last
updates of each path. Large arrays are not fetched, so it costs the same for a number and an image. "lost"
counts updates that did not arrive here. Plain writes have "(stored)" behind their path. They are detected at most
1000 times a second, and several at once count as one.

Examples:
    reem hz
    reem hz raw_image set_point
    reem hz set_point --timeout 5 --json
""",
    stored=True,
)

bw = _command(
    "bw",
    BANDWIDTH,
    """Measure how many bytes are published, until Ctrl-C (exit code 0).

Bytes a second and bytes of one update: mean, least, greatest, of the last updates of each path.
Nothing is fetched: each notice says the size of its value. += and append() do not, and count as 0.

Examples:
    reem bw
    reem bw 'cam_*'
    reem bw raw_image --count 300 --json
""",
)

delay = _command(
    "delay",
    DELAY,
    """Measure the time from publishing to receiving, until Ctrl-C (exit code 0).

The time at which a notice is received here, minus the time that its publisher wrote into it, of
the last updates of each path. Both clocks matter: between two machines it also shows how far they
are apart, and may be negative; see `reem doctor`. Fetching a large value is not in it.

Examples:
    reem delay
    reem delay raw_image set_point
    reem delay set_point --timeout 5 --json
""",
)
