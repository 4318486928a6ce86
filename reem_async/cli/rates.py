"""`reem hz`, `reem bw` and `reem delay`: measured from notices, without fetching what they announce."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from reem_async.cli.following import Ending, follow
from reem_async.cli.options import DEFAULT_URL, AsJson, Count, Namespace, Patterns, Timeout, Url, WindowLength
from reem_async.cli.output import emit, emit_json, is_terminal, note, typed
from reem_async.cli.running import run
from reem_async.cli.windows import BANDWIDTH, DELAY, RATE, Measure, Window

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.monitor import Event

__all__ = ["bw", "delay", "hz"]

_WINDOW = 1000
_MOST_PATHS = 10_000
_SECONDS_PER_PICTURE = 0.25

Every = Annotated[
    float,
    typer.Option("--every", min=0.1, metavar="SECONDS", help="Time between reports where the output is no terminal."),
]


def _command(name: str, measure: Measure, text: str) -> Callable[..., None]:
    """Return the command that shows one measure of updates; `text` is its help."""

    def command(
        patterns: Patterns = None,
        window: WindowLength = _WINDOW,
        count: Count = None,
        timeout: Timeout = None,
        every: Every = 1.0,
        as_json: AsJson = False,
        url: Url = DEFAULT_URL,
        namespace: Namespace = "",
    ) -> None:
        board, wanted = Board(measure, window), patterns or ()

        async def work(interface: RedisInterface) -> int:
            if is_terminal() and not as_json:
                from reem_async.cli.picture import Picture

                waiting = f"waiting for updates of {', '.join(wanted) or 'any key'}"
                with Picture(board, waiting) as picture:
                    ending = await follow(
                        interface, wanted, board.take, count=count, seconds=timeout, every=_SECONDS_PER_PICTURE,
                        tick=lambda _: picture.draw(),
                    )  # fmt: skip
                return ending.tell()
            report = board.report_json if as_json else board.report
            ending = await follow(
                interface,
                patterns or (),
                board.take,
                count=count,
                seconds=timeout,
                every=every,
                tick=lambda _: report(),
            )
            report(final=True)
            if measure.remark and not as_json:
                note(measure.remark)
            return ending.tell()

        run(name, work, url, namespace, live=True)

    command.__name__, command.__doc__ = name, text
    return command


class Board:
    """The windows of all paths that were heard of.

    Args:
        measure: What is shown of them.
        length: How many updates of a path count.

    Attributes:
        windows: By path.
        unlisted: Updates of paths for which there was no more room.
    """

    def __init__(self, measure: Measure, length: int) -> None:
        self.measure = measure
        self.windows: dict[str, Window] = {}
        self.unlisted = 0
        self._length = length
        self._reported: dict[str, int] = {}

    def take(self, event: Event, _: Ending) -> None:
        """Enter an update."""
        path = typed(event.path)
        window = self.windows.get(path)
        if window is None:
            if len(self.windows) >= _MOST_PATHS:
                self.unlisted += 1
                return
            window = self.windows[path] = Window(self._length)
        window.add(event)

    def report(self, *, final: bool = False) -> None:
        """Print a line for each path with new updates; at the end, for each."""
        for path, window in self._due(final):
            emit(f"{path}: {self.measure.line(window)}, window {len(window.received)}, lost {window.lost}")
        sys.stdout.flush()

    def report_json(self, *, final: bool = False) -> None:
        """As `report`, for programs."""
        for path, window in self._due(final):
            numbers = {"updates": window.total, "window": len(window.received), "lost": window.lost}
            emit_json({"path": path, **self.measure.data(window), **numbers, "time": time.time(), "final": final})

    def _due(self, final: bool) -> list[tuple[str, Window]]:
        due = [(path, it) for path, it in self.windows.items() if final or self._reported.get(path) != it.total]
        self._reported = {path: it.total for path, it in self.windows.items()}
        return sorted(due, key=lambda pair: pair[0])


hz = _command(
    "hz",
    RATE,
    """Measure how often paths are published, until Ctrl-C (exit code 0).

Updates a second, and the time between two: mean, least, greatest, standard deviation, of the last
updates of each path. Nothing is fetched, so it costs the same for a number and an image. "lost"
counts updates that did not arrive here.

Examples:
    reem hz
    reem hz raw_image --window 100
    reem hz set_point --timeout 5 --json
""",
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
