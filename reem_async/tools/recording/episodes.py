"""Episodes of a recording: spans in which a path holds a dict, such as `kvs["episode"] = {"task": "pick"}`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

from ...plan.paths import Path
from ...plan.trees import same
from .align import Whole
from .log_reader import RecordedPast
from .times import seconds

# Fields that are known at the end of an episode.
_VERDICTS = ("outcome", "discard")


@dataclass(frozen=True, slots=True)
class Episode:
    """A span of a recording in which a path held a dict.

    Attributes:
        start: When the dict was written, in seconds since 1970 on the recorder's clock.
        end: When it was deleted or replaced; the end of the recording if it was not.
        data: The dict, as it was at the end.
        ended: Whether it was deleted or replaced. If not, the recording ends before the episode.
    """

    start: float
    end: float
    data: dict[str, Any]
    ended: bool

    @property
    def duration(self) -> float:
        """Seconds from the start to the end."""
        return self.end - self.start

    @property
    def discarded(self) -> bool:
        """Whether the dict says so: `"discard": True` or `"outcome": "discarded"`."""
        return self.data.get("discard") is True or self.data.get("outcome") == "discarded"


def episodes_of(past: RecordedPast, whole: Whole, path: Path, clock: str, end: float) -> list[Episode]:
    """Return the episodes that the dicts at a path make, in order; see `Log.episodes`."""
    above = [it for it in past.concerning(path) if len(it.path) <= len(path)]
    wholes = {int(time) for time in past.timeline.times([channel for it in above for channel in it.channels])}
    found: list[Episode] = []
    begun, data = 0, None
    shown = partial(past.published_at, path) if clock == "publisher" else int
    for ns, tree in past.changes(path, -1):
        value = whole(tree)
        value = value if isinstance(value, dict) else None
        if data is not None and (value is None or (ns in wholes and not _continues(data, value))):
            found.append(Episode(seconds(shown(begun)), seconds(shown(ns)), data, ended=True))
            data = None
        if value is not None:
            begun = begun if data is not None else ns
            data = value
    if data is not None:
        found.append(Episode(seconds(shown(begun)), end, data, ended=False))
    return found


def _continues(old: dict[str, Any], new: dict[str, Any]) -> bool:
    """Return whether a whole dict belongs to the episode that the one before began."""
    return all(key in new and (key in _VERDICTS or same(value, new[key])) for key, value in old.items())
