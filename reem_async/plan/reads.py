"""Plans that read: one command for plain JSON, one transaction for a document with attachments.

The transaction makes document and arrays of one instant. The last read tells which arrays to ask for; the placeholders
in the reply show whether that guess was right. If not, the read is repeated with those: a mixture is never returned.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from ..errors import BadData, Conflict, MissingDocument, MissingKey, NotAllowed, WrongKind, WrongType, is_of_command
from ..legacy.olddata import first_read as first_read  # for all that read: only this module imports it
from ..legacy.olddata import look_first as look_first
from ..ships.registry import Registered, Ships
from . import Command, Plan, Reply
from .keys import Keys
from .paths import Path, show, to_jsonpath
from .placeholders import Placeholder, PlaceholderSlot, Unfetched, Unreadable, find, marked, place_of
from .replies import checked, explained, full, loads, missing, type_name
from .shapes import ShapeCache
from .sizes import LARGE
from .trees import MISSING

# Attempts at a document whose arrays change their places in between. A round trip takes about 0.1 ms, so 50 are far
# more than any program needs, and no writer blocks a reader for ever.
_TRIES = 50

HeldValues = Mapping[tuple[str, str], Any]
"""Values of attachments, by label and suffix, that are equal to those on the server."""

_NOTHING: HeldValues = {}


class RawRead(NamedTuple):
    holder: list[Any]  # a list of one: the tree, with placeholders where `slots` says
    name: str  # the top-level key
    # Of each attachment, its place in the tree, the ship, and the reply to interpret.
    slots: list[tuple[PlaceholderSlot, Registered, Reply]]
    commands: tuple[Command, ...]  # the last commands that were sent, and
    raw: tuple[Any, ...]  # their replies: `exchange` compares with these
    also: tuple[Any, ...] = ()  # the replies to the additional commands, if there were any
    # The objects in the tree for attachments that were not fetched, by label and suffix.
    left: Mapping[tuple[str, str], Unfetched] = {}
    # The objects in the tree for values that cannot be read; None if that is an error.
    unreadable: list[Unreadable] | None = None

    def give_up(self, slot: PlaceholderSlot, error: Exception) -> Unreadable:
        """Return an Unreadable; raises the error if the read is not tolerant."""
        if self.unreadable is None:
            raise error
        it = Unreadable(place_of(self.name, slot.placeholder.suffix), str(error))
        self.unreadable.append(it)
        return it


def interpreted(raw_read: RawRead, slot: PlaceholderSlot, ship: Registered, reply: Reply) -> Any:
    """Return what the ship makes of a reply: the value, something for `awaited`, or an Unreadable."""
    cause: Exception | None = None
    try:
        return ship.ship.interpret_read([reply if ship.blob is not None else with_bytes(reply)])
    except BadData as error:
        problem = str(error)
    except Exception as error:
        problem, cause = f"the ship {ship.label!r} could not make a value of it: {error!r}", error
    it = BadData(f"{place_of(raw_read.name, slot.placeholder.suffix)}: {problem}")
    it.__cause__ = cause
    return raw_read.give_up(slot, it)


async def awaited(raw_read: RawRead, slot: PlaceholderSlot, value: Awaitable[Any]) -> Any:
    try:
        return await value
    except Exception as error:
        return raw_read.give_up(slot, error)


def with_bytes(reply: Reply) -> Reply:
    """Return a reply as redis-py gives it to ships of users: the transport reads large strings into a bytearray."""
    if isinstance(reply, bytearray):
        return bytes(reply)
    if isinstance(reply, list):
        return [with_bytes(item) for item in reply]
    if isinstance(reply, dict):
        return {with_bytes(key): with_bytes(item) for key, item in reply.items()}
    return reply


def get_command(keys: Keys, path: Path) -> Command:
    return ("JSON.GET", keys.document, to_jsonpath(path))


def read(
    keys: Keys,
    path: Path,
    ships: Ships,
    cache: ShapeCache,
    also: tuple[Command, ...] = (),
    held: HeldValues = _NOTHING,
    largest: float = math.inf,
    *,
    tolerant: bool = False,
) -> Plan:
    """Plan to read the value at `path`; the result is a `RawRead`, or MissingKey is raised.

    The commands `also` are executed in the same transaction. With these, a missing value is no error: the result holds
    MISSING. One round trip, if the arrays are those of the last read; else two or more.

    Attachments in `held` are not fetched. `held` is looked at again when the reply is decoded: an attachment that has
    left it by then is fetched in another round trip. Attachments of more than `largest` bytes are not fetched either:
    an `Unfetched` is in the tree, the one in `held` if there is one; their keys are only touched.

    A `tolerant` read has an `Unreadable` in the place of each attachment that cannot be read, now or by `interpreted`:
    it is gone or damaged, its ship is missing, the user may not read it. Any other read raises BadData or NotAllowed.
    """
    # Without a guess, first ask for the document alone; if it has no placeholders, that is all. Else `_Fetch` asks for
    # document and arrays in one transaction, until the placeholders are those that were asked for.
    known = cache.of(keys.document).layout(path)
    # A missing ship is an error only if the reply still has its placeholder.
    known = tuple([each for each in known if ships.has(each.label) or each.size > largest])
    if known:
        return _Fetch(keys, path, ships, cache, known, also, held, largest, tolerant).plan()

    command = get_command(keys, path)

    def decode(replies: Sequence[Reply]) -> Any:
        text = _found(replies[0], keys, path, bool(also))
        if text is None:
            return RawRead([MISSING], keys.name, [], (command,), (None,), tuple(replies[1:]))
        holder = loads(text, keys)
        unreadable: list[Unreadable] | None = [] if tolerant else None
        slots = find(holder, keys.name, unreadable) if marked(text) else []
        if not slots:
            return RawRead(holder, keys.name, [], (command,), (text,), tuple(replies[1:]), unreadable=unreadable)
        met = tuple(slot.placeholder for slot in slots)
        return _Fetch(keys, path, ships, cache, met, also, held, largest, tolerant).plan()

    return Plan([command, *also], decode, atomic=bool(also))


def _found(reply: Reply, keys: Keys, path: Path, may_lack: bool) -> bytes | None:
    """Return the text of a reply to JSON.GET; None if nothing is there and it `may_lack`."""
    try:
        return present(reply, keys, path)
    except MissingKey:
        if may_lack:
            return None
        raise


def present(reply: Reply, keys: Keys, path: Path) -> bytes:
    text: bytes | None = reply if type(reply) is bytes else checked(reply, keys, path)
    # nil: there is no document. An empty list: there is one, and nothing at the path.
    if text is None or text == b"[]":
        raise missing(keys, path, text)
    return text


@dataclass(slots=True)
class _Fetch:
    keys: Keys
    path: Path
    ships: Ships
    cache: ShapeCache
    wanted: tuple[Placeholder, ...]
    also: tuple[Command, ...]
    held: HeldValues
    largest: float
    tolerant: bool
    touches: bool = True
    tries: int = 0
    refused: dict[tuple[str, str], Exception] = field(default_factory=dict)  # attachments that the user may not read

    def plan(self) -> Plan:
        where = show(full(self.keys, self.path))
        lacking = [
            each
            for each in self.wanted
            if (each.label, each.suffix) not in self.held and self._unobtainable(each) is None
        ]
        fetched = [each for each in lacking if each.size <= self.largest]
        asked = {(each.label, each.suffix): self.ships.labelled(each.label, where) for each in fetched}
        left = {(each.label, each.suffix) for each in lacking if each.size > self.largest}
        reads = [ship.read_command(self.keys.tag + suffix) for (_, suffix), ship in asked.items()]
        # Enough for CLIENT TRACKING: the server reports changes of keys that any command has read.
        touches = [("TYPE", self.keys.tag + suffix) for _, suffix in left if self.touches]
        commands = (get_command(self.keys, self.path), *reads, *touches, *self.also)
        # By the sizes at the last read; if they are wrong, the other connection is used.
        bulk = sum(each.size for each in fetched) >= LARGE
        return Plan(
            commands,
            lambda replies: self._decode(asked, left, 1 + len(reads) + len(touches), commands, replies),
            atomic=True,
            bulk=bulk,
            without_refused=partial(self._without_refused, [*asked], [*left]) if self.tolerant else None,
        )

    def _unobtainable(self, it: Placeholder) -> Exception | None:
        # Of a larger one no ship is needed.
        if self.tolerant and it.size <= self.largest and not self.ships.has(it.label):
            return self.ships.lacks(it.label, "it")
        return self.refused.get((it.label, it.suffix))

    def _without_refused(
        self, asked: list[tuple[str, str]], left: list[tuple[str, str]], replies: Sequence[Reply]
    ) -> Plan | None:
        """Plan to read the attachments that the user may read; None if the document itself was refused."""
        places = [*asked, *left]
        refused = {place: it for place, it in zip(places, replies[1:], strict=False) if isinstance(it, NotAllowed)}
        if not refused or isinstance(replies[0], Exception):
            return None
        if any(place in left and is_of_command(it) for place, it in refused.items()):  # TYPE: it is not needed to read
            self.touches = False
        else:
            self.refused |= refused
        return self.plan()

    def _decode(
        self,
        asked: dict[tuple[str, str], Registered],
        left: set[tuple[str, str]],
        end: int,
        commands: tuple[Command, ...],
        replies: Sequence[Reply],
    ) -> Any:
        text = _found(replies[0], self.keys, self.path, bool(self.also))
        if text is None:
            return RawRead([MISSING], self.keys.name, [], commands, (None,), tuple(replies[end:]))
        holder = loads(text, self.keys)
        unreadable: list[Unreadable] | None = [] if self.tolerant else None
        slots = find(holder, self.keys.name, unreadable)
        met = tuple(slot.placeholder for slot in slots)
        got = dict(zip(asked, replies[1:], strict=False))
        places = [(each.label, each.suffix) for each in met]
        # Not fetched: by its size now, which may have changed since it was asked for.
        touched = {place for place, each in zip(places, met, strict=True) if each.size > self.largest} & (
            left | got.keys()
        )
        errors = {place: self._unobtainable(each) for place, each in zip(places, met, strict=True)}
        # A placeholder that was not asked for: the document has changed since the last read. Start again, since arrays
        # of a later instant do not belong to it.
        if any(
            place not in got and place not in self.held and place not in touched and errors[place] is None
            for place in places
        ):
            return self._again(met)
        self.cache.of(self.keys.document).saw_layout(self.path, met)
        placed: list[tuple[PlaceholderSlot, Registered, Reply]] = []
        unfetched: dict[tuple[str, str], Unfetched] = {}
        raw, also = (text, *replies[1:end]), tuple(replies[end:])
        raw_read = RawRead(holder, self.keys.name, placed, commands, raw, also, unfetched, unreadable)
        for slot, place in zip(slots, places, strict=True):
            error = errors[place] or self._strange(got.get(place), place[1])
            if error is not None:
                slot.container[slot.key] = raw_read.give_up(slot, error)
            elif place in got and place not in touched:
                placed.append((slot, asked[place], got[place]))
            elif place in touched:
                it = slot.placeholder
                slot.container[slot.key] = unfetched[place] = Unfetched(it.label, it.size, it.summary)
            else:
                slot.container[slot.key] = self.held[place]
        return raw_read

    def _strange(self, reply: Reply, suffix: str) -> BadData | None:
        if not isinstance(reply, Exception):
            return None
        # A foreign program has put a list or a hash under the attachment's key; any other error is the server's own.
        if isinstance(explained(reply, self.keys, self.path), WrongKind):
            where = place_of(self.keys.name, suffix)
            return BadData(f"{where}: what is under {self.keys.tag}{suffix} is not what the ship wrote: {reply}")
        raise reply

    def _again(self, met: tuple[Placeholder, ...]) -> Plan:
        self.tries += 1
        if self.tries > _TRIES:
            raise Conflict(
                f"{show(full(self.keys, self.path))} changed its shape {_TRIES} times while it was read; read again"
            )
        self.wanted = met
        return self.plan()


def exists(keys: Keys) -> Plan:
    def decode(replies: Sequence[Reply]) -> bool:
        try:
            return type_name(checked(replies[0], keys, ())) is not None
        except WrongKind:
            return False

    return Plan([("JSON.TYPE", keys.document, "$")], decode)


def type_of(keys: Keys, path: Path, ships: Ships) -> Plan:
    """Plan to find the Python type at `path`: one round trip, two for what is text on the server.

    The result is None where only reading the value can tell.
    """

    def decode(replies: Sequence[Reply]) -> Any:
        name = type_name(checked(replies[0], keys, path))
        if name is None:
            raise missing(keys, path, replies[0])
        return _PYTHON_TYPES.get(name) or Plan([get_command(keys, path)], decode_text)

    def decode_text(replies: Sequence[Reply]) -> Any:
        holder = loads(present(replies[0], keys, path), keys)
        slots = find(holder, keys.name)
        if not slots:
            return type(holder[0])
        return ships.labelled(slots[0].placeholder.label, show(full(keys, path))).carries

    return Plan([("JSON.TYPE", keys.document, to_jsonpath(path))], decode)


def keys_at(keys: Keys, path: Path) -> Plan:
    def decode(replies: Sequence[Reply]) -> list[str]:
        reply = checked(replies[0], keys, path)
        if not reply:
            raise missing(keys, path, reply)
        if not isinstance(reply[0], list):
            raise _no_dict(keys, path)
        return [name.decode() for name in reply[0]]

    return Plan([("JSON.OBJKEYS", keys.document, to_jsonpath(path))], decode)


def has_key(keys: Keys, path: Path, key: str) -> Plan:
    """Plan to tell in one round trip if the dict at `path` has a key; raises MissingKey or WrongType in decode."""

    def decode(replies: Sequence[Reply]) -> bool:
        kind = type_name(checked(replies[0], keys, path))
        if kind is None:
            raise missing(keys, path, replies[0])
        if kind != "object":
            raise _no_dict(keys, path)
        return type_name(checked(replies[1], keys, path)) is not None

    places = to_jsonpath(path), to_jsonpath((*path, key))
    return Plan([("JSON.TYPE", keys.document, place) for place in places], decode, atomic=True)


def _no_dict(keys: Keys, path: Path) -> WrongType:
    return WrongType(
        f"{show(full(keys, path))} is not a dict and has no keys; use .read(), and look into what it gives"
    )


def nothing(keys: Keys, path: Path, why: MissingKey) -> RawRead:
    """Return the result of a read that raised `why`, with the reply of JSON.GET for `exchange` to compare with."""
    reply = None if isinstance(why, MissingDocument) else b"[]"
    return RawRead([], keys.name, [], (get_command(keys, path),), (reply,))


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
            raise missing(keys, path, replies[0])
        return next((count for count in map(count_in, replies[1:]) if count is not None), None)

    return Plan(
        [
            ("JSON.TYPE", keys.document, place),
            entries_command(keys.document, place),
            ("JSON.ARRLEN", keys.document, place),
        ],
        decode,
    )


def entries_command(document: str, place: str) -> Command:
    """Return the command for the number of entries of a dict; `count_in` reads its reply."""
    # JSON.OBJLEN of a missing key names the path in its error. RedisJSON 2.8 panics then, and the server exits, if the
    # path has a character whose code point ends in 00, such as U+4E00. JSON.OBJKEYS does not.
    return ("JSON.OBJLEN" if place.isascii() else "JSON.OBJKEYS", document, place)


def count_in(reply: Reply) -> int | None:
    """Return the number in a reply to JSON.OBJLEN, JSON.ARRLEN or JSON.OBJKEYS; or None."""
    first = reply[0] if isinstance(reply, list) and reply else None
    return len(first) if isinstance(first, list) else first
