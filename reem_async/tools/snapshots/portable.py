"""Portable snapshots: every key of REEM to one file and back, with no more rights than programs have anyway."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import anyio.from_thread
import anyio.to_thread

from ... import __version__
from ...connection import RedisInterface
from ...errors import BadData, Conflict, MissingKey, NotAllowed, PartialWrite, RedisError, ReemError, WrongKind
from ...plan import Command, Plan
from ...plan.keys import DOCUMENT, Keys
from ...plan.notices import announce, published
from ...plan.paths import shorten
from ...session import Session
from .archive import Archive, ArchiveWriter, header, verify
from .files import Snapshot, check_target, sniff
from .plans import dump, lifetimes, put, types
from .survey import Survey, matcher, survey
from .values import Entry

__all__ = ["Progress", "Restored", "restore", "save"]

_BATCH = 1 << 20
"""Bytes that are handed to the thread that writes, or by it, at once; one top-level key may be more."""

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


Told = Callable[[Progress], None]


async def save(
    interface: RedisInterface,
    path: str | os.PathLike[str],
    match: str = "*",
    *,
    overwrite: bool = False,
    progress: Told | None = None,
) -> Snapshot:
    """Save the keys of REEM to one file: documents, arrays, whatever ships hold, byte for byte.

    Each top-level key is of one instant, with all that belongs to it; different keys are not. What is not
    REEM's is left out and counted. One round trip for a key without arrays, two for others, after one for
    about 1000 keys of the server to find them (none if `match` has no `*` or `?`); in a cluster all primaries
    are asked. What was found is compared with the number of keys that the servers count; if they
    count more, the result's `doubt` says so. What cannot be read is left out and named in the result's `unsaved`:
    where a right is missing, an array is gone, or a ship's value has a Redis type that cannot be saved. A key that
    expires is saved with the time it has left. In memory there are one top-level key, up to 1 MB of others and
    the names of all Redis keys. Cancelling leaves no file behind.

    Args:
        interface: The server; its namespace is what is saved.
        path: The file to make; it appears under this name when it is complete and on the disk.
        match: Which top-level keys: a name in which `*` and `?` stand for other characters.
        overwrite: Whether a file that is there may be replaced.
        progress: Called now and then, on the event loop.

    Returns:
        What the file holds.

    Raises:
        MissingKey: `match` is not "*" and names nothing. No file was made.
        BadData, NotAllowed, Conflict: No key at all could be saved; this is why for the first. No file was made.
        ClusterNode: The server is one node of several. No file was made.
        NotConnected: A node does not answer, or slots of the cluster have none. No file was made.
        FileExistsError: The file is there, or was made by somebody else meanwhile.
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
    saved = await anyio.to_thread.run_sync(_describe, target)
    return dataclasses.replace(saved, doubt=found.doubt)


def _describe(path: Path) -> Snapshot:
    with Archive(path) as archive:
        return archive.summary


async def _fill(
    session: Session, writer: ArchiveWriter, found: Survey, progress: Told | None
) -> tuple[int, Exception | None]:
    """Fetch and write the keys found; return how many were still there, and why the first that failed did."""
    count, batch, failure = 0, _Batch(), None
    lifetimes_left: list[int | None] = []
    for number, name in enumerate(found.names):
        _tell(progress, "save", number, len(found.names))
        if number % _PAGE == 0:
            lifetimes_left = await _lifetimes(session, found, found.names[number : number + _PAGE])
        keys = session.keys(name)
        try:
            entry: Entry | None = await session.run(dump(keys))
        except WrongKind:  # replaced by a program without REEM since it was found
            continue
        except (BadData, Conflict, NotAllowed) as error:
            failure = failure or error
            found.failed(name, str(error))
            continue
        if entry is None:
            continue
        entry = entry._replace(expires=lifetimes_left[number % _PAGE])
        count += 1
        found.owns(entry)
        if batch.takes(entry):
            await anyio.to_thread.run_sync(_write, writer, batch.handed_over())
    await anyio.to_thread.run_sync(_write, writer, batch.handed_over())
    _tell(progress, "save", len(found.names), len(found.names))
    return count, failure


async def _lifetimes(session: Session, found: Survey, names: Sequence[str]) -> list[int | None]:
    left: list[int | None] | None = await session.run(lifetimes([session.keys(name).document for name in names]))
    if left is None:
        found.doubt = found.doubt or "this user may not ask when keys expire (+pttl), so they are saved without expiry"
    return left or [None] * len(names)


def _write(writer: ArchiveWriter, entries: Sequence[Entry]) -> None:
    for entry in entries:
        writer.add(entry)


class _Batch:
    """Entries on their way between the event loop and the thread that reads or writes the file."""

    def __init__(self) -> None:
        self._entries: list[Entry] = []
        self._size = 0

    def takes(self, entry: Entry) -> bool:
        """Add one; return whether it is time to hand them over."""
        self._entries.append(entry)
        # 100 bytes for what an entry costs besides its content, so that many empty ones make a batch too.
        self._size += entry.size + 100
        return self._size >= _BATCH

    def handed_over(self) -> list[Entry]:
        """Return the entries and forget them."""
        entries, self._entries, self._size = self._entries, [], 0
        return entries


async def restore(
    interface: RedisInterface,
    path: str | os.PathLike[str],
    match: str = "*",
    *,
    replace: bool = False,
    into: str = "",
    progress: Told | None = None,
) -> Restored:
    """Write the keys of a portable snapshot to a server, and tell their subscribers.

    The whole file is checked first, and whether keys are in the way: a damaged file, or a key that is
    there, changes nothing. Then each top-level key is one transaction of all that belongs to it and its
    notice; the keys together are not. A key that was saved with an expiry has as long to live as it had left
    then. Two round trips for each, after one for 500 of them. Cancelling, or an error on the way, leaves some keys
    written and the others as they were, none half.

    Args:
        interface: The server; the keys go to its namespace, whatever the one was they were saved of.
        path: The file.
        match: Which top-level keys of the file: a name in which `*` and `?` stand for other characters.
        replace: Whether keys that are there may be replaced. Others on the server are left alone.
        into: Goes before the name of each key.
        progress: Called now and then, on the event loop.

    Raises:
        BadData: The file is damaged, or none of REEM. Nothing was written.
        MissingKey: `match` names no key of the file. Nothing was written.
        Conflict: A key is there and `replace` is False. Nothing was written, unless the message says so.
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
        left = list(names)
        while left:
            # Reading and unpacking are the thread's work, so that the event loop goes on meanwhile.
            batch = await anyio.to_thread.run_sync(_next_batch, archive, left)
            left = left[len(batch) :]
            while batch:  # each is let go of before the next one comes
                entry = batch.pop(0)
                size += entry.size
                _tell(progress, "restore", len(done), len(names))
                await _put(session, names[entry.name], entry, done, replace=replace)
                del entry
        _tell(progress, "restore", len(done), len(names))
    return Restored(tuple(done), size)


async def _check_file(source: Path, progress: Told | None) -> None:
    if await anyio.to_thread.run_sync(sniff, source) == "rdb":
        raise BadData(
            f"{source} is an RDB file, which only a server can read: start one with `reem up --from {source}`, "
            "and save a portable snapshot of that"
        )

    # `verify` runs in a thread; the caller's function expects to be called on the event loop.
    def told(done: int, total: int) -> None:
        if progress is not None:
            anyio.from_thread.run_sync(progress, Progress("verify", done, total))

    await anyio.to_thread.run_sync(verify, source, told)


async def _check_room(session: Session, keys: Sequence[Keys], *, replace: bool) -> None:
    """Raise if anything is in the way, before anything is written."""
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
            "replaces them, into= gives what is restored other names"
        )


def _next_batch(archive: Archive, names: Iterable[str]) -> list[Entry]:
    batch = _Batch()
    for name in names:
        if batch.takes(archive.read(name)):
            break
    return batch.handed_over()


async def _put(session: Session, keys: Keys, entry: Entry, done: list[str], *, replace: bool) -> None:
    def notices() -> list[Command]:
        stamp = *session.stamp(keys), time.time(), ()
        payload = announce(*stamp, size=entry.size)
        return published(keys, *stamp[:2], payload, everywhere=session.is_fresh(keys))

    plan: Plan = await anyio.to_thread.run_sync(
        lambda: put(keys, entry, session.cache, replace=replace, notices=notices)
    )
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


def _after(error: Exception, done: Sequence[str]) -> str:
    """Return what went wrong, and what had been written by then."""
    why = str(error).replace(", nothing was written", "")
    return f"{why}. Written before that: {len(done)} keys, from {done[0]!r} to {done[-1]!r}"


def _tell(progress: Told | None, doing: str, done: int, total: int) -> None:
    if progress is not None:
        progress(Progress(doing, done, total))
