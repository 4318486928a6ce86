"""Old keys: find them by SCAN, make their values from their parts, and convert them in place."""

from __future__ import annotations

import re
import secrets
import shlex
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..connection import RedisInterface
from ..errors import BadData, BadInput, BadKey, Conflict, MissingKey, NotAllowed, PartialWrite, WrongKind
from ..plain.documents import is_document
from ..plan import Command, Plan, Reply
from ..plan.attachments import permitted
from ..plan.changes import Announcement
from ..plan.keys import DOCUMENT, Keys
from ..plan.paths import Path, Pattern, check_top_key, escaped, shorten, to_jsonpath
from ..plan.placeholders import Placeholder, PlaceholderSlot
from ..plan.reads import RawRead, nothing, read
from ..plan.sizes import STAGED
from ..plan.writes import exchange, set_change
from ..session import Session
from ..ships.numpy import NumpyShip
from ..store.document import Turn, opened
from ..store.publish import DocumentPublisher
from ..tools.snapshots.plans import settable
from ..transport import scanned
from .olddata import METADATA, ROOT, candidates, is_rooted, root_command, special_paths

# Finding them.


_SECOND = METADATA.encode()


@dataclass
class OldKey:
    name: str  # without namespace
    places: dict[str, str] | None = None  # of ships' values, with labels; None if there is no second document
    rooted: bool = False  # its value is no dict and was stored in one
    stale: list[str] = field(default_factory=list)  # Redis keys of arrays that old programs have left behind

    @property
    def misread(self) -> bool:
        """Whether new programs would read another value than was written."""
        return self.rooted or bool(self.places)


async def find(session: Session, *, stale: bool = True) -> list[OldKey]:
    """Return the old keys of a session's namespace, sorted; two round trips for about 1000 keys of the server.

    `stale` finds arrays that were left behind, too, by another SCAN.
    """
    found: dict[str, OldKey] = {}
    async for names in _pages(session, DOCUMENT):
        for name, reply in zip(names, await asked(session, [_question(name) for name in names]), strict=True):
            _note(session, found, name, reply)
    if stale and any(each.places is not None for each in found.values()):
        async for names in _pages(session, "hash"):
            await _add_stale(session, found, names)
    return [found[name] for name in sorted(found)]


async def _pages(session: Session, kind: str) -> AsyncIterator[list[str]]:
    # SCAN may name a key several times.
    seen: set[bytes] = set()
    async for page in scanned(session.transport, escaped(session.namespace) + "*", kind):
        fresh = [key for key in dict.fromkeys(map(bytes, page)) if key not in seen]
        seen.update(fresh)
        yield [name for key in fresh if (name := _decoded(key)) is not None]


def _decoded(key: bytes) -> str | None:
    try:
        return key.decode()
    except UnicodeDecodeError:
        return None


async def asked(session: Session, commands: Sequence[tuple[Any, ...]]) -> Sequence[Reply]:
    if not commands:
        return []
    replies: Sequence[Reply] = await session.run(Plan(commands, lambda replies: replies))
    return replies


def _question(document: str) -> tuple[Any, ...]:
    # Second documents are read whole; of others only one entry matters.
    return ("JSON.GET", document, "$") if document.endswith(METADATA) else root_command(document)


def _note(session: Session, found: dict[str, OldKey], document: str, reply: Reply) -> None:
    second = document.endswith(METADATA)
    places = special_paths(reply) if second else None
    if places is None and (second or not is_rooted(reply)):
        return
    name = document[len(session.namespace) :].removesuffix(METADATA if second else "")
    key = found.setdefault(name, OldKey(name))
    if second:
        key.places = places
    else:
        key.rooted = True


async def _add_stale(session: Session, found: dict[str, OldKey], names: Sequence[str]) -> None:
    """Add the hashes that are arrays of old keys, but not in their documents."""
    owned = [(name, owner) for name in names if (owner := _owner(session, found, name)) is not None]
    replies = await asked(session, [("HKEYS", name) for name, _ in owned])
    for (name, owner), fields in zip(owned, replies, strict=True):
        if isinstance(fields, NotAllowed):  # else the arrays would silently stay for ever
            raise fields
        place = name[len(session.namespace) + len(owner.name) :]
        if (
            isinstance(fields, list | set)
            and is_array(frozenset(map(bytes, fields)))
            and not _may_be_lost(place, owner.places or ())
        ):
            owner.stale.append(name)


def _may_be_lost(place: str, places: Iterable[str]) -> bool:
    """Return whether this name begins with that of another place, but is not inside it.

    Writing `foo.image` made old programs forget `foo.image2`: that array stays.
    """
    return any(place.startswith(each) and place[len(each) :][:1] not in ("", ".", "[") for each in places)


def _owner(session: Session, found: dict[str, OldKey], name: str) -> OldKey | None:
    """Return the old key that a hash belongs to, though its second document does not name the hash."""
    for top in _tops(name[len(session.namespace) :]):
        key = found.get(top)
        if key is None or key.places is None:
            continue
        place = name[len(session.namespace) + len(top) :]
        # Named by the second document, so it was not left behind; or the second document itself.
        if place in key.places or place.startswith("&"):
            return None
        try:
            candidates(place)
        except BadData:
            return None
        return key
    return None


def _tops(name: str) -> Iterator[str]:
    """Yield the possible top-level keys in `foo.bar` or `foo[0].bar`; none has a dot."""
    top = name.partition(".")[0]
    yield top
    while top.endswith("]") and "[" in top:
        top = top[: top.rindex("[")]
        yield top


# Making values from their parts; nothing is evaluated.


ARRAY_LABEL = "default_numpy_handler"  # the label of the ship for arrays

ARRAY_FIELDS = frozenset({b"arr", b"dtype", b"shape"})
_MORE_FIELDS = frozenset({b"strides"})

_NAMED = re.compile(r"bool|u?int(?:8|16|32|64)|float(?:16|32|64)|complex(?:64|128)")
_TIME = re.compile(r"(datetime64|timedelta64)(\[\d{0,9}[a-zA-Zμ]{1,2}\])?")
_SHAPE = re.compile(r"\((?:\d{1,15}L?(?:, ?\d{1,15}L?)*,?)?\)")
# Bytes of the text of a dtype or a shape; longer ones are not valid.
_LONGEST = 1 << 15


def is_array(fields: frozenset[bytes]) -> bool:
    return fields >= ARRAY_FIELDS and fields <= ARRAY_FIELDS | _MORE_FIELDS


def array_of(fields: Any) -> np.ndarray[Any, Any]:
    """Return the array in an old hash; raises BadData.

    The bytes are in C order. The strides are those in the memory of the writer, and mean nothing.
    """
    if not isinstance(fields, Mapping) or not fields.keys() >= ARRAY_FIELDS:
        raise BadData("the array is gone from the server, or something else is in its place")
    # Old programs stored repr() of both: these are matched, never evaluated.
    dtype, shape = _text(fields[b"dtype"]), _text(fields[b"shape"])
    if not _SHAPE.fullmatch(shape):
        raise BadData(f"an array has the shape {shorten(shape)}, which is none")
    header = f"{{'descr': {_description(dtype)}, 'fortran_order': False, 'shape': {shape.replace('L', '')}, }}".encode()
    # Read as an .npy file, by the ship that checks everything.
    start = b"\x93NUMPY\x03\x00" + len(header).to_bytes(4, "little")
    try:
        return NumpyShip().unpack(start + header + bytes(fields[b"arr"]))
    except BadData as error:
        raise BadData(f"the array of dtype {shorten(dtype)} and shape {shape} cannot be converted: {error}") from None


def _text(value: Any) -> str:
    try:
        return bytes(value[:_LONGEST]).decode()
    except UnicodeDecodeError:
        return repr(value[:20])


def _description(dtype: str) -> str:
    if _NAMED.fullmatch(dtype):
        return repr(np.dtype(dtype).str)
    if found := _TIME.fullmatch(dtype):
        return repr(f"<{'M' if found[1] == 'datetime64' else 'm'}8{found[2] or ''}")
    return dtype if dtype.startswith("[") else repr(dtype)


class Tree:
    """A document into which the values of old ships are put.

    The holder is a list of the document, empty if there is none. The values of new ships in `kept` stay.
    """

    def __init__(self, holder: list[Any], kept: list[tuple[Any, Any]]) -> None:
        self._holder = holder
        # By id: equal containers may be in several places.
        self._kept = {(id(container), key) for container, key in kept}

    def put(self, place: str, value: Any) -> bool:
        """Put a ship's value at an old place, unless a value of a new ship is there; return whether it was put.

        Raises BadData if the place is inside of a value without entries.
        """
        found = self._slot(place)
        if (id(found[0]), found[1]) in self._kept:
            return False
        container, key = found
        if key == len(container) and isinstance(container, list):
            container.append(value)
        else:
            container[key] = value
        return True

    def holds(self, place: str) -> bool:
        for path in candidates(place):
            found = self._find(path)
            if found is not None and (id(found[0]), found[1]) in self._kept:
                return True
        return False

    def root(self, deletion: Callable[[str], str]) -> list[Any]:
        """Return the whole value in a list of one, empty if there is none, taken out of the dict made for it.

        Raises BadData if the dict has other entries, which old programs read by path only; `deletion` returns the shell
        command that deletes an entry.
        """
        if not self._holder or not isinstance(self._holder[0], dict) or ROOT not in self._holder[0]:
            return self._holder
        others = sorted(self._holder[0].keys() - {ROOT})
        if others:
            raise BadData(
                f"it holds both a value and, beside it, {', '.join(map(shorten, others[:3]))}, which no key can any "
                f"more; delete the value with `{deletion(ROOT)}`, or {shorten(others[0])} with `{deletion(others[0])}`"
            )
        return [self._holder[0][ROOT]]

    def _find(self, path: Path) -> tuple[Any, Any] | None:
        if path and path[0] == ROOT and self._holder and not isinstance(self._holder[0], dict):
            path = path[1:]  # it was taken out of its dict already
        container: Any = self._holder
        key: Any = 0
        for step in path:
            if not _has(container, key):
                return None
            container, key = container[key], step
        if not _has(container, key):
            return None
        return container, key + len(container) if isinstance(key, int) and key < 0 else key

    def _slot(self, place: str) -> tuple[Any, Any]:
        """Return the container and the key to set; makes missing dicts on the path, as old programs did."""
        found = candidates(place)
        for path in found:
            slot = self._find(path)
            if slot is not None:
                return slot
        container: Any = self._holder
        key: Any = 0
        for step in found[-1]:
            if not _has(container, key):
                if isinstance(container, list):
                    container.append({})
                else:
                    container[key] = {}
            container, key = container[key], step
            if not isinstance(container, dict):
                raise BadData(f"{place} is inside of a value of type {type(container).__name__}, which has no entries")
        return container, key


def _has(container: Any, key: Any) -> bool:
    if isinstance(container, dict):
        return key in container
    if isinstance(container, list) and isinstance(key, int):
        return -len(container) <= key < len(container)
    return False


# Converting them.


class Migrated(NamedTuple):
    """The conversion of one old key.

    Attributes:
        name: The top-level key.
        places: The places of ships' values that were put into the document, as `.image`.
        rooted: Whether its value, which is no dict, was taken out of one.
        removed: The Redis keys of the old layout that are removed, with those of arrays that were left behind.
        problem: Why it could not be converted; empty if it was.
        was_text: Whether its document was text, of a server without JSON.
    """

    name: str
    places: tuple[str, ...] = ()
    rooted: bool = False
    removed: tuple[str, ...] = ()
    problem: str = ""
    was_text: bool = False


@dataclass(frozen=True)
class Migration:
    """The result of `migrate`.

    Attributes:
        keys: The old keys, sorted by name.
        dry_run: Whether nothing was changed.
    """

    keys: tuple[Migrated, ...]
    dry_run: bool

    @property
    def problems(self) -> tuple[Migrated, ...]:
        return tuple(key for key in self.keys if key.problem)


async def migrate(
    interface: RedisInterface,
    match: str = "*",
    *,
    dry_run: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Migration:
    """Convert data of REEM 0.0 and 0.1 in place, so that it reads as it did there.

    Arrays and other values of ships are put into their documents, values that are no dict are taken out of the dict
    they were stored in, and the Redis keys of the old layout are removed, with those that old programs have left
    behind. New data is left alone, so a second run finds nothing to do. Each key is written in one transaction, and
    what is old of it removed right after that. This can be interrupted at any time and run again. Subscribers are
    notified. A key that cannot be converted, or that another client changes meanwhile, stays, and the result says why.
    End the programs of old versions first.

    Documents that are text, from a server without JSON (an RDB file that has moved), are converted too.

    Two round trips for about 1000 keys of the server to find the old ones, three times; then four for each of these,
    and two for each of its arrays. One top-level key at a time is in memory.

    Args:
        interface: The server, the namespace to convert, and ships with the labels of the old ones.
        match: Which top-level keys: a name with `*` and `?`.
        dry_run: Read and check only.
        progress: Called with the number of keys that are done, and of all.

    Raises:
        ClusterNode: The server is one node of several.
        BadKey: `match` is no pattern.
    """
    session = interface.session
    await session.ships.ready()
    wanted = Pattern(check_top_key(match))
    # Texts first: the search for old keys finds documents only.
    texts = [name for name in await _texts(session) if wanted.concerns((name,))]
    old = [key for key in await find(session) if wanted.concerns((key.name,))]
    conversions: list[tuple[str, Callable[[], Awaitable[Migrated]]]] = [
        *((name, partial(_converted_text, session, name, dry_run)) for name in texts),
        *((key.name, _Converter(session, key, dry_run).run) for key in old),
    ]
    done: list[Migrated] = []
    for name, convert in conversions:
        if progress is not None:
            progress(len(done), len(conversions))
        try:
            done.append(await convert())
        except (BadData, BadInput, Conflict, PartialWrite, WrongKind) as error:
            done.append(Migrated(name, problem=str(error), was_text=len(done) < len(texts)))
    if progress is not None and done:
        progress(len(done), len(done))
    return Migration(tuple(done), dry_run)


class _Converter:
    def __init__(self, session: Session, key: OldKey, dry_run: bool) -> None:
        self.session = session
        self._key = key
        self._dry_run = dry_run

    async def run(self) -> Migrated:
        self.keys = self.session.keys(self._key.name)
        self._second = self.keys.document + METADATA
        (second,) = await self._replies([("JSON.GET", self._second, "$")])
        found = special_paths(second)
        labels = found or {}
        raw_read = await self._sealed()
        tops = set(raw_read.holder[0]) if raw_read.holder and isinstance(raw_read.holder[0], dict) else set()
        tree = Tree(raw_read.holder, [(slot.container, slot.key) for slot, _, _ in raw_read.slots])
        # A value of a new ship there was written later, or by a run that was interrupted, so the old one is obsolete.
        missing = {place: label for place, label in labels.items() if not tree.holds(place)}
        # Outer values first: in old programs one hides those inside it.
        put = [place for place in sorted(missing) if tree.put(place, await self._value(place, missing[place]))]
        if raw_read.slots:
            await opened(raw_read)
        root = tree.root(lambda entry: self._deletion(entry, entry in tops, labels))
        rooted = root is not raw_read.holder
        if put or rooted:
            await self._write(root[0], raw_read)
        # The second document last: another run finds what to remove by it.
        gone = [*(self.keys.document + place for place in labels), *self._key.stale]
        gone += [self._second] if found is not None else []
        for key in () if self._dry_run else gone:  # they may be on several nodes
            await self._replies([("UNLINK", key)])
        return Migrated(self._key.name, tuple(put), rooted, tuple(gone))

    def _deletion(self, entry: str, in_document: bool, places: Iterable[str]) -> str:
        """Return the shell commands that delete an entry, from the document and from the second document."""
        paths: list[tuple[str, Path]] = [(self.keys.document, (entry,))] if in_document else []
        inside = [place for place in places if any(path[:1] == (entry,) for path in candidates(place))]
        paths += [(self._second, ("special_paths", place)) for place in inside]
        return " && ".join([shlex.join(["redis-cli", "JSON.DEL", name, to_jsonpath(path)]) for name, path in paths])

    async def _replies(self, commands: list[Command]) -> list[Reply]:
        replies: list[Reply] = await self.session.run(Plan(commands, list, bulk=True))
        for reply in replies:
            # WRONGTYPE: a foreign value is in the place of a ship's value.
            if isinstance(reply, Exception) and not str(reply).startswith("WRONGTYPE"):
                raise reply
        return replies

    async def _sealed(self) -> RawRead:
        try:
            raw_read: RawRead = await self.session.run(read(self.keys, (), self.session.ships, self.session.cache))
        except MissingKey as why:
            return nothing(self.keys, (), why)
        return raw_read

    async def _value(self, place: str, label: str) -> Any:
        where, key = self.keys.name + place.removesuffix("."), self.keys.document + place
        ships = self.session.ships
        ship = None
        if label != ARRAY_LABEL or ships.has(label):  # the arrays of REEM 0.1 need no ship
            try:
                ship = ships.labelled(label, where)
            except BadData as error:
                raise BadData(f"{error}; `reem migrate --ship MODULE:CLASS` converts it with the ship") from None
        (reply,) = await self._replies([("HGETALL", key) if ship is None else ship.read_command(key)])
        if reply is None or reply == {} or reply == [] or isinstance(reply, Exception):
            raise BadData(
                f"{where}: what the ship {label!r} stored is gone from {key!r}; to convert the rest without it: "
                f"redis-cli JSON.DEL '{self._second}' '$.special_paths[\"{place}\"]'"
            )
        if ship is not None:
            holder: list[Any] = [None]
            slot = PlaceholderSlot(Placeholder(label, place), holder, 0)
            return await opened(RawRead(holder, self.keys.name, [(slot, ship, reply)], (), ()))
        try:
            return array_of(reply)
        except BadData as error:
            raise BadData(f"{where}: {error}") from None

    async def _write(self, value: Any, raw_read: RawRead) -> None:
        """Store the value and notify subscribers, if the document has not changed; raises Conflict."""
        writer = DocumentPublisher(self.session, self.keys.name)
        # In a dry run too, to find values that would be refused.
        text, attachments = await writer.encoder.encoded((), value)

        async def send(turn: Turn) -> None:
            it = set_change(self.keys, (), text, attachments, announcement=turn.reserve())
            await self.session.run(exchange(it, raw_read.commands, raw_read.raw, self.session.cache))

        if not self._dry_run:
            await writer.in_turn(send)


# Documents that are text on a server with JSON: an RDB file of a server without JSON has moved there.


async def _texts(session: Session) -> list[str]:
    """Return the top-level keys of a session's namespace whose documents are text.

    On a server without JSON there are none. One round trip for about 1000 keys of the server, and one for the strings.
    """
    found: set[str] = set()
    async for page in scanned(session.transport, escaped(session.namespace) + "*", "string"):
        names = [name for name in page if b"{" not in name]
        replies = await asked(session, [look for it in names for look in (("TYPE", it), ("GETRANGE", it, "0", "0"))])
        for name, kind, begins in zip(names, replies[::2], replies[1::2], strict=True):
            # On a server without JSON the transport translates the reply to TYPE, so nothing is found there.
            if kind == b"string" and isinstance(begins, bytes) and is_document(begins):
                with suppress(UnicodeDecodeError, BadKey):
                    found.add(session.keys(name.decode()[len(session.namespace) :]).name)
    return sorted(found)


async def _converted_text(session: Session, name: str, dry_run: bool) -> Migrated:
    """Convert a text to a document of the server's JSON, floats to the last bit; raises BadData if it is no JSON.

    One transaction, two round trips. Attachments stay.
    """
    writer = DocumentPublisher(session, name)

    async def send(turn: Turn) -> None:
        await session.run(_text_conversion(writer.keys, turn.reserve(), dry_run))

    await writer.in_turn(send)
    return Migrated(name, was_text=True)


def _text_conversion(keys: Keys, announcement: Announcement, dry_run: bool) -> Plan:
    def look(replies: list[Reply]) -> Plan:
        permitted(replies[0], keys.document)
        text = replies[1] if isinstance(replies[1], bytes | bytearray) else b""  # deleted or replaced in between
        ready = settable(bytes(text[1:])) if is_document(text) else b""
        if dry_run or not ready:
            return Plan([("UNWATCH",)], lambda _: None, held=True)
        # Under another name first: JSON.SET refuses a key that holds a string, and a DEL before it could not be
        # undone if the text is not JSON, since EXEC continues after an error.
        coming = f"{keys.tag}{STAGED}{secrets.token_hex(5)}"
        # RENAME is refused if JSON.SET was refused: then nothing changes.
        commands: list[Command] = [("JSON.SET", coming, "$", ready), ("RENAME", coming, keys.document)]
        return Plan([*commands, *announcement.commands(())], done, atomic=True, held=True)

    def done(replies: list[Reply] | None) -> Plan | None:
        if replies is None:  # another client wrote in between
            announcement.unsent()
            return _text_conversion(keys, announcement, dry_run)
        for reply in replies[:2]:
            if isinstance(reply, Exception):
                raise BadData(f"{keys.name}: the server refused its text as JSON: {reply}")
        return None

    return Plan([("WATCH", keys.document), ("GET", keys.document)], look, held=True)
