"""Recording and replaying for plain scripts: the core's recorder on the background loop, this waits for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from reem_async.errors import InterfaceClosed
from reem_async.tools import recording as core
from reem_async.tools.recording import (
    ArrayHandle,
    ChannelSummary,
    DamagedRecording,
    Log,
    LogPath,
    LogUpdate,
    RecorderStatus,
    RecordingFailed,
    ReplayStatus,
    open_log,
)
from reem_async.tools.recording.times import Instant

from ._twin import documented_by, shares, waits
from .connection import RedisInterface

__all__ = [
    "ArrayHandle",
    "ChannelSummary",
    "DamagedRecording",
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
    """Records what is published under some patterns of paths, and samples of others, into an MCAP file.

    A context manager: inside of the block it records, in the background. For the rest see
    `reem_async.recording.Recorder`; the arguments are the same.
    """

    def __init__(
        self,
        interface: RedisInterface,
        patterns: Sequence[str] = ("*",),
        path: str | Path = "run.mcap",
        *,
        sample: dict[str, float] | str | Path | None = None,
        keyframe: float = 5.0,
        overwrite: bool = False,
        compression: str = "zstd",
        queue_bytes: int = 256 << 20,
    ) -> None:
        self._interface = interface
        self._core = core.Recorder(
            interface._followers,
            patterns,
            path,
            sample=sample,
            keyframe=keyframe,
            overwrite=overwrite,
            compression=compression,
            queue_bytes=queue_bytes,
        )

    status = shares(core.Recorder.status)
    start = waits(core.Recorder.start)
    stop = waits(core.Recorder.stop)
    wait = waits(core.Recorder.wait)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # The block's own error is what its reader has to know; that the recording failed too is a note on it.
        if error is None:
            self.stop()
            return
        try:
            self.stop()
        except InterfaceClosed:
            pass
        except RecordingFailed as failure:
            error.add_note(str(failure))


@documented_by(core.Replayer)
class Replayer:
    """Publishes a recording again: first all that was there at the start, then every update in its turn.

    See `reem_async.recording.Replayer`; the arguments are the same.
    """

    def __init__(
        self,
        interface: RedisInterface,
        log: Log,
        *,
        rate: float = 1.0,
        start: Instant | None = None,
        end: Instant | None = None,
        loop: bool = False,
        patterns: Sequence[str] = ("*",),
        remap: Mapping[str, str] | None = None,
    ) -> None:
        self._interface = interface
        # Checked by the core, which has the same names.
        settings: dict[str, Any] = {"start": start, "end": end, "loop": loop, "patterns": patterns, "remap": remap}
        self._core = core.Replayer(interface._followers, log, rate=rate, **settings)
        self.start, self.end = self._core.start, self._core.end

    status = shares(core.Replayer.status)
    play = waits(core.Replayer.play)
    step = waits(core.Replayer.step)
