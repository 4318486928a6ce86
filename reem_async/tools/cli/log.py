"""`reem play` and `reem log`: what is done with a recording."""

from __future__ import annotations

import asyncio
import datetime
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...connection import RedisInterface
from .export import export
from .following import progress
from .options import AsJson, More, Only, Recording, with_server
from .output import clean, columns, counted, emit, emit_json, figures, named, progress_bar, size_text, styled
from .running import USAGE, CommandFailed, run_local

if TYPE_CHECKING:
    from ..recording import ChannelSummary, Log, Replayer, ReplayStatus

_NOTICED_LAG = 0.1
"""Seconds behind the pace that are worth a word."""


@with_server("play", live=True)
async def play(
    interface: RedisInterface,
    file: Recording,
    patterns: Only = None,
    more: More = None,
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
) -> int:
    """Publish a recording again, at the pace at which it was recorded.

    First the state at the start is published, then every update in its turn, bit for bit.
    If the server is slower than the pace, nothing is left out, and the lag is reported. Damaged and unrecorded values
    are left out and counted, and the exit code is 1.

    Examples:
        reem play run.mcap
        reem play run.mcap --start 12.5 --rate 0.5 --loop
        reem play run.mcap 'cam_*' --remap cam_left=camera
        reem play run-0001.mcap --with run-0002.mcap
    """
    from ..recording import Replayer, open_log

    names = dict(_pair(text) for text in remap or ())
    with open_log([file, *(more or ())]) as log:
        replayer = Replayer(
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
                async with progress(
                    lambda: _progress(replayer), lambda: figures(replayer.status, 6), 0.1, as_json=as_json
                ):
                    await replayer.play()
        finally:
            _end(replayer.status, file, as_json)
        # What is damaged is left out and the rest is played; the exit code tells scripts.
        return 1 if replayer.status.unreadable else 0


def _pair(text: str) -> tuple[str, str]:
    old, found, new = text.partition("=")
    if not found or not old or not new:
        raise CommandFailed(f"--remap {text} is not of the form OLD=NEW", USAGE)
    return old, new


async def _step(replayer: Replayer, log: Log, as_json: bool) -> None:
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
    except PermissionError:  # a file is always ready
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


def _progress(replayer: Replayer) -> str:
    status = replayer.status
    done, length = status.position - replayer.start, replayer.end - replayer.start
    lag = f"  {status.lag:.2f} s behind" if status.lag > _NOTICED_LAG else ""
    rounds = f"  round {status.rounds + 1}" if status.rounds else ""
    return f"{done:.1f}/{length:.1f} s  {status.published} published{rounds}{lag}"


def _end(status: ReplayStatus, file: Path, as_json: bool) -> None:
    if as_json:
        emit_json(figures(status, 6) | {"ended": True})
        return
    text = f"{file}: {status.published} published"
    if status.refused:
        text += f", {status.refused} refused by the server (nothing there to write into)"
    if status.unreadable:
        text += f"; {status.unreadable} damaged or not recorded and left out (see reem log info --verify)"
    if status.most_lag > _NOTICED_LAG:
        text += f"; the server was slower than the pace, at most {status.most_lag:.2f} s behind"
    emit(clean(text))


app = typer.Typer(
    help="Look into recordings, and export them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


@app.command()
def info(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="The recording; several are read as one.")],
    verify: Annotated[bool, typer.Option("--verify", help="Read all of the file and count what is damaged.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show what a recording holds: when, what, how often, how much, and what is missing.

    A path may have three channels: published values, those marked (stored), and those marked (read), which the
    recorder read from the server at the start, after a loss, or as samples.
    The exit code is 1 if a part of the file was found to be damaged or missing.
    """

    def work() -> int:
        from ..recording import open_log

        with ExitStack() as stack:
            with progress_bar() as bar:
                log = stack.enter_context(open_log(files, progress=bar("opening")))
                if verify:
                    log.verify(bar("checking"))
                channels = log.channels(bar("counting"))
            if as_json:
                emit_json(_summary(log, channels))
            else:
                _print(log, channels)
            return 1 if log.unreadable else 0

    run_local("log info", work)


def _summary(log: Log, channels: list[ChannelSummary]) -> dict[str, Any]:
    return {
        "file": str(log.path),
        "files": [str(file) for file in log.files],
        "bytes": _size(log),
        "start": log.start,
        "end": log.end,
        "duration": log.duration,
        "complete": log.indexed,
        "damaged": log.damaged,
        "unreadable": log.unreadable,
        "gaps": [{"time": time, "path": path, "missed": missed} for time, path, missed in log.gaps()],
        "metadata": log.metadata,
        "channels": [asdict(each) | {"rate": each.rate} for each in channels],
    }


def _size(log: Log) -> int:
    return sum(file.stat().st_size for file in log.files)


def _print(log: Log, channels: list[ChannelSummary]) -> None:
    metadata = log.metadata
    damage = f"; {log.damaged} records are damaged or missing" if log.damaged else ""
    if log.unreadable > log.damaged:
        damage += f"; {counted(log.unreadable, 'message')} cannot be decoded as its schema says"
    complete = "complete" if log.indexed else "not ended properly: the last second may be missing"
    # First what was recorded, then what REEM notes of it.
    order = sorted(channels, key=lambda each: each.topic.startswith("/_reem"))
    # Channels of REEM itself (/_reem/...) say which top-level key they are about.
    rows = [
        (
            clean(each.topic or '""'),
            clean(f"{each.role} {each.path}".strip() if each.topic.startswith("/_reem") else _role(each)),
            clean(each.schema),
            str(each.messages),
            f"{each.rate:.1f} Hz" if each.messages > 1 else "-",
            size_text(each.bytes),
        )
        for each in order
    ]
    columns(rows, ("bold", "", "cyan", "", "yellow", "green"), right=frozenset({3, 4, 5}), shrink=(0, 2, 1))
    emit("")
    lines = [
        ("file", f"{named([str(file) for file in log.files])}, {size_text(_size(log))}, {complete}{damage}"),
        ("time", f"{_when(log.start)} to {_when(log.end)}, {log.duration:.1f} s"),
        ("messages", f"{sum(each.messages for each in channels)} in {len(channels)} channels"),
    ]
    if log.foreign:
        profile = f", profile {metadata['profile']}" if metadata.get("profile") else ""
        lines.append(("recorded", f"by another program: {metadata.get('library') or 'unnamed'}{profile}"))
        lines += [("skipped", text) for text in _skipped(channels)]
    if metadata.get("host") or not log.foreign:
        who = f"{metadata.get('user', '')}@{metadata.get('host', '')}"
        lines.append(("recorded", f"{metadata.get('patterns') or 'samples'} by {who}"))
        lines += [("server", metadata.get("server", "")), ("missing", _missing(log))]
    for label, text in lines:
        emit(styled(f"{label:9}", "cyan") + clean(text))


def _skipped(channels: list[ChannelSummary]) -> Iterator[str]:
    """Yield what is left out for each reason."""
    for reason in dict.fromkeys(each.skipped for each in channels if each.skipped):
        those = [each for each in channels if each.skipped == reason]
        messages = counted(sum(each.messages for each in those), "message")
        topics = [each.topic or '""' for each in those]
        yield f"{messages} of {named(topics)}: {reason}"


def _role(each: ChannelSummary) -> str:
    """Return what the messages of a channel are, and where they come from if they were not published."""
    if each.skipped:
        return "skipped"
    return each.role + {"stored": " (stored)", "kvs": " (read)"}.get(each.kind, "")


def _missing(log: Log) -> str:
    counts = log.metadata
    if "messages" not in counts:
        # A recorder that was killed did not write its counters.
        counts = dict.fromkeys(("dropped", "skipped"), "?")
    gaps = list(log.gaps())
    text = f"{counts.get('dropped')} dropped, {counts.get('skipped')} skipped, {len(gaps)} gaps"
    words = {"lost": "unreadable or not recordable", "samples late": "samples late", "samples failed": "samples failed"}
    text += "".join([f", {counts[name]} {word}" for name, word in words.items() if counts.get(name, "0") != "0"])
    worst = [
        f"{key.removeprefix('not recorded: ')} {value}" for key, value in counts.items() if key.startswith("not rec")
    ]
    # Of a part of a recording, the counts are those of all parts until its end.
    part = log.metadata.get("split", "").rpartition(" ")[2]
    since = (
        ", counted from the first file of the recording on" if part.isdecimal() and int(part) > len(log.files) else ""
    )
    return text + (f" ({', '.join(worst[:5])})" if worst else "") + since


def _when(instant: float) -> str:
    return f"{datetime.datetime.fromtimestamp(instant).astimezone():%Y-%m-%d %H:%M:%S %Z}"


app.command()(export)
