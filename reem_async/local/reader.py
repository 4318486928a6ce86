"""Views of what publishers of the same host have put into their shared memory.

Each view locks its slot through an open file description of its own, which is closed with the last array that looks
into the slot: by any thread, the garbage collector or the kernel, and no Ctrl-C can come in between.
"""

from __future__ import annotations

import collections
import fcntl
import io
import mmap
import os
import stat
import time
import weakref
from typing import Any, NamedTuple

import numpy as np

from ..concurrency.wakeup import Descriptor
from ..plan.notices import Slot
from .segment import IDENTITY, MARK, NAME, SEALS, STAMP, Shape, lock_for_reading, stamp_at

_MAPPINGS = 64  # segments that are kept mapped: so many cameras that publish through one host

# Slots of a segment that may be looked into at a time: what a slow callback works on, the newest, and the one that
# takes its place. A program that keeps more gets copies.
_PINS = 3

_IDLE = 10.0  # seconds after which a segment is unmapped that nothing was looked for in

_MOST_SLOTS = 64
_LARGEST = 1 << 34  # bytes of a segment: no publisher makes one of 16 GB
_BLOCK = 512  # bytes of what `st_blocks` counts, whatever the file system's blocks are


class _Root(np.ndarray[Any, Any]):
    """What all arrays that look into a slot refer to."""

    lock: mmap.mmap  # has the description open by which the slot is locked


class _Pin(NamedTuple):
    """A slot that is being looked into."""

    root: weakref.ref[_Root]
    number: int
    stamp: int  # what it held then


class _Mapping:
    """A publisher's segment, mapped to be read."""

    def __init__(self, slot: Slot) -> None:
        self.pins: list[_Pin] = []
        self.used = 0.0
        self._descriptor = _opened(slot)
        self._owner = Descriptor(self._descriptor)
        self._shape = _checked(self._descriptor, slot)
        self._map = mmap.mmap(self._descriptor, self._shape.size, prot=mmap.PROT_READ)

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
        with io.FileIO(f"/proc/self/fd/{self._descriptor}") as file:
            # A mapping has it open, too, and gives it back without any code of ours. It is not looked into.
            lock = mmap.mmap(file.fileno(), mmap.PAGESIZE, prot=mmap.PROT_READ)
            return lock if lock_for_reading(file.fileno(), number) else None


def _opened(slot: Slot) -> int:
    """Open the memory of another process, if it is what is meant; nothing is opened that could block or act."""
    name = f"/proc/{slot.process}/fd/{slot.descriptor}"
    if os.readlink(name) != f"/memfd:{NAME} (deleted)":  # a file's server may hang when it is asked anything
        raise ValueError("it is another file")
    path = os.open(name, os.O_PATH | os.O_CLOEXEC)
    try:
        found = os.fstat(path)
        if not stat.S_ISREG(found.st_mode) or found.st_ino != slot.inode or found.st_uid != os.geteuid():
            raise ValueError("it is another file")
        return os.open(f"/proc/self/fd/{path}", os.O_RDONLY | os.O_CLOEXEC)
    finally:
        os.close(path)


def _checked(descriptor: int, slot: Slot) -> Shape:
    """Return how a segment is divided; raises ValueError or OSError if it is none, or if it could still be altered."""
    if fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & SEALS != SEALS:
        raise ValueError("it is not sealed")
    mark, slots, room = IDENTITY.unpack(os.pread(descriptor, IDENTITY.size, 0).ljust(IDENTITY.size))
    shape = Shape(slots, room)
    found = os.fstat(descriptor)
    if mark != MARK or not 0 < slots <= _MOST_SLOTS or found.st_size != shape.size or shape.size > _LARGEST:
        raise ValueError("it is no segment")
    if found.st_ino != slot.inode:
        raise ValueError("it is another file")
    # Publishers take all memory of a segment at once. Of one that has none yet a few bytes may say that a text has
    # gigabytes, and to copy it would take these from us. The seals keep it from being given back later.
    if found.st_blocks * _BLOCK < found.st_size:
        raise ValueError("its memory is not there")
    return shape


class LocalReader:
    """The segments that a subscriber looks into, mapped when first needed."""

    def __init__(self) -> None:
        self._mappings: collections.OrderedDict[tuple[int, int, int], _Mapping] = collections.OrderedDict()

    def view(self, slot: Slot, size: int) -> memoryview | None:
        """Return the first `size` bytes of a slot, read-only; None if they are not to be had (any more).

        The slot is not written while anything refers to the view, which may be a copy.
        """
        place = slot.process, slot.descriptor, slot.inode
        try:
            mapping = self._mappings.get(place)
            if mapping is None:
                mapping = self._mappings[place] = _Mapping(slot)
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
