"""RDB files: asking the server for one and copying it, and what the beginning of one says.

An RDB file holds the whole server, every database and namespace, foreign keys too, at one instant.
Only a server can read it (`reem up --from FILE`), one not older than the one that wrote it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import anyio
import anyio.to_thread

from ...connection import RedisInterface
from ...errors import ReemError
from ...plan import Plan, Reply
from .files import NewFile, Snapshot, check_target

__all__ = ["RdbUnavailable", "describe_rdb", "save_rdb"]

# Between two looks at INFO: a save of a small server takes some milliseconds, of a large one minutes.
_POLL_SECONDS = 0.05
_START_SECONDS = 10.0
"""What a save that the server has accepted gets to begin."""
# Bytes of the beginning that are looked at: the facts stand in the first few hundred, but modules may come before them.
_HEAD = 1 << 20
# Bytes copied at a time.
_BLOCK = 1 << 22


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
        overwrite: Whether a file that is there may be replaced.

    Raises:
        RdbUnavailable: The server does not allow it, or its file cannot be read here, or this is a cluster,
            whose nodes have a file each.
        FileExistsError: The file is there, or was made by somebody else meanwhile.
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
    await anyio.to_thread.run_sync(_check_readable, source)
    # Order: note the file and the counters, ask for a save, wait until it is over, check that the file is another one
    # (else the path is that of another machine), copy it.
    before = _identity(source)
    saves = await _progress(interface)
    # SCHEDULE: if the server is rewriting its append-only file it saves after that, and does not refuse.
    await _asked(interface, "BGSAVE", "SCHEDULE")
    await _finished(interface, source, before, saves)
    await _copy(source, before, target, overwrite=overwrite)
    return await anyio.to_thread.run_sync(describe_rdb, target)


async def _place(interface: RedisInterface) -> Path:
    """Return where the server keeps its file, as the server sees it."""
    words = []
    for option in ("dir", "dbfilename"):
        reply = await _asked(interface, "CONFIG", "GET", option)
        pairs = reply if isinstance(reply, dict) else {}
        value = pairs.get(option.encode())
        if not value:
            raise RdbUnavailable(f"the server does not say where its RDB file is (CONFIG GET {option} gave {reply!r})")
        words.append(os.fsdecode(bytes(value)))
    return Path(*words)


async def _asked(interface: RedisInterface, *command: str) -> Any:
    def decode(replies: Sequence[Reply]) -> Any:
        if isinstance(replies[0], Exception):
            raise RdbUnavailable(f"the server refused {' '.join(command)}: {replies[0]}")
        return replies[0]

    return await interface.session.run(Plan([command], decode))


def _check_readable(source: Path) -> None:
    """Raise RdbUnavailable before the server is put to work for nothing."""
    readable = os.access(source.parent, os.R_OK | os.X_OK) and (not source.exists() or os.access(source, os.R_OK))
    if not readable:
        raise RdbUnavailable(
            f"the server keeps its RDB file at {source}, which this program cannot read (another machine, "
            "a container, or another user)"
        )


def _identity(source: Path) -> tuple[int, int, int] | None:
    """Return what tells one version of a file from the next: the server makes a new one and renames it."""
    try:
        status = source.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


async def _progress(interface: RedisInterface) -> dict[str, str]:
    text = bytes(await _asked(interface, "INFO", "persistence")).decode(errors="replace")
    return dict(re.findall(r"(?m)^(\w+):([^\r\n]*)", text))


async def _finished(
    interface: RedisInterface, source: Path, before: tuple[int, int, int] | None, first: dict[str, str]
) -> None:
    """Wait until the server has saved. What was under way when it was asked is waited for, and counts as well."""
    idle = 0.0
    while idle < _START_SECONDS:
        now = await _progress(interface)
        # A save that was scheduled begins only after the rewriting of the append-only file.
        busy = "1" in (now.get("rdb_bgsave_in_progress"), now.get("aof_rewrite_in_progress"))
        if not busy and now.get("rdb_last_bgsave_status") == "err":
            raise RdbUnavailable("the server could not save its RDB file; its log says why")
        # rdb_saves is new (Redis 7); the time of the last save has seconds only, so the file's identity counts too.
        counted = any(now.get(name) != first.get(name) for name in ("rdb_saves", "rdb_last_save_time"))
        if not busy and (counted or _identity(source) != before):
            return
        # The limit is for a save that does not begin; how long one takes is the server's business.
        idle = 0.0 if busy else idle + _POLL_SECONDS
        await anyio.sleep(_POLL_SECONDS)
    raise RdbUnavailable(f"the server has accepted BGSAVE but not begun within {_START_SECONDS:.0f} s")


async def _copy(source: Path, before: tuple[int, int, int] | None, target: Path, *, overwrite: bool) -> None:
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


def describe_rdb(path: Path) -> Snapshot:
    """Return what the beginning of an RDB file says; what it does not say is None or empty."""
    status = path.stat()
    with path.open("rb") as file:
        facts, count = _read_head(file)
    moment = facts.get("ctime", "")
    program = next((f"{name[:-4]} {facts[name]}" for name in ("redis-ver", "valkey-ver") if name in facts), "")
    # ctime is in seconds; a file without it (very old) has the time of the file.
    taken = float(moment) if moment.isascii() and moment.isdigit() and len(moment) < 12 else status.st_mtime
    return Snapshot(path, "rdb", taken, status.st_size, count, server=program)


def _read_head(file: BinaryIO) -> tuple[dict[str, str], int | None]:
    """Return the facts an RDB file begins with, and the number of keys of its first database."""
    head = _Head(file.read(_HEAD))
    facts: dict[str, str] = {}
    try:
        while (code := head.byte()) in _SECTIONS:
            if code == _FACT:
                name = head.text()
                facts[name] = head.text()
            elif code == _SELECT:
                head.length()
            elif code == _SIZES:
                return facts, head.length()
            else:
                head.skip_module()
    except (IndexError, ValueError):
        return facts, None
    return facts, 0 if code == _END else None


# Opcodes of the RDB format: an auxiliary field, a module's data, the number of a database, its sizes, the end.
_FACT, _MODULE, _SELECT, _SIZES, _END = 0xFA, 0xF7, 0xFE, 0xFB, 0xFF
_SECTIONS = {_FACT, _MODULE, _SELECT, _SIZES}


class _Head:
    """Reads the encodings of an RDB file; raises IndexError or ValueError at what it does not know."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._position = 9  # after magic and version

    def byte(self) -> int:
        self._position += 1
        return self._data[self._position - 1]

    def take(self, count: int) -> bytes:
        self._position += count
        if self._position > len(self._data):
            raise IndexError("the beginning ends here")
        return self._data[self._position - count : self._position]

    def length(self) -> int:
        # The two highest bits say how long the length is: 6 bits, 14 bits, or (0x80, 0x81) 4 or 8 bytes, big-endian.
        first = self.byte()
        if first < 0x40:
            return first
        if first < 0x80:
            return (first & 0x3F) << 8 | self.byte()
        if first in (0x80, 0x81):
            return int.from_bytes(self.take(8 if first & 1 else 4))
        raise ValueError("an encoding, not a length")

    def text(self) -> str:
        first = self._data[self._position]
        if first < 0xC0:
            return self.take(self.length()).decode(errors="replace")
        self._position += 1
        # 0xC0 to 0xC2: the text is an integer of 1, 2 or 4 bytes. 0xC3 would be a compressed text, which no fact here
        # is.
        if first in (0xC0, 0xC1, 0xC2):
            return str(int.from_bytes(self.take(1 << (first & 3)), "little", signed=True))
        raise ValueError("a compressed text")

    def skip_module(self) -> None:
        """Skip what a module has stored beside the keys."""
        self.length()
        while code := self.length():
            # Opcodes of a module: 1 and 2 integers, 3 a float, 4 a double, 5 a text, 0 the end.
            if code in (1, 2):
                self.length()
            elif code in (3, 4):
                self.take(4 if code == 3 else 8)
            elif code == 5:
                self.text()
            else:
                raise ValueError("an unknown part of a module")
