"""Which processes can share memory with this one: of the same user and host, and seeing the same processes."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import sys
from functools import lru_cache

from ..plan.notices import Slot
from .reader import LocalReader
from .segment import Segment

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
