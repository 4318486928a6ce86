"""Locks on bytes of a file that belong to an open file description, not to a process.

The kernel gives them back when the description is closed for the last time, so also when its process is killed. Each
byte stands for one slot; no process ever waits for one.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import struct

# struct flock of <fcntl.h> where off_t has 64 bits: l_type, l_whence, l_start, l_len, l_pid (0 for these locks), and
# the padding at its end.
_FLOCK = struct.Struct("@hhqqi4x")
_TAKEN = (errno.EAGAIN, errno.EACCES)


def lock_for_reading(descriptor: int, number: int) -> bool:
    """Lock a slot beside other readers; returns False if it is being written."""
    return _set(descriptor, fcntl.F_RDLCK, number)


def lock_for_writing(descriptor: int, number: int) -> bool:
    """Lock a slot for oneself; returns False if it is being read."""
    return _set(descriptor, fcntl.F_WRLCK, number)


def unlock(descriptor: int, number: int) -> None:
    """Give the lock of this description back."""
    with contextlib.suppress(OSError):
        _set(descriptor, fcntl.F_UNLCK, number)


def _set(descriptor: int, kind: int, number: int) -> bool:
    try:
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, _FLOCK.pack(kind, 0, number, 1, 0))
    except OSError as error:
        if error.errno in _TAKEN:
            return False
        raise
    return True
