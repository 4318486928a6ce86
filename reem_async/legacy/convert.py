"""Old keys into keys of today, in place."""

from __future__ import annotations

import secrets
import shlex
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from ..connection import RedisInterface
from ..errors import BadData, BadInput, BadKey, Conflict, MissingKey, PartialWrite, WrongKind
from ..plain.documents import is_document
from ..plan import Command, Plan, Reply
from ..plan.attachments import permitted
from ..plan.changes import Announcement
from ..plan.paths import Path, Pattern, check_top_key, escaped, to_jsonpath
from ..plan.placeholders import Placeholder, PlaceholderSlot
from ..plan.reads import RawRead, nothing, read
from ..plan.sizes import STAGED
from ..plan.writes import exchange, set_change
from ..session import Session
from ..store.document import Turn, opened
from ..store.publish import DocumentPublisher
from ..tools.snapshots.plans import settable
from ..transport import scanned
from .finding import OldKey, asked, find
from .olddata import METADATA, candidates, special_paths
from .values import ARRAY_LABEL, Tree, array_of


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
        *((name, _TextConverter(session, name, dry_run).run) for name in texts),
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


class _TextConverter:
    """Converts one text to a document of the server's JSON, floats to the last bit. Attachments stay."""

    def __init__(self, session: Session, name: str, dry_run: bool) -> None:
        self.session = session
        self._dry_run = dry_run
        self._writer = DocumentPublisher(session, name)
        self.keys = self._writer.keys

    async def run(self) -> Migrated:
        """Convert it in one transaction, two round trips; raises BadData if the server refuses the text."""

        async def send(turn: Turn) -> None:
            await self.session.run(self._plan(turn.reserve()))

        await self._writer.in_turn(send)
        return Migrated(self.keys.name, was_text=True)

    def _plan(self, announcement: Announcement) -> Plan:
        def look(replies: list[Reply]) -> Plan:
            permitted(replies[0], self.keys.document)
            text = replies[1] if isinstance(replies[1], bytes | bytearray) else b""  # deleted or replaced in between
            ready = settable(bytes(text[1:])) if is_document(text) else b""
            if self._dry_run or not ready:
                return Plan([("UNWATCH",)], lambda _: None, held=True)
            # Under another name first: JSON.SET refuses a key that holds a string, and a DEL before it could not be
            # undone if the text is not JSON, since EXEC continues after an error.
            coming = f"{self.keys.tag}{STAGED}{secrets.token_hex(5)}"
            # RENAME is refused if JSON.SET was refused: then nothing changes.
            commands: list[Command] = [("JSON.SET", coming, "$", ready), ("RENAME", coming, self.keys.document)]
            return Plan([*commands, *announcement.commands(())], done, atomic=True, held=True)

        def done(replies: list[Reply] | None) -> Plan | None:
            if replies is None:  # another client wrote in between
                announcement.unsent()
                return self._plan(announcement)
            for reply in replies[:2]:
                if isinstance(reply, Exception):
                    raise BadData(f"{self.keys.name}: the server refused its text as JSON: {reply}")
            return None

        return Plan([("WATCH", self.keys.document), ("GET", self.keys.document)], look, held=True)
