"""What subscribers are given: one update of what they follow."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

__all__ = ["Origin", "Update"]


class Origin(StrEnum):
    """How an update came to be known."""

    PUBLISHED = "published"
    """Somebody published it: it has a publisher, a number and a time, and each one is told."""

    STORED = "stored"
    """Somebody changed what is stored, and published nothing: several changes may be told as what they led to."""

    FOUND = "found"
    """It was there when following began, or after a loss."""


@dataclass(frozen=True, slots=True)
class Update:
    """One update of what a subscriber follows.

    Attributes:
        path: What was updated, such as "callback_channel.number".
        data: The whole structure below the channel after the update, None if it is gone; the
            containers are the receiver's own, arrays are read-only.
        value: What was written: the value at `path`, or the part of it below the channel (`data` itself, if
            that is all of it); None if it was deleted. `data` may be newer than that: what was read for a large
            update may have later ones in it. If these have changed what it wrote, it is skipped.
        initial: This is the value that was there when following began.
        time: When it was published, in seconds since 1970 on the publisher's clock; None for a value
            that was read and not published: what is stored, the initial one, and the one after a broken connection.
        publisher: The id of the interface that published it; None likewise.
        sequence: Its number among this publisher's updates of the top-level key; None likewise.
        gap: Updates were lost between this one and the last: a connection broke, or one was unreadable.
        missed: How many were lost, None if that is not known.
        origin: Whether it was published, only stored, or found at the beginning or after a loss.
        deleted: Nothing is there any more: `value` is None because of that.
        early: It was told before the server had it (`RedisInterface(local="early")` of its publisher): the server has
            it soon, or what it has then is told, with `gap`.
    """

    path: str
    data: Any
    value: Any
    initial: bool = False
    time: float | None = None
    publisher: str | None = None
    sequence: int | None = None
    gap: bool = False
    missed: int | None = 0
    origin: Origin = Origin.PUBLISHED
    deleted: bool = False
    early: bool = False
