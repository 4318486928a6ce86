"""Recordings of what is published: write them, look into them, publish them again.

async with Recorder(interface, ["arm", "cam_*"], "run.mcap"):
    await asyncio.sleep(60)

log = open_log("run.mcap")
log["arm.joint"].at(log.start + 10)        # the value at that instant
times, values = log["arm.joint"].history() # numpy arrays
await Replayer(interface, log).play()      # publish it all again

Needs the extra `tools`.
"""

try:
    from .align import AlignedBlock, AlignedCounts, Alignment
    from .episodes import Episode
    from .format import DamagedRecording, RecordingFailed
    from .log import ArrayHandle, Log, LogPath, LogUpdate, open_log
    from .places import ChannelSummary
    from .recorder import Recorder, RecorderStatus
    from .replay import Replayer, ReplayStatus
except ModuleNotFoundError as error:
    package = (error.name or "reem").partition(".")[0]
    if package.startswith("reem"):
        raise
    raise ModuleNotFoundError(f"recordings need {package}: pip install 'reem-async[tools]'", name=package) from None

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
