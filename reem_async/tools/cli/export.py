"""`reem log export`: a recording as a table of updates, or its episodes as a training set."""

from __future__ import annotations

import datetime
import shutil
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...errors import BadValue
from .options import AsJson, Force, More, Only, Recording
from .output import clean, counted, emit, emit_json, note, progress_bar, size_text
from .running import run_local

if TYPE_CHECKING:
    from ..recording.training import ExportedEpisode, TrainingSet

_STDOUT = Path("-")
_TRAINING = "Training sets"


def _paths(name: str, what: str) -> Any:
    return typer.Option(
        name, metavar="PATH", show_default=False, rich_help_panel=_TRAINING, help=f"{what}; may be given several times."
    )


def export(
    file: Recording,
    patterns: Only = None,
    more: More = None,
    to: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="FORMAT",
            show_default=False,
            help="csv, npz or parquet, else the end of FILE, or csv; with --rate npz, parquet or lerobot.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            show_default=False,
            help="The file; - is the standard output, for csv. The recording's name with another end if not given.",
        ),
    ] = None,
    force: Force = False,
    rate: Annotated[
        float | None,
        typer.Option(metavar="HZ", show_default=False, rich_help_panel=_TRAINING, help="Frames per second."),
    ] = None,
    state: Annotated[list[str] | None, _paths("--state", "Numbers that are observed")] = None,
    action: Annotated[list[str] | None, _paths("--action", "Numbers that are commanded")] = None,
    image: Annotated[list[str] | None, _paths("--image", "Pictures")] = None,
    episodes: Annotated[
        str, typer.Option(metavar="PATH", rich_help_panel=_TRAINING, help="Where a dict is while an episode goes on.")
    ] = "episode",
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[PATH=]METHOD",
            show_default=False,
            rich_help_panel=_TRAINING,
            help="nearest (in time, the default), previous or linear, for all paths or one.",
        ),
    ] = None,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[PATH=]SECONDS",
            show_default=False,
            rich_help_panel=_TRAINING,
            help="How far a value may be away from its frame; 3/4 of a frame if not given.",
        ),
    ] = None,
    clock: Annotated[
        str,
        typer.Option(
            "--clock",  # typer 0.27.0 takes a metavar that is the name for the option itself
            metavar="CLOCK",
            rich_help_panel=_TRAINING,
            help="Whose times count: recorder, or publisher, where all publishers have clocks that agree.",
        ),
    ] = "recorder",
    max_missing: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            show_default=False,
            rich_help_panel=_TRAINING,
            help="Fail if a larger share of the frames of an episode is missing, such as 0.01.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a recording as CSV, npz or Parquet, or its episodes as a training set.

    CSV and Parquet have a row for each update and a column for each number or text; npz has an array of
    all values for each path, pictures too, and their times.

    With --rate, a training set has a row for each frame of each episode that was not discarded, with the values that
    are nearest in time. Frames in which a value is missing are left out and counted.

    Examples:
        reem log export run.mcap arm --to csv
        reem log export run.mcap --to parquet --rate 30 --state arm.q --action cmd.q --image cam.rgb
    """

    def work() -> int:
        from ..recording import open_log
        from ..recording.training import TrainingSet, export_training

        if rate is None:
            if state or action or image:
                raise BadValue("--state, --action and --image make a training set, which needs --rate")
            return _table([file, *(more or ())], patterns, to, output, force=force, as_json=as_json)
        if patterns:
            raise BadValue(f"with --rate, name paths with --state, --action or --image, not {patterns[0]}")
        kind = _format(to, output, ("parquet", "npz", "lerobot"))
        target = output or file.with_suffix(".lerobot" if kind == "lerobot" else f".{kind}")
        with progress_bar() as bar, open_log([file, *(more or ())], progress=bar("opening")) as log:
            frames = TrainingSet(
                log,
                rate=rate,
                state=state or (),
                action=action or (),
                images=image or (),
                episodes=episodes,
                method=_by_path("--method", method, "nearest"),
                tolerance=_by_path("--tolerance", tolerance, None),
                clock=clock,
                max_missing=max_missing,
                progress=bar("exporting"),
            )
            export_training(frames, kind, target, overwrite=force)
        _report(frames, target, as_json=as_json)
        return 1 if log.unreadable else 0

    run_local("log export", work)


def _by_path(name: str, given: Sequence[str] | None, otherwise: Any) -> Any:
    """Return what was given for all paths, or a dict by path."""
    if not given:
        return otherwise
    found: dict[str, Any] = {}
    for text in given:
        path, _, value = text.rpartition("=")
        try:
            found[path] = float(value) if name == "--tolerance" else value
        except ValueError:
            raise BadValue(f"{name} {text} is not of the form SECONDS or PATH=SECONDS") from None
    if "" in found and len(found) > 1:
        raise BadValue(f"{name} is given for all paths and for {list(found)[-1]}; name each path")
    return found.get("", found)


def _report(frames: TrainingSet, target: Path, *, as_json: bool) -> None:
    if as_json:
        emit_json(
            {"file": str(target), "discarded": frames.discarded, "episodes": [asdict(each) for each in frames.reports]}
        )
        return
    if not frames.has_episodes:
        note("no dict marks an episode in the recording: all of it is one")
    for each in frames.reports:
        emit(clean(_line(each)))
    total = sum(each.frames for each in frames.reports)
    left = f", {counted(frames.discarded, 'episode')} discarded" if frames.discarded else ""
    emit(clean(f"{target}: {counted(len(frames.reports), 'episode')}, {counted(total, 'frame')}{left}"))


def _line(each: ExportedEpisode) -> str:
    begun = datetime.datetime.fromtimestamp(each.start).astimezone()
    missing = ", ".join([f"{path} {count}" for path, count in each.by_path.items()])
    said = [f"{counted(each.frames, 'frame')}", f"{each.missing} missing{f' ({missing})' if missing else ''}"]
    said += [] if each.ended else ["without an end: it ends with the recording"]
    head = f"episode {each.episode}, {begun:%H:%M:%S}, {each.end - each.start:.1f} s"
    return f"{head}: {', '.join(said)}  {each.task}".rstrip()


def _table(
    files: list[Path], patterns: list[str] | None, to: str | None, output: Path | None, *, force: bool, as_json: bool
) -> int:
    from ..recording import open_log
    from ..recording.export import FORMATS
    from ..recording.export import export as write

    kind, to_stdout = _format(to, output, tuple(FORMATS)), output == _STDOUT
    if to_stdout and as_json:
        raise BadValue("--json and the export would both be on the standard output; name a file with -o")
    with open_log(files) as log, ExitStack() as stack:
        target = output or files[0].with_suffix(f".{kind}")
        if to_stdout:
            target = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "export"
        result = write(log, kind, target, patterns or ["*"], overwrite=force)
        size = target.stat().st_size
        if to_stdout:
            with target.open(encoding="utf-8", newline="") as text:
                shutil.copyfileobj(text, sys.stdout)
    for path, why in result.left_out.items():
        note(f"left out: {path}: {why}")
    if result.time != "time":
        note(f"the column of instants is {result.time}: time is a path of the recording")
    if result.unreadable:
        note(f"{result.unreadable} updates are damaged or were not recorded (see reem log info --verify)")
    if as_json:
        names = ("rows", "columns", "left_out", "time", "unreadable")
        emit_json({"file": str(target)} | {name: getattr(result, name) for name in names})
    elif not to_stdout:
        emit(clean(f"{target}: {len(result.columns)} columns, {result.rows} rows, {size_text(size)}"))
    return 1 if result.unreadable else 0


def _format(to: str | None, output: Path | None, formats: Sequence[str]) -> str:
    """Return the format of an export; BadValue if there is none of this name, or the file's name is that of another."""
    end = "" if output is None else output.suffix.removeprefix(".").lower()
    by_name = formats[0] if output in (None, _STDOUT) else end
    kind = by_name if to is None else to
    if to is None and kind not in formats:
        ends = ", ".join([f".{each}" for each in formats])
        raise BadValue(f"no format is known by the name {output}; let it end in one of {ends}, or give --to")
    if kind not in formats:
        raise BadValue(f"{kind!r} is none of {', '.join(formats)}")
    if end in formats and end != kind:
        raise BadValue(f"--to {kind} does not fit the name {output}; leave out --to, or choose another name")
    if output == _STDOUT and kind != "csv":
        raise BadValue(f"{kind} is not text and is not written to the standard output; name a file with -o")
    return kind
