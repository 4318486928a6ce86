"""What a thread waits for, so that another one can wake it."""

from __future__ import annotations

import os
import queue
import sys
from typing import Protocol

__all__ = ["Wakeups", "wakeups"]


class Wakeups(Protocol):
    """Each wakeup that is put wakes one thread that gets one."""

    def put(self, wakeup: None) -> None:
        """Add a wakeup."""

    def get(self) -> None:
        """Take a wakeup; block this thread until there is one."""


def wakeups() -> Wakeups:
    """Return the wakeups that wake fastest here."""
    try:
        return _Descriptor()
    except (AttributeError, OSError):  # not Linux; or no descriptor is left
        return queue.SimpleQueue()


class _Descriptor:
    """Wakeups that the kernel counts, in one file descriptor.

    The thread that is woken may get the processor at once, while the other one is still waking it. That one lets go
    of the interpreter to write to a descriptor; a lock it would release with the interpreter in its hands, for which
    the woken thread would have to wait again.
    """

    def __init__(self) -> None:
        self._descriptor = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_SEMAPHORE)

    def put(self, wakeup: None) -> None:
        os.write(self._descriptor, (1).to_bytes(8, sys.byteorder))

    def get(self) -> None:
        os.read(self._descriptor, 8)

    def __del__(self) -> None:
        if hasattr(self, "_descriptor"):
            os.close(self._descriptor)
