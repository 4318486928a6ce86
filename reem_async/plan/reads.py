"""Plans that read: one command for plain JSON, one transaction where ships hold a part.

A transaction is what makes document and arrays of one instant. Which arrays to ask for is known
from the last read; the placeholders in the reply say whether that guess was right. If not, the
read is done again with what they name: a mixture is never returned.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from ..errors import BadData, Conflict, MissingDocument, MissingKey, NotAllowed, WrongKind, WrongType
from ..legacy.olddata import first_read as first_read
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

# Reads of a document whose arrays come and go faster than it is read. Each takes a round trip of about 0.1 ms, so 50
# are far more than any program needs, and no writer keeps a reader for ever.
_TRIES = 50

HeldValues = Mapping[tuple[str, str], Any]
"""Values that ships made of attachments, by label and suffix, which are what the server has."""

_NOTHING: HeldValues = {}


class RawRead(NamedTuple):
    """What a read brought, ships' replies not yet interpreted.

    Attributes:
        holder: A list of one: the tree, with placeholders where `slots` says.
        name: The top-level key.
        slots: Where each ship's value goes, the ship, and the reply to interpret.
        commands: What was asked in the end, and
        raw: what was received for it, to tell later whether anything changed.
        also: The replies to what was asked besides, if it was asked for.
        left: What stands in the tree for attachments that were left at the server, by label and suffix.
        unreadable: What stands in the tree for values that could not be read; None if that is an error.
    """

    holder: list[Any]
    name: str
    slots: list[tuple[PlaceholderSlot, Registered, Reply]]
    commands: tuple[Command, ...]
    raw: tuple[Any, ...]
    also: tuple[Any, ...] = ()
    left: Mapping[tuple[str, str], Unfetched] = {}
    unreadable: list[Unreadable] | None = None

    def give_up(self, slot: PlaceholderSlot, error: Exception) -> Unreadable:
        """Return what stands for a value that cannot be read; raises the error if the read is to have all values."""
        if self.unreadable is None:
            raise error
        it = Unreadable(place_of(self.name, slot.placeholder.suffix), str(error))
        self.unreadable.append(it)
        return it


def interpreted(raw_read: RawRead, slot: PlaceholderSlot, ship: Registered, reply: Reply) -> Any:
    """Return what the ship makes of a reply: the value, something for `awaited`, or what `RawRead.give_up` says."""
    try:
        return interpret(raw_read.name, slot, ship, reply)
    except BadData as error:
        return raw_read.give_up(slot, error)


async def awaited(raw_read: RawRead, slot: PlaceholderSlot, value: Awaitable[Any]) -> Any:
    """Return the value that a ship has to be awaited for, or what `RawRead.give_up` says."""
    try:
        return await value
    except Exception as error:
        return raw_read.give_up(slot, error)


def interpret(name: str, slot: PlaceholderSlot, ship: Registered, reply: Reply) -> Any:
    """Return what the ship makes of a reply: the value, or something to await.

    Raises:
        BadData: With the path, if the ship cannot believe it.
    """
    try:
        return ship.ship.interpret_read([reply if ship.blob is not None else _plain(reply)])
    except BadData as error:
        raise BadData(f"{place_of(name, slot.placeholder.suffix)}: {error}") from None
    except Exception as error:
        where = place_of(name, slot.placeholder.suffix)
        raise BadData(f"{where}: the ship {ship.label!r} could not make a value of it: {error!r}") from error


def _plain(reply: Reply) -> Reply:
    """Return a reply as redis-py would: large strings are bytes there, not bytearrays."""
    # The transport reads large strings into a bytearray, without a copy. Ships of users know redis-py's bytes only.
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
    """Plan to read the value at `path`; the result is `RawRead`, or MissingKey is raised.

    What is asked `also` is of the same instant, in one transaction; then that nothing is there is no error: the
    result holds MISSING. One round trip, if the arrays there are those the last read met; else two or more.

    Attachments that are `held` are not fetched. Which these are is looked at again as the reply is decoded: what has
    left `held` by then is fetched in another round trip. Attachments of more than `largest` bytes are not fetched:
    an `Unfetched` is in the tree, the same as in `held` if that has one; their keys are only touched.

    A `tolerant` read has an `Unreadable` in the place of each attachment that cannot be read, now or by `interpreted`:
    it is gone or damaged, its ship is lacking, the user may not read it. Any other read raises BadData or NotAllowed.
    """
    # States of a read: without a guess it asks for the document alone, and is done if there are no placeholders in it.
    # Else `_Fetch` asks for document and arrays in one transaction, until the placeholders are those that were asked
    # for.
    known = cache.layout(keys.document, path)
    # What a ship wrote that is lacking here is an error if it is there still; that a reply says, not a guess.
    known = tuple([each for each in known if ships.has(each.label) or each.size > largest])
    if known:
        return _Fetch(keys, path, ships, cache, known, also, held, largest, tolerant=tolerant).plan()

    command = get_command(keys, path)

    def decode(replies: Sequence[Reply]) -> Any:
        text = _found(replies[0], keys, path, bool(also))
        # Only where a note is asked for besides: a follower wants to know that nothing is there, and as of when.
        if text is None:
            return RawRead([MISSING], keys.name, [], (command,), (None,), tuple(replies[1:]))
        holder = loads(text, keys)
        unreadable: list[Unreadable] | None = [] if tolerant else None
        slots = find(holder, keys.name, unreadable) if marked(text) else []
        if not slots:
            return RawRead(holder, keys.name, [], (command,), (text,), tuple(replies[1:]), unreadable=unreadable)
        met = tuple(slot.placeholder for slot in slots)
        return _Fetch(keys, path, ships, cache, met, also, held, largest, tolerant=tolerant).plan()

    return Plan([command, *also], decode, atomic=bool(also))


def _found(reply: Reply, keys: Keys, path: Path, may_lack: bool) -> bytes | None:
    """Return the text of a reply to JSON.GET; None if nothing is there and that `may` be."""
    try:
        return present(reply, keys, path)
    except MissingKey:
        if may_lack:
            return None
        raise


def present(reply: Reply, keys: Keys, path: Path) -> bytes:
    """Return the text of a reply to JSON.GET; raise MissingKey if there is nothing."""
    text: bytes | None = reply if type(reply) is bytes else checked(reply, keys, path)
    # nil: there is no document. An empty list: there is one, and nothing at the path.
    if text is None or text == b"[]":
        raise missing(keys, path, text)
    return text


class _Fetch:
    """Reads document and ships' keys in one transaction, again if the guess was wrong."""

    __slots__ = ("also", "cache", "held", "keys", "largest", "path", "refused", "ships", "tolerant", "tries", "wanted")

    def __init__(
        self,
        keys: Keys,
        path: Path,
        ships: Ships,
        cache: ShapeCache,
        wanted: tuple[Placeholder, ...],
        also: tuple[Command, ...] = (),
        held: HeldValues = _NOTHING,
        largest: float = math.inf,
        *,
        tolerant: bool,
    ) -> None:
        self.tolerant = tolerant
        self.refused: dict[tuple[str, str], Exception] = {}  # what the user may not read
        self.held = held
        self.largest = largest
        self.keys = keys
        self.path = path
        self.ships = ships
        self.cache = cache
        self.wanted = wanted
        self.also = also
        self.tries = 0

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
        # Read-only, and enough for CLIENT TRACKING: the server tells of changes to keys that were read, whatever the
        # command.
        touches = [("TYPE", self.keys.tag + suffix) for _, suffix in left]
        commands = (get_command(self.keys, self.path), *reads, *touches, *self.also)
        # By the sizes in the placeholders of the last read; a wrong one only chooses the other connection.
        bulk = sum(each.size for each in fetched) >= LARGE
        return Plan(
            commands,
            lambda replies: self._decode(asked, left, commands, replies),
            atomic=True,
            bulk=bulk,
            without_refused=partial(self._without_refused, [*asked, *left]) if self.tolerant else None,
        )

    def _unobtainable(self, it: Placeholder) -> Exception | None:
        """Return why an attachment is not asked for by a tolerant read; None if it is."""
        if not self.tolerant or it.size > self.largest:  # then no ship is needed
            return self.refused.get((it.label, it.suffix))
        if not self.ships.has(it.label):
            return self.ships.lacks(it.label, "it")
        return self.refused.get((it.label, it.suffix))

    def _without_refused(self, places: list[tuple[str, str]], replies: Sequence[Reply]) -> Plan | None:
        """Plan to read what the user may read; None if that is not even the document."""
        refused = {place: it for place, it in zip(places, replies[1:], strict=False) if isinstance(it, NotAllowed)}
        if not refused or isinstance(replies[0], Exception):
            return None
        self.refused |= refused
        return self.plan()

    def _decode(
        self,
        asked: dict[tuple[str, str], Registered],
        left: set[tuple[str, str]],
        commands: tuple[Command, ...],
        replies: Sequence[Reply],
    ) -> Any:
        end = 1 + len(asked) + len(left)
        text = _found(replies[0], self.keys, self.path, bool(self.also))
        if text is None:
            return RawRead([MISSING], self.keys.name, [], commands, (None,), tuple(replies[end:]))
        holder = loads(text, self.keys)
        unreadable: list[Unreadable] | None = [] if self.tolerant else None
        slots = find(holder, self.keys.name, unreadable)
        met = tuple(slot.placeholder for slot in slots)
        got = dict(zip(asked, replies[1:], strict=False))
        places = [(each.label, each.suffix) for each in met]
        # Left at the server: by its size now, which may be another one than when it was asked for.
        touched = {place for place, each in zip(places, met, strict=True) if each.size > self.largest} & (
            left | got.keys()
        )
        errors = {place: self._unobtainable(each) for place, each in zip(places, met, strict=True)}
        # A placeholder of which nothing was asked: the document was changed since the last read. What came is thrown
        # away, since arrays of a later instant do not belong to it.
        if any(
            place not in got and place not in self.held and place not in touched and errors[place] is None
            for place in places
        ):
            return self._again(met)
        # Only now: a guess that was wrong must not be remembered.
        self.cache.saw_layout(self.keys.document, self.path, met)
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
        """Return an error if another type of data is under a ship's key, None if it is a reply for the ship."""
        if not isinstance(reply, Exception):
            return None
        # A stranger has put a list or a hash under the ship's key; any other error is the server's own.
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
    """Plan to find out whether there is a document in one round trip; what REEM did not write is none."""

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
        # JSON.TYPE answers an empty list, or nil, where nothing is.
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
    """Plan to list the keys of the dict at `path` in one round trip; raises MissingKey or WrongType in decode."""

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
    """Return what a read brought that raised `why`."""
    # What JSON.GET has answered: `exchange` compares it with the reply that it gets under WATCH.
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
    """Return the command that tells how many entries a dict has; `count_in` reads its reply.

    JSON.OBJLEN of a key that is not there names the path in its error, at which RedisJSON 2.8 panics, and the
    server ends, if the path has a character whose code point ends in 00, such as U+4E00. Who asks for the keys
    in its place gets more than is needed, but never that.
    """
    return ("JSON.OBJLEN" if place.isascii() else "JSON.OBJKEYS", document, place)


def count_in(reply: Reply) -> int | None:
    """Return the number in a reply to JSON.OBJLEN or JSON.ARRLEN, or of the keys in one to JSON.OBJKEYS; or None."""
    first = reply[0] if isinstance(reply, list) and reply else None
    return len(first) if isinstance(first, list) else first
