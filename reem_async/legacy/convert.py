"""Old keys into keys of today, in place."""

from __future__ import annotations

import secrets
import shlex
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from ..connection import RedisInterface
from ..errors import BadData, BadInput, BadKey, Conflict, MissingKey, PartialWrite, WrongKind
from ..plain.documents import is_document
from ..plan import Command, Plan, Reply
from ..plan.attachments import permitted
from ..plan.changes import Announcement, EncodedAttachment
from ..plan.paths import Path, Pattern, check_top_key, escaped, to_jsonpath
from ..plan.placeholders import Placeholder, PlaceholderSlot
from ..plan.reads import RawRead, get_command, read
from ..plan.sizes import STAGED
from ..plan.writes import exchange, set_change
from ..session import Session
from ..ships.registry import Registered
from ..store.document import Turn
from ..store.publish import DocumentPublisher
from ..store.reader import opened
from ..tools.snapshots.plans import settable
from ..transport import scanned
from .finding import OldKey, find
from .olddata import METADATA, candidates, special_paths
from .values import ARRAY_LABEL, Tree, array_of

# A key that is written each millisecond can be converted in between. For one that cannot, a program must be ended.
_TRIES = 50


class Migrated(NamedTuple):
    """The conversion of one old key.

    Attributes:
        name: The top-level key.
        places: The places of ships' values that were put into the document, as `.image`.
        rooted: Whether its value, which is no dict, was taken out of one.
        removed: The Redis keys of the old layout that are removed, with those of arrays that were left behind.
        lost: The Redis keys of arrays that are not in the document, perhaps by mistake: writing `foo.image` made old
            programs forget `foo.image2`. They stay.
        problem: Why it could not be converted; empty if it was.
        was_text: Whether its document was text, of a server without JSON.
    """

    name: str
    places: tuple[str, ...] = ()
    rooted: bool = False
    removed: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
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
    behind. New data is left alone, so a second run finds nothing to do. Each key is one transaction, so this can be
    interrupted at any time and run again. In a cluster, whose nodes share no transaction, the old keys are removed
    right after it. Subscribers are notified. A key that cannot be converted stays, and the result says why. End the
    programs of old versions first.

    Documents that are text, from a server without JSON (an RDB file that has moved), are converted too.

    Two round trips for about 1000 keys of the server to find the old ones, three times; then six for each of these.
    Arrays are read twice. One top-level key at a time is in memory.

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
    text = [name for name in await _texts(session) if wanted.concerns((name,))]
    old = [key for key in await find(session) if wanted.concerns((key.name,))]
    conversions: list[Callable[[], Awaitable[Migrated]]] = [
        *(partial(_given_to_json, session, name, dry_run) for name in text),
        *(partial(_migrated, session, key, dry_run) for key in old),
    ]
    done: list[Migrated] = []
    for convert in conversions:
        if progress is not None:
            progress(len(done), len(conversions))
        done.append(await convert())
    if progress is not None and done:
        progress(len(done), len(done))
    return Migration(tuple(done), dry_run)


async def _given_to_json(session: Session, name: str, dry_run: bool) -> Migrated:
    try:
        await _TextConverter(session, name).run(dry_run=dry_run)
    except (BadData, WrongKind) as error:
        return Migrated(name, problem=str(error), was_text=True)
    return Migrated(name, was_text=True)


async def _migrated(session: Session, key: OldKey, dry_run: bool) -> Migrated:
    for _ in range(_TRIES):
        try:
            return await _Converter(session, key).run(dry_run=dry_run)
        except Conflict:
            continue
        except (BadData, BadInput, PartialWrite, WrongKind) as error:
            return Migrated(key.name, problem=str(error))
    return Migrated(key.name, problem=f"it changed {_TRIES} times in between; end the programs that write to it")


class _RemovingFirst(Announcement):
    """An announcement behind the command that removes the old keys; none if they may be on another node."""

    __slots__ = ("_announcement", "_removal")

    def __init__(self, removal: Sequence[Command], announcement: Announcement) -> None:
        self._removal = removal
        self._announcement = announcement

    def commands(self, path: Path) -> Sequence[Command]:
        return [*self._removal, *self._announcement.commands(path)]

    def unsent(self) -> None:
        self._announcement.unsent()

    def retract(self, path: Path) -> Sequence[Command]:
        return self._announcement.retract(path)


class _Converter:
    """Converts one top-level key.

    First read everything and make the value. Then write it and remove the old keys in one transaction, if nothing has
    changed.
    """

    def __init__(self, session: Session, key: OldKey) -> None:
        self.session = session
        self.keys = session.keys(key.name)
        self.name = self.keys.name
        self._writer = DocumentPublisher(session, key.name)
        self._second = self.keys.document + METADATA
        self._key = key
        self._old: dict[str, tuple[Command, Reply]] = {}  # by place: how the ship's value was read, and the reply

    async def run(self, *, dry_run: bool) -> Migrated:
        (second,) = await self._replies([("JSON.GET", self._second, "$")])
        found = special_paths(second)
        labels = found or {}
        raw_read = await self._sealed()
        tops = set(raw_read.holder[0]) if raw_read.holder and isinstance(raw_read.holder[0], dict) else set()
        tree = Tree(raw_read.holder, [(slot.container, slot.key) for slot, _, _ in raw_read.slots])
        # A value of a new ship there was written later, so the old one is obsolete.
        missing = {place: label for place, label in labels.items() if not tree.holds(place)}
        await self._look(missing)
        # Outer values first: in old programs one hides those inside it.
        put = [place for place in sorted(missing) if tree.put(place, await self._value(place, missing[place]))]
        if raw_read.slots:
            await opened(raw_read)
        root = tree.root(lambda entry: self._deletion(entry, entry in tops, labels))
        rooted = root is not raw_read.holder
        # The second document last: another run finds what to remove by it.
        gone = [*(self.keys.document + place for place in labels), *self._key.stale]
        gone += [self._second] if found is not None else []
        if put or rooted:
            await self._write(root[0], raw_read, second, gone, dry_run=dry_run)
        removed_with_it = (put or rooted) and not self.session.transport.sharded
        if not dry_run and not removed_with_it:
            for key in gone:  # they may be on several nodes
                await self._replies([("UNLINK", key)])
        return Migrated(self.name, tuple(put), rooted, tuple(gone), tuple(self._key.lost))

    def _deletion(self, entry: str, in_document: bool, places: Iterable[str]) -> str:
        """Return the shell commands that delete an entry, from the document and from the second document."""
        paths: list[tuple[str, Path]] = [(self.keys.document, (entry,))] if in_document else []
        inside = [place for place in places if any(path[:1] == (entry,) for path in candidates(place))]
        paths += [(self._second, ("special_paths", place)) for place in inside]
        return " && ".join([shlex.join(["redis-cli", "JSON.DEL", name, to_jsonpath(path)]) for name, path in paths])

    async def _replies(self, commands: Sequence[Command]) -> Sequence[Reply]:
        if not commands:
            return ()
        replies: Sequence[Reply] = await self.session.run(Plan(commands, lambda replies: replies, bulk=True))
        for reply in replies:
            # WRONGTYPE: a foreign value is in the place of a ship's value.
            if isinstance(reply, Exception) and not str(reply).startswith("WRONGTYPE"):
                raise reply
        return replies

    async def _sealed(self) -> RawRead:
        """Return the document as a new program reads it; an empty one if there is none."""
        plan = read(self.keys, (), self.session.ships, self.session.cache)
        try:
            raw_read: RawRead = await self.session.run(plan)
        except MissingKey:
            return RawRead([], self.name, [], (get_command(self.keys, ()),), (None,))
        return raw_read

    async def _look(self, labels: dict[str, str]) -> None:
        commands = [self._ask(place, label) for place, label in labels.items()]
        self._old = dict(zip(labels, zip(commands, await self._replies(commands), strict=True), strict=True))

    def _ask(self, place: str, label: str) -> Command:
        ship = self._ship(place, label)
        key = self.keys.document + place
        return ("HGETALL", key) if ship is None else ship.read_command(key)

    def _ship(self, place: str, label: str) -> Registered | None:
        """Return the user's ship with a label, None for the arrays of REEM 0.1; raises BadData."""
        ships = self.session.ships
        try:
            return ships.labelled(label, self.name + place.removesuffix("."))
        except BadData as error:
            if label == ARRAY_LABEL:
                return None
            raise BadData(f"{error}; `reem migrate --ship MODULE:CLASS` converts it with the ship") from None

    async def _value(self, place: str, label: str) -> Any:
        ship, (command, reply) = self._ship(place, label), self._old[place]
        where = self.name + place.removesuffix(".")
        if reply is None or reply == {} or reply == [] or isinstance(reply, Exception):
            raise BadData(
                f"{where}: what the ship {label!r} stored is gone from {command[1]!r}; to convert the rest without it: "
                f"redis-cli JSON.DEL '{self._second}' '$.special_paths[\"{place}\"]'"
            )
        if ship is not None:
            return await self._opened(place, ship, reply)
        try:
            return array_of(reply)
        except BadData as error:
            raise BadData(f"{where}: {error}") from None

    async def _opened(self, place: str, ship: Registered, reply: Reply) -> Any:
        holder: list[Any] = [None]
        slot = PlaceholderSlot(Placeholder(ship.label, place), holder, 0)
        return await opened(RawRead(holder, self.name, [(slot, ship, reply)], (), ()))

    async def _write(self, value: Any, raw_read: RawRead, second: Reply, gone: list[str], *, dry_run: bool) -> None:
        """Store the value, remove the old keys and notify subscribers, if nothing has changed; raises Conflict."""
        # In a dry run too, to find values that would be refused.
        encoded = await self._writer.encoder.encoded((), value)
        if dry_run:
            return
        # Everything, ships' values too, is read again under WATCH and compared: no write of an old program is lost.
        reads, seen = raw_read.commands, raw_read.raw
        removal: list[Command] = []
        if not self.session.transport.sharded:
            asked = self._old.values()
            old = [("WATCH", self._second, *gone), ("JSON.GET", self._second, "$"), *(command for command, _ in asked)]
            reads, seen = (*old, *reads), (b"OK", second, *(reply for _, reply in asked), *seen)
            removal = [("UNLINK", *gone)] if gone else []

        async def send(turn: Turn, text: bytes, attachments: tuple[EncodedAttachment, ...]) -> None:
            announcement = _RemovingFirst(removal, turn.reserve())
            it = set_change(self.keys, (), text, attachments, announcement=announcement)
            await self.session.run(exchange(it, reads, seen, self.session.cache))

        await self._writer.in_turn(send, *encoded)


# Documents that are text on a server with JSON: an RDB file of a server without JSON has moved there.


async def _texts(session: Session) -> list[str]:
    """Return the top-level keys of a session's namespace whose documents are text.

    On a server without JSON there are none. One round trip for about 1000 keys of the server, and one for the strings.
    """
    found: set[str] = set()
    async for page in scanned(session.transport, escaped(session.namespace) + "*", "string"):
        names = [name for name in page if b"{" not in name]
        looks: list[Command] = [look for name in names for look in (("TYPE", name), ("GETRANGE", name, "0", "0"))]
        replies: Sequence[Reply] = await session.run(Plan(looks, list)) if looks else []
        for name, kind, begins in zip(names, replies[::2], replies[1::2], strict=True):
            # On a server without JSON the transport translates the reply to TYPE, so nothing is found there.
            if kind == b"string" and isinstance(begins, bytes) and is_document(begins):
                found |= _named(session, name)
    return sorted(found)


def _named(session: Session, document: bytes) -> set[str]:
    try:
        return {session.keys(document.decode()[len(session.namespace) :]).name}
    except (UnicodeDecodeError, BadKey):
        return set()


class _TextConverter:
    """Converts one text to a document of the server's JSON, floats to the last bit. Attachments stay."""

    def __init__(self, session: Session, name: str) -> None:
        self.session = session
        self._writer = DocumentPublisher(session, name)
        self.keys = self._writer.keys

    async def run(self, *, dry_run: bool) -> None:
        """Convert it in one transaction, two round trips; raises BadData if the server refuses the text."""
        await self._writer.in_turn(self._send, dry_run)

    async def _send(self, turn: Turn, dry_run: bool) -> None:
        await self.session.run(self._look(turn.reserve(), dry_run, _TRIES))

    def _look(self, announcement: Announcement, dry_run: bool, tries: int) -> Plan:
        def decode(replies: Sequence[Reply]) -> Plan:
            permitted(replies[0], self.keys.document)
            text = replies[1] if isinstance(replies[1], bytes | bytearray) else b""  # deleted or replaced in between
            ready = settable(bytes(text[1:])) if is_document(text) else b""
            if dry_run or not ready:
                return Plan([("UNWATCH",)], lambda _: None, held=True)
            return self._change(announcement, ready, tries)

        return Plan([("WATCH", self.keys.document), ("GET", self.keys.document)], decode, held=True)

    def _change(self, announcement: Announcement, text: bytes, tries: int) -> Plan:
        # Under another name first: JSON.SET refuses a key that holds a string, and a DEL before it could not be undone
        # if the text is not JSON, since EXEC continues after an error.
        coming = f"{self.keys.tag}{STAGED}{secrets.token_hex(5)}"
        commands: list[Command] = [
            ("JSON.SET", coming, "$", text),
            ("RENAME", coming, self.keys.document),  # refused if JSON.SET was refused: then nothing changes
            *announcement.commands(()),
        ]

        def decode(replies: Sequence[Reply] | None) -> Plan | None:
            if replies is not None:
                for reply in replies[:2]:
                    if isinstance(reply, Exception):
                        raise BadData(f"{self.keys.name}: the server refused its text as JSON: {reply}")
                return None
            announcement.unsent()
            if not tries:
                raise BadData(
                    f"{self.keys.name}: it changed {_TRIES} times in between; end the programs that write to it"
                )
            return self._look(announcement, False, tries - 1)

        return Plan(commands, decode, atomic=True, held=True)
