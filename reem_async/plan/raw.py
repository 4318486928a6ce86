"""Keys of other programs: which command reads each Redis type, what a reply means, and how a value is written.

Nothing of REEM is added to them: a number is written as its JSON text, a text and bytes as they are.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
import orjson

from ..errors import BadKey, BadType, BadValue, NotAllowed, TooLarge, WrongType, is_of_command
from . import Command, Plan, Reply, blamed
from .documents import nested_over
from .keys import DOCUMENT
from .paths import shorten
from .placeholders import Unfetched
from .sizes import LARGE

SHORT = 1 << 12  # bytes below which a string is read without asking for its type first
LARGEST = 64 << 20  # bytes of a key that are fetched unless another number is given
_DEEPEST = 128  # levels of JSON that are decoded; text that is nested deeper stays text
_ATTEMPTS = 5  # to read a key that changes its type each time
# Elements of which the server takes the mean when it is asked for the bytes of a key
_SAMPLES = "100"

# What a robot's texts do not have, and packed numbers and images do, in their first bytes
_LOOKED_AT = 4096
_BINARY = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
# What REEM stores beside its documents: `{foo}.bar.image`, `{foo}:ships`, large values of calls, staged values.
_COMPANION = re.compile(rb"\{[^{}]*\}(?:$|[.\[]|:(?:ships|last|lease|fence|nodes?|staged|call|answer)(?:$|[:.]))")


class RawValue(NamedTuple):
    """What is at a key."""

    kind: str  # the Redis type, such as "hash"; "none" if nothing is there
    value: Any  # an `Unfetched` if it is too large
    size: int  # bytes: of a string its length, of others the memory that they take on the server


class _Reading(NamedTuple):
    """How one Redis type is read."""

    measure: str  # the command that counts its bytes or elements
    command: str  # the command that reads it, and the words behind the key
    words: tuple[str, ...]
    decode: Callable[[Any], Any]


def plain_value(data: bytes) -> Any:
    """Return what the bytes of another program mean: JSON if they are, else text, else the bytes."""
    with suppress(orjson.JSONDecodeError):
        value = orjson.loads(data)
        if not nested_over(data, [value], _DEEPEST):
            return value
    with suppress(UnicodeDecodeError):
        if _BINARY.search(data[:_LOOKED_AT]) is None:
            return data.decode()
    return bytes(data)


def _name(data: bytes) -> str:
    return data.decode(errors="backslashreplace")


def _pairs(reply: Mapping[bytes, bytes] | Sequence[bytes]) -> dict[str, Any]:
    """Return the fields of a hash, or of an entry of a stream: some servers send them in one list."""
    pairs: Iterable[Any]
    pairs = reply.items() if isinstance(reply, Mapping) else zip(reply[::2], reply[1::2], strict=True)
    return {_name(field): plain_value(value) for field, value in pairs}


def _scores(reply: Sequence[Any]) -> dict[str, float]:
    return {_name(member): float(score) for member, score in reply}


def _members(reply: Iterable[bytes]) -> list[Any]:
    return [plain_value(each) for each in sorted(map(bytes, reply))]


_READINGS = {
    "string": _Reading("STRLEN", "GET", (), plain_value),
    "hash": _Reading("HLEN", "HGETALL", (), _pairs),
    "list": _Reading("LLEN", "LRANGE", ("0", "-1"), lambda reply: [plain_value(each) for each in reply]),
    "set": _Reading("SCARD", "SMEMBERS", (), _members),
    "zset": _Reading("ZCARD", "ZRANGE", ("0", "-1", "WITHSCORES"), _scores),
    "stream": _Reading(
        "XLEN", "XREVRANGE", ("+", "-", "COUNT", "1"), lambda reply: _pairs(reply[0][1]) if reply else {}
    ),
}


def check_raw_name(name: object, what: str = "key") -> str:
    """Return the name of a key or field of another program; raises BadKey."""
    try:
        if isinstance(name, str) and name and name.encode():
            return str(name)
    except UnicodeEncodeError:
        pass
    raise BadKey(f"the {what} {shorten(name)} of another program is not a str of UTF-8 with at least a character")


def raw_name(key: bytes) -> str | None:
    """Return the name of a key that may be another program's; None if REEM has made it, or it is not UTF-8."""
    if key[:1] == b"{" and _COMPANION.match(key) is not None:
        return None
    try:
        return key.decode()
    except UnicodeDecodeError:
        return None


def kinds_of(names: Sequence[str]) -> Plan:
    """Plan to ask for the Redis types of keys: a dict.

    Those of REEM, those that are not there, and those that the user may not look at are left out.
    """

    def decode(replies: Sequence[Reply]) -> dict[str, str]:
        kinds: dict[str, str] = {}
        for name, reply in zip(names, replies, strict=True):
            if not isinstance(reply, NotAllowed) or is_of_command(reply):
                kinds[name] = _raised(name, reply, "TYPE").decode()
        return {name: kind for name, kind in kinds.items() if kind not in (DOCUMENT, "none")}

    return Plan([("TYPE", name) for name in names], decode)


def read(name: str, largest: float = LARGEST, attempts: int = _ATTEMPTS) -> Plan:
    """Plan to read a key, as a `RawValue`; two round trips. Of a document of REEM only the kind is told.

    Its decode raises WrongType for a type of the server that this does not know.
    """

    def decode(replies: Sequence[Reply]) -> Any:
        kind, size = _raised(name, replies[0], "TYPE").decode(), replies[1]
        if isinstance(size, NotAllowed) or not isinstance(size, int | Exception):
            size = 0  # this user cannot be told, or the key has just gone
        size = _raised(name, size, "MEMORY USAGE")
        if kind == "none":
            return RawValue(kind, None, 0)
        if kind == DOCUMENT:
            return RawValue(kind, None, 0)
        if (reading := _READINGS.get(kind)) is None:
            raise WrongType(
                f"{name} is of the Redis type {kind}, which has no form in Python; ask with interface.client"
            )
        command = (reading.command, name, *reading.words)
        fetch = Plan([command], lambda got: _decoded(name, kind, reading, got[0], size, again), bulk=size >= LARGE)

        def measured(counts: Sequence[Reply]) -> Any:
            count = counts[0] if isinstance(counts[0], int) else 0
            if kind == "string":  # it is shorter than the memory that it takes
                return fetch if count <= largest else RawValue(kind, Unfetched(kind, count, "bytes"), count)
            return RawValue(kind, Unfetched(kind, size, f"{kind} of {count}"), size)

        if size > largest and kind != "stream":  # of a stream only the last entry is read
            return Plan([(reading.measure, name)], measured)
        return fetch

    def again() -> Plan:
        return read(name, largest, attempts - 1)

    if not attempts:
        raise WrongType(f"{name} changed its type {_ATTEMPTS} times while it was read; read it again")
    return Plan(look(name), decode)


def read_short(name: str, largest: float = LARGEST) -> Plan:
    """Plan to read a key that was a short string, as `read`: one round trip if it still is, else three."""

    def decode(replies: Sequence[Reply]) -> Any:
        data = replies[0]
        # Without the JSON module a document of REEM is a string too, which begins with a space.
        if isinstance(data, bytes) and 0 < len(data) < min(SHORT, largest) and data[:1] != b" ":
            return RawValue("string", plain_value(data), len(data))
        return read(name, largest)

    return Plan([("GETRANGE", name, "0", str(SHORT - 1))], decode)


def look(name: str) -> list[Command]:
    """Return the commands that ask for the Redis type of a key and the bytes that it takes."""
    return [("TYPE", name), ("MEMORY", "USAGE", name, "SAMPLES", _SAMPLES)]


def _decoded(name: str, kind: str, reading: _Reading, reply: Reply, size: int, again: Callable[[], Plan]) -> Any:
    if isinstance(reply, Exception) and str(reply).startswith("WRONGTYPE"):
        return again()
    if reply is None:  # it has gone since its type was asked for
        return RawValue("none", None, 0)
    value = reading.decode(_raised(name, reply, reading.command))
    return RawValue(kind, value, len(reply) if kind == "string" else size)


def fetched(name: str, it: RawValue, largest: float) -> Any:
    """Return the value of a read; raises TooLarge, and WrongType for a document of REEM."""
    if it.kind == DOCUMENT:
        raise WrongType(f"{name} is a document of REEM: read it with kvs[{name!r}], without .raw")
    if isinstance(it.value, Unfetched):
        raise TooLarge(
            f"{name}: this {it.kind} takes {it.size} bytes, and a read fetches {largest:.0f}; "
            f"read(largest={it.size}) fetches it"
        )
    return it.value


def read_field(name: str, field: str, largest: float = LARGEST) -> Plan:
    """Plan to read one field of a hash; None if it is not there. Two round trips; its decode raises as `read`."""

    def decode(replies: Sequence[Reply]) -> Any:
        if isinstance(replies[0], Exception) and str(replies[0]).startswith("WRONGTYPE"):
            raise WrongType(f"{name} is no hash, so it has no field {field!r}; read all of it")
        size = _raised(name, replies[0], "HSTRLEN")
        if size > largest:
            return fetched(f"{name}, field {field!r}", RawValue("value", Unfetched("string", size, ""), size), largest)
        return Plan([("HGET", name, field)], lambda got: decode_value(got[0]), bulk=size >= LARGE)

    def decode_value(reply: Reply) -> Any:
        found = _raised(name, reply, "HGET")
        return None if found is None else plain_value(found)

    return Plan([("HSTRLEN", name, field)], decode)


def write(name: str, field: str | None, value: Any) -> Plan:
    """Plan to write a string, or a field of a hash; two round trips. Raises BadType or BadValue at once.

    Its decode raises WrongType, with nothing written, if the key is of another type.
    """
    data, wanted = _encoded(name, value), "string" if field is None else "hash"
    command = ("SET", name, data) if field is None else ("HSET", name, field, data)

    def decode(replies: Sequence[Reply]) -> Any:
        kind = _raised(name, replies[0], "TYPE").decode()
        if kind in (wanted, "none"):
            return Plan([command], lambda got: _raised(name, got[0], str(command[0])) and None)
        if kind == DOCUMENT:
            raise WrongType(f"{name} is a document of REEM: write it with kvs[{name!r}], without .raw")
        raise WrongType(
            f"{name} is a {kind}, and kvs.raw writes strings and fields of hashes; nothing was written; "
            "change it as the program that owns it does"
        )

    return Plan([("TYPE", name)], decode)


def _encoded(name: str, value: Any) -> bytes:
    if isinstance(value, bytes | bytearray | memoryview):
        return bytes(value)
    try:
        text = value if isinstance(value, str) else json.dumps(value, allow_nan=False, ensure_ascii=False)
        return text.encode()
    except TypeError:
        array = isinstance(value, np.ndarray | np.generic)
        cure = "use its .tolist() for JSON, its .tobytes() for packed bytes" if array else "convert it to plain values"
        raise BadType(f"{name}: a {type(value).__name__} is neither JSON, text nor bytes; {cure}") from None
    except (ValueError, RecursionError) as error:
        raise BadValue(f"{name}: {shorten(value)} cannot be JSON or UTF-8 text: {error}") from None


def _raised(name: str, reply: Reply, command: str) -> Any:
    if isinstance(reply, Exception):
        raise blamed(reply, (command, name))
    return reply
