"""`reem top`, `hz`, `bw` and `delay`: measured from notices, without fetching what they announce."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from reem_async.tools.cli.board import Board
from reem_async.tools.cli.following import follow
from reem_async.tools.cli.options import DEFAULT_URL, AsJson, Count, Namespace, Patterns, Timeout, Url, WindowLength
from reem_async.tools.cli.output import is_terminal, note
from reem_async.tools.cli.running import run
from reem_async.tools.cli.windows import ALL, BANDWIDTH, DELAY, RATE, Measure

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.plan.paths import Path

__all__ = ["bw", "delay", "hz", "top"]

# Updates of a path that count: five seconds of an IMU at 200 Hz, half a minute of a camera.
_WINDOW = 1000
# People can read numbers that change four times a second.
_SECONDS_PER_PICTURE = 0.25

Every = Annotated[
    float | None,
    typer.Option(
        "--every",
        min=0.1,
        metavar="SECONDS",
        show_default="1; with --timeout or --count one report, at the end",
        help="Time between reports where the output is no terminal.",
    ),
]


def _command(
    name: str,
    measure: Measure,
    text: str,
    place: Callable[[Path], Path] = lambda path: path,
    *,
    stored: bool = False,
) -> Callable[..., None]:
    """Return the command that shows one measure of updates, also of `stored` changes; `text` is its help.

    See `Board` for `place`.
    """

    def command(
        patterns: Patterns = None,
        window: WindowLength = _WINDOW,
        count: Count = None,
        timeout: Timeout = None,
        every: Every = None,
        as_json: AsJson = False,
        url: Url = DEFAULT_URL,
        namespace: Namespace = "",
    ) -> None:
        # With an end (--timeout, --count) a script wants one report; without one, a report each second.
        board, wanted = Board(measure, window, place), patterns or ()
        period = 1.0 if every is None and timeout is None and count is None else every

        async def work(interface: RedisInterface) -> int:
            if is_terminal() and not as_json:
                from reem_async.tools.cli.picture import Picture, ended_by_q

                waiting = f"waiting for updates of {', '.join(wanted) or 'any key'}"
                with ended_by_q(), Picture(board, waiting) as picture:
                    ending = await follow(
                        interface, wanted, board.take, count=count, seconds=timeout, every=_SECONDS_PER_PICTURE,
                        tick=lambda _: picture.draw(), stored=stored,
                    )  # fmt: skip
                return ending.tell()
            report = board.report_json if as_json else board.report
            ending = await follow(
                interface,
                patterns or (),
                board.take,
                count=count,
                seconds=timeout,
                every=period,
                tick=lambda _: report(),
                stored=stored,
            )
            report(final=True)
            if measure is ALL:
                for line in board.warnings():
                    note(f"warning: {line}")
            if measure.remark and not as_json:
                note(measure.remark)
            return ending.tell()

        run(name, work, url, namespace, live=True)

    command.__name__, command.__doc__ = name, text
    return command


top = _command(
    "top",
    ALL,
    """Show what is published: a live table of keys, until q or Ctrl-C (exit code 0).

Of each top-level key: updates a second, bytes a second, delay, seconds since the last update, and how many
programs publish it. Two that publish one key at once are marked, since each overwrites the other. "shared" says that
large updates also go through shared memory, to programs on the publisher's host that asked for them. Nothing is
fetched. What a KeyValueStore writes is not heard.

Examples:
    reem top
    reem top 'cam_*' imu
    reem top --timeout 5 --json
""",
    lambda path: path[:1],
)

hz = _command(
    "hz",
    RATE,
    """Measure how often paths are published or stored, until Ctrl-C (exit code 0).

Updates a second, and the time between two: mean, least, greatest, standard deviation, of the last
updates of each path. Large arrays are not fetched, so it costs the same for a number and an image. "lost"
counts updates that did not arrive here. What is only stored counts as often as it was found to be changed, with
"(stored)" behind its path: at most 1000 times a second, and several changes at once as one.

Examples:
    reem hz
    reem hz raw_image --window 100
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
