"""`reem play`: a recording, published again."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reem_async.tools.cli.options import DEFAULT_URL, AsJson, Namespace, Url
from reem_async.tools.cli.output import clean, emit, emit_json
from reem_async.tools.cli.record import tools
from reem_async.tools.cli.running import USAGE, Refused, run

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.tools.recording import Log, Replayer, ReplayStatus

__all__ = ["play"]

_NOTICED_LAG = 0.1
"""Seconds behind the pace that are worth a word."""


def play(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The recording.")],
    patterns: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PATTERN]...", show_default=False, help="Only these paths; all if there is none."),
    ] = None,
    rate: Annotated[
        float, typer.Option("--rate", "-r", min=0.001, max=1_000_000, metavar="N", help="N times as fast as it was.")
    ] = 1.0,
    start: Annotated[float, typer.Option(metavar="SECONDS", help="From so long after the beginning.")] = 0.0,
    end: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Until so long after the beginning of the recording.")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", "-l", help="Begin again at the end, until Ctrl-C.")] = False,
    step: Annotated[bool, typer.Option("--step", help="One update for each Enter.")] = False,
    remap: Annotated[
        list[str] | None, typer.Option(metavar="OLD=NEW", help="Another name for a top-level key; may be repeated.")
    ] = None,
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Publish a recording again, at the pace at which it was recorded.

    First all that there was at the start is published, then every update in its turn, bit for bit.
    If the server is slower than the pace, nothing is left out; how far it lags is said. What is damaged or was not
    recorded is left out, but not what is beside it; it is counted, and the exit code is 1.

    Examples:
        reem play run.mcap
        reem play run.mcap --start 12.5 --rate 0.5 --loop
        reem play run.mcap 'cam_*' --remap cam_left=camera
    """

    async def work(interface: RedisInterface) -> int:
        names = dict(_pair(text) for text in remap or ())
        with tools("open_log")(file) as log:
            replayer = tools("Replayer")(
                interface,
                log,
                rate=rate,
                start=log.start + start,
                end=None if end is None else log.start + end,
                loop=loop,
                patterns=patterns or ["*"],
                remap=names,
            )
            try:
                if step:
                    await _step(replayer, log, as_json)
                else:
                    async with _progress(replayer, as_json):
                        await replayer.play()
            finally:
                _end(replayer.status, file, as_json)
            # What is damaged is left out and the rest is played; the exit code tells scripts.
            return 1 if replayer.status.unreadable else 0

    run("play", work, url, namespace, live=True)


def _pair(text: str) -> tuple[str, str]:
    old, found, new = text.partition("=")
    if not found or not old or not new:
        raise Refused(f"--remap {text} is not of the form OLD=NEW", USAGE)
    return old, new


async def _step(replayer: Replayer, log: Log, as_json: bool) -> None:
    """Publish one update for each line of the input."""
    while True:
        update = await replayer.step()
        if update is None:
            return
        since = update.time - log.start
        what = "deleted" if update.deleted else ""
        if as_json:
            emit_json({"time": update.time, "since": round(since, 6), "path": update.shown, "deleted": update.deleted})
        else:
            emit(clean(f"{since:12.6f}  {update.shown}  {what}".rstrip()))
            sys.stdout.flush()
        if not await _line():
            return


async def _line() -> bool:
    """Wait for a line of the input, so that Ctrl-C ends the waiting; return whether there was one."""
    loop, ready = asyncio.get_running_loop(), asyncio.Event()
    try:
        loop.add_reader(sys.stdin.fileno(), ready.set)
    except (PermissionError, NotImplementedError):  # a file is always ready; Windows cannot wait so
        return bool(sys.stdin.readline())
    try:
        await ready.wait()
    finally:
        loop.remove_reader(sys.stdin.fileno())
    return bool(_read_line())


def _read_line() -> bytes:
    """Read one line without a buffer, which would keep the next ones from being waited for."""
    line = b""
    while not line.endswith(b"\n") and (byte := os.read(sys.stdin.fileno(), 1)):
        line += byte
    return line


@contextlib.asynccontextmanager
async def _progress(replayer: Replayer, as_json: bool) -> AsyncIterator[None]:
    """Show a bar on a terminal, a line of JSON a second for scripts."""
    task = asyncio.create_task(_report(replayer) if as_json else _draw(replayer))
    try:
        yield
    finally:
        # Before what became of it is said: the bar must not be drawn over that.
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def _report(replayer: Replayer) -> None:
    while True:
        await asyncio.sleep(1.0)
        emit_json(_fields(replayer.status))


async def _draw(replayer: Replayer) -> None:
    # In a log the bar would be a line for each time that it is drawn.
    if not sys.stderr.isatty():
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("{task.fields[clock]}"), BarColumn(None), TextColumn("{task.fields[text]}"))
    # A recording of one instant has no length, which the bar divides by.
    length = max(replayer.end - replayer.start, 1e-9)
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=length, clock="", text="")
        while True:
            status = replayer.status
            done = status.position - replayer.start
            lag = f"  {status.lag:.2f} s behind" if status.lag > _NOTICED_LAG else ""
            rounds = f"  round {status.rounds + 1}" if status.rounds else ""
            progress.update(
                task,
                completed=done,
                clock=f"{done:.1f}/{length:.1f} s",
                text=f"{status.published} published{rounds}{lag}",
            )
            await asyncio.sleep(0.1)


def _fields(status: ReplayStatus) -> dict[str, float]:
    names = ("position", "published", "refused", "lag", "most_lag", "rounds", "unreadable")
    return {name: round(getattr(status, name), 6) for name in names}


def _end(status: ReplayStatus, file: Path, as_json: bool) -> None:
    """Say what became of it."""
    if as_json:
        emit_json(_fields(status) | {"ended": True})
        return
    text = f"{file}: {status.published} published"
    if status.refused:
        text += f", {status.refused} refused by the server (nothing there to write into)"
    if status.unreadable:
        text += f"; {status.unreadable} damaged or not recorded and left out (see reem log info --verify)"
    if status.most_lag > _NOTICED_LAG:
        text += f"; the server was slower than the pace, at most {status.most_lag:.2f} s behind"
    emit(clean(text))
