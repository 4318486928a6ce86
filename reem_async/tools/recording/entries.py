"""What a recording gives to its reader: updates, arrays that are not read yet, and what its channels hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ...plan.paths import Path, show
from .log_reader import Past
from .stored import Stored

__all__ = ["ArrayHandle", "ChannelSummary", "LogUpdate"]


@dataclass(frozen=True, slots=True)
class LogUpdate:
    """One recorded update.

    Attributes:
        time: When it was received, in seconds since 1970 on the recorder's clock.
        path: What was updated, top-level key first.
        value: What is there now; None if it was deleted.
        deleted: What was there is gone.
        published: When it was published, in seconds since 1970 on the publisher's clock; `time` if it was not.
        sequence: Its number among its publisher's updates of the top-level key; 0 if it was not published.
        kind: "pub" if it was published; "stored" if somebody changed what is stored and published nothing: what that
            led to, at the instant at which it was found; "kvs" if it was sampled, or found when the key was read:
            what is left of an update that was changed before it could be read, or what a server that does not tell
            of stored changes had at a keyframe.
    """

    time: float
    path: Path
    value: Any
    deleted: bool
    published: float
    sequence: int
    kind: str

    @property
    def shown(self) -> str:
        """The path as people write it."""
        return show(self.path)


@dataclass(frozen=True, slots=True)
class ArrayHandle:
    """An array (or bytes, a long list, a custom value) of a past tree, not yet read.

    Attributes:
        label: "numpy", "bytes", "list", or the label of a custom ship.
        dtype: The dtype of an array as text, else "".
        shape: The shape of an array, else None.
        size: Its bytes.
        summary: What it is, such as "uint8[480,640,3]".
    """

    label: str
    dtype: str
    shape: tuple[int, ...] | None
    size: int
    summary: str
    _stored: Stored
    _past: Past

    def read(self) -> Any:
        """Return the value, read-only; raises DamagedRecording if it is."""
        return self._past.value(self._stored)


@dataclass(frozen=True, slots=True)
class ChannelSummary:
    """What a channel of the file holds.

    Attributes:
        topic: What viewers call it.
        path: The path it is about; "" if it is about the recording itself.
        role: "update", "part", "delete", "state", "keyframe", "gap", "skip", or "".
        kind: "pub", "stored", "kvs" or "".
        schema: The name of its schema.
        messages: How many.
        bytes: Their size, before compression.
        first: The instant of the first, 0 if there is none.
        last: The instant of the last.
    """

    topic: str
    path: str
    role: str
    kind: str
    schema: str
    messages: int
    bytes: int
    first: float
    last: float

    @property
    def rate(self) -> float:
        """Messages a second, from the first to the last."""
        return (self.messages - 1) / (self.last - self.first) if self.last > self.first else 0.0
