"""`reem record`: updates and samples into an MCAP file."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reem_async.cli.options import DEFAULT_URL, AsJson, Namespace, Patterns, Url
from reem_async.cli.output import clean, cut, emit, emit_json, size_text, width
from reem_async.cli.running import Refused, prepared, run
from reem_async.courtesy import come_second, keep_memory, stand_back

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.recording import Recorder, RecorderStatus

__all__ = ["record"]

_SHOWN_EVERY = 0.5
_TOOLS = "recordings need {}: pip install 'reem[tools]'"


def record(
    patterns: Patterns = None,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The file, MCAP.")] = Path("run.mcap"),
    sample: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Read paths at given periods too: a line `path, seconds` for each."),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(min=0.001, metavar="SECONDS", help="End after so long; until Ctrl-C otherwise.")
    ] = None,
    keyframe: Annotated[
        float, typer.Option(min=0.05, metavar="SECONDS", help="Write the whole of the keys so often.")
    ] = 5.0,
    compression: Annotated[str, typer.Option(metavar="NAME", help="zstd, lz4 or none.")] = "zstd",
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it is there already.")] = False,
    background: Annotated[
        bool, typer.Option("--background", help="Take only processor time that nobody else wants.")
    ] = False,
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Record what is published, and samples, into an MCAP file.

    Everything that is published under the patterns is recorded, arrays too, bit for bit. What programs only
    store (KeyValueStore) is read at each keyframe; with --sample, as often as you like. With --sample and
    no pattern, only the samples are recorded. Ctrl-C ends the recording and completes the file; if it is
    killed, all but the last second can be read.

    The programs that are recorded come first. On the server's own machine it is read through its Unix socket,
    if it has one: that costs it less than TCP. With --background they notice the recorder least, but where
    they need every processor wholly, updates are missing from the recording; it says how many.

    Examples:
        reem record -o run.mcap
        reem record arm 'cam_*' --duration 60
        reem record --background            beside a tight control loop
        reem record --sample keys.csv       its lines: arm.joint, 0.01
    """
    wanted = list(patterns or ()) or ([] if sample is not None else ["*"])

    async def work(interface: RedisInterface) -> int:
        from reem_async.transport.nearby import look_nearby

        if background:
            _stand_back()
        else:
            come_second()
        keep_memory()
        look_nearby(interface.session.options)
        recorder = _recorder(interface, wanted, output, sample, keyframe, compression, force)
        try:
            async with recorder:
                shown = asyncio.create_task(_show(recorder, as_json))
                try:
                    await recorder.wait(duration)
                finally:
                    shown.cancel()
        finally:
            _end(recorder, as_json)
        return 0

    run("record", work, url, namespace, live=True)


def _stand_back() -> None:
    try:
        stand_back()
    except (AttributeError, OSError) as error:
        raise Refused(f"this system has nothing like --background ({error}); leave it out") from None


def _recorder(
    interface: RedisInterface,
    patterns: list[str],
    output: Path,
    sample: Path | None,
    keyframe: float,
    compression: str,
    force: bool,
) -> Recorder:
    kind = prepared("record", lambda: tools("Recorder"))
    recorder: Recorder = kind(
        interface, patterns, output, sample=sample, keyframe=keyframe, compression=compression, overwrite=force
    )
    return recorder


def tools(name: str) -> Any:
    """Return a name of `reem_async.recording`; Refused if what that needs is not installed."""
    try:
        from reem_async import recording
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package.startswith("reem"):
            raise
        raise Refused(_TOOLS.format(package)) from None
    return getattr(recording, name)


async def _show(recorder: Recorder, as_json: bool) -> None:
    """Show how it is getting on: a line that is written over on a terminal, lines of JSON for scripts."""
    before, then = recorder.status, time.monotonic()
    while True:
        await asyncio.sleep(1.0 if as_json else _SHOWN_EVERY)
        status, now = recorder.status, time.monotonic()
        rates = (status.messages - before.messages) / (now - then), (status.bytes - before.bytes) / (now - then)
        before, then = status, now
        if as_json:
            emit_json(_fields(status) | {"rate": round(rates[0], 1)})
        elif sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
            text = f"{_clock(status.seconds)}  {status.messages} messages  {rates[0]:.0f}/s  {size_text(rates[1])}/s"
            text += f"  {size_text(status.file_bytes)} in the file  {_missing(status)}"
            sys.stderr.write("\r" + cut(text, width() - 1) + "\x1b[K")
            sys.stderr.flush()


def _end(recorder: Recorder, as_json: bool) -> None:
    """Say what became of it."""
    status = recorder.status
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[K")
    if as_json:
        emit_json(_fields(status) | {"file": str(recorder.path), "ended": True})
        return
    size = recorder.path.stat().st_size if recorder.path.exists() else 0
    what = f"{status.messages} messages, {size_text(status.bytes)} in {_clock(status.seconds)}"
    emit(clean(f"{recorder.path}: {what}, {size_text(size)} in the file; {_missing(status)}"))


def _fields(status: RecorderStatus) -> dict[str, Any]:
    names = ("seconds", "messages", "bytes", "file_bytes", "dropped", "skipped", "gaps", "lost", "rate")
    return {name: round(getattr(status, name), 3) for name in names}


def _missing(status: RecorderStatus) -> str:
    extra = [f"{count} {word}" for count, word in ((status.gaps, "gaps"), (status.lost, "not recordable")) if count]
    return ", ".join([f"{status.dropped} dropped", f"{status.skipped} skipped", *extra])


def _clock(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60)
    return f"{int(minutes)}:{rest:04.1f}"
