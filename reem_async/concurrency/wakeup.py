"""What a thread waits for, so that another one can wake it."""

from __future__ import annotations

import os
import queue
from typing import NoReturn


class Descriptor:
    """A file descriptor that is closed with this object, unless its number is another file's by then.

    A program that becomes a daemon closes all descriptors, and the numbers are its own files' afterwards.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self._file = self._now()

    def _now(self) -> tuple[int, int]:
        found = os.fstat(self.number)
        return found.st_dev, found.st_ino

    @property
    def is_own(self) -> bool:
        try:
            return self._now() == self._file
        except OSError:
            return False

    def __reduce__(self) -> NoReturn:
        raise TypeError("what owns a file descriptor cannot be copied or pickled; make another watch or mirror")

    def __del__(self) -> None:
        if self.is_own:
            os.close(self.number)


class Pipe:
    """Wakeups that are bytes in a pipe.

    A thread lets go of the interpreter to write to a descriptor, so the one that it wakes may run at once. A lock it
    would release with the interpreter in its hands. (fstat does not tell an eventfd from another one, or an epoll.)
    """

    def __init__(self) -> None:
        self._read, self._write = map(Descriptor, os.pipe())

    def put(self, wakeup: None) -> None:
        if self._write.is_own:
            os.write(self._write.number, b"\0")

    def get(self) -> None:
        os.read(self._read.number, 1)


Wakeups = Pipe | queue.SimpleQueue[None]  # each wakeup that is put wakes one thread that gets one


def wakeups() -> Wakeups:
    try:
        return Pipe()
    except OSError:  # no descriptor is left
        return queue.SimpleQueue()
