"""What belongs to one top-level key, the plan that fetches it at one instant, and what stores it again. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import orjson

from ...errors import BadData, Conflict, Refused
from ...plan import Command, Plan, Reply
from ...plan.changes import EncodedAttachment
from ...plan.floats import exact_text, may_lose
from ...plan.keys import DOCUMENT, Keys
from ...plan.placeholders import find, inline_float, marked
from ...plan.reads import get_command
from ...plan.replies import checked, loads

_WORDS = 1000
"""Words of one command at most, so that no single one keeps the server busy for long."""


class Value(NamedTuple):
    suffix: str  # of the key's name, after the tag
    kind: str  # the Redis type
    pieces: tuple[Any, ...]  # byte strings: one for a string, several for what has parts

    @property
    def size(self) -> int:
        return sum(map(len, self.pieces))


class KeyContent(NamedTuple):
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
    commands: list[Command] = [get_command(keys, ()), ("SMEMBERS", keys.registry), ("PTTL", keys.document)]
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
        # Replies: document, registry, time to live, then type and content of each attachment that was asked for.
        found = {suffix: kind for suffix, kind in zip(asked, map(_type, replies[3::2]), strict=True) if kind != "none"}
        # What the document refers to counts even if the registry has lost it.
        belongs = {*registry, *placed}
        if belongs - set(asked) or any(asked[suffix] != kind for suffix, kind in found.items()):
            # "string" is the guess for a new attachment: arrays and bytes, nearly all.
            return _dump(keys, {suffix: found.get(suffix, "string") for suffix in sorted(belongs)}, tries - 1)
        values = [
            _value(suffix, asked[suffix], reply, keys)
            for suffix, reply in zip(asked, replies[4::2], strict=True)
            if suffix in found and suffix in belongs
        ]
        missing = tuple(sorted(placed - set(found)))
        left = int(checked(replies[2], keys, ()))
        return KeyContent(
            keys.name, bytes(text[1:-1]), registry, tuple(values), left if left > 0 else None, missing=missing
        )

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


def storing(keys: Keys, value: Value) -> EncodedAttachment:
    commands = redis_type(value.kind, keys.name + value.suffix).write(keys.tag + value.suffix, value.pieces)
    return EncodedAttachment(value.suffix, "", tuple(commands))
