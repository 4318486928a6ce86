"""Ships' keys that the document does not refer to: finding them under WATCH, and removing them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ..errors import WrongKind
from . import Command, Plan, Reply
from .keys import Keys
from .memory import Memory
from .paths import Path
from .placeholders import find
from .reads import get_command
from .replies import explained, loads, registered
from .staging import Staged

__all__ = ["clean", "survey", "unreferred", "watch"]


def watch(keys: Keys, coming: Sequence[Staged] = ()) -> Command:
    """Return the command after which a transaction fails if document or registry, or what is coming, has changed."""
    return ("WATCH", keys.document, keys.registry, *(each.name for each in coming))


def survey(keys: Keys, path: Path) -> tuple[Command, ...]:
    """Return the commands that `unreferred` takes the replies of."""
    return get_command(keys, ()), get_command(keys, path), ("SMEMBERS", keys.registry)


def unreferred(replies: Sequence[Reply], keys: Keys) -> tuple[bytes, ...] | None:
    """Return the suffixes that nothing refers to once what is at the surveyed path is replaced.

    None if the user may not read: then nobody knows.
    """
    whole, part, members = replies
    if isinstance(whole, Exception) or isinstance(part, Exception):
        return None
    kept = _referred(whole, keys) - _referred(part, keys)
    return tuple(sorted(registered(members, keys) - kept))


def _referred(text: Reply, keys: Keys) -> set[bytes]:
    """Return the suffixes that a reply to JSON.GET refers to."""
    if text is None or text == b"[]":
        return set()
    return {crate.placeholder.suffix.encode() for crate in find(loads(text, keys), keys.name)}


def clean(keys: Keys, memory: Memory, then: Callable[[], Any]) -> Plan:
    """Plan to remove the ships' keys that the document does not refer to, then go on with `then`.

    Looks and removes under WATCH: if anybody writes to the document in between, it looks again.
    """

    def look(replies: Sequence[Reply]) -> Any:
        text = replies[1]
        if isinstance(text, Exception):
            if not isinstance(explained(text, keys, ()), WrongKind):  # nobody knows what the document refers to
                return Plan([("UNWATCH",)], lambda _: then(), held=True)
            text = None  # a foreign type refers to nothing
        members = registered(replies[2], keys)
        orphans = sorted(members - _referred(text, keys))
        memory.saw_members(keys.document, members)
        if not orphans:
            return Plan([("UNWATCH",)], lambda _: then(), held=True)
        tag = keys.tag.encode()
        removal = [("UNLINK", *(tag + orphan for orphan in orphans)), ("SREM", keys.registry, *orphans)]
        return Plan(removal, lambda replies: remove(replies, members - frozenset(orphans)), atomic=True, held=True)

    def remove(replies: Sequence[Reply] | None, left: frozenset[bytes]) -> Any:
        if replies is None:
            return clean(keys, memory, then)
        memory.saw_members(keys.document, left)
        return then()

    return Plan([watch(keys), get_command(keys, ()), ("SMEMBERS", keys.registry)], look, held=True)
