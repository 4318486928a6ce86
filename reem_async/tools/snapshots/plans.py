"""What belongs to one top-level key, and the plans that fetch it at one instant and store it again. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import orjson

from ...errors import BadData, Conflict, NotAllowed, PartialWrite, Refused, WrongKind
from ...plan import Command, Plan, Reply
from ...plan.attachments import permitted
from ...plan.floats import exact_text, may_lose
from ...plan.keys import DOCUMENT, Keys
from ...plan.placeholders import find, inline_float, marked
from ...plan.reads import get_command
from ...plan.replies import checked, loads
from ...plan.shapes import ShapeCache

_WORDS = 1000
"""Words of one command at most, so that no single one keeps the server busy for long."""


class Value(NamedTuple):
    """What a ship holds under a key of its own."""

    suffix: str  # of the key's name, after the tag
    kind: str  # the Redis type
    pieces: tuple[Any, ...]  # byte strings: one for a string, several for what has parts

    @property
    def size(self) -> int:
        return sum(map(len, self.pieces))


class KeyContent(NamedTuple):
    """One top-level key at one instant."""

    name: str  # without namespace
    text: bytes  # the document's JSON, as the server sent it
    registry: tuple[str, ...]  # suffixes, sorted
    values: tuple[Value, ...]
    expires: int | None = None  # in milliseconds
    missing: tuple[str, ...] = ()  # suffixes of ships' keys that the document refers to and that are not there

    @property
    def size(self) -> int:
        return len(self.text) + sum([value.size for value in self.values])


class RedisType(NamedTuple):
    """How one Redis type is read and made again."""

    read: Command  # without the key, which comes second
    pieces: Callable[[Reply], Sequence[Any]]  # turns the reply into byte strings
    write: Callable[[str, Sequence[Any]], list[Command]]  # makes it under an empty key


def redis_type(name: str, place: str) -> RedisType:
    """Return how the Redis type `name` is handled; raises BadData, naming the `place`, if it is not."""
    try:
        return REDIS_TYPES[name]
    except KeyError:
        raise BadData(
            f"{place}: its ship keeps it as a Redis {name}, which a portable snapshot cannot hold (it holds "
            f"{', '.join(REDIS_TYPES)}); take an RDB snapshot (`reem snapshot save --rdb`), or leave this key out with "
            "a match pattern"
        ) from None


def settable(text: bytes) -> bytes:
    """Return JSON that makes JSON.SET store the document of which JSON.GET gave `text`.

    The server reads long decimals with one rounding too many, so its own text given back changes one
    float in ten. Floats that no text carries become the string that REEM's readers take for a float.
    """
    try:
        tree = orjson.loads(text)
    except orjson.JSONDecodeError as error:
        raise BadData(f"a document begins with {text[:60]!r} and is not JSON: {error}") from None
    plain = orjson.dumps(tree)  # exponents get a sign, without which the next line does not see them
    return orjson.dumps(_exact(tree)) if may_lose(plain) else plain


def _exact(node: Any) -> Any:
    kind = type(node)
    if kind is float:
        text = exact_text(node)
        return inline_float(node) if text is None else orjson.Fragment(text)
    if kind is dict:
        return {key: _exact(value) for key, value in node.items()}
    if kind is list:
        return [_exact(value) for value in node]
    return node


def joined(pieces: Sequence[Any]) -> bytes:
    """Join byte strings, each after its length and a colon; `split` gets them back."""
    return b"".join([part for piece in pieces for part in (b"%d:" % len(piece), piece)])


def split(blob: bytes) -> list[bytes]:
    """Return the byte strings that `joined` put together; raises BadData."""
    pieces, position = [], 0
    while position < len(blob):
        # A length has at most 19 digits.
        colon = blob.find(b":", position, position + 20)
        digits = blob[position : max(colon, position)]
        end = colon + 1 + int(digits) if digits.isdigit() else len(blob) + 1
        if end > len(blob):
            raise BadData("a value with several parts is damaged")
        pieces.append(bytes(blob[colon + 1 : end]))
        position = end
    return pieces


def _commands(command: str) -> Callable[[str, Sequence[Any]], list[Command]]:
    def write(key: str, pieces: Sequence[Any]) -> list[Command]:
        return [(command, key, *pieces[start : start + _WORDS]) for start in range(0, len(pieces), _WORDS)]

    return write


def _scored(reply: Reply) -> list[Any]:
    return [each for member, score in reply for each in (member, repr(float(score)).encode())]


def _add_scored(key: str, pieces: Sequence[Any]) -> list[Command]:
    turned = [each for place in range(0, len(pieces), 2) for each in (pieces[place + 1], pieces[place])]
    return _commands("ZADD")(key, turned)


# Streams are missing on purpose: no ship is known that uses them, and RDB files hold them.
REDIS_TYPES = {
    "string": RedisType(("GET",), lambda reply: [reply], lambda key, pieces: [("SET", key, pieces[0])]),
    "hash": RedisType(("HGETALL",), lambda reply: [each for pair in reply.items() for each in pair], _commands("HSET")),
    "list": RedisType(("LRANGE", "0", "-1"), list, _commands("RPUSH")),
    "set": RedisType(("SMEMBERS",), sorted, _commands("SADD")),
    "zset": RedisType(("ZRANGE", "0", "-1", "WITHSCORES"), _scored, _add_scored),
    DOCUMENT: RedisType(
        ("JSON.GET", "$"),
        lambda reply: [reply[1:-1]],
        lambda key, pieces: [("JSON.SET", key, "$", settable(pieces[0]))],
    ),
}


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
    """Plan to fetch all that belongs to one top-level key, in one transaction; the result is a `KeyContent` or None.

    One round trip for a document without arrays, else two; more if its shape changes in between: a mixture is never
    returned. None: nothing is stored there.
    """
    return _dump(keys, {}, _TRIES)


def _dump(keys: Keys, asked: dict[str, str], tries: int) -> Plan:
    """Plan to fetch document, registry, and the attachments `asked` for: their Redis types by suffix."""
    # The first transaction asks for no attachments. If document or registry name some that were not asked for, or one
    # has another type than was guessed, the next transaction asks for everything again. Only a transaction that asked
    # for exactly what belongs to the key becomes a `KeyContent`.
    if not tries:
        raise Conflict(f"{keys.name} changed its shape {_TRIES} times while it was read; try again")
    commands: list[Command] = [get_command(keys, ()), ("SMEMBERS", keys.registry)]
    for suffix, kind in asked.items():
        key, read = keys.tag + suffix, redis_type(kind, keys.name + suffix).read
        commands += [("TYPE", key), (read[0], key, *read[1:])]

    def decode(replies: Sequence[Reply]) -> Any:
        text = checked(replies[0], keys, ())
        # nil: no such key. An empty list: nothing at the path.
        if text is None or text == b"[]":
            return None
        placed = _placed(text, keys)
        # A program without REEM has overwritten the registry: the document still says what belongs to it.
        overwritten = isinstance(replies[1], Exception) and not isinstance(replies[1], Refused)
        registry = tuple(sorted(placed)) if overwritten else _registry(replies[1], keys)
        # Replies: document, registry, then type and content of each attachment that was asked for.
        found = {suffix: kind for suffix, kind in zip(asked, map(_type, replies[2::2]), strict=True) if kind != "none"}
        # What the document refers to counts even if the registry has lost it.
        belongs = {*registry, *placed}
        if belongs - set(asked) or any(asked[suffix] != kind for suffix, kind in found.items()):
            # "string" is the guess for a new attachment: arrays and bytes, nearly all.
            return _dump(keys, {suffix: found.get(suffix, "string") for suffix in sorted(belongs)}, tries - 1)
        values = [
            _value(suffix, asked[suffix], reply, keys)
            for suffix, reply in zip(asked, replies[3::2], strict=True)
            if suffix in found and suffix in belongs
        ]
        missing = tuple(sorted(placed - set(found)))
        return KeyContent(keys.name, bytes(text[1:-1]), registry, tuple(values), missing=missing)

    return Plan(commands, decode, atomic=True, bulk=True)


def _registry(reply: Reply, keys: Keys) -> tuple[str, ...]:
    checked(reply, keys, ())
    try:
        return tuple(sorted(bytes(member).decode() for member in reply))
    except UnicodeDecodeError:
        raise BadData(f"{keys.name}: {keys.registry} holds a name that is not text") from None


def _placed(text: bytes, keys: Keys) -> set[str]:
    """Return the suffixes that the document refers to: all of them are in the registry, unless it was damaged."""
    if not marked(text):
        return set()
    try:
        return {slot.placeholder.suffix for slot in find(loads(text, keys), keys.name)}
    except BadData:  # a program without REEM wrote it: it is saved as it is
        return set()


def _value(suffix: str, kind: str, reply: Reply, keys: Keys) -> Value:
    if isinstance(reply, Exception):
        raise reply
    return Value(suffix, kind, tuple(redis_type(kind, keys.name + suffix).pieces(reply)))


def put(
    keys: Keys, content: KeyContent, cache: ShapeCache, *, replace: bool, notices: Callable[[], Sequence[Command]]
) -> Plan:
    """Plan to store a top-level key, with all that belongs to it and the notice, in one transaction.

    Two round trips; more if another client writes to the key between them. `notices` makes the commands that notify
    subscribers; it is called once, when the write is certain.
    """
    return _Put(keys, content, cache, replace, notices).plan()


class _Put:
    """Watches the key, looks at it, and writes; starts again if another client has written in between.

    Not nested functions: those would refer to each other in a circle, and large arrays would wait for the garbage
    collector.
    """

    def __init__(
        self,
        keys: Keys,
        content: KeyContent,
        cache: ShapeCache,
        replace: bool,
        notices: Callable[[], Sequence[Command]],
    ) -> None:
        self._keys = keys
        self._registry = content.registry
        self._cache = cache
        self._replace = replace
        self._notices = notices
        self._notice: Sequence[Command] = ()
        self._suffixes = [value.suffix for value in content.values]
        self._writes: list[Command] = []
        for value in content.values:
            kind = redis_type(value.kind, keys.name + value.suffix)
            self._writes += kind.write(keys.tag + value.suffix, value.pieces)
        self._writes.append(("JSON.SET", keys.document, "$", settable(content.text)))
        if content.registry:
            self._writes.append(("SADD", keys.registry, *content.registry))
        if content.expires is not None:
            names = [keys.document, keys.registry, *(keys.tag + suffix for suffix in self._suffixes)]
            self._writes += [("PEXPIRE", name, str(content.expires)) for name in names]

    def plan(self) -> Plan:
        keys = self._keys
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
        # Only now, since a number that is not used would look like a loss; and once for all attempts.
        self._notice = self._notice or self._notices()
        # First remove the old attachments and all that is in the way of the new ones. Then fill the attachments, set
        # the document and the registry, and publish the notice.
        tag = keys.tag.encode()
        before = sorted(tag + bytes(member) for member in members)
        unlink = ("UNLINK", keys.registry, *before, *(tag + suffix.encode() for suffix in self._suffixes))
        commands = [unlink, *lasting, *self._writes, *self._notice]
        return Plan(commands, partial(self._done, [command[:2] for command in commands]), atomic=True, held=True)

    def _done(self, sent: Sequence[Command], replies: Sequence[Reply] | None) -> Plan | None:
        if replies is None:  # another client wrote in between
            return self.plan()
        for (command, key), reply in zip(sent, replies, strict=True):
            if isinstance(reply, Exception):
                raise PartialWrite(
                    f"{self._keys.name}: the server refused {command} {key!s:.60}: {reply}; the rest was written: "
                    "restore this key again"
                )
        # What this interface remembers of the key no longer holds.
        self._cache.of(self._keys.document).saw_members(frozenset(suffix.encode() for suffix in self._registry))
        self._cache.of(self._keys.document).forget_numbers()
        return None
