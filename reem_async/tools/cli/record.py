"""`reem record`: updates and samples into an MCAP file."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...concurrency.queues import Last
from ...concurrency.tasks import come_second, keep_memory, stand_back
from ...connection import RedisInterface
from ...coordination.calls import statistics
from ...coordination.services import CALLS
from ...errors import BadValue, RedisError, ReemError
from ...store.store import KeyValueStore
from ...transport.options import look_nearby
from ..partfile import there_already
from .following import progress
from .options import DEFAULT_URL, AsJson, Force, Namespace, Patterns, Ships, Url, existing, named_ships
from .output import clean, emit, emit_json, figures, note, size_text
from .running import CommandFailed, guarded, run

if TYPE_CHECKING:
    from ...pubsub.subscribers import Watch
    from ..recording import Recorder, RecorderStatus

# Seconds between two lines that say how it is getting on.
_SHOWN_EVERY = 0.5
_MOST_EDGES = 1000  # values of the path of --on that wait
_ASKED_EVERY = 1.0  # seconds between two questions to the servers of services to publish their calls


def record(
    patterns: Patterns = None,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The file, MCAP.")] = Path("run.mcap"),
    sample: Annotated[
        Path | None, typer.Option(metavar="FILE", callback=existing, help="Read paths too: lines `path, seconds`.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(min=0.001, metavar="SECONDS", help="End after so long; until Ctrl-C otherwise.")
    ] = None,
    keyframe: Annotated[
        float, typer.Option(min=0.05, metavar="SECONDS", help="Write the whole of the keys so often.")
    ] = 5.0,
    compression: Annotated[str, typer.Option(metavar="NAME", help="zstd, lz4 or none.")] = "zstd",
    split: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE|TIME", help="Begin another file after so much, such as 1GB or 10min: run-0001.mcap."
        ),
    ] = None,
    force: Force = False,
    ships: Ships = None,
    last: Annotated[
        float | None,
        typer.Option(min=0.1, metavar="SECONDS", help="Keep so many in memory; write them at Ctrl-C, or see --on."),
    ] = None,
    on: Annotated[
        str | None, typer.Option("--on", metavar="PATH", help="With --last: write when the value there becomes true.")
    ] = None,
    after: Annotated[
        float, typer.Option(min=0.0, metavar="SECONDS", help="With --on: write what follows for so long, too.")
    ] = 5.0,
    services: Annotated[bool, typer.Option("--services", help="Record calls of services too, under _calls.")] = False,
    background: Annotated[bool, typer.Option("--background", help="Use only idle processor time.")] = False,
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Record what is published, and samples, into an MCAP file.

    Everything that is published under the patterns is recorded, arrays too, bit for bit. Plain writes are recorded a
    moment later and marked as stored; several in a moment may be merged into one. A user without the right
    +client|tracking gets them at each keyframe. With --sample, paths are read at given periods; without a pattern,
    only the samples are recorded. Ctrl-C completes the file. If the recorder is killed, all but the last second can
    be read. Unreadable values are marked in the file and counted. Values of a ship of your own need --ship.

    `recording into run.mcap` on standard error, or the first line of JSON, says that it has begun. The file holds
    everything that is published from then on. Ctrl-C before that leaves no file; the exit code is 130.

    The recorder gives way to the programs that it records, and uses the server's Unix socket where there is one.
    With --services, the servers of services publish each call that they have answered, with arguments, answer (or
    error) and seconds, under the key _calls, by service. It is removed at the end.

    With --last nothing is written at first. Ctrl-C writes the last seconds. With --on a file is written each time the
    value at a path becomes true, with {time} in its name in UTC, but not while another one is being written.
    The memory has 256 MB: what it cannot hold is dropped, oldest first, and counted.

    With --split the files are run-0001.mcap, run-0002.mcap and so on. Each can be read by itself; several are read as
    one: reem log info run-*.mcap.

    With --background it disturbs them least, but drops and counts updates if they use all processors.

    Examples:
        reem record -o run.mcap
        reem record arm 'cam_*' --duration 60
        reem record -o run.mcap --split 1GB
        reem record --background            beside a tight control loop
        reem record --services policy       its updates, and all calls
        reem record --sample keys.csv       its lines: arm.joint, 0.01
        reem record --last 60 --on fault.active -o 'crash-{time}.mcap'
    """
    if on is not None and last is None:
        raise typer.BadParameter("--on needs --last: how many seconds before it are written")
    wanted = list(patterns or ()) or ([] if sample is not None else ["*"])
    if services and "*" not in wanted:
        wanted.append(CALLS)

    async def work(interface: RedisInterface) -> int:
        from ..recording import Recorder

        # Before the recorder is made: threads that it starts inherit the scheduling.
        try:
            if background:
                stand_back()
            else:
                come_second()
        except (AttributeError, OSError) as error:
            raise CommandFailed(f"this system has nothing like --background ({error}); leave it out") from None
        # Frames of a megabyte come and go all the time; giving their pages back and asking for new ones costs more.
        keep_memory()
        look_nearby(interface.session.options)
        if output == Path("-"):
            raise BadValue("a recording is not text and is not written to the standard output; name a file with -o")
        if last is not None and output.exists() and not force:  # not only once there is something to be written
            raise BadValue(str(there_already(output)))
        # Refused here if the file is there already: nothing was sent for it yet.
        recorder = Recorder(
            *(interface, wanted, output),
            sample=sample,
            keyframe=keyframe,
            compression=compression,
            overwrite=force,
            split=split,
            last=last,
        )
        box = None if last is None else _Box(recorder, output, on, after, force=force, as_json=as_json)
        # Whether there is a recording: Ctrl-C before that ends with 130 and leaves no file.
        begun = False
        try:
            async with recorder:
                begun = True
                async with box.saving(interface) if box else nullcontext():
                    _begin(recorder, duration, as_json, box)
                    async with _calls(interface) if services else nullcontext(), _progress(recorder, as_json):
                        await recorder.wait(duration)
        except asyncio.CancelledError:  # Ctrl-C is how a recording ends; it may have failed all the same
            if not begun:  # there is no recording
                raise
            await recorder.stop()
        finally:
            if begun and box is None:
                _end(recorder, as_json)
                if not recorder.status.messages:
                    note(_nothing(wanted, recorder.status.failed))
        return 0

    with guarded("record"):
        own = named_ships(ships)
    run("record", work, url, namespace, ships=own)


@asynccontextmanager
async def _calls(interface: RedisInterface) -> AsyncIterator[None]:
    """Have the servers of services publish their calls meanwhile."""

    async def ask() -> None:
        while True:
            with suppress(ReemError, RedisError, OSError):  # an outage
                await statistics(interface.session, record=3 * _ASKED_EVERY)
            await asyncio.sleep(_ASKED_EVERY)

    asking = asyncio.create_task(ask())
    try:
        yield
    finally:
        asking.cancel()
        with suppress(ReemError, RedisError, OSError):
            await statistics(interface.session, record=0.001)
            await KeyValueStore(interface)[CALLS].delete()


class _Box:
    """What a black box writes, and when."""

    def __init__(
        self, recorder: Recorder, output: Path, on: str | None, after: float, *, force: bool, as_json: bool
    ) -> None:
        self._recorder = recorder
        self._output = output
        self._on = on
        self._after = after
        self._force = force
        self._as_json = as_json

    @property
    def when(self) -> str:
        return f"when {self._on} becomes true" if self._on is not None else "at Ctrl-C"

    @asynccontextmanager
    async def saving(self, interface: RedisInterface) -> AsyncIterator[None]:
        """Write when it is time, as long as the block runs; without a path that says so, at its end."""
        if self._on is None:
            try:
                yield
            finally:
                await self._save(0.0)
            return
        async with KeyValueStore(interface).at(self._on).watch(Last(_MOST_EDGES)) as updates:
            following = asyncio.create_task(self._follow(updates))
            try:
                yield
            finally:
                following.cancel()
                await asyncio.gather(following, return_exceptions=True)

    async def _follow(self, updates: Watch) -> None:
        was, saving = False, None
        try:
            async for update in updates:
                is_true = not update.deleted and _is_true(update.data)
                if is_true and not was and not update.initial and (saving is None or saving.done()):
                    saving = asyncio.create_task(self._save(self._after))
                was = is_true
        finally:
            if saving is not None:
                await saving

    async def _save(self, after: float) -> None:
        name = str(self._output).replace("{time}", time.strftime("%Y%m%dT%H%M%SZ", time.gmtime()))
        try:
            path = await self._recorder.save(name, after, overwrite=self._force)
        except ReemError as error:
            if self._on is None:
                raise
            # The next one may be written.
            note(f"not saved: {error}")
            return
        size = path.stat().st_size
        if self._as_json:
            emit_json({"saved": str(path), "bytes": size})
        else:
            emit(clean(f"saved {path}: {size_text(size)}; {_missing(self._recorder.status)}"))
        sys.stdout.flush()


def _is_true(value: Any) -> bool:
    return bool(value) if isinstance(value, bool | int | float | str | list | dict | None) else True


def _progress(recorder: Recorder, as_json: bool) -> AbstractAsyncContextManager[None]:
    def text() -> str:
        status = recorder.status
        line = f"{_clock(status.seconds)}  {status.messages} messages  {status.rate:.0f}/s"
        where = f"{size_text(status.file_bytes)} in the file" if status.file_bytes else "in memory"
        return f"{line}  {where}  {_missing(status)}"

    return progress(text, lambda: figures(recorder.status, 3), _SHOWN_EVERY, as_json=as_json)


def _begin(recorder: Recorder, duration: float | None, as_json: bool, box: _Box | None) -> None:
    """Say that it has begun: from now on nothing is missed, and Ctrl-C completes the file."""
    if as_json:
        emit_json(figures(recorder.status, 3))
    elif box is not None:
        note(f"recording into memory, and into {recorder.path} {box.when}")
    else:
        note(f"recording into {recorder.files[0]} " + ("until Ctrl-C" if duration is None else f"for {duration:g} s"))


def _nothing(patterns: list[str], failed: int) -> str:
    if not patterns:
        why = f"could be read: {failed} readings failed, and all others found nothing" if failed else "was there"
        return f"warning: nothing was recorded: none of the paths of the samples {why}"
    return (
        f"warning: nothing was recorded: nothing was published, and nothing is stored, under {', '.join(patterns)}; "
        "`reem ls` lists the keys, `reem top` what is published"
    )


def _end(recorder: Recorder, as_json: bool) -> None:
    status = recorder.status
    if as_json:
        names = [str(file) for file in recorder.files]
        emit_json(figures(status, 3) | {"file": names[0], "files": names, "ended": True})
        return
    size = sum(file.stat().st_size for file in recorder.files if file.exists())
    what = f"{status.messages} messages, {size_text(status.bytes)} in {_clock(status.seconds)}"
    first, *more = recorder.files
    name = f"{first} to {more[-1]}" if more else first
    emit(clean(f"{name}: {what}, {size_text(size)} in the file; {_missing(status)}"))


def _missing(status: RecorderStatus) -> str:
    extra = {
        "gaps": status.gaps,
        "unreadable or not recordable": status.lost,
        "steps of a publisher's clock": status.clock_steps,
        "samples late": status.late,
        "samples failed": status.failed,
    }
    found = [f"{count} {word}" for word, count in extra.items() if count]
    return ", ".join([f"{status.dropped} dropped", f"{status.skipped} skipped", *found])


def _clock(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60)
    return f"{int(minutes)}:{rest:04.1f}"
