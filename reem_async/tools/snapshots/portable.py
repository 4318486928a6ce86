"""Portable snapshots: every key of REEM to one file and back, with no more rights than programs have anyway."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import anyio.to_thread

from ... import __version__
from ...connection import RedisInterface
from ...errors import BadData, BadKey, Conflict, MissingKey, NotAllowed, PartialWrite, RedisError, ReemError, WrongKind
from ...plan.changes import EncodedAttachment
from ...plan.keys import DOCUMENT, Keys
from ...plan.paths import Pattern, check_top_key, shorten
from ...plan.writes import change, exchange, expiry, set_change
from ...session import Session
from ...store.document import Turn
from ...store.publish import DocumentPublisher
from ...transport import counted, scanned
from .archive import Archive, ArchiveWriter, header, verify
from .files import Snapshot, check_target, sniff
from .plans import NOT_ALLOWED, KeyContent, dump, settable, storing, types

# Keys whose types are asked for in one round trip.
_PAGE = 500


class Progress(NamedTuple):
    """How far a call has come.

    Attributes:
        doing: "save" or "restore".
        done: How many keys are done, and
        total: of how many.
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


def _unseen(_: Progress) -> None: ...


async def save(
    interface: RedisInterface,
    path: str | os.PathLike[str],
    match: str = "*",
    *,
    overwrite: bool = False,
    progress: ProgressFunction | None = None,
) -> Snapshot:
    """Save the keys of REEM to one file: documents, arrays, whatever ships hold, byte for byte.

    Each top-level key is of one instant, with all that belongs to it; different keys are not. What is not REEM's is
    left out. What cannot be read is left out and named in the result's `unsaved`: where a right is missing, an array is
    gone, or a ship's value has a Redis type that cannot be saved. A key that expires is saved with the time it has
    left. Cancelling leaves no file behind.

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
    session, target, progress = interface.session, Path(path), progress or _unseen
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
        await anyio.to_thread.run_sync(writer.finish, found.unsaved)
    # Cancelling included: there is a file with this name only if it is complete.
    except BaseException:
        writer.abandon()
        raise
    with await anyio.to_thread.run_sync(Archive, target) as archive:
        return dataclasses.replace(archive.summary, doubt=found.doubt)


async def _fill(
    session: Session, writer: ArchiveWriter, found: Survey, progress: ProgressFunction
) -> tuple[int, Exception | None]:
    """Fetch and write the keys found; return how many were still there, and why the first that failed did."""
    count, failure = 0, None
    for number, name in enumerate(found.names):
        progress(Progress("save", number, len(found.names)))
        try:
            content: KeyContent | None = await session.run(dump(session.keys(name)))
        except WrongKind:  # replaced by a program without REEM since it was found
            continue
        except (BadData, Conflict, NotAllowed) as error:
            failure = failure or error
            found.unsaved[name] = str(error)
            continue
        if content is not None:
            count += 1
            for suffix in content.missing:
                found.unsaved[name + suffix.partition("~")[0]] = "it is gone from the server, only its name is left"
            await anyio.to_thread.run_sync(writer.add, content)
    progress(Progress("save", len(found.names), len(found.names)))
    return count, failure


async def restore(
    interface: RedisInterface,
    path: str | os.PathLike[str],
    match: str = "*",
    *,
    replace: bool = False,
    progress: ProgressFunction | None = None,
) -> Restored:
    """Write the keys of a portable snapshot to a server, and notify their subscribers.

    First the whole file is checked, and whether keys are in the way: a damaged file, or an existing key, changes
    nothing. Then each top-level key is one transaction of all that belongs to it and its notice; the keys together
    are not. A key that was saved with an expiry has as long to live as it had left then, from another transaction on.
    Two round trips for each, four with an expiry or `replace`, after one for 500 of them. Cancelling, or an error on
    the way, leaves some keys written and the others as they were, none half.

    Args:
        interface: The server; the keys go to its namespace, whatever the one was they were saved of.
        path: The file.
        match: Which top-level keys of the file: a name in which `*` and `?` stand for other characters.
        replace: Whether existing keys may be replaced. Others on the server are left alone.
        progress: Called now and then, on the event loop.

    Raises:
        BadData: The file is damaged, or none of REEM. Nothing was written.
        MissingKey: `match` names no key of the file. Nothing was written.
        Conflict: A key exists and `replace` is False. Nothing was written, unless the message says so.
        WrongKind: A Redis key that is not REEM's has the name of one. Nothing was written.
        BadKey: A name with the namespace before it is too long.
        PartialWrite: The server, or the connection, failed behind some keys; the message says which were written.
        OSError: The file cannot be read.
    """
    session, source, progress = interface.session, Path(path), progress or _unseen
    await anyio.to_thread.run_sync(_check_file, source)
    archive = await anyio.to_thread.run_sync(Archive, source)
    with archive:
        pattern = Pattern(check_top_key(match))
        names = [session.keys(key.name) for key in archive.summary.keys if pattern.concerns((key.name,))]
        if not names and match != "*":
            raise MissingKey(f"{source}: no key of this snapshot matches {shorten(match)}; nothing was written")
        # Before the first write, so that a restore that is refused changes nothing; `_put` looks at each key once more.
        await _check_room(session, names, replace=replace)
        done: list[str] = []
        size = 0
        for keys in names:
            progress(Progress("restore", len(done), len(names)))
            size += await _put(session, archive, keys, done, replace=replace)
        progress(Progress("restore", len(done), len(names)))
    return Restored(tuple(done), size)


def _check_file(source: Path) -> None:
    if sniff(source) == "rdb":
        raise BadData(
            f"{source} is an RDB file, which only a server can read: start one with `reem up --from {source}`, "
            "and save a portable snapshot of that"
        )
    verify(source)


async def _check_room(session: Session, keys: Sequence[Keys], *, replace: bool) -> None:
    there: list[str] = []
    for start in range(0, len(keys), _PAGE):
        page = keys[start : start + _PAGE]
        kinds: list[str] = await session.run(types([name for each in page for name in (each.document, each.registry)]))
        for each, kind, registry in zip(page, kinds[::2], kinds[1::2], strict=True):
            if kind not in ("none", DOCUMENT):
                raise WrongKind(each.document, each.name, kind)
            if registry not in ("none", "set"):
                raise WrongKind(each.registry, each.name, registry)
            if kind == DOCUMENT:
                there.append(each.name)
    if there and not replace:
        more = f" and {len(there) - 3} more" if len(there) > 3 else ""
        raise Conflict(
            f"{', '.join(map(repr, there[:3]))}{more}: on the server already; nothing was restored: replace=True "
            "(--replace) replaces them, another namespace= (--namespace) keeps both"
        )


async def _put(session: Session, archive: Archive, keys: Keys, done: list[str], *, replace: bool) -> int:
    # Reading, unpacking and converting is work for a thread.
    def prepared() -> tuple[KeyContent, bytes, tuple[EncodedAttachment, ...]]:
        content = archive.read(keys.name)
        return content, settable(content.text), tuple([storing(keys, value) for value in content.values])

    async def send(turn: Turn, content: KeyContent, text: bytes, attachments: tuple[EncodedAttachment, ...]) -> None:
        it = set_change(keys, (), text, attachments, turn.reserve())
        absent = [("TYPE", keys.document)], (b"none",)
        await session.run(change(it, session.cache) if replace else exchange(it, *absent, session.cache))
        # A document that was replaced still has its expiry.
        if replace or content.expires is not None:
            await session.run(expiry(keys, content.expires))

    content, *encoded = await anyio.to_thread.run_sync(prepared)
    try:
        await DocumentPublisher(session, keys.name).in_turn(send, content, *encoded)
    except Conflict:
        raise Conflict(_after(f"{keys.name!r} was written by another client meanwhile", done)) from None
    except (ReemError, RedisError) as error:
        # Where nothing was written yet, the error says the whole truth as it is.
        if not done:
            raise
        raise PartialWrite(_after(str(error), done)) from error
    done.append(keys.name)
    return content.size


def _after(why: str, done: Sequence[str]) -> str:
    if not done:
        return f"{why}; nothing was written"
    why = why.replace(", nothing was written", "")
    return f"{why}. Written before that: {len(done)} keys, from {done[0]!r} to {done[-1]!r}"


# Which keys of a server are REEM's, found by SCAN.

_SEARCHES = 3
"""How often the servers are searched before a count that does not agree is reported."""


@dataclasses.dataclass
class Survey:
    names: list[str]  # of top-level keys
    unsaved: dict[str, str] = dataclasses.field(default_factory=dict)  # keys and arrays that cannot be saved, and why
    doubt: str = ""  # why keys may be missing, for people


async def survey(session: Session, match: str) -> Survey:
    """Find the keys of a session's namespace; a plain name is taken as it is, without a search.

    The servers are searched again if they count more keys than they named: a key that moves from node to node may be
    named by neither.
    """
    pattern, found = Pattern(check_top_key(match)), Survey([])
    if not set("*?") & set(match):
        return Survey([match])
    seen: set[bytes] = set()
    for _ in range(_SEARCHES):
        named = await _search(session, pattern, found, seen)
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


async def _search(session: Session, pattern: Pattern, found: Survey, seen: set[bytes]) -> int:
    """Add the keys that were not `seen` before; returns how many were named, of any kind, seen before or not."""
    space = session.namespace.encode()
    named: set[bytes] = set()  # SCAN may name a key twice
    async for page in scanned(session.transport):
        named.update(map(bytes, page))
        names = {key: _name(key[len(space) :]) for key in set(map(bytes, page)) - seen if key.startswith(space)}
        wanted = {key: name for key, name in names.items() if name is not None and pattern.concerns((name,))}
        seen.update(names)
        kinds: list[str] = await session.run(types(list(wanted))) if wanted else []
        for name, kind in zip(wanted.values(), kinds, strict=True):
            if kind == DOCUMENT:
                found.names.append(name)
            elif kind == NOT_ALLOWED:
                found.unsaved[name] = "this user may not read it"
    return len(named)


def _name(key: bytes) -> str | None:
    with suppress(UnicodeDecodeError, BadKey):
        return check_top_key(key.decode())
    return None
