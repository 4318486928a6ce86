"""Reading a value together with the note of which notice it includes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..document import opened
from ..errors import MissingKey
from ..plan import Plan, Reply
from ..plan.keys import Keys
from ..plan.memory import Memory
from ..plan.notices import parsed_note
from ..plan.paths import Path
from ..plan.placeholders import find, marked
from ..plan.reads import Sealed, get_command, present, read
from ..plan.replies import loads
from ..plan.trees import MISSING
from ..session import Session
from ..ships.registry import Ships

__all__ = ["Fetched", "fetch"]

Fetched = tuple[Any, int, str, int]
"""A value (MISSING if nothing is there), its bytes, and who published last before it was read, and the number."""


async def fetch(session: Session, keys: Keys, path: Path) -> Fetched:
    """Read what is at `path` below a top-level key: one round trip, two where arrays were not known of.

    Large values come over the connection for them. Cancelling leaves the connection usable.
    """
    await session.ships.ready()
    try:
        sealed: Sealed = await session.run(_snapshot(keys, path, session.ships, session.memory))
    except MissingKey:
        return MISSING, 0, "", 0
    size = sum([len(reply) for reply in sealed.raw if isinstance(reply, bytes | bytearray)])
    value = await opened(sealed) if sealed.crates else sealed.holder[0]
    return value, size, *parsed_note(sealed.also[0] if sealed.also else None)


def _snapshot(keys: Keys, path: Path, ships: Ships, memory: Memory) -> Plan:
    note = ("GET", keys.last)
    if memory.layout(keys.document, path):
        return read(keys, path, ships, memory, (note,))
    command = get_command(keys, path)

    def decode(replies: Sequence[Reply]) -> Any:
        text = present(replies[0], keys, path)
        holder = loads(text, keys)
        crates = find(holder, keys.name) if marked(text) else []
        if crates:
            memory.saw_layout(keys.document, path, tuple([crate.placeholder for crate in crates]))
            return read(keys, path, ships, memory, (note,))
        return Sealed(holder, keys.name, [], (command,), (text,), (replies[1],))

    return Plan([command, note], decode, atomic=True)
