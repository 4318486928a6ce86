"""The memory of a publisher: one file without a name for each top-level key, in slots that each hold one update.

The file is sealed: only the process that made it can change or shorten it, so a reader that has checked the seals
can neither be surprised by other bytes than the publisher's nor be killed by a page that is gone. It lives as long as
a process has it open.

    0        identity        readers compare it
    64       a stamp for each slot: 0 while it is written
    4096     slot 0, slot 1, ... each of the same size

Each view of a reader locks its slot through an open file description of its own, which is closed with the last array
that looks into the slot: by any thread, the garbage collector or the kernel, and no Ctrl-C can come in between.
"""

from __future__ import annotations

import collections
import contextlib
import errno
import fcntl
import hashlib
import io
import mmap
import os
import secrets
import stat
import struct
import sys
import time
import weakref
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..concurrency.locks import Descriptor
from ..plan.notices import Slot, starts

SLOTS = 6  # one that is written, three for a subscriber (see `_PINS`), two for others that are not as far
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
    return _set(descriptor, fcntl.F_RDLCK, number)


def lock_for_writing(descriptor: int, number: int) -> bool:
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
        self.memory = Descriptor(self.descriptor)
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
        self.inode = self.memory.inode
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


_MAPPINGS = 64  # segments that are kept mapped: so many cameras that publish through one host

# Slots of a segment that may be looked into at a time: what a slow callback works on, the newest, and the one that
# takes its place. A program that keeps more gets copies.
_PINS = 3

_IDLE = 10.0  # seconds after which a segment is unmapped that nothing was looked for in

_MOST_SLOTS = 64
_LARGEST = 1 << 34  # bytes of a segment: no publisher makes one of 16 GB
_BLOCK = 512  # bytes of what `st_blocks` counts, whatever the file system's blocks are


class _Root(np.ndarray[Any, Any]):
    lock: mmap.mmap  # has the description open by which the slot is locked


class _Pin(NamedTuple):
    root: weakref.ref[_Root]
    number: int
    stamp: int  # what it held then


class _Mapping:
    def __init__(self, memory: Descriptor) -> None:
        self.pins: list[_Pin] = []
        self.used = 0.0
        self._memory = memory
        self._shape = _checked(memory.number)
        self._map = mmap.mmap(memory.number, self._shape.size, prot=mmap.PROT_READ)

    def view(self, slot: Slot, size: int) -> memoryview | None:
        """Return a view of the first `size` bytes of a slot; None if it does not hold any more what is meant."""
        if slot.number >= self._shape.slots or not 0 < size <= self._shape.room:
            return None
        self.pins = [pin for pin in self.pins if pin.root() is not None]
        for pin in self.pins:
            root = pin.root()
            if root is not None and (pin.number, pin.stamp) == (slot.number, slot.stamp) and len(root) >= size:
                return root.data[:size]
        lock = self._locked(slot.number)
        if lock is None or STAMP.unpack_from(self._map, stamp_at(slot.number)) != (slot.stamp,):
            return None
        content = np.frombuffer(self._map, np.uint8, size, self._shape.start(slot.number))
        if len(self.pins) >= _PINS:
            content = content.copy()
            content.flags.writeable = False
            return content.data
        root = content.view(_Root)
        root.lock = lock
        self.pins.append(_Pin(weakref.ref(root), slot.number, slot.stamp))
        return root.data

    def _locked(self, number: int) -> mmap.mmap | None:
        """Return what has a slot locked for reading as long as it lives; None if the slot is being written."""
        # Its own description, so that its lock goes with it and with nothing else.
        with io.FileIO(f"/proc/self/fd/{self._memory.number}") as file:
            # A mapping has it open, too, and gives it back without any code of ours. It is not looked into.
            lock = mmap.mmap(file.fileno(), mmap.PAGESIZE, prot=mmap.PROT_READ)
            return lock if lock_for_reading(file.fileno(), number) else None


def _opened(slot: Slot) -> Descriptor:
    """Open the memory of another process, if it is what is meant; nothing is opened that could block or act."""
    name = f"/proc/{slot.process}/fd/{slot.descriptor}"
    if os.readlink(name) != f"/memfd:{NAME} (deleted)":  # a file's server may hang when it is asked anything
        raise ValueError("it is another file")
    path = os.open(name, os.O_PATH | os.O_CLOEXEC)
    try:
        found = os.fstat(path)
        if not stat.S_ISREG(found.st_mode) or found.st_ino != slot.inode:
            raise ValueError("it is another file")
        return Descriptor(os.open(f"/proc/self/fd/{path}", os.O_RDONLY | os.O_CLOEXEC))
    finally:
        os.close(path)


def _checked(descriptor: int) -> Shape:
    """Return how a segment is divided; raises ValueError or OSError if it is none, or if it could still be altered."""
    if fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & SEALS != SEALS:
        raise ValueError("it is not sealed")
    mark, slots, room = IDENTITY.unpack(os.pread(descriptor, IDENTITY.size, 0).ljust(IDENTITY.size))
    shape = Shape(slots, room)
    found = os.fstat(descriptor)
    if mark != MARK or not 0 < slots <= _MOST_SLOTS or found.st_size != shape.size or shape.size > _LARGEST:
        raise ValueError("it is no segment")
    if found.st_uid != os.geteuid():
        raise ValueError("it is another user's")
    # Publishers take all memory of a segment at once. Of one that has none yet a few bytes may say that a text has
    # gigabytes, and to copy it would take these from us. The seals keep it from being given back later.
    if found.st_blocks * _BLOCK < found.st_size:
        raise ValueError("its memory is not there")
    return shape


class LocalReader:
    """The segments that a subscriber looks into, mapped when first needed."""

    def __init__(self) -> None:
        self._mappings: collections.OrderedDict[tuple[int, int, int, str], _Mapping] = collections.OrderedDict()

    def view(
        self, slot: Slot, size: int, passed: Descriptor | None = None, *, is_near: bool = True
    ) -> memoryview | None:
        """Return the first `size` bytes of a slot, read-only; None if they are not to be had (any more).

        The slot is not written while anything refers to the view, which may be a copy. `passed` is the descriptor that
        has arrived with the notice. Without it the publisher's is opened through `/proc`, if that `is_near`.
        """
        place = slot.process, slot.descriptor, slot.inode, slot.host
        try:
            mapping = self._mappings.get(place)
            if mapping is None:
                if passed is None or passed.inode != slot.inode:
                    if not is_near:
                        return None
                    passed = _opened(slot)
                mapping = self._mappings[place] = _Mapping(passed)
                while len(self._mappings) > _MAPPINGS:
                    self._mappings.popitem(last=False)
            self._mappings.move_to_end(place)
            mapping.used = time.monotonic()
            return mapping.view(slot, size)
        except (OSError, ValueError, OverflowError, MemoryError):
            self._mappings.pop(place, None)
            return None

    def let_go(self) -> None:
        """Unmap the segments that nothing was looked for in of late: their publishers may be gone."""
        before = time.monotonic() - _IDLE
        for place, mapping in list(self._mappings.items()):
            # Else its views would not be counted any more.
            if mapping.used < before and all(pin.root() is None for pin in mapping.pins):
                self._mappings.pop(place, None)

    def close(self) -> None:
        self._mappings.clear()


_BOOT = "/proc/sys/kernel/random/boot_id"
_PROCESSES = "/proc/self/ns/pid"
_PASSING = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC)  # a later call tries again


def host() -> str:
    """Return what names the processes that can share memory with this one; empty if none can."""
    try:
        return "" if reason_against() else _named(os.geteuid())
    except OSError:  # a program that has given up rights, or /proc, since
        return ""


@lru_cache(maxsize=4)
def _named(user: int) -> str:
    """Return the name for one user: a container whose processes have numbers of their own is a host by itself."""
    with open(_BOOT, encoding="ascii") as file:
        words = file.read().strip(), os.readlink(_PROCESSES), str(user)
    return hashlib.sha256("\0".join(words).encode()).hexdigest()[:16]


def reason_against() -> str:
    """Return why memory cannot be shared here, empty if it can; tried once, with a segment of a page."""
    try:
        return _found_against()
    except OSError as error:
        return f"no shared memory is to be had now: {error}"


@lru_cache(maxsize=1)
def _found_against() -> str:
    if sys.maxsize < 1 << 32:
        return "this Python has 32 bits"
    if not hasattr(os, "memfd_create") or not hasattr(fcntl, "F_OFD_SETLK"):
        return "only Linux has what it takes (memfd_create and locks of open files)"
    try:
        _named(os.geteuid())
        segment = Segment(1)
    except OSError as error:
        if error.errno in _PASSING:
            raise
        return f"no shared memory is to be had here: {error}"
    try:
        number, stamp = segment.put([b"\x01"], [1]) or (-1, 0)
        slot = Slot("", os.getpid(), segment.descriptor, segment.inode, number, stamp)
        view = LocalReader().view(slot, 1)
        return "" if view is not None and bytes(view) == b"\x01" else "memory of another process cannot be opened here"
    except OSError as error:
        if error.errno in _PASSING:
            raise
        return f"memory cannot be shared here: {error}"
