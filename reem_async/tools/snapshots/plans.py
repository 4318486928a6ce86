"""Plans of snapshots: what is sent to tell keys apart, to fetch one at one instant, and to put it back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from ...errors import BadData, Conflict, NotAllowed, PartialWrite, Refused, WrongKind
from ...plan import Command, Plan, Reply
from ...plan.attachments import permitted
from ...plan.keys import DOCUMENT, Keys
from ...plan.placeholders import find, marked
from ...plan.reads import get_command
from ...plan.replies import checked, loads
from ...plan.shapes import ShapeCache
from .values import Entry, Value, kind_of, settable

__all__ = ["NOT_ALLOWED", "dump", "lifetimes", "put", "shown", "strangers", "types"]

# Attempts at a key whose shape others change: each takes a round trip, so it is some seconds at worst.
_TRIES = 50


def types(names: Sequence[Any]) -> Plan:
    """Plan to find the Redis types of some keys; the result is their names, "none" for what is not there.

    A key that the user may not look at has the type `NOT_ALLOWED`.
    """

    def decode(replies: Sequence[Reply]) -> list[str]:
        return [_type(reply) for reply in replies]

    return Plan([("TYPE", name) for name in names], decode)


def _type(reply: Reply) -> str:
    if isinstance(reply, Exception):
        if "permissions to access" not in str(reply):
            raise reply  # it is not this key alone that is out of bounds
        return NOT_ALLOWED
    return str(reply.decode())


NOT_ALLOWED = "not allowed"


def lifetimes(names: Sequence[str]) -> Plan:
    """Plan to ask in how many milliseconds keys expire; the result has None for those that do not.

    It is None as a whole if the user may not ask.
    """

    def decode(replies: Sequence[Reply]) -> list[int | None] | None:
        if any(isinstance(reply, NotAllowed) for reply in replies):
            return None
        return [int(reply) if int(reply) > 0 else None for reply in replies]

    # By itself: a user without the right to PTTL would have a whole transaction refused.
    return Plan([("PTTL", name) for name in names], decode)


def shown(key: bytes, kind: str) -> str:
    """Return how a foreign key is named."""
    return f"{key.decode(errors='backslashreplace')} ({kind})"


def strangers(keys: Keys, suffixes: Sequence[bytes]) -> Plan:
    """Plan to find which keys that carry the tag of a top-level key do not belong to it; the result names them.

    What the registry of a document holds belongs to it, and so does its note of the last notice.
    """
    tag = keys.tag.encode()
    commands: list[Command] = [("TYPE", keys.document), ("SMEMBERS", keys.registry)]

    def decode(replies: Sequence[Reply]) -> list[str]:
        # Without a document nothing belongs to the key, whatever a registry says that was left behind.
        there = _type(replies[0]) == DOCUMENT
        known = {b":last"} | (
            {b":ships", *map(bytes, replies[1])} if there and isinstance(replies[1], list | set) else set()
        )
        kinds = zip(suffixes, map(_type, replies[2:]), strict=True)
        return [shown(tag + suffix, kind) for suffix, kind in kinds if suffix not in known and kind != "none"]

    return Plan([*commands, *(("TYPE", tag + suffix) for suffix in suffixes)], decode)


def dump(keys: Keys) -> Plan:
    """Plan to fetch all that belongs to one top-level key, in one transaction; the result is an `Entry` or None.

    One round trip for a document without arrays, else two; more if its shape changes meanwhile: a
    mixture is never returned. None: nothing is stored there.

    Raises (in decode):
        WrongKind: Something other than a document is under the key.
        BadData: A ship keeps its value in a Redis type that cannot be saved.
        Conflict: The shape changed 50 times meanwhile.
    """
    return _Dump(keys).plan()


class _Dump:
    """Fetches document, registry and ships' keys; again if others than those asked for belong to it."""

    __slots__ = ("keys", "kinds", "tries")

    def __init__(self, keys: Keys) -> None:
        self.keys = keys
        self.kinds: dict[str, str] = {}  # Redis types by suffix, guessed at first
        self.tries = 0

    # States: first, with no arrays known, one transaction reads document and registry. If these name attachments that
    # were not asked for, or of another type than was guessed, another transaction asks for everything again. Only a
    # transaction that asked for just what belongs to the key becomes an entry.
    def plan(self) -> Plan:
        asked = dict(self.kinds)
        commands: list[Command] = [get_command(self.keys, ()), ("SMEMBERS", self.keys.registry)]
        for suffix, kind in asked.items():
            key = self.keys.tag + suffix
            commands += [("TYPE", key), kind_of(kind, self.keys.name + suffix).read_command(key)]
        return Plan(commands, lambda replies: self._decode(asked, replies), atomic=True, bulk=True)

    def _decode(self, asked: dict[str, str], replies: Sequence[Reply]) -> Any:
        text = checked(replies[0], self.keys, ())
        # nil: no such key. An empty list: nothing at the path.
        if text is None or text == b"[]":
            return None
        placed = self._placed(text)
        # A program without REEM has overwritten the registry: the document still says what belongs to it.
        overwritten = isinstance(replies[1], Exception) and not isinstance(replies[1], Refused)
        registry = tuple(sorted(placed)) if overwritten else self._registry(replies[1])
        # Replies: document, registry, then type and content for each that was asked for.
        found = {suffix: kind for suffix, kind in zip(asked, map(_type, replies[2::2]), strict=True) if kind != "none"}
        # What the document refers to counts even if the registry has lost it.
        belongs = {*registry, *placed}
        if belongs - set(asked) or any(asked[suffix] != kind for suffix, kind in found.items()):
            # "string" is the guess for what is new: arrays and bytes, nearly everything.
            return self._again({suffix: found.get(suffix, "string") for suffix in sorted(belongs)})
        values = [
            self._value(suffix, asked[suffix], reply)
            for suffix, reply in zip(asked, replies[3::2], strict=True)
            if suffix in found and suffix in belongs
        ]
        missing = tuple(sorted(placed - set(found)))
        return Entry(self.keys.name, bytes(text[1:-1]), registry, tuple(values), missing=missing)

    def _registry(self, reply: Reply) -> tuple[str, ...]:
        checked(reply, self.keys, ())
        try:
            return tuple(sorted(bytes(member).decode() for member in reply))
        except UnicodeDecodeError:
            raise BadData(f"{self.keys.name}: {self.keys.registry} holds a name that is not text") from None

    def _placed(self, text: bytes) -> set[str]:
        """Return the suffixes that the document refers to: all of them are in the registry, unless it was damaged."""
        if not marked(text):
            return set()
        try:
            return {slot.placeholder.suffix for slot in find(loads(text, self.keys), self.keys.name)}
        except BadData:  # a program without REEM wrote it: it is saved as it is
            return set()

    def _value(self, suffix: str, kind: str, reply: Reply) -> Value:
        if isinstance(reply, Exception):
            raise reply
        return Value(suffix, kind, tuple(kind_of(kind, self.keys.name + suffix).pieces(reply)))

    def _again(self, kinds: dict[str, str]) -> Plan:
        self.tries += 1
        if self.tries > _TRIES:
            raise Conflict(f"{self.keys.name} changed its shape {_TRIES} times while it was read; try again")
        self.kinds = kinds
        return self.plan()


def put(
    keys: Keys, entry: Entry, cache: ShapeCache, *, replace: bool, notices: Callable[[], Sequence[Command]]
) -> Plan:
    """Plan to store a top-level key, with all that belongs to it and what tells its subscribers, in one transaction.

    Two round trips; more if somebody else writes to it between them.

    Args:
        keys: Where to.
        entry: What.
        cache: What is known of the server.
        replace: Whether what is there may be replaced.
        notices: Makes the commands that tell subscribers; called once, when it is known that there is a write.

    Raises (in decode):
        Conflict: A document is there and `replace` is False. Nothing was written.
        WrongKind: A foreign Redis type is there. Nothing was written.
        PartialWrite: The server refused a part.
    """
    return _Put(keys, entry, cache, replace=replace, notices=notices).plan()


class _Put:
    """Looks at what is there, then writes, unless somebody else has written in between: then again.

    Not functions within a function: those would refer to each other in a circle, and large arrays would wait
    for the garbage collector.
    """

    def __init__(
        self, keys: Keys, entry: Entry, cache: ShapeCache, *, replace: bool, notices: Callable[[], Sequence[Command]]
    ) -> None:
        self._keys = keys
        self._registry = entry.registry
        self._memory = cache
        self._replace = replace
        self._notices = notices
        # What tells subscribers is made once, though there may be several tries: each stamp uses up a number.
        self._told: Sequence[Command] = ()
        self._suffixes = [value.suffix for value in entry.values]
        self._writes = [command for value in entry.values for command in self._filling(value)]
        self._writes.append(("JSON.SET", keys.document, "$", settable(entry.text)))
        if entry.registry:
            self._writes.append(("SADD", keys.registry, *entry.registry))
        if entry.expires is not None:
            names = [keys.document, keys.registry, *(keys.tag + suffix for suffix in self._suffixes)]
            self._writes += [("PEXPIRE", name, str(entry.expires)) for name in names]

    def _filling(self, value: Value) -> list[Command]:
        kind = kind_of(value.kind, self._keys.name + value.suffix)
        return kind.write(self._keys.tag + value.suffix, value.pieces)

    def plan(self) -> Plan:
        keys = self._keys
        # The document and the registry are watched: if others write to the key before our transaction, it does not run.
        commands = [("WATCH", keys.document, keys.registry), ("TYPE", keys.document), ("SMEMBERS", keys.registry)]
        return Plan(commands, self._look, held=True)

    def _look(self, replies: Sequence[Reply]) -> Plan:
        keys, kind, members = self._keys, _type(replies[1]), replies[2]
        permitted(replies[0], keys.document, keys.registry)
        if kind not in ("none", DOCUMENT):
            raise WrongKind(keys.document, keys.name)
        if kind == DOCUMENT and not self._replace:
            raise Conflict(f"{keys.name!r} is there already; nothing of it was changed")
        if isinstance(members, Exception):
            raise BadData(f"{keys.name}: {keys.registry} is not the set of names it should be: {members}")
        # JSON.SET keeps the expiry of what it replaces.
        lasting = [("PERSIST", keys.document)] if kind == DOCUMENT else []
        # Only now is it known that something will be written: a number that is used up for nothing would look like a
        # loss.
        self._told = self._told or self._notices()
        # Old attachments go, new ones are filled, then the document, the registry and the notice: one transaction.
        commands = [self._clearing(members), *lasting, *self._writes, *self._told]
        return Plan(commands, partial(self._done, [command[:2] for command in commands]), atomic=True, held=True)

    def _clearing(self, members: Reply) -> Command:
        """Return the command that removes what the ships held, and anything in the way of what they will."""
        tag = self._keys.tag.encode()
        before = sorted(tag + bytes(member) for member in members)
        return ("UNLINK", self._keys.registry, *before, *(tag + suffix.encode() for suffix in self._suffixes))

    def _done(self, sent: Sequence[Command], replies: Sequence[Reply] | None) -> Plan | None:
        if replies is None:  # somebody wrote in between
            return self.plan()
        for (command, key), reply in zip(sent, replies, strict=True):
            if isinstance(reply, Exception):
                raise PartialWrite(
                    f"{self._keys.name}: the server refused {command} {key!s:.60}: {reply}; the rest was written: "
                    "restore this key again"
                )
        # What readers and writers of this interface believed of the key no longer holds.
        self._memory.saw_members(self._keys.document, frozenset(suffix.encode() for suffix in self._registry))
        self._memory.forget_numbers(self._keys.document)
        return None
