"""What belongs to one top-level key, as a snapshot holds it; and the Redis types a ship may use.

Pure: the commands that read a type and that make it again, and JSON text that the server takes
without changing a float.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import orjson

from ...errors import BadData
from ...plan import Command, Reply
from ...plan.floats import exact_text, may_lose
from ...plan.placeholders import inline_float

__all__ = ["KINDS", "Entry", "Value", "joined", "kind_of", "settable", "split"]

_WORDS = 1000
"""Words of one command at most, so that no single one keeps the server busy for long."""

KEY = object()
"""Stands for the key in the words of a command."""


class Value(NamedTuple):
    """What a ship holds under a key of its own.

    Attributes:
        suffix: The key's name after the tag.
        kind: Its Redis type, as TYPE says it.
        pieces: Its content as byte strings: one for a string, several for what has parts.
    """

    suffix: str
    kind: str
    pieces: tuple[Any, ...]

    @property
    def size(self) -> int:
        """Bytes of content."""
        return sum(map(len, self.pieces))


class Entry(NamedTuple):
    """One top-level key at one instant.

    Attributes:
        name: The key, without namespace.
        text: The document's JSON, as the server sent it.
        registry: The suffixes the registry names, sorted.
        values: What the ships hold.
        expires: Milliseconds until the key expires; None if it does not.
        missing: The suffixes of ships' keys that the document refers to and that are not there.
    """

    name: str
    text: bytes
    registry: tuple[str, ...]
    values: tuple[Value, ...]
    expires: int | None = None
    missing: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Bytes of content."""
        return len(self.text) + sum([value.size for value in self.values])


class Kind(NamedTuple):
    """How one Redis type is read and made again.

    Attributes:
        read: The words of the command that fetches all of it, with `KEY` in the key's place.
        pieces: Turns the reply into byte strings.
        write: Returns the commands that make it under an empty key.
    """

    read: Command
    pieces: Callable[[Reply], Sequence[Any]]
    write: Callable[[str, Sequence[Any]], list[Command]]

    def read_command(self, key: str) -> Command:
        """Return the command that fetches what is under `key`."""
        return tuple(key if word is KEY else word for word in self.read)


def kind_of(name: str, place: str) -> Kind:
    """Return how the Redis type `name` is handled; raises BadData, naming the `place`, if it is not."""
    try:
        return KINDS[name]
    except KeyError:
        known = ", ".join(KINDS)
        raise BadData(
            f"{place}: its ship keeps it as a Redis {name}, which a portable snapshot cannot hold (it holds {known}); "
            "take an RDB snapshot (`reem snapshot save --rdb`), or leave this key out with a match pattern"
        ) from None


def settable(text: bytes) -> bytes:
    """Return JSON that makes JSON.SET store the document of which JSON.GET gave `text`.

    The server reads long decimals with one rounding too many, so its own text given back changes one
    float in ten. Floats that no text carries become the string that REEM's readers take for a float.

    Raises:
        BadData: Not JSON.
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
    """Return byte strings as one, from which `split` gets them back: each after its length and a colon."""
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


def _pairs(reply: Reply) -> list[Any]:
    """Return what a hash holds: field, value, field, value."""
    return [each for pair in reply.items() for each in pair]


def _scored(reply: Reply) -> list[Any]:
    """Return what a sorted set holds: member, score, member, score."""
    return [each for member, score in reply for each in (member, repr(float(score)).encode())]


def _turned(pieces: Sequence[Any]) -> list[Any]:
    """Return members and scores as ZADD takes them."""
    return [each for place in range(0, len(pieces), 2) for each in (pieces[place + 1], pieces[place])]


def _in_parts(command: str, key: str, words: Sequence[Any]) -> list[Command]:
    return [(command, key, *words[start : start + _WORDS]) for start in range(0, len(words), _WORDS)]


# Streams are missing on purpose: no ship is known that uses them, and RDB files hold them.
KINDS: dict[str, Kind] = {
    "string": Kind(
        ("GET", KEY),
        lambda reply: [reply],
        lambda key, pieces: [("SET", key, pieces[0])],
    ),
    "hash": Kind(
        ("HGETALL", KEY),
        _pairs,
        lambda key, pieces: _in_parts("HSET", key, pieces),
    ),
    "list": Kind(
        ("LRANGE", KEY, "0", "-1"),
        list,
        lambda key, pieces: _in_parts("RPUSH", key, pieces),
    ),
    "set": Kind(
        ("SMEMBERS", KEY),
        sorted,
        lambda key, pieces: _in_parts("SADD", key, pieces),
    ),
    "zset": Kind(
        ("ZRANGE", KEY, "0", "-1", "WITHSCORES"),
        _scored,
        lambda key, pieces: _in_parts("ZADD", key, _turned(pieces)),
    ),
    "ReJSON-RL": Kind(
        ("JSON.GET", KEY, "$"),
        lambda reply: [reply[1:-1]],
        lambda key, pieces: [("JSON.SET", key, "$", settable(pieces[0]))],
    ),
}
