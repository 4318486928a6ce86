"""Recorder: every update of some keys into an MCAP file."""

from __future__ import annotations

import asyncio
import contextlib
import getpass
import os
import platform
import time
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path as FilePath
from types import TracebackType
from typing import Any, Self

import numpy as np

from ..catalog import names
from ..connection import RedisInterface
from ..courtesy import give_way
from ..errors import BadType, BadValue, InterfaceClosed, RedisError
from ..monitor import Monitor
from ..plan.paths import Path
from ..plan.patterns import Pattern, parse_pattern
from ..policy import EMPTY, Ended, Last
from .errors import RecordingFailed
from .feed import Feed
from .line import HURRIED, PATIENCE, Line
from .sample import Sampler, samples_of
from .scribe import Operation, Scribe
from .sink import Sink
from .times import Arrivals, Clock

__all__ = ["Recorder", "RecorderStatus"]

_TICK = 0.1
_MAILBOX = 50_000
_FETCHES = 8
_MOST_SILENT_READS = 500
"""Keys that are read again at one keyframe."""
_PATIENCE = 3.0
"""Seconds in which what was announced before the end is still fetched."""


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """How a recording is getting on.

    Attributes:
        seconds: Since it began.
        messages: Written.
        bytes: Written, before compression.
        file_bytes: In the file.
        dropped: Updates left out since the disk or this program could not keep up.
        skipped: Updates that were announced, and overtaken by a newer one before they could be fetched.
        gaps: How often updates were lost on the way from the server.
        lost: Values that cannot be recorded: of custom types that are not made of bytes.
        rate: Messages a second, on average.
    """

    seconds: float
    messages: int
    bytes: int
    file_bytes: int
    dropped: int
    skipped: int
    gaps: int
    lost: int
    rate: float


class Recorder:
    """Records what is published under some patterns of paths, and samples of others, into an MCAP file.

    An asynchronous context manager: inside of the block it records. Small values come with their
    notices, large ones are fetched, the newest only; both are as on the server, bit for bit. At the
    beginning, every `keyframe` seconds and after each gap the whole of the keys is written, so that any
    instant can be rebuilt; thus what a KeyValueStore writes is seen too, though only then. Nobody
    who publishes waits for the recorder. What it cannot keep up with it drops, and counts.

    The file can be read while it grows, and after the recorder was killed but for the last second. It
    is not synchronised to the disk: a power cut costs what the system had not written yet.

    Args:
        interface: The server.
        patterns: Globs such as "arm", "cam_*" or "robot.*.battery"; everything if not given. An empty
            list records samples only.
        path: The file; it must not exist.
        sample: Paths to read at given periods, in seconds: a dict, or a key file (lines `path, seconds`).
        keyframe: Seconds from one keyframe to the next.
        overwrite: Replace the file if it exists.
        compression: "zstd", "lz4" or "none".
        queue_bytes: What may wait for the disk.

    Raises:
        BadValue: The file exists or cannot be made, or an argument that means nothing.
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
    ) -> None:
        if isinstance(patterns, str):
            raise BadType(f"patterns is a list of patterns; use [{patterns!r}]")
        if not keyframe > 0:
            raise BadValue(f"keyframe={keyframe!r} cannot be; give seconds over 0")
        self.path = FilePath(path)
        self.patterns: list[Pattern] = [parse_pattern(text) for text in patterns]
        self.session = interface.session
        self.clock = Clock()
        self.arrivals = Arrivals(2 * PATIENCE)  # the system wakes nobody at the very moment
        self.fetching = asyncio.Semaphore(_FETCHES)
        self._interface = interface
        self._samples = samples_of(sample)
        if not self.patterns and not self._samples:
            raise BadValue("nothing to record: give a pattern such as '*', or sample=")
        self._sink = Sink(self.path, compression, self._description(patterns, keyframe), overwrite=overwrite)
        self.scribe = Scribe(self._sink, self.session.ships, queue_bytes)
        self._keyframe_seconds = keyframe
        self._keyframes = 0
        self._feeds: dict[str, Feed] = {}
        tops = list(dict.fromkeys(pattern.top for pattern in self.patterns))
        self._tops = tops
        self._monitor = Monitor(interface, tops, Last(_MAILBOX), patience=PATIENCE) if tops else None
        self._line = Line(self) if tops else None
        self._sampler = Sampler(self.session, self._samples, self._sampled)
        self._tasks: list[asyncio.Task[None]] = []
        self._begun = self._ended = 0.0
        self._dropped = 0
        self._failure: Exception | None = None
        self._done = asyncio.Event()

    def _description(self, patterns: Sequence[str], keyframe: float) -> dict[str, str]:
        try:
            ours = version("reem")
        except PackageNotFoundError:
            ours = "from its sources"
        return {
            "version": ours,
            "format": "1",
            "server": self.session.options.address,
            "namespace": self.session.namespace,
            "host": platform.node(),
            "user": _user(),
            "process": str(os.getpid()),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "patterns": ", ".join(patterns),
            "samples": ", ".join([str(each) for each in self._samples]),
            "keyframe": f"{keyframe:g}",
        }

    # Lifetime.

    async def start(self) -> None:
        """Begin to record. When this returns, what is there is recorded and no later update is missed.

        One round trip for each pattern, one or two for each key. If it fails or is cancelled, there is no file.
        """
        self.scribe.start()
        self._begun = time.monotonic()
        try:
            if self._monitor is not None and self._line is not None:
                await self._monitor.listen()
                await self.session.hub.follow(self._line)
                self._begin(self._listen)
                for name in await self._names():
                    self._feed(name).read()
                await self._settled(_PATIENCE)
            self._sampler.start()
            self._begin(self._tick)
        except BaseException:
            await self._end()
            self.path.unlink(missing_ok=True)
            raise

    def _begin(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Do something beside the recorded program; if it goes wrong, the recording ends."""

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
            with contextlib.suppress(RedisError, OSError):  # no connection: what has arrived is all there is
                await self.fence()
            self._pump()
            await self._settled(_PATIENCE)
            await self._complete(time.monotonic() + _PATIENCE)
            await self._look_once_more()
            self._keyframe_of_all()
        await self._end()
        self._check()

    async def _end(self) -> None:
        self._ended = self._ended or time.monotonic()
        self._done.set()
        await self._sampler.stop()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for feed in self._feeds.values():
            if feed.busy is not None:
                feed.busy.cancel()
        with contextlib.suppress(InterfaceClosed):
            if self._line is not None:
                await self.session.hub.unfollow(self._line)
            if self._monitor is not None:
                await self._monitor.close()
        ended = {"ended": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "seconds": f"{self.status.seconds:.3f}"}
        late = {"samples late": str(self._sampler.late), "samples failed": str(self._sampler.failed)}
        await asyncio.to_thread(self.scribe.stop, ended | (late if self._samples else {}))

    async def wait(self, seconds: float | None = None) -> None:
        """Return after so many seconds, or never; raises RecordingFailed as soon as it cannot go on."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._done.wait()
        self._check()

    def _check(self) -> None:
        failure = self.scribe.failure or self._failure
        if failure is not None:
            reason = failure.strerror if isinstance(failure, OSError) and failure.strerror else repr(failure)
            raise RecordingFailed(
                f"{self.path} could not be written any further ({reason}); what is in the file by now can be read"
            ) from failure

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            await self.stop()
            return
        with contextlib.suppress(RecordingFailed):
            await self.stop()

    @property
    def status(self) -> RecorderStatus:
        """How the recording is getting on. Any thread may ask."""
        counts, now = self.scribe.counts, self._ended or time.monotonic()
        seconds = max(now - self._begun, 0.0) if self._begun else 0.0
        return RecorderStatus(
            seconds,
            counts.messages,
            counts.bytes,
            self._sink.output.tell(),
            counts.dropped,
            counts.skipped,
            counts.gaps,
            counts.lost,
            counts.messages / seconds if seconds else 0.0,
        )

    # What comes in.

    async def _listen(self) -> None:
        assert self._monitor is not None
        async for event in self._monitor:
            self._feed(event.name).on_event(event)
            if self._line is not None and self._line.leisurely:
                give_way()

    def _pump(self) -> None:
        """Take what has arrived already."""
        with contextlib.suppress(Ended):
            while self._monitor is not None and (event := self._monitor.mailbox.take()) is not EMPTY:
                self._feed(event.name).on_event(event)

    def _feed(self, name: str) -> Feed:
        feed = self._feeds.get(name)
        if feed is None:
            feed = self._feeds[name] = Feed(self, name)
        return feed

    def _sampled(self, path: Path, value: Any, size: int) -> None:
        self._feed(str(path[0])).sampled(path, value, size)

    async def fence(self) -> None:
        """Wait until everything published before now has been handed to the feeds."""
        if self._line is not None and self._line.wire is not None:
            await self._line.wire.roundtrip([("PING",)])
        self._pump()

    def hurry(self) -> None:
        """Look more often at what was published: large updates come fast."""
        self.session.hub.hurry(HURRIED)

    def failed(self, error: Exception) -> None:
        """End the recording: something went wrong that should not."""
        self._failure = error
        self._done.set()

    async def _names(self) -> set[str]:
        """Return the keys there are, of those that are recorded."""
        found: set[str] = set()
        for top in self._tops:
            if "*" in top or "?" in top:
                found.update([name async for name in names(self._interface, top)])
            else:
                found.add(top)
        return found

    async def _settled(self, patience: float) -> None:
        """Wait until nothing is being fetched, but not for ever."""
        deadline = time.monotonic() + patience
        while (busy := [feed.busy for feed in self._feeds.values() if feed.busy]) and time.monotonic() < deadline:
            await asyncio.wait(busy, timeout=deadline - time.monotonic())

    async def _complete(self, deadline: float) -> None:
        """Read anew what was dropped at the last moment: the file is to end with what is there."""
        while self._line is not None and self._line.wire is not None:
            await self._settled(deadline - time.monotonic())  # also what `_tick` has begun
            if not self.scribe.behind or self.scribe.failure is not None or time.monotonic() > deadline:
                return
            self._catch_up()
            await asyncio.sleep(_TICK / 10)

    # What is done from time to time.

    async def _tick(self) -> None:
        """Keep the recording complete: read anew what is behind, write keyframes, end if the disk is full."""
        due = time.monotonic() + self._keyframe_seconds
        while True:
            await asyncio.sleep(_TICK)
            if self.scribe.failure is not None:
                self._done.set()
                return
            self._catch_up()
            if time.monotonic() >= due:
                due += self._keyframe_seconds * max(1, (time.monotonic() - due) // self._keyframe_seconds + 1)
                with contextlib.suppress(RedisError, OSError):  # no connection now: it is made again
                    await self._look()
                self._keyframe_of_all()

    def _catch_up(self) -> None:
        """Read the keys anew of which something is missing, if there is room for it."""
        if self._monitor is not None and self._monitor.dropped > self._dropped:
            self.scribe.counts.dropped += self._monitor.dropped - self._dropped
            self._dropped = self._monitor.dropped
            self.lost()
        if self._line is not None and self._line.wire is not None and self.scribe.waiting < (1 << 20):
            for name in list(self.scribe.behind):
                self.scribe.behind.discard(name)
                if self._monitor is not None and any(pattern.concerns((name,)) for pattern in self.patterns):
                    self._feed(name).read()

    def lost(self) -> None:
        """Note that updates of any key may be lost, and read all keys anew."""
        for feed in self._feeds.values():
            feed.lost(None)

    async def _look_once_more(self) -> None:
        """Read what is there at the end: somebody may have stored something since the last keyframe."""
        for feed in self._feeds.values():
            feed.news = False
        if self._line is not None and self._line.wire is not None and self.scribe.failure is None:
            with contextlib.suppress(RedisError, OSError):
                await self._look()

    async def _look(self) -> None:
        """Read keys that were not published as a whole since the last keyframe: somebody may have stored something."""
        if self._monitor is None:
            return
        there = await self._names()
        now, reads = time.monotonic(), 0
        for name in sorted(there | self._feeds.keys(), key=lambda name: self._feed(name).next_read):
            feed = self._feed(name)
            if feed.news or not any(pattern.concerns((name,)) for pattern in self.patterns):
                continue
            if name not in there:
                feed.gone()
            elif feed.next_read <= now and reads < _MOST_SILENT_READS:
                reads += 1
                feed.read()
        await self._settled(_PATIENCE)

    def _keyframe_of_all(self) -> None:
        self._keyframes += 1
        for feed in self._feeds.values():
            feed.keyframe(self._keyframes)
            feed.news = False
        status = self.status
        figures = {name: getattr(status, name) for name in ("messages", "bytes", "dropped", "skipped", "gaps", "lost")}
        stamp = self.clock.stamp(), self.clock.stamp(), self._keyframes
        self.scribe.put(Operation("statistics", ("",), figures | {"waiting": self.scribe.waiting}, stamp), 0)


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # nobody knows the name of this user
        return ""
