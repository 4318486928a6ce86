"""Recorder: every update of some keys into an MCAP file."""

from __future__ import annotations

import asyncio
import contextlib
import os
import platform
import pwd
import threading
import time
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from types import TracebackType
from typing import Any, Self

import numpy as np

from ... import __version__
from ...concurrency.queues import Last
from ...concurrency.streams import arrived
from ...concurrency.tasks import give_way
from ...connection import RedisInterface
from ...coordination.clock import ServerClock
from ...errors import BadValue, InterfaceClosed, Misuse, RedisError
from ...plan.arguments import check_instance, check_number
from ...plan.paths import parse_patterns
from ...pubsub.manager import manager_of
from ...pubsub.monitor import Monitor
from ...pubsub.refresh import find_regularly
from ...session import Session
from .blackbox import BlackBox
from .format import RecordingFailed
from .key_recorder import RecordedKeys
from .output import FileGone
from .raw_keys import RawRecorder
from .sample import Sample, Sampler, samples_of
from .sink import SPLIT, Sink
from .split import Split
from .times import PATIENCE, Arrivals, Clock
from .writer_thread import Operation, WriterThread

# Seconds between looks at keyframes that are due, the disk, and keys that must be read again.
_TICK = 0.1
# Updates that may wait for the event loop: 25 seconds at 2 kHz.
_WAITING = 50_000
# Large values that are fetched at the same time: more would not be faster, and be more memory.
_FETCHES = 8
_CLOCK_READINGS = 4  # round trips
_PATIENCE = 3.0
"""Seconds in which what was announced before the end is still fetched."""
_NAMING = threading.RLock()
"""Held to ask the C library for a user's name: it has a lock that a child forked meanwhile would find taken."""
os.register_at_fork(before=_NAMING.acquire, after_in_parent=_NAMING.release, after_in_child=_NAMING.release)


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """How a recording is getting on.

    Attributes:
        seconds: Since it began.
        messages: Written; of a black box, in memory.
        bytes: Written, before compression; of a black box, in memory.
        file_bytes: In the file.
        dropped: Updates left out since the disk or this program could not keep up; of a black box, that went before
            their time since it may not take more memory.
        skipped: Updates that were announced, and that a newer one replaced, or changed inside, before they could be
            fetched: what they wrote cannot be had any more.
        gaps: How often updates were lost on the way from the server.
        lost: Values that could not be read, or are of custom types that are not made of bytes; marked in the file.
        late: Readings of samples left out since the ones before took too long.
        failed: Readings of samples that failed: what is there cannot be read, or the server did not answer.
        rate: Messages a second, on average.
        clock_steps: How often the publisher's times of a key went back by over 10 ms: its clock was set, or another
            program with another clock, or with updates that were longer on their way, publishes it.
    """

    seconds: float
    messages: int
    bytes: int
    file_bytes: int
    dropped: int
    skipped: int
    gaps: int
    lost: int
    late: int
    failed: int
    rate: float
    clock_steps: int


class Recorder:
    """Records what is published under some patterns of paths, and samples of others, into an MCAP file.

    A context manager: inside of the block it records. Values are as they were published, bit for bit,
    and in this order. A large one that others changed before it was fetched is skipped, and counted. At the
    beginning, every `keyframe` seconds and after each gap the whole of the keys is written, so that any
    instant can be rebuilt quickly. No publisher waits for the recorder. What it cannot keep up with it drops,
    and counts.

    What is only stored, by any client, is recorded a moment later (`LogUpdate.kind` is "stored"): several changes in a
    moment are one. So are keys of programs without REEM, as JSON, text or bytes, up to 64 MB; with a namespace, none.
    Where the user may not use CLIENT TRACKING, it is read at the keyframes, and a warning says so.

    The file can be read while it grows, and after the recorder was killed but for the last second. It
    is not synchronised to the disk: a power cut costs what the system had not written yet.

    Args:
        interface: The server.
        patterns: Globs such as "arm", "cam_*" or "robot.*.battery"; everything if not given. An empty
            list records samples only.
        path: The file; it must not exist.
        sample: Paths to read at given periods, in seconds: a dict, or a key file (lines `path, seconds`).
        keyframe: Seconds from one keyframe to the next.
        overwrite: Replace the file if it exists; it stays as it is until recording has begun.
        compression: "zstd", "lz4" or "none".
        queue_bytes: What may wait for the disk.
        split: Go on in another file after so much of a file or time, such as "1GB" or "10min". The files are
            run-0001.mcap, run-0002.mcap and so on. Each begins with all that is there, so it can be read by itself;
            `open_log` reads several as one.
        last: A black box: so many seconds are kept in memory, and there is no file but by `save`. `path` is not used.
        memory: Bytes that these may take, with what each key held before them. The oldest go before their time if they
            would take more, which `status.dropped` counts. Plain values that the keys hold are kept whatever they take.

    Raises:
        BadValue: The file exists, is being recorded or cannot be made, or an argument that means nothing.
        BadKey: A pattern or path that cannot be.
    """

    def __init__(
        self,
        interface: RedisInterface,
        patterns: Sequence[str] = ("*",),
        path: str | FilePath = "run.mcap",
        *,
        sample: dict[str, float] | str | FilePath | None = None,
        keyframe: float = 5.0,
        overwrite: bool = False,
        compression: str = "zstd",
        queue_bytes: int = 256 << 20,
        split: str | None = None,
        last: float | None = None,
        memory: int = 256 << 20,
    ) -> None:
        check_number("keyframe", keyframe, "use seconds, over 0", above=0)
        check_number("queue_bytes", queue_bytes, "use a number of bytes, 1 or more", least=1)
        check_number("memory", memory, "use a number of bytes, 1 or more", least=1)
        check_instance("path", path, (str, FilePath), "use the name of a file")
        if last is not None:
            check_number("last", last, "use seconds, over 0, or None for a file", above=0)
        if split is not None and last is not None:
            raise BadValue("split is for a recording into files, and a black box (last) keeps it in memory")
        self.path = FilePath(path)
        self._split = None if split is None else Split(split, self.path)
        if self._split is not None:
            self._split.refuse_others(overwrite=overwrite)
        self._overwrite = overwrite
        self.patterns = parse_patterns(patterns)
        self.session = interface.session.raw  # pictures go into the file as they are
        self.clock = Clock()
        self.arrivals = Arrivals(2 * PATIENCE)  # the system wakes no process at the very moment
        self.fetching = asyncio.Semaphore(_FETCHES)
        self._samples = samples_of(sample)
        if not self.patterns and not self._samples:
            raise BadValue("nothing to record: give a pattern such as '*', or paths to sample")
        self._keyframe_seconds = keyframe
        self._keyframes = 0
        self._keys = RecordedKeys(self)
        tops = self._keys.tops
        # A camera's frames are taken from its memory before it writes others there, however busy the server is.
        self._monitor = (
            Monitor(interface, tops, Last(_WAITING), patience=PATIENCE, raw=True, local=True) if tops else None
        )
        if self._monitor is not None:
            self._monitor.invalidated = lambda name: self._keys.of(name).lost(None)
            self._monitor.resynchronised = self._keys.lost
            self._monitor.changed = self._keys.changed
        self._raw = RawRecorder(self, tops)
        self._sampler = Sampler(
            self.session, self._samples, lambda path, *read: self._keys.of(str(path[0])).sampled(path, *read)
        )
        self._tasks: list[asyncio.Task[None]] = []
        self._begun = self._ended = 0.0
        self._dropped = 0
        self._failure: Exception | None = None
        self._done = asyncio.Event()
        self._compression, self._queue_bytes = compression, queue_bytes
        self._described = description(self.session, patterns, self._samples, keyframe)
        self._box = None if last is None else BlackBox(last, memory)
        self._sink: Sink | None = None
        if self._box is None:
            self._sink = self._next_sink() if self._split else self._sink_of(self.path, overwrite=overwrite)
            self.writer_thread: WriterThread | BlackBox = self._writer_to(self._sink)
        else:
            self.writer_thread = self._box

    def _sink_of(self, path: FilePath, *, overwrite: bool, whole: bool = False) -> Sink:
        return Sink(path, self._compression, self._described, overwrite=overwrite, whole=whole)

    def _next_sink(self) -> Sink:
        assert self._split is not None
        path, place = self._split.next()
        self._described |= {SPLIT: place}
        return self._sink_of(path, overwrite=self._overwrite)

    def _writer_to(self, sink: Sink, first: Sequence[Operation] = ()) -> WriterThread:
        following = None if self._split is None else self._next_sink
        return WriterThread(sink, self.session.ships, self._queue_bytes, self.patterns, first, following)

    @property
    def files(self) -> list[FilePath]:
        """The files that it has written until now, and the one that it writes to."""
        return [self.path] if self._split is None else list(self._split.files)

    # Lifetime.

    async def start(self) -> None:
        """Begin to record. When this returns, what is there is recorded and no later update is missed.

        One round trip for each pattern, one or two for each key. If it fails or is cancelled, there is no file, or
        the one that was to be replaced is still there.
        """
        self._begun = time.monotonic()
        try:
            self._described |= (clocks := await self._clocks())
            if self._sink is not None:
                self._sink.describe(clocks)
            self.writer_thread.start()
            if self._monitor is not None:
                await self._monitor.listen()
                await self._monitor.watch_changes()
                self._begin(self._listen)
                for name in await self._keys.present():
                    self._keys.of(name).read()
                await self._raw.start()
                self._begin(self._raw.follow)
                await self._keys.settled(_PATIENCE)
                await self._raw.settled(_PATIENCE)
                self._begin(lambda: find_regularly(self._search))
            self._sampler.start()
            self._begin(self._tick)
            self._check()
            if self._sink is not None:
                self._sink.output.appear()
            if self._split is not None:
                self._split.remove_others()
        except BaseException:
            await self._end()
            raise

    async def _clocks(self) -> dict[str, str]:
        """Return what is noted of this computer's clock and the server's, which publishers measure, too."""
        found = await ServerClock(self.session).known(0.0, _CLOCK_READINGS)
        if found is None:
            return {"clock offset": "unknown: the server did not say, or this user may not ask (TIME)"}
        return {"clock offset": f"{found.offset:.6f}", "clock bound": f"{found.bound:.6f}"}

    def _begin(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Start a task; if it fails, the recording ends."""

        async def watched() -> None:
            try:
                await work()
            except Exception as error:
                self.failed(error)

        self._tasks.append(asyncio.create_task(watched()))

    async def stop(self) -> None:
        """End the recording: take what was published until now, write the index, close the file. Idempotent.

        Raises:
            RecordingFailed: Writing ended before, for want of space or another reason.
        """
        if self._begun and not self._ended:
            await self._catch_up_to_now()
            await self._look_once_more()
            await self._complete(time.monotonic() + _PATIENCE)
            self._keyframe_of_all()
        await self._end()
        self._check()

    async def save(self, path: str | FilePath, after: float = 0.0, *, overwrite: bool = False) -> FilePath:
        """Write what a black box (`last`) has in memory, and what follows for `after` seconds; return the path.

        The file is the one of a recorder that had begun `last` seconds ago. It gets its name once it is whole. If it
        cannot be written, or this is cancelled, nothing is left of it, and the box goes on as before. Several may be
        saved at a time.

        Args:
            path: The file; it must not exist.
            after: Seconds.
            overwrite: Replace the file if it exists.

        Raises:
            BadValue: The file exists or cannot be made, or `after` is no number of seconds.
            Misuse: The recorder has no `last`, or does not record now.
            RecordingFailed: The disk is full, or the like.
        """
        check_number("after", after, "use seconds, 0 or more")
        check_instance("path", path, (str, FilePath), "use the name of a file")
        if self._box is None or not self._begun or self._ended:
            raise Misuse("save() needs a recorder that keeps the last seconds, between start() and stop()")
        sink = self._sink_of(FilePath(path), overwrite=overwrite, whole=True)
        try:
            await self._catch_up_to_now()
            writer = self._writer_to(sink, self._box.operations())
        except BaseException:
            sink.close()
            raise
        writer.start()
        self._box.saves.append(writer)
        try:
            end = time.monotonic() + after
            while (left := end - time.monotonic()) > 0 and writer.failure is None and not self._done.is_set():
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._done.wait(), min(_TICK, left))
            if after:
                await self._catch_up_to_now()
        except BaseException:
            sink.whole = False
            raise
        finally:
            self._box.saves.remove(writer)
            await _uninterrupted(asyncio.to_thread(writer.stop, self._ended_metadata()))
        if writer.failure is not None:
            reason = _reason(writer.failure)
            raise RecordingFailed(f"{path} could not be saved ({reason}); nothing is left of it") from writer.failure
        return sink.path

    async def _catch_up_to_now(self) -> None:
        """Take what was published until now, as far as the server answers."""
        with contextlib.suppress(RedisError, OSError):  # no connection: what has arrived is all there is
            await self.fence()
        self._pump()
        await self._keys.settled(_PATIENCE)
        await self._raw.settled(_PATIENCE)

    async def _end(self) -> None:
        self._ended = self._ended or time.monotonic()
        self._done.set()
        await self._sampler.stop()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._keys.cancel()
        with contextlib.suppress(InterfaceClosed):
            await self._raw.stop()
            if self._monitor is not None:
                await self._monitor.close()
        if self._box is not None:  # they end soon, since this is done
            await self._box.saved()
        await asyncio.to_thread(self.writer_thread.stop, self._ended_metadata())

    def _ended_metadata(self) -> dict[str, str]:
        ended = {"ended": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "seconds": f"{self.status.seconds:.3f}"}
        late = {"samples late": str(self._sampler.late), "samples failed": str(self._sampler.failed)}
        return ended | (late if self._samples else {})

    async def wait(self, seconds: float | None = None) -> None:
        """Return after so many seconds, or never; raises RecordingFailed as soon as it cannot go on."""
        if seconds is not None:
            check_number("seconds", seconds, "use a number of seconds, or None for no limit")
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._done.wait()
        self._check()

    def _check(self) -> None:
        failure = self.writer_thread.failure or self._failure
        if failure is not None:
            reason = _reason(failure)
            left = "" if isinstance(failure, FileGone) else "; what is in the file by now can be read"
            raise RecordingFailed(f"{self.files[-1]} could not be written any further ({reason}){left}") from failure

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            await self.stop()
            return
        try:
            await self.stop()
        except RecordingFailed as failure:
            error.add_note(str(failure))

    @property
    def status(self) -> RecorderStatus:
        """How the recording is getting on. Any thread may ask."""
        counts, now = self.writer_thread.counts, self._ended or time.monotonic()
        seconds = max(now - self._begun, 0.0) if self._begun else 0.0
        messages = counts.messages if self._box is None else self._box.messages
        span = seconds if self._box is None else min(seconds, self._box.seconds)
        return RecorderStatus(
            seconds,
            messages,
            counts.bytes if self._box is None else self._box.bytes,
            0 if isinstance(self.writer_thread, BlackBox) else self.writer_thread.file_bytes,
            counts.dropped,
            counts.skipped,
            counts.gaps,
            counts.lost,
            self._sampler.late,
            self._sampler.failed,
            messages / span if span else 0.0,
            counts.clock_steps,
        )

    # What comes in.

    async def _listen(self) -> None:
        assert self._monitor is not None
        async for event in self._monitor:
            self._keys.of(event.name).on_event(event)
            del event  # it may keep a slot of its publisher's memory
            if self._monitor.batches_messages:
                give_way()

    def _pump(self) -> None:
        for event in arrived(self._monitor) if self._monitor is not None else ():
            self._keys.of(event.name).on_event(event)

    async def fence(self, channels: Sequence[str] | None = None) -> None:
        """Wait until everything published before now, to some keys or all, has been handed to the key recorders."""
        if self._monitor is not None:
            with contextlib.suppress(InterfaceClosed):
                await manager_of(self.session).fence(channels)
        self._pump()

    @property
    def hears_of_changes(self) -> bool:
        return manager_of(self.session).hears_of_changes

    def record_raw(self, name: str) -> bool:
        """Record a key as another program's from now on; return whether such keys are recorded."""
        return self._raw.look(name)

    def failed(self, error: Exception) -> None:
        self._failure = error
        self._done.set()

    @property
    def _connected(self) -> bool:
        return self._monitor is not None and self._monitor.connected

    async def _complete(self, deadline: float) -> None:
        """Read again what was dropped at the last moment: the file is to end with what is there."""
        writer = self.writer_thread
        while self._connected and writer.failure is None and time.monotonic() < deadline:
            await self._keys.settled(deadline - time.monotonic())  # also what `_tick` has begun
            # What could not be written is known when all was taken from the queue, and not earlier.
            if not writer.waiting and not writer.behind:
                return
            self._catch_up()
            await asyncio.sleep(_TICK / 10)

    # What is done from time to time.

    async def _tick(self) -> None:
        """Keep the recording complete: read what is behind, write keyframes, end if the disk is full."""
        due = time.monotonic() + self._keyframe_seconds
        while True:
            await asyncio.sleep(_TICK)
            if self.writer_thread.failure is not None:
                self._done.set()
                return
            self._catch_up()
            self._begin_next_file()
            if time.monotonic() >= due:
                due += self._keyframe_seconds * max(1, (time.monotonic() - due) // self._keyframe_seconds + 1)
                if self._monitor is not None and not self.hears_of_changes:
                    with contextlib.suppress(RedisError, OSError):
                        await self._look()
                self._keyframe_of_all()

    def _begin_next_file(self) -> None:
        """Begin the next file if this one has the size or age at which files are split."""
        writer = self.writer_thread
        if self._split is None or isinstance(writer, BlackBox) or writer.splitting:
            return
        if self._split.is_due(writer.part_bytes):
            self._pump()  # what has arrived has times before it
            writer.split(self.clock.stamp(), self._keys.waiting())

    async def _search(self) -> bool:
        if self.hears_of_changes:  # else keys are read at each keyframe
            await self._look()
        return True

    def _catch_up(self) -> None:
        """Read the keys again of which something is missing, if there is room for it."""
        self.look_for_losses()
        if self._connected and self.writer_thread.waiting < (1 << 20):
            for name in list(self.writer_thread.behind):
                self.writer_thread.behind.discard(name)
                if name not in self._raw.names and self._keys.concerns(name):
                    self._keys.of(name).read()

    def look_for_losses(self) -> None:
        """Note updates that were dropped before they were taken: they may be of any key."""
        if self._monitor is not None and self._monitor.dropped > self._dropped:
            self.writer_thread.counts.dropped += self._monitor.dropped - self._dropped
            self._dropped = self._monitor.dropped
            self._keys.lost()

    async def _look_once_more(self) -> None:
        """Read what is there at the end: keys may have been stored since the last keyframe."""
        if self._connected and self.writer_thread.failure is None:
            with contextlib.suppress(RedisError, OSError):
                await self._look()
                self._keys.look_at_once()
                await self._keys.settled(_PATIENCE)

    async def _look(self) -> None:
        """Follow new keys; if no server reports what was stored since the last keyframe, read all that are there."""
        present = await self._keys.present()
        if self.hears_of_changes:
            self._keys.follow(present)
        else:
            self._keys.read_silent(present)
            await self._keys.settled(_PATIENCE)

    def _keyframe_of_all(self) -> None:
        self._keyframes += 1
        self._keys.keyframe(self._keyframes)
        self._raw.keyframe(self._keyframes)


def _reason(failure: Exception) -> str:
    return failure.strerror if isinstance(failure, OSError) and failure.strerror else repr(failure)


async def _uninterrupted(work: Coroutine[Any, Any, None]) -> None:
    """Wait for work to its end, also if this task is cancelled meanwhile."""
    task = asyncio.ensure_future(work)
    try:
        await asyncio.shield(task)
    except asyncio.CancelledError:
        await task
        raise


def description(
    session: Session, patterns: Sequence[str], samples: Sequence[Sample], keyframe: float
) -> dict[str, str]:
    return {
        "version": __version__,
        "format": "1",
        "server": session.options.address,
        "namespace": session.namespace,
        "host": platform.node(),
        "user": _user(),
        "process": str(os.getpid()),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "patterns": ", ".join(patterns),
        "samples": ", ".join([str(each) for each in samples]),
        "keyframe": f"{keyframe:g}",
    }


def _user() -> str:
    try:
        with _NAMING:
            return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # this user has no name
        return ""
