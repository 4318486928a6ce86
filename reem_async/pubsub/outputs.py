"""What a `Replica` asks for, and what it tells: commands for who drives it, and events, in one queue in order."""

from __future__ import annotations

from typing import Any, NamedTuple

from ..plan import Plan
from ..plan.notices import Notice
from ..plan.paths import Path
from ..plan.reads import RawRead

__all__ = [
    "Arm", "Failed", "Fence", "Look", "Open", "Output", "Read", "Ready", "Skipped", "Snapshot", "Stored", "Updated",
]  # fmt: skip


class Read(NamedTuple):
    """Command: send the commands of a plan and bring the replies to `replies`.

    Over the connection of the notices, or if the plan is `bulk` over another one.
    """

    number: int
    plan: Plan


class Arm(NamedTuple):
    """Command: touch keys over the connection of the notices, for the server to tell of changes; then call `armed`."""

    number: int
    keys: tuple[str, ...]


class Look(NamedTuple):
    """Command: something was changed; call `look` soon, but not more often than is good for the server."""


class Fence(NamedTuple):
    """Command: send a PING over the connection of the notices and bring word of its answer to `fenced`."""

    number: int


class Open(NamedTuple):
    """Command: have the ships make values of their replies, and bring the tree to `opened` or the error to `failed`."""

    number: int
    raw_read: RawRead


class Updated(NamedTuple):
    """Event: an update.

    Attributes:
        notice: What was heard of it.
        data: All that is at the followed path; MISSING if nothing is. Not to be changed.
        value: What was written; the same object as `data` if that is all of it.
        missed: How many updates were lost since the last event that told of losses, None if nobody knows.
    """

    notice: Notice
    data: Any
    value: Any
    missed: int | None


class Skipped(NamedTuple):
    """Event: what a large update wrote cannot be told, since it was changed before it was read.

    Attributes:
        notice: What was heard of it.
        data: All that is at the followed path.
        newest: No later update of this path is told of in its place.
    """

    notice: Notice
    data: Any
    newest: bool


class Stored(NamedTuple):
    """Event: what is there differs from all that was published.

    Attributes:
        path: The deepest place, below what is followed, that holds all that differs.
        data: All that is at the followed path; MISSING if nothing is.
        value: What is at `path`; MISSING if nothing is.
    """

    path: Path
    data: Any
    value: Any


class Snapshot(NamedTuple):
    """Event: what is there, at the beginning or after a loss.

    Attributes:
        data: All that is at the followed path.
        initial: It was there when following began.
        missed: How many updates were lost, None if nobody knows.
    """

    data: Any
    initial: bool
    missed: int | None


class Ready(NamedTuple):
    """Event: the copy is that of the server."""


class Failed(NamedTuple):
    """Event: a snapshot could not be taken; the next update, or note, tries again."""

    error: Exception


Output = Read | Arm | Look | Fence | Open | Updated | Stored | Skipped | Snapshot | Ready | Failed
