"""The memory of a publisher: one file without a name for each top-level key, in slots that each hold one update.

The file is sealed: only the process that made it can change or shorten it, so a reader that has checked the seals
can neither be surprised by other bytes than the publisher's nor be killed by a page that is gone. It lives as long as
a process has it open.

    0        identity        readers compare it
    64       a stamp for each slot: 0 while it is written
    4096     slot 0, slot 1, ... each of the same size
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import mmap
import os
import secrets
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..concurrency.wakeup import Descriptor
from ..plan.notices import starts

SLOTS = 6  # one that is written, three for a subscriber (see `reader.py`), two for others that are not as far
NAME = "reem"  # of the file, for a look at the descriptors of a process
HEAD = 4096  # bytes before the first slot: a page

IDENTITY = struct.Struct("<8sQQ")  # a mark, how many slots a segment has, and the bytes of each
MARK = b"REEM\x00\x00\x00\x01"

STAMP = struct.Struct("<Q")
_STAMPS = 64

_STEP = 1 << 20  # bytes that are allocated at a time: older kernels restart when a signal comes

_FUTURE_WRITE = 0x10  # F_SEAL_FUTURE_WRITE of <linux/fcntl.h>: no mapping to write can be made any more
_POPULATE_WRITE = 23  # MADV_POPULATE_WRITE of <sys/mman.h>: map the pages now, and not at their first touch
SEALS = getattr(fcntl, "F_SEAL_SHRINK", 0) | getattr(fcntl, "F_SEAL_GROW", 0) | _FUTURE_WRITE


# Locks on bytes of a file that belong to an open file description, not to a process. The kernel gives them back when
# the description is closed for the last time, so also when its process is killed. Each byte is that of one slot; no
# process ever waits for one.

# struct flock of <fcntl.h> where off_t has 64 bits: l_type, l_whence, l_start, l_len, l_pid (0 for these locks), and
# the padding at its end.
_FLOCK = struct.Struct("@hhqqi4x")
_TAKEN = (errno.EAGAIN, errno.EACCES)


def lock_for_reading(descriptor: int, number: int) -> bool:
    """Return whether the slot is not being written, and is locked now."""
    return _set(descriptor, fcntl.F_RDLCK, number)


def lock_for_writing(descriptor: int, number: int) -> bool:
    """Return whether the slot is not being read, and is locked now."""
    return _set(descriptor, fcntl.F_WRLCK, number)


def _set(descriptor: int, kind: int, number: int) -> bool:
    try:
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, _FLOCK.pack(kind, 0, number, 1, 0))
    except OSError as error:
        if error.errno in _TAKEN:
            return False
        raise
    return True


class Shape(NamedTuple):
    slots: int
    room: int  # bytes in each

    @property
    def size(self) -> int:
        return HEAD + self.slots * self.room

    def start(self, number: int) -> int:
        return HEAD + number * self.room


def stamp_at(number: int) -> int:
    return _STAMPS + number * STAMP.size


class Segment:
    """The shared memory of one publisher and top-level key. Raises OSError if there is no memory, or no descriptor.

    Dropping it frees the memory; mapped slots stay valid.
    """

    def __init__(self, room: int) -> None:
        self.shape = Shape(SLOTS, -(-room // mmap.PAGESIZE) * mmap.PAGESIZE)
        self.used = 0.0  # when it was written last, on the clock of its owner
        self._oldest = list(range(SLOTS))
        # By which other processes reach it
        self.descriptor = os.memfd_create(NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        # Closed with the last reference: another thread may be writing when the interface is closed.
        self._owner = Descriptor(self.descriptor)
        os.fchmod(self.descriptor, 0o600)
        # All of it now: where memory is short this fails, and no write later is met by SIGBUS. (A cgroup's limit may
        # still end the program, as it may wherever a program takes memory.)
        for start in range(0, self.shape.size, _STEP):
            os.posix_fallocate(self.descriptor, start, min(_STEP, self.shape.size - start))
        self._map = mmap.mmap(self.descriptor, self.shape.size)
        # Else the first update in each slot takes several times as long as later ones. Linux before 5.14 cannot.
        with contextlib.suppress(OSError):
            for start in range(0, self.shape.size, _STEP):
                self._map.madvise(_POPULATE_WRITE, start, min(_STEP, self.shape.size - start))
        fcntl.fcntl(self.descriptor, fcntl.F_ADD_SEALS, SEALS | fcntl.F_SEAL_SEAL)
        self.inode = os.fstat(self.descriptor).st_ino
        IDENTITY.pack_into(self._map, 0, MARK, *self.shape)
        self._bytes = np.frombuffer(self._map, np.uint8)

    def put(self, pieces: Sequence[Any], sizes: Sequence[int]) -> tuple[int, int] | None:
        """Copy parts into the oldest slot that no reader has; returns its number and stamp, None if all are read.

        Args:
            pieces: Flat buffers of bytes. Several make up one part where a size spans them.
            sizes: The bytes of each part; see `plan.notices.starts`.
        """
        # Its own description: its lock goes with it, and keeps out a call that comes in between, in a `__del__`.
        with io.FileIO(f"/proc/self/fd/{self.descriptor}", "r+") as file:
            for number in self._oldest:
                if lock_for_writing(file.fileno(), number):
                    try:
                        stamp = self._write(number, pieces, sizes)
                    finally:  # a child that was forked meanwhile has the description open, too
                        _set(file.fileno(), fcntl.F_UNLCK, number)
                    self._oldest = [*(other for other in self._oldest if other != number), number]
                    return number, stamp
        return None

    def _write(self, number: int, pieces: Sequence[Any], sizes: Sequence[int]) -> int:
        STAMP.pack_into(self._map, stamp_at(number), 0)  # broken off in the middle, it belongs to no update
        base, waiting = self.shape.start(number), iter(pieces)
        for start, size in zip(starts(sizes), sizes, strict=False):
            at = base + start
            end = at + size
            while at < end:
                buffer = next(waiting)
                if not len(buffer):  # numpy refuses it
                    continue
                piece = np.frombuffer(buffer, np.uint8)  # numpy lets other threads run while it copies
                if len(piece) > end - at:
                    raise ValueError("a buffer has more bytes than its length says: the next slot begins there")
                self._bytes[at : at + len(piece)] = piece
                at += len(piece)
        stamp = secrets.randbelow((1 << 53) - 1) + 1
        STAMP.pack_into(self._map, stamp_at(number), stamp)
        return stamp
