"""Attachments after a change: remove those that the document does not refer to, and judge the change itself.

If the server refuses something after the document was written, the error is a `PartialWrite`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import BadKey, MissingKey, PartialWrite, PathRefused, WrongKind
from . import Command, Plan, Reply, blamed
from .changes import REFUSED, DocumentChange
from .keys import Keys
from .paths import Path, below, may_hold, parse_suffix, show
from .placeholders import find
from .reads import get_command
from .replies import diagnose, explained, full, loads, registered
from .shapes import ShapeCache
from .sizes import Staged

# An array begins with this (the .npy format): so one that no registry names any more is recognised.
_ARRAY = b"\x93NUMPY"


def watch(keys: Keys, coming: Sequence[Staged] = ()) -> Command:
    return ("WATCH", keys.document, keys.registry, *(each.name for each in coming))


def permitted(reply: Reply, *names: str) -> None:
    if isinstance(reply, Exception):
        raise blamed(reply, ("WATCH", " ".join(names)))


def survey(keys: Keys, path: Path) -> tuple[Command, ...]:
    return get_command(keys, ()), get_command(keys, path), ("SMEMBERS", keys.registry)


def unreferred(replies: Sequence[Reply], keys: Keys) -> tuple[bytes, ...] | None:
    """Return the suffixes that nothing refers to once the surveyed path is replaced; None if the user may not read."""
    whole, part, members = replies
    if isinstance(whole, Exception) or isinstance(part, Exception):
        return None
    # No suffix is both inside and outside of the part: `find` refuses a document that names one twice.
    kept = _referred(whole, keys) - _referred(part, keys)
    return tuple(sorted(registered(members, keys) - kept))


def _referred(text: Reply, keys: Keys) -> set[bytes]:
    if text is None or text == b"[]":
        return set()
    return {slot.placeholder.suffix.encode() for slot in find(loads(text, keys), keys.name)}


def clean(
    keys: Keys,
    cache: ShapeCache,
    then: Callable[[list[bytes]], Any],
    unfinished: Callable[[Exception], Exception] | None = None,
    found: Sequence[bytes] = (),
) -> Plan:
    """Plan to remove the attachments that the document does not refer to, then go on with `then`, which gets them.

    Under WATCH: if another client writes to the document in between, it starts again. `unfinished` is that of `Plan`,
    `found` that of `orphans`.
    """

    def look(replies: Sequence[Reply]) -> Any:
        permitted(replies[0], keys.document, keys.registry)
        text, gone, members = replies[1], list[bytes](), frozenset[bytes]()
        # With another error it is unknown what the document refers to.
        if not isinstance(text, Exception) or isinstance(explained(text, keys, ()), WrongKind):
            members, gone = registered(replies[2], keys), _orphans(replies[1:], keys, found)
            cache.of(keys.document).saw_members(members)
        if not gone:
            return Plan([("UNWATCH",)], lambda _: then(gone), held=True)
        tag = keys.tag.encode()
        removal = [("UNLINK", *(tag + orphan for orphan in gone)), ("SREM", keys.registry, *gone)]
        left = members - frozenset(gone)
        return Plan(removal, lambda replies: remove(replies, gone, left), atomic=True, held=True, unfinished=unfinished)

    def remove(replies: Sequence[Reply] | None, gone: list[bytes], left: frozenset[bytes]) -> Any:
        if replies is None:  # the document was changed in between
            return clean(keys, cache, then, unfinished, found)
        cache.of(keys.document).saw_members(left)
        return then(gone)

    return Plan([watch(keys), *_look_for_orphans(keys, found)], look, held=True, unfinished=unfinished)


def place_of(member: bytes) -> Path:
    """Return the path of a member of the registry; a foreign member is at no place."""
    try:
        return parse_suffix(member.decode())
    except (BadKey, UnicodeDecodeError):
        return ("\0",)


def left_behind(known: Iterable[bytes], path: Path, written: Collection[bytes]) -> list[bytes]:
    """Return the known attachments at `path`, which leads through no list, that are not written there again."""
    return [member for member in known if member not in written and below(place_of(member), path)]


def orphans(keys: Keys, found: Sequence[bytes]) -> Plan:
    """Plan to find the attachments of one top-level key that its document does not refer to; the result is suffixes.

    One transaction. They are left behind if a document expires, or is deleted or renamed by a program without REEM.
    Only keys that the registry names, or that hold an array, count as attachments. SCAN has `found` the suffixes of
    the Redis keys that carry the tag.

    Raises (in decode):
        BadData, RedisError: Document or registry cannot be read, so it is not known what belongs to the key.
    """
    return Plan(_look_for_orphans(keys, found), lambda replies: _orphans(replies, keys, found), atomic=True)


def remove_orphans(keys: Keys, found: Sequence[bytes], cache: ShapeCache) -> Plan:
    """Plan to remove what `orphans` finds; the result is what was removed. Two round trips, as `clean`."""
    return clean(keys, cache, lambda gone: gone, found=found)


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


@dataclass(slots=True)
class ChangeOutcome:
    it: DocumentChange
    cache: ShapeCache
    commands: Sequence[Command]
    replies: Sequence[Reply]
    main: int  # the position of the command that changes the document
    refusal: PathRefused | None = None  # in the server's words

    def next(self) -> Any:
        members = self._members()
        judged = self._judged()
        # The notice went out in the same transaction as the command that was refused.
        refused = judged is REFUSED or isinstance(judged, Exception)
        if refused and (correction := self.it.announcement.retract(self.it.path)):
            return Plan(
                correction, lambda _: self._settle(members, judged), atomic=True, unfinished=self._not_retracted
            )
        return self._settle(members, judged)

    def _members(self) -> frozenset[bytes]:
        # In the order in which `writes._change` sends: the command, SADD if there are attachments, then SMEMBERS.
        reply = self.replies[self.main + (2 if self.it.attachments else 1)]
        if isinstance(reply, Exception):
            self.cache.of(self.it.keys.document).may_look = False
            return frozenset()
        members = registered(reply, self.it.keys)
        self.cache.of(self.it.keys.document).saw_members(members)
        return members

    def _judged(self) -> Any:
        reply = self.replies[self.main]
        if isinstance(reply, Exception):
            error = explained(reply, self.it.keys, self.it.path)
            # The server calls every item that it cannot set out of range, also where there is no list.
            if type(error) is not PathRefused:
                return error
            self.refusal = error
            return REFUSED
        try:
            judged = self.it.judge(reply)
        except Exception as error:
            return error
        # Servers execute the rest of a transaction when one command fails, and undo nothing.
        refused = [pair for pair in zip(self.commands, self.replies, strict=True) if isinstance(pair[1], Exception)]
        return self._partial(*refused[0]) if refused and judged is not REFUSED else judged

    def _settle(self, members: frozenset[bytes], judged: Any) -> Any:
        if self._suspects(members, judged):
            return clean(self.it.keys, self.cache, lambda _: self._finish(judged), lambda why: self._left(judged, why))
        return self._finish(judged)

    def _suspects(self, members: frozenset[bytes], judged: Any) -> bool:
        shape = self.cache.of(self.it.keys.document)
        if members and shape.interrupted:
            shape.interrupted = False
            return True
        if judged is REFUSED or isinstance(judged, Exception):
            # A deletion of nothing may have found leftovers of an interrupted call.
            return bool(self.it.attachments) or (isinstance(judged, MissingKey) and not self.it.path and bool(members))
        if not members or not self.it.replaces or self.it.gone is not None:
            return False
        # An attachment below the path that this change did not write: another client has stored it in between.
        written = {each.suffix.encode() for each in self.it.attachments}
        return any(member not in written and may_hold(self.it.path, place_of(member)) for member in members)

    def _finish(self, judged: Any) -> Any:
        if judged is REFUSED:
            return diagnose(self.it.keys, self.it.path, self.refusal)
        if isinstance(judged, Exception):
            raise judged
        return judged

    @property
    def _where(self) -> str:
        return show(full(self.it.keys, self.it.path))

    def _partial(self, command: Command, error: Exception) -> PartialWrite:
        left = "what this command should have stored cannot be read: write again"
        if command[0] == "SMEMBERS":
            left = "arrays that it may have replaced stay, unseen, until the next write there"
        return PartialWrite(
            f"{self._where}: the document was written, but not {command[0]} {command[1]!s:.60}: {error}; {left}"
        )

    def _left(self, judged: Any, error: Exception) -> PartialWrite:
        what = "the document was written"
        if judged is REFUSED or isinstance(judged, Exception):
            what = "the document was not written" + (f" ({judged})" if judged is not REFUSED else "")
        return PartialWrite(
            f"{self._where}: {what}, but arrays that nothing refers to could not be removed: {error}; "
            "they stay, unseen, until the next write there"
        )

    def _not_retracted(self, error: Exception) -> PartialWrite:
        return PartialWrite(
            f"{self._where}: refused after subscribers were notified, and the correction failed: {error}; write again"
        )
