"""Plans that read: one command for plain JSON, one transaction where ships hold a part.

A transaction is what makes document and arrays of one instant. Which arrays to ask for is known
from the last read; the placeholders in the reply say whether that guess was right. If not, the
read is done again with what they name: a mixture is never returned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from ..errors import BadData, Conflict, WrongKind
from ..ships.registry import Registered, Ships
from . import Command, Plan, Reply
from .keys import Keys
from .memory import Memory
from .paths import Path, show, to_jsonpath
from .placeholders import Crate, Placeholder, find, marked
from .replies import checked, explained, full, loads, missing, type_name
from .sizes import LARGE

__all__ = ["Sealed", "length", "read", "type_of"]

_TRIES = 50


class Sealed(NamedTuple):
    """What a read brought, ships' replies not yet interpreted.

    Attributes:
        holder: A list of one: the tree, with placeholders where `crates` says.
        name: The top-level key.
        crates: Where each ship's value goes, the ship, and the reply to interpret.
        commands: What was asked in the end, and
        raw: what was received for it, to tell later whether anything changed.
        also: The replies to what was asked besides, if it was asked for.
    """

    holder: list[Any]
    name: str
    crates: list[tuple[Crate, Registered, Reply]]
    commands: tuple[Command, ...]
    raw: tuple[Any, ...]
    also: tuple[Any, ...] = ()


def interpret(name: str, crate: Crate, ship: Registered, reply: Reply) -> Any:
    """Return what the ship makes of a reply: the value, or something to await.

    Raises:
        BadData: With the path, if the ship cannot believe it.
    """
    try:
        return ship.ship.interpret_read([reply if ship.blob is not None else _plain(reply)])
    except BadData as error:
        raise BadData(f"{name}{crate.placeholder.suffix.partition('~')[0]}: {error}") from None
    except Exception as error:
        where = f"{name}{crate.placeholder.suffix.partition('~')[0]}"
        raise BadData(f"{where}: the ship {ship.label!r} could not make a value of it: {error!r}") from error


def _plain(reply: Reply) -> Reply:
    """Return a reply as redis-py would: large strings are bytes there, not bytearrays."""
    if isinstance(reply, bytearray):
        return bytes(reply)
    if isinstance(reply, list):
        return [_plain(item) for item in reply]
    if isinstance(reply, dict):
        return {_plain(key): _plain(item) for key, item in reply.items()}
    return reply


def get_command(keys: Keys, path: Path) -> Command:
    """Return the command that fetches the JSON at `path`."""
    return ("JSON.GET", keys.document, to_jsonpath(path))


def read(keys: Keys, path: Path, ships: Ships, memory: Memory, also: tuple[Command, ...] = ()) -> Plan:
    """Plan to read the value at `path`; the result is `Sealed`, or MissingKey is raised.

    What is asked `also` goes into the transaction, where there is one. One round trip, if the arrays
    there are those the last read met; else two or more.
    """
    known = memory.layout(keys.document, path)
    if known:
        return _Fetch(keys, path, ships, memory, known, also).plan()

    command = get_command(keys, path)

    def decode(replies: Sequence[Reply]) -> Any:
        text = present(replies[0], keys, path)
        holder = loads(text, keys)
        crates = find(holder, keys.name) if marked(text) else []
        if not crates:
            return Sealed(holder, keys.name, [], (command,), (text,))
        met = tuple(crate.placeholder for crate in crates)
        return _Fetch(keys, path, ships, memory, met, also).plan()

    return Plan([command], decode)


def present(reply: Reply, keys: Keys, path: Path) -> bytes:
    """Return the text of a reply to JSON.GET; raise MissingKey if there is nothing."""
    text: bytes | None = reply if type(reply) is bytes else checked(reply, keys, path)
    if text is None or text == b"[]":
        raise missing(keys, path)
    return text


class _Fetch:
    """Reads document and ships' keys in one transaction, again if the guess was wrong."""

    __slots__ = ("also", "keys", "memory", "path", "ships", "tries", "wanted")

    def __init__(
        self,
        keys: Keys,
        path: Path,
        ships: Ships,
        memory: Memory,
        wanted: tuple[Placeholder, ...],
        also: tuple[Command, ...] = (),
    ) -> None:
        self.keys = keys
        self.path = path
        self.ships = ships
        self.memory = memory
        self.wanted = wanted
        self.also = also
        self.tries = 0

    def plan(self) -> Plan:
        where = show(full(self.keys, self.path))
        asked = {(each.label, each.suffix): self.ships.labelled(each.label, where) for each in self.wanted}
        self.memory.saw_layout(self.keys.document, self.path, self.wanted)
        reads = [ship.read_command(self.keys.tag + suffix) for (_, suffix), ship in asked.items()]
        commands = (get_command(self.keys, self.path), *reads, *self.also)
        bulk = sum(each.size for each in self.wanted) >= LARGE
        return Plan(
            commands,
            lambda replies: self._decode(asked, commands, replies),
            atomic=True,
            bulk=bulk,
        )

    def _decode(
        self,
        asked: dict[tuple[str, str], Registered],
        commands: tuple[Command, ...],
        replies: Sequence[Reply],
    ) -> Any:
        text = present(replies[0], self.keys, self.path)
        holder = loads(text, self.keys)
        crates = find(holder, self.keys.name)
        met = tuple(crate.placeholder for crate in crates)
        end = 1 + len(asked)
        got = dict(zip(asked, replies[1:end], strict=True))
        if any((each.label, each.suffix) not in got for each in met):
            return self._again(met)
        if met != self.wanted:
            self.memory.saw_layout(self.keys.document, self.path, met)
        crated = [
            (crate, asked[place], self._intact(got[place], place[1]))
            for crate in crates
            for place in [(crate.placeholder.label, crate.placeholder.suffix)]
        ]
        return Sealed(holder, self.keys.name, crated, commands, (text, *replies[1:end]), tuple(replies[end:]))

    def _intact(self, reply: Reply, suffix: str) -> Reply:
        """Return a ship's reply; raise BadData if another type of data is under its key."""
        if not isinstance(reply, Exception):
            return reply
        if isinstance(explained(reply, self.keys, self.path), WrongKind):
            where = f"{self.keys.name}{suffix.partition('~')[0]}"
            raise BadData(f"{where}: what is under {self.keys.tag}{suffix} is not what the ship wrote: {reply}")
        raise reply

    def _again(self, met: tuple[Placeholder, ...]) -> Plan:
        self.tries += 1
        if self.tries > _TRIES:
            raise Conflict(
                f"{show(full(self.keys, self.path))} changed its shape {_TRIES} times while it was read; read again"
            )
        self.wanted = met
        return self.plan()


def type_of(keys: Keys, path: Path, ships: Ships) -> Plan:
    """Plan to find the Python type at `path`: one round trip, two for what is text on the server.

    The result is None where only reading the value can tell.
    """

    def decode(replies: Sequence[Reply]) -> Any:
        name = type_name(checked(replies[0], keys, path))
        if name is None:
            raise missing(keys, path)
        return _PYTHON_TYPES.get(name) or Plan([get_command(keys, path)], decode_text)

    def decode_text(replies: Sequence[Reply]) -> Any:
        holder = loads(present(replies[0], keys, path), keys)
        crates = find(holder, keys.name)
        if not crates:
            return type(holder[0])
        return ships.labelled(crates[0].placeholder.label, show(full(keys, path))).carries

    return Plan([("JSON.TYPE", keys.document, to_jsonpath(path))], decode)


_PYTHON_TYPES = {
    "object": dict,
    "array": list,
    "integer": int,
    "number": float,
    "boolean": bool,
    "null": type(None),
}


def length(keys: Keys, path: Path) -> Plan:
    """Plan to find the length of a dict or list in one round trip; the result is None for anything else."""
    place = to_jsonpath(path)

    def decode(replies: Sequence[Reply]) -> Any:
        if type_name(checked(replies[0], keys, path)) is None:
            raise missing(keys, path)
        counts = [reply[0] for reply in replies[1:] if isinstance(reply, list) and reply]
        return next((count for count in counts if count is not None), None)

    return Plan(
        [
            ("JSON.TYPE", keys.document, place),
            ("JSON.OBJLEN", keys.document, place),
            ("JSON.ARRLEN", keys.document, place),
        ],
        decode,
    )
