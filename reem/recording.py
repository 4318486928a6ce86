"""Recording and replaying for plain scripts: the core's recorder on the background loop, this waits for it."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from reem_async.errors import InterfaceClosed
from reem_async.tools import recording as core
from reem_async.tools.recording import (
    AlignedBlock,
    AlignedCounts,
    Alignment,
    ArrayHandle,
    ChannelSummary,
    DamagedRecording,
    Episode,
    Log,
    LogPath,
    LogUpdate,
    RecorderStatus,
    RecordingFailed,
    ReplayStatus,
    open_log,
)

from ._twin import documented_by, shares, takes_interface, waits
from .connection import RedisInterface

__all__ = [
    "AlignedBlock",
    "AlignedCounts",
    "Alignment",
    "ArrayHandle",
    "ChannelSummary",
    "DamagedRecording",
    "Episode",
    "Log",
    "LogPath",
    "LogUpdate",
    "Recorder",
    "RecorderStatus",
    "RecordingFailed",
    "ReplayStatus",
    "Replayer",
    "open_log",
]


@documented_by(core.Recorder)
class Recorder:
    """Records what is published under some patterns of paths, and samples of others, into an MCAP file."""

    @takes_interface(core.Recorder.__init__)
    def __init__(self, interface: RedisInterface, *given: Any, **options: Any) -> None:
        self._interface = interface
        self._core = core.Recorder(interface._followers, *given, **options)

    status = shares(core.Recorder.status)
    files = shares(core.Recorder.files)
    start = waits(core.Recorder.start)
    stop = waits(core.Recorder.stop)
    wait = waits(core.Recorder.wait)
    save = waits(core.Recorder.save)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._interface._wait(self._core.__aexit__(kind, error, trace))
        except InterfaceClosed:
            if error is None:  # else the block's own error is what its reader has to know
                raise


@documented_by(core.Replayer)
class Replayer:
    """Publishes a recording again: first all that was there at the start, then every update in its turn."""

    @takes_interface(core.Replayer.__init__)
    def __init__(self, interface: RedisInterface, *given: Any, **options: Any) -> None:
        self._interface = interface
        self._core = core.Replayer(interface._followers, *given, **options)
        self.start, self.end = self._core.start, self._core.end

    status = shares(core.Replayer.status)
    play = waits(core.Replayer.play)
    step = waits(core.Replayer.step)
