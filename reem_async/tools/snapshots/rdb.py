"""RDB files: have the server save one, and copy it.

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
from ..partfile import PartFile
from .files import Snapshot, check_target

# Between two requests of INFO: a save of a small server takes some milliseconds, of a large one minutes.
_POLL_SECONDS = 0.05
# A save that the server has accepted must have begun, or be done, within this time.
_START_SECONDS = 10.0
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
    # SCHEDULE: a server that is rewriting its append-only file saves after that, and does not refuse.
    await _asked(interface, "BGSAVE", "SCHEDULE")
    await _finished(interface, source, before)
    await _copy(source, target, overwrite=overwrite)
    return await anyio.to_thread.run_sync(describe_rdb, target)


async def _asked(interface: RedisInterface, *command: str) -> Any:
    def decode(replies: Sequence[Reply]) -> Any:
        if isinstance(replies[0], Exception):
            raise RdbUnavailable(f"the server refused {' '.join(command)}: {replies[0]}")
        return replies[0]

    return await interface.session.run(Plan([command], decode))


async def _place(interface: RedisInterface) -> Path:
    reply = await _asked(interface, "CONFIG", "GET", "dir", "dbfilename")
    try:
        return Path(*[os.fsdecode(bytes(reply[option])) for option in (b"dir", b"dbfilename")])
    except (LookupError, TypeError):
        raise RdbUnavailable(f"the server does not say where its RDB file is (CONFIG GET gave {reply!r})") from None


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


async def _finished(interface: RedisInterface, source: Path, before: Identity) -> None:
    """Wait until the server has saved. A save that was running when it was asked counts as well."""
    idle = 0.0
    while idle < _START_SECONDS:
        text = bytes(await _asked(interface, "INFO", "persistence")).decode(errors="replace")
        now = dict(re.findall(r"(?m)^(\w+):([^\r\n]*)", text))
        # A scheduled save begins only after the rewriting of the append-only file.
        busy = "1" in (now.get("rdb_bgsave_in_progress"), now.get("aof_rewrite_in_progress"))
        if not busy and now.get("rdb_last_bgsave_status") == "err":
            raise RdbUnavailable("the server could not save its RDB file; its log says why")
        if not busy and _identity(source) not in (None, before):
            return
        # The limit is for a save that does not begin; a running one takes as long as it needs.
        idle = 0.0 if busy else idle + _POLL_SECONDS
        await anyio.sleep(_POLL_SECONDS)
    raise RdbUnavailable(
        f"the server has accepted BGSAVE, but the file {source} of this machine has not changed within "
        f"{_START_SECONDS:.0f} s: it is another server's"
    )


async def _copy(source: Path, target: Path, *, overwrite: bool) -> None:
    part = PartFile(target, replace=overwrite)
    try:
        with source.open("rb") as origin, part.path.open("wb") as copy:
            while await anyio.to_thread.run_sync(lambda: copy.write(origin.read(_BLOCK))):
                pass
        await anyio.to_thread.run_sync(part.finish)
    finally:
        part.close()


def describe_rdb(path: Path) -> Snapshot:
    """Return the summary of an RDB file: only a server can tell what it holds."""
    status = path.stat()
    return Snapshot(path, "rdb", status.st_mtime, status.st_size, None)
