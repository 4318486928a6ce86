"""RDB files: have the server save one and copy it, and read the facts at the beginning of one.

An RDB file holds the whole server, every database and namespace, foreign keys too, at one instant.
Only a server can read it (`reem up --from FILE`), one not older than the one that wrote it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread

from ...connection import RedisInterface
from ...errors import ReemError
from ...plan import Plan, Reply
from .files import NewFile, Snapshot, check_target

# Between two requests of INFO: a save of a small server takes some milliseconds, of a large one minutes.
_POLL_SECONDS = 0.05
# A save that the server has accepted must begin within this time.
_START_SECONDS = 10.0
# Bytes of the beginning that are read: the facts are in the first few hundred, but modules may come before them.
_HEAD = 1 << 20
# Bytes copied at a time.
_BLOCK = 1 << 22

Identity = tuple[int, int, int] | None


class RdbUnavailable(ReemError):
    """This program cannot get at the server's RDB file; says why. Nothing was saved."""


async def save_rdb(interface: RedisInterface, path: str | os.PathLike[str], *, overwrite: bool = False) -> Snapshot:
    """Have the server save all it holds to its RDB file, and copy that file to `path`.

    The user of the interface needs the commands CONFIG GET, BGSAVE and INFO, and this program the right
    to read the server's directory, so the server must run on this machine. Takes as long as the server
    needs. Cancelling leaves no file behind.

    Args:
        interface: The server.
        path: The file to make; it appears under this name when it is complete.
        overwrite: Whether an existing file may be replaced.

    Raises:
        RdbUnavailable: The server does not allow it, or its file cannot be read here, or this is a cluster,
            whose nodes have a file each.
        FileExistsError: The file exists, or another program made it in between.
        OSError: The file cannot be written.
    """
    target = Path(path)
    await anyio.to_thread.run_sync(lambda: check_target(target, overwrite=overwrite))
    if interface.session.transport.sharded:
        raise RdbUnavailable(
            "the nodes of a cluster have an RDB file each, with a part of the keys, and none has all; save each node "
            "by itself (redis-cli -h HOST -p PORT --rdb FILE)"
        )
    source = await _place(interface)
    # Before the server is put to work for nothing.
    await anyio.to_thread.run_sync(_check_readable, source)
    before = _identity(source)
    first = await _persistence(interface)
    # SCHEDULE: a server that is rewriting its append-only file saves after that, and does not refuse.
    await _asked(interface, "BGSAVE", "SCHEDULE")
    await _finished(interface, source, before, first)
    await _copy(source, before, target, overwrite=overwrite)
    return await anyio.to_thread.run_sync(describe_rdb, target)


async def _asked(interface: RedisInterface, *command: str) -> Any:
    def decode(replies: Sequence[Reply]) -> Any:
        if isinstance(replies[0], Exception):
            raise RdbUnavailable(f"the server refused {' '.join(command)}: {replies[0]}")
        return replies[0]

    return await interface.session.run(Plan([command], decode))


async def _place(interface: RedisInterface) -> Path:
    words = []
    for option in ("dir", "dbfilename"):
        reply = await _asked(interface, "CONFIG", "GET", option)
        value = reply.get(option.encode()) if isinstance(reply, dict) else None
        if not value:
            raise RdbUnavailable(f"the server does not say where its RDB file is (CONFIG GET {option} gave {reply!r})")
        words.append(os.fsdecode(bytes(value)))
    return Path(*words)


def _check_readable(source: Path) -> None:
    if not os.access(source.parent, os.R_OK | os.X_OK) or (source.exists() and not os.access(source, os.R_OK)):
        raise RdbUnavailable(
            f"the server keeps its RDB file at {source}, which this program cannot read (another machine, "
            "a container, or another user)"
        )


def _identity(source: Path) -> Identity:
    """Return what tells one version of a file from the next: the server makes a new one and renames it."""
    try:
        status = source.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


async def _persistence(interface: RedisInterface) -> dict[str, str]:
    text = bytes(await _asked(interface, "INFO", "persistence")).decode(errors="replace")
    return dict(re.findall(r"(?m)^(\w+):([^\r\n]*)", text))


async def _finished(interface: RedisInterface, source: Path, before: Identity, first: dict[str, str]) -> None:
    """Wait until the server has saved. A save that was running when it was asked counts as well."""
    idle = 0.0
    while idle < _START_SECONDS:
        now = await _persistence(interface)
        # A scheduled save begins only after the rewriting of the append-only file.
        busy = "1" in (now.get("rdb_bgsave_in_progress"), now.get("aof_rewrite_in_progress"))
        if not busy and now.get("rdb_last_bgsave_status") == "err":
            raise RdbUnavailable("the server could not save its RDB file; its log says why")
        # rdb_saves is new (Redis 7); the time of the last save has seconds only, so the file's identity counts too.
        counted = any(now.get(name) != first.get(name) for name in ("rdb_saves", "rdb_last_save_time"))
        if not busy and (counted or _identity(source) != before):
            return
        # The limit is for a save that does not begin; a running one takes as long as it needs.
        idle = 0.0 if busy else idle + _POLL_SECONDS
        await anyio.sleep(_POLL_SECONDS)
    raise RdbUnavailable(f"the server has accepted BGSAVE but not begun within {_START_SECONDS:.0f} s")


async def _copy(source: Path, before: Identity, target: Path, *, overwrite: bool) -> None:
    if _identity(source) in (None, before):
        raise RdbUnavailable(
            f"the server has saved, but the file {source} of this machine has not changed: it is another server's"
        )
    new = NewFile(target, overwrite=overwrite)
    try:
        with source.open("rb") as origin:
            while await anyio.to_thread.run_sync(lambda: new.file.write(origin.read(_BLOCK))):
                pass
        await anyio.to_thread.run_sync(new.commit)
    except BaseException:
        new.discard()
        raise


# The beginning of an RDB file: facts (0xfa, name, text), then for each database its number (0xfe) and sizes (0xfb).
_PROGRAM = re.compile(rb"\xfa[\x09\x0a](redis|valkey)-ver[\x00-\x3f]([\w.+-]+)")
_TIME = re.compile(rb"\xfa\x05ctime(?:\xc2(.{4})|[\x01-\x0b]([0-9]{1,11})(?=[\xf0-\xff]))", re.DOTALL)
_SIZES = re.compile(rb"\xfe[\x00-\x3f]\xfb(?:([\x00-\x3f])|([\x40-\x7f].)|\x80(.{4})|\x81(.{8}))", re.DOTALL)
_END = re.compile(rb"\xff.{8}\Z", re.DOTALL)


def describe_rdb(path: Path) -> Snapshot:
    """Return what the beginning of an RDB file says; what it does not say is None or empty."""
    status = path.stat()
    with path.open("rb") as file:
        head = file.read(_HEAD)
    program, moment, sizes = _PROGRAM.search(head), _TIME.search(head), _SIZES.search(head)
    taken = status.st_mtime  # of a file that does not say it: very old ones
    if moment is not None:
        taken = float(int.from_bytes(moment[1], "little") if moment[1] else int(moment[2]))
    count = None
    if sizes is not None:  # in the bytes of the length, the two highest bits of the first say how long it is
        count = int.from_bytes(next(filter(None, sizes.groups()))) & (0x3FFF if sizes[2] else -1)
    elif b"\xfe" not in head[:-8] and _END.search(head):  # no database at all
        count = 0
    server = b"%s %s" % program.groups() if program is not None else b""
    return Snapshot(path, "rdb", taken, status.st_size, count, server=server.decode())
