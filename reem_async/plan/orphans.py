"""Ships' keys that the document does not refer to: finding them under WATCH, and removing them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any

from ..errors import BadKey, WrongKind
from . import Command, Plan, Reply, blamed
from .keys import Keys
from .paths import Path, below, parse_suffix
from .placeholders import find
from .reads import get_command
from .replies import checked, explained, loads, registered
from .shapes import ShapeCache
from .staging import Staged

__all__ = [
    "clean",
    "left_behind",
    "orphans",
    "permitted",
    "place_of",
    "remove_orphans",
    "survey",
    "unreferred",
    "watch",
]

# What an array begins with (the .npy format): so one is recognised that no registry names any more.
_ARRAY = b"\x93NUMPY"


def watch(keys: Keys, coming: Sequence[Staged] = ()) -> Command:
    """Return the command after which a transaction fails if document or registry, or what is coming, has changed."""
    return ("WATCH", keys.document, keys.registry, *(each.name for each in coming))


def permitted(reply: Reply, *names: str) -> None:
    """Raise what a reply to the WATCH of `names` means if it is an error: nothing would be watched."""
    if isinstance(reply, Exception):
        raise blamed(reply, ("WATCH", " ".join(names)))


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
    # A suffix that stands both inside and outside of the part cannot be: `find` refuses a document that names one
    # twice.
    kept = _referred(whole, keys) - _referred(part, keys)
    return tuple(sorted(registered(members, keys) - kept))


def _referred(text: Reply, keys: Keys) -> set[bytes]:
    """Return the suffixes that a reply to JSON.GET refers to."""
    if text is None or text == b"[]":
        return set()
    return {slot.placeholder.suffix.encode() for slot in find(loads(text, keys), keys.name)}


def clean(
    keys: Keys, cache: ShapeCache, then: Callable[[], Any], unfinished: Callable[[Exception], Exception] | None = None
) -> Plan:
    """Plan to remove the ships' keys that the document does not refer to, then go on with `then`.

    Looks and removes under WATCH: if anybody writes to the document in between, it looks again.
    `unfinished` makes the error to raise from the one that kept it from that.
    """

    def look(replies: Sequence[Reply]) -> Any:
        permitted(replies[0], keys.document, keys.registry)
        text = replies[1]
        if isinstance(text, Exception):
            if not isinstance(explained(text, keys, ()), WrongKind):  # nobody knows what the document refers to
                return Plan([("UNWATCH",)], lambda _: then(), held=True)
            text = None  # a foreign type refers to nothing
        members = registered(replies[2], keys)
        orphans = sorted(members - _referred(text, keys))
        cache.saw_members(keys.document, members)
        if not orphans:
            return Plan([("UNWATCH",)], lambda _: then(), held=True)
        tag = keys.tag.encode()
        removal = [("UNLINK", *(tag + orphan for orphan in orphans)), ("SREM", keys.registry, *orphans)]
        left = members - frozenset(orphans)
        return Plan(removal, lambda replies: remove(replies, left), atomic=True, held=True, unfinished=unfinished)

    def remove(replies: Sequence[Reply] | None, left: frozenset[bytes]) -> Any:
        # Somebody wrote to the document since the look: what it refers to may be something else now.
        if replies is None:
            return clean(keys, cache, then, unfinished)
        cache.saw_members(keys.document, left)
        return then()

    commands = [watch(keys), get_command(keys, ()), ("SMEMBERS", keys.registry)]
    return Plan(commands, look, held=True, unfinished=unfinished)


def place_of(member: bytes) -> Path:
    """Return where a member of the registry belongs; what REEM did not enter there belongs to no place."""
    try:
        return parse_suffix(member.decode())
    except (BadKey, UnicodeDecodeError):
        return ("\0",)


def left_behind(known: Iterable[bytes], path: Path, written: Collection[bytes]) -> list[bytes]:
    """Return the known keys that belong at `path`, which leads through no list, and are not written there again."""
    return [member for member in known if member not in written and below(place_of(member), path)]


def orphans(keys: Keys, found: Sequence[bytes]) -> Plan:
    """Plan to find the ships' keys of one top-level key that its document does not refer to; the result is suffixes.

    One transaction. They are left behind where a document expires, or is deleted or renamed by a program without REEM.
    Only keys that the registry names, or that hold an array, are taken for ships' keys.

    Args:
        keys: The top-level key.
        found: The suffixes of the Redis keys that carry its tag, as a look through all keys has found them.

    Raises (in decode):
        BadData, RedisError: Document or registry cannot be read, so it is not known what belongs to the key.
    """
    return Plan(_look_for_orphans(keys, found), lambda replies: _orphans(replies, keys, found), atomic=True)


def remove_orphans(keys: Keys, found: Sequence[bytes], cache: ShapeCache) -> Plan:
    """Plan to remove what `orphans` finds; the result is what was removed.

    Two round trips under WATCH, again if another client writes to the key in between: what a document refers to is
    never removed.
    """

    def look(replies: Sequence[Reply]) -> Any:
        permitted(replies[0], keys.document, keys.registry)
        gone = _orphans(replies[1:], keys, found)
        if not gone:
            return Plan([("UNWATCH",)], lambda _: gone, held=True)
        tag = keys.tag.encode()
        removal = [("UNLINK", *(tag + suffix for suffix in gone)), ("SREM", keys.registry, *gone)]
        return Plan(removal, lambda replies: done(replies, gone), atomic=True, held=True)

    def done(replies: Sequence[Reply] | None, gone: list[bytes]) -> Any:
        if replies is None:
            return remove_orphans(keys, found, cache)
        for reply in replies:
            checked(reply, keys, ())
        cache.saw_members(keys.document, cache.members(keys.document) - frozenset(gone))
        return gone

    return Plan([watch(keys), *_look_for_orphans(keys, found)], look, held=True)


def _look_for_orphans(keys: Keys, found: Sequence[bytes]) -> list[Command]:
    tag = keys.tag.encode()
    begins = [("GETRANGE", tag + suffix, "0", str(len(_ARRAY) - 1)) for suffix in found]
    return [get_command(keys, ()), ("SMEMBERS", keys.registry), *begins]


def _orphans(replies: Sequence[Reply], keys: Keys, found: Sequence[bytes]) -> list[bytes]:
    text, members = replies[0], registered(replies[1], keys)
    if isinstance(text, Exception):
        if not isinstance(explained(text, keys, ()), WrongKind):
            raise text
        text = None  # a foreign type refers to nothing
    arrays = {suffix for suffix, begin in zip(found, replies[2:], strict=True) if begin == _ARRAY}
    return sorted((members | arrays) - _referred(text, keys))
