"""Portable snapshots: every key of REEM to one file and back, with no more rights than programs have anyway."""

from __future__ import annotations

import dataclasses
import os
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import anyio.from_thread
import anyio.to_thread

from ... import __version__
from ...connection import RedisInterface
from ...errors import BadData, BadKey, Conflict, MissingKey, NotAllowed, PartialWrite, RedisError, ReemError, WrongKind
from ...plan import Command, Plan
from ...plan.keys import DOCUMENT, PRESENCE, Keys
from ...plan.notices import announce, published
from ...plan.paths import Pattern, check_top_key, shorten
from ...plan.sizes import STAGED
from ...session import Session
from ...transport import counted, scanned
from .archive import Archive, ArchiveWriter, header, verify
from .files import Snapshot, check_target, sniff
from .plans import NOT_ALLOWED, KeyContent, dump, lifetimes, put, shown, strangers, types

# Keys whose types are asked for in one round trip.
_PAGE = 500


class Progress(NamedTuple):
    """How far a call has come.

    Attributes:
        doing: "save", "verify" or "restore".
        done: How much is done, and
        total: of how much: keys, or bytes where it verifies.
    """

    doing: str
    done: int
    total: int


class Restored(NamedTuple):
    """What a restore has written.

    Attributes:
        names: The top-level keys, as they are called now.
        size: Bytes of documents and arrays.
    """

    names: tuple[str, ...]
    size: int


ProgressFunction = Callable[[Progress], None]


async def save(
    interface: RedisInterface,
    path: str | os.PathLike[str],
    match: str = "*",
    *,
    overwrite: bool = False,
    progress: ProgressFunction | None = None,
) -> Snapshot:
    """Save the keys of REEM to one file: documents, arrays, whatever ships hold, byte for byte.

    Each top-level key is of one instant, with all that belongs to it; different keys are not. What is not
    REEM's is left out and counted. What cannot be read is left out and named in the result's `unsaved`: where a right
    is missing, an array is gone, or a ship's value has a Redis type that cannot be saved. A key that expires is saved
    with the time it has left. Cancelling leaves no file behind.

    One round trip for a key without arrays, two for others, after one for about 1000 keys of the server to find them
    (none if `match` has no `*` or `?`); in a cluster all primaries are asked. If the servers count more keys than
    were found, the result's `doubt` says so. One top-level key and the names of all Redis keys are in memory.

    Args:
        interface: The server; its namespace is what is saved.
        path: The file to make; it appears under this name when it is complete and on the disk.
        match: Which top-level keys: a name in which `*` and `?` stand for other characters.
        overwrite: Whether an existing file may be replaced.
        progress: Called now and then, on the event loop.

    Returns:
        What the file holds.

    Raises:
        MissingKey: `match` is not "*" and names nothing. No file was made.
        BadData, NotAllowed, Conflict: No key at all could be saved; this is why for the first. No file was made.
        ClusterNode: The server is one node of several. No file was made.
        NotConnected: A node does not answer, or slots of the cluster have none. No file was made.
        FileExistsError: The file exists, or another program made it in between.
        OSError: The file cannot be written.
    """
    session, target = interface.session, Path(path)
    await anyio.to_thread.run_sync(lambda: check_target(target, overwrite=overwrite))
    found = await survey(session, match)
    # The time in the header is that of the beginning: no key was read before it.
    facts = header(interface.hostname, session.namespace, match, __version__)
    writer = ArchiveWriter(target, facts, overwrite=overwrite)
    try:
        count, failure = await _fill(session, writer, found, progress)
        if not count and failure is not None:
            raise failure
        if not count and match != "*":
            raise MissingKey(f"no key matches {shorten(match)}; nothing was saved")
        foreign = await found.foreign(session)
        await anyio.to_thread.run_sync(writer.finish, foreign, found.unsaved)
    # Cancelling included: there is a file with this name only if it is complete.
    except BaseException:
        writer.abandon()
        raise
    with await anyio.to_thread.run_sync(Archive, target) as archive:
        return dataclasses.replace(archive.summary, doubt=found.doubt)


async def _fill(
    session: Session, writer: ArchiveWriter, found: Survey, progress: ProgressFunction | None
) -> tuple[int, Exception | None]:
    """Fetch and write the keys found; return how many were still there, and why the first that failed did."""
    count, failure = 0, None
    left: list[int | None] = []
    for number, name in enumerate(found.names):
        _report(progress, "save", number, len(found.names))
        if number % _PAGE == 0:
            left = await _lifetimes(session, found, found.names[number : number + _PAGE])
        try:
            content: KeyContent | None = await session.run(dump(session.keys(name)))
        except WrongKind:  # replaced by a program without REEM since it was found
            continue
        except (BadData, Conflict, NotAllowed) as error:
            failure = failure or error
            found.failed(name, str(error))
            continue
        if content is not None:
            count += 1
            found.owns(content)
            await anyio.to_thread.run_sync(writer.add, content._replace(expires=left[number % _PAGE]))
    _report(progress, "save", len(found.names), len(found.names))
    return count, failure


async def _lifetimes(session: Session, found: Survey, names: Sequence[str]) -> list[int | None]:
    left: list[int | None] | None = await session.run(lifetimes([session.keys(name).document for name in names]))
    if left is None:
        found.doubt = found.doubt or "this user may not ask when keys expire (+pttl), so they are saved without expiry"
    return left or [None] * len(names)


async def restore(
    interface: RedisInterface,
    path: str | os.PathLike[str],
    match: str = "*",
    *,
    replace: bool = False,
    into: str = "",
    progress: ProgressFunction | None = None,
) -> Restored:
    """Write the keys of a portable snapshot to a server, and notify their subscribers.

    First the whole file is checked, and whether keys are in the way: a damaged file, or an existing key, changes
    nothing. Then each top-level key is one transaction of all that belongs to it and its notice; the keys together
    are not. A key that was saved with an expiry has as long to live as it had left then. Two round trips for each,
    after one for 500 of them. Cancelling, or an error on the way, leaves some keys written and the others as they
    were, none half.

    Args:
        interface: The server; the keys go to its namespace, whatever the one was they were saved of.
        path: The file.
        match: Which top-level keys of the file: a name in which `*` and `?` stand for other characters.
        replace: Whether existing keys may be replaced. Others on the server are left alone.
        into: Goes before the name of each key.
        progress: Called now and then, on the event loop.

    Raises:
        BadData: The file is damaged, or none of REEM. Nothing was written.
        MissingKey: `match` names no key of the file. Nothing was written.
        Conflict: A key exists and `replace` is False. Nothing was written, unless the message says so.
        WrongKind: A Redis key that is not REEM's has the name of one. Nothing was written.
        BadKey: A name with `into` before it is none.
        PartialWrite: The server, or the connection, failed behind some keys; the message says which were written.
        OSError: The file cannot be read.
    """
    session, source = interface.session, Path(path)
    await _check_file(source, progress)
    archive = await anyio.to_thread.run_sync(Archive, source)
    with archive:
        wanted = matcher(match)
        names = {key.name: session.keys(into + key.name) for key in archive.summary.keys if wanted(key.name)}
        if not names and match != "*":
            raise MissingKey(f"{source}: no key of this snapshot matches {shorten(match)}; nothing was written")
        # Before the first write, so that a restore that is refused changes nothing; `put` looks at each key once more.
        await _check_room(session, list(names.values()), replace=replace)
        done: list[str] = []
        size = 0
        for name, keys in names.items():
            _report(progress, "restore", len(done), len(names))
            size += await _put(session, archive, name, keys, done, replace=replace)
        _report(progress, "restore", len(done), len(names))
    return Restored(tuple(done), size)


async def _check_file(source: Path, progress: ProgressFunction | None) -> None:
    if await anyio.to_thread.run_sync(sniff, source) == "rdb":
        raise BadData(
            f"{source} is an RDB file, which only a server can read: start one with `reem up --from {source}`, "
            "and save a portable snapshot of that"
        )

    # `verify` runs in a thread; the caller's function expects to be called on the event loop.
    def report(done: int, total: int) -> None:
        if progress is not None:
            anyio.from_thread.run_sync(progress, Progress("verify", done, total))

    await anyio.to_thread.run_sync(verify, source, report)


async def _check_room(session: Session, keys: Sequence[Keys], *, replace: bool) -> None:
    there: list[str] = []
    for start in range(0, len(keys), _PAGE):
        page = keys[start : start + _PAGE]
        kinds: list[str] = await session.run(types([each.document for each in page]))
        for each, kind in zip(page, kinds, strict=True):
            if kind not in ("none", DOCUMENT):
                raise WrongKind(each.document, each.name, kind)
            if kind == DOCUMENT:
                there.append(each.name)
    if there and not replace:
        more = f" and {len(there) - 3} more" if len(there) > 3 else ""
        raise Conflict(
            f"{', '.join(map(repr, there[:3]))}{more}: on the server already; nothing was restored: replace=True "
            "(--replace) replaces them, into= (--into) gives what is restored other names"
        )


async def _put(session: Session, archive: Archive, name: str, keys: Keys, done: list[str], *, replace: bool) -> int:
    size = 0

    def notices() -> list[Command]:
        stamp = *session.stamp(keys), time.time(), ()
        payload = announce(*stamp, size=size)
        return published(keys, *stamp[:2], payload, everywhere=session.is_fresh(keys))

    # Reading, unpacking and converting is work for a thread.
    def prepared() -> tuple[int, Plan]:
        content = archive.read(name)
        return content.size, put(keys, content, session.cache, replace=replace, notices=notices)

    size, plan = await anyio.to_thread.run_sync(prepared)
    # As every publish: notices of one key are sent in the order of their numbers.
    async with session.transport.ordered(keys.channel):
        await session.transport.settle(keys.document)
        try:
            await session.run(plan)
        except (Conflict, WrongKind) as error:
            # Nothing was written yet, so the error says the whole truth as it is.
            if not done:
                raise
            raise Conflict(_after(error, done)) from None
        except (ReemError, RedisError) as error:
            if not done:
                raise
            raise PartialWrite(_after(error, done)) from error
    done.append(keys.name)
    return size


def _after(error: Exception, done: Sequence[str]) -> str:
    why = str(error).replace(", nothing was written", "")
    return f"{why}. Written before that: {len(done)} keys, from {done[0]!r} to {done[-1]!r}"


def _report(progress: ProgressFunction | None, doing: str, done: int, total: int) -> None:
    if progress is not None:
        progress(Progress(doing, done, total))


# Which keys of a server are REEM's, found by SCAN.

# Of each top-level key: the registry, and the note of its last update.
_OF_KEY = {b":ships", b":last"}
# What is not foreign, and gone in a moment: large arrays that are on their way to a key, and nodes.
_PASSING = STAGED.encode(), PRESENCE.encode()
_SEARCHES = 3
"""How often the servers are searched before a count that does not agree is reported."""
# The keys beside a document carry its name in braces: {foo}:ships, {foo}.bar.image.
_TAGGED = re.compile(rb"\{([^{}]*)\}(.*)", re.DOTALL)

Wanted = Callable[[str], bool]


class Survey:
    """What was found in the namespace of one session."""

    def __init__(self) -> None:
        self.names: list[str] = []  # of top-level keys
        self.seen: set[bytes] = set()  # all keys that the servers named, foreign ones too
        self.unsaved: dict[str, str] = {}  # top-level keys, and arrays, that could not be saved, and why
        self.doubt = ""  # why keys may be missing, for people
        self._tagged: dict[str, set[bytes]] = {}  # what carries a key's tag: suffixes by name, until it is known whose
        self._foreign: list[str] = []

    def owns(self, content: KeyContent) -> None:
        """Note that a key was fetched: what belongs to it is not foreign."""
        tagged = self._tagged.get(content.name, set())
        tagged -= {suffix.encode() for suffix in content.registry}
        tagged -= {value.suffix.encode() for value in content.values}
        for suffix in content.missing:
            self.unsaved[content.name + suffix.partition("~")[0]] = "it is gone from the server, only its name is left"

    def failed(self, name: str, why: str) -> None:
        """Note that a key could not be fetched; what belongs to it is not foreign."""
        self.unsaved[name] = why
        self._tagged.pop(name, None)

    async def foreign(self, session: Session) -> list[str]:
        """Return the keys that are not REEM's, each with its type. One round trip for each tag in question."""
        found, documents = list(self._foreign), set(self.names)
        for name, suffixes in sorted(self._tagged.items()):
            suffixes = {suffix for suffix in suffixes if not suffix.startswith(_PASSING)}
            # Registry and note alone need no look where the document was found.
            if suffixes and (name not in documents or suffixes - _OF_KEY):
                found += await session.run(strangers(session.keys(name), sorted(suffixes)))
        return found

    def add_page(self, page: Sequence[bytes], kinds: Sequence[str], namespace: bytes, wanted: Wanted) -> None:
        for key, kind in zip(page, kinds, strict=True):
            tagged = _TAGGED.fullmatch(key)
            name = _name((tagged[1] if tagged else key)[len(namespace) :])
            if name is None:
                self._foreign.append(shown(key, kind))
            elif not wanted(name):
                continue
            elif kind == NOT_ALLOWED:
                # Of what belongs to a document, the document is named. Its rights may be other ones.
                if tagged is None:
                    self.failed(name, "this user may not read it")
            elif tagged:
                self._tagged.setdefault(name, set()).add(tagged[2])
            elif kind == DOCUMENT:
                self.names.append(name)
            elif kind != "none":
                self._foreign.append(shown(key, kind))


def matcher(match: str) -> Wanted:
    """Return what tells whether a top-level key matches; raises BadKey."""
    pattern = Pattern(check_top_key(match))
    return lambda name: pattern.concerns((name,))


def _name(key: bytes) -> str | None:
    with suppress(UnicodeDecodeError, BadKey):
        return check_top_key(key.decode())
    return None


async def survey(session: Session, match: str) -> Survey:
    """Find the keys of a session's namespace; a plain name is taken as it is, without a search.

    The servers are searched again if they count more keys than they named: a key that moves from node to node may be
    named by neither.
    """
    wanted, found = matcher(match), Survey()
    if not set("*?") & set(match):
        found.names.append(check_top_key(match))
        return found
    for _ in range(_SEARCHES):
        named = await _search(session, found, wanted)
        held = await counted(session.transport, session.options.database)
        if held is None:
            found.doubt = "this user may not ask the server for its count (+info), so it was not compared"
            break
        # Keys that were written in between are counted but not seen: another search finds them, or keys that moved
        # between nodes. Of one search only: what was deleted since the first would hide as many that were missed.
        more = held - named
        found.doubt = f"the server counts {more} Redis keys more than it named: new ones, or missed" if more > 0 else ""
        if not found.doubt:
            break
    found.names.sort()
    return found


async def _search(session: Session, found: Survey, wanted: Wanted) -> int:
    """Add the keys that were not seen before; returns how many were named, seen before or not."""
    space = session.namespace.encode()
    named: set[bytes] = set()  # SCAN may name a key twice
    async for page in scanned(session.transport):
        named.update(map(bytes, page))
        fresh = [key for key in dict.fromkeys(map(bytes, page)) if key not in found.seen]
        found.seen.update(fresh)
        # In the namespace itself, or with a tag of it.
        ours = [key for key in fresh if key.startswith((space, b"{" + space))]
        kinds: list[str] = await session.run(types(ours)) if ours else []
        found.add_page(ours, kinds, space, wanted)
    return len(named)
