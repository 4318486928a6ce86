"""`reem log`: what is in a recording, and out of it into other formats."""

from __future__ import annotations

import datetime
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reem_async.tools.cli.bar import progress_bar
from reem_async.tools.cli.options import AsJson, Force
from reem_async.tools.cli.output import clean, columns, emit, emit_json, note, size_text, styled
from reem_async.tools.cli.record import tools
from reem_async.tools.cli.running import guarded

if TYPE_CHECKING:
    from reem_async.tools.recording import ChannelSummary, Log

__all__ = ["app"]

app = typer.Typer(
    help="Look into recordings, and export them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

_File = Annotated[Path, typer.Argument(metavar="FILE", help="The recording.")]


@app.command()
def info(
    file: _File,
    verify: Annotated[bool, typer.Option("--verify", help="Read all of the file and count what is damaged.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show what a recording holds: when, what, how often, how much, and what is missing."""

    def work() -> int:
        with ExitStack() as stack:
            with progress_bar() as bar:
                log = stack.enter_context(tools("open_log")(file, progress=bar("opening")))
                if verify:
                    log.verify(bar("checking"))
                channels = log.channels(bar("counting"))
            if as_json:
                emit_json(_summary(log, channels))
            else:
                _print(log, channels)
            return 1 if verify and log.damaged else 0

    _guard("log info", work)


def _guard(name: str, work: Any) -> None:
    code = guarded(name, work)
    if code:
        raise typer.Exit(code)


def _summary(log: Log, channels: list[ChannelSummary]) -> dict[str, Any]:
    return {
        "file": str(log.path),
        "bytes": log.path.stat().st_size,
        "start": log.start,
        "end": log.end,
        "duration": log.duration,
        "complete": log.indexed,
        "damaged": log.damaged,
        "gaps": [{"time": time, "path": path, "missed": missed} for time, path, missed in log.gaps()],
        "metadata": log.metadata,
        "channels": [_channel(each) for each in channels],
    }


def _channel(each: ChannelSummary) -> dict[str, Any]:
    names = ("topic", "path", "role", "kind", "schema", "messages", "bytes", "first", "last", "rate")
    return {name: getattr(each, name) for name in names}


def _print(log: Log, channels: list[ChannelSummary]) -> None:
    metadata = log.metadata
    damage = f"; {log.damaged} damaged records are skipped" if log.damaged else ""
    complete = "complete" if log.indexed else "not ended properly: the last second may be missing"
    # First what was recorded, then what REEM notes of it.
    order = sorted(channels, key=lambda each: each.topic.startswith("/_reem"))
    # Channels of REEM itself (/_reem/...) say which top-level key they are about.
    rows = [
        (
            clean(each.topic),
            clean(f"{_role(each)} {each.path}".strip() if each.topic.startswith("/_reem") else _role(each)),
            clean(each.schema),
            str(each.messages),
            f"{each.rate:.1f} Hz",
            size_text(each.bytes),
        )
        for each in order
    ]
    columns(rows, ("bold", "", "cyan", "", "yellow", "green"), right=frozenset({3, 4, 5}), shrink=(0, 2, 1))
    emit("")
    lines = [
        ("file", f"{log.path}, {size_text(log.path.stat().st_size)}, {complete}{damage}"),
        ("time", f"{_when(log.start)} to {_when(log.end)}, {log.duration:.1f} s"),
        ("messages", f"{sum(each.messages for each in channels)} in {len(channels)} channels"),
        (
            "recorded",
            f"{metadata.get('patterns') or 'samples'} by {metadata.get('user', '')}@{metadata.get('host', '')}",
        ),
        ("server", metadata.get("server", "")),
        ("missing", _missing(log)),
    ]
    for label, text in lines:
        emit(styled(f"{label:9}", "cyan") + clean(text))


def _role(each: ChannelSummary) -> str:
    """Return what the messages of a channel are, and whether nobody has published them."""
    return f"{each.role} (stored)" if each.kind == "stored" else each.role


def _missing(log: Log) -> str:
    counts = log.metadata
    if "messages" not in counts:
        # A recorder that was killed did not write its counters.
        counts = dict.fromkeys(("dropped", "skipped"), "?")
    gaps = list(log.gaps())
    text = f"{counts.get('dropped')} dropped, {counts.get('skipped')} skipped, {len(gaps)} gaps"
    words = {"lost": "not recordable", "samples late": "samples late", "samples failed": "samples failed"}
    text += "".join([f", {counts[name]} {word}" for name, word in words.items() if counts.get(name, "0") != "0"])
    worst = [
        f"{key.removeprefix('not recorded: ')} {value}" for key, value in counts.items() if key.startswith("not rec")
    ]
    return text + (f" ({', '.join(worst[:5])})" if worst else "")


def _when(instant: float) -> str:
    """Return an instant in local time, with the name of the zone."""
    return f"{datetime.datetime.fromtimestamp(instant).astimezone():%Y-%m-%d %H:%M:%S %Z}"


@app.command()
def export(
    file: _File,
    patterns: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PATTERN]...", show_default=False, help="Only these paths; all if there is none."),
    ] = None,
    to: Annotated[str, typer.Option("--to", metavar="FORMAT", help="csv, npz or parquet.")] = "csv",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="The file; the recording's name with another end if not given."
        ),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a recording as CSV, npz or Parquet.

    CSV and Parquet have a row for each update and a column for each number or text; npz has an array of
    all values for each path, pictures too, and their times.
    """

    def work() -> int:
        open_log = tools("open_log")
        from reem_async.tools.recording.export import check_format
        from reem_async.tools.recording.export import export as write

        check_format(to)  # before it becomes a part of a name
        with open_log(file) as log:
            target = output or file.with_suffix(f".{to}")
            result = write(log, to, target, patterns or ["*"], overwrite=force)
        for path, why in result.left_out.items():
            note(f"left out: {path}: {why}")
        if result.time != "time":
            note(f"the column of instants is {result.time}: time is a path of the recording")
        if result.unreadable:
            note(f"{result.unreadable} updates are damaged or were not recorded (see reem log info --verify)")
        if as_json:
            names = ("rows", "columns", "left_out", "time", "unreadable")
            emit_json({"file": str(target)} | {name: getattr(result, name) for name in names})
        else:
            emit(
                clean(
                    f"{target}: {len(result.columns)} columns, {result.rows} rows, {size_text(target.stat().st_size)}"
                )
            )
        return 1 if result.unreadable else 0

    _guard("log export", work)
