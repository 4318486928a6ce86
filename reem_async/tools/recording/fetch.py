"""Reading a value together with the note of which notice it includes."""

from __future__ import annotations

from typing import Any, NamedTuple

from ...plan import Reply
from ...plan.keys import Keys
from ...plan.paths import Path
from ...plan.reads import RawRead, read
from ...pubsub.manager import manager_of
from ...session import Session
from ...store.reader import opened

__all__ = ["Fetched", "fetch", "size_of"]


class Fetched(NamedTuple):
    """What was read.

    Attributes:
        value: What is there; MISSING if nothing is.
        size: Its bytes.
        note: The server's note of the last update that is in it.
    """

    value: Any
    size: int
    note: Reply


def size_of(raw_read: RawRead) -> int:
    """Return how many bytes a read brought."""
    return sum([len(reply) for reply in raw_read.raw if isinstance(reply, bytes | bytearray)])


async def fetch(session: Session, keys: Keys, path: Path) -> Fetched:
    """Read what is at `path` below a top-level key: one round trip, two where arrays were not known of.

    An `Unreadable` stands in the place of what cannot be read.

    Large values come over the connection for them. Cancelling leaves the connection usable.
    """
    await session.ships.ready()
    plan = read(keys, path, session.ships, session.cache, (("GET", keys.last),), tolerant=True)
    raw_read: RawRead = await session.run(plan)
    size = size_of(raw_read)
    value = await opened(raw_read) if raw_read.slots else raw_read.holder[0]
    manager_of(session).report(raw_read.unreadable)
    return Fetched(value, size, raw_read.also[0])
