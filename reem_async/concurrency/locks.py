"""What threads and forks share: locks, wakeups, file descriptors, and what a child does with what it inherits."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import weakref
from collections.abc import Callable, Iterator
from typing import Any, Generic, NoReturn, TypeVar

Item = TypeVar("Item")
Lock = TypeVar("Lock", bound=Any)

# Keys whose locks are kept though they are not in use; making one costs a microsecond.
_MOST = 1000


class Locks(Generic[Lock]):
    """The locks of the last thousand keys, and of all that are held or waited for."""

    def __init__(self, new: Callable[[], Lock]) -> None:
        self._new = new
        self._recent: dict[str, Lock] = {}
        self._older: weakref.WeakValueDictionary[str, Lock] = weakref.WeakValueDictionary()
        self._trimming = threading.Lock()

    def of(self, key: str) -> Lock:
        lock = self._recent.get(key)
        return lock if lock is not None else self._put(key)

    def _put(self, key: str) -> Lock:
        # No thread waits here for another one, which Ctrl-C may end while it holds the lock.
        if len(self._recent) >= _MOST and self._trimming.acquire(blocking=False):
            try:  # first in the one, then out of the other: always to be found
                for old, lock in list(self._recent.items()):
                    self._older[old] = lock
                    self._recent.pop(old, None)
            finally:
                self._trimming.release()
        lock = self._recent.setdefault(key, self._older.get(key) or self._new())
        older = self._older.get(key)
        if older is not None and older is not lock:  # it was made and went there just between the two
            lock = self._recent[key] = older
        return lock

    def all(self) -> list[Lock]:
        older = (reference() for reference in self._older.valuerefs())
        return [*list(self._recent.values()), *(lock for lock in older if lock is not None)]


class WeakList(Generic[Item]):
    """Those of some objects that still live. Threads may share it, and Ctrl-C may come, unlike with a WeakSet."""

    def __init__(self) -> None:
        self._references: list[weakref.ref[Item]] = []

    def add(self, item: Item) -> None:
        self._references.append(weakref.ref(item, self._references.remove))

    def present(self) -> list[Item]:
        # A tuple first: another thread may drop one meanwhile.
        return [item for reference in tuple(self._references) if (item := reference()) is not None]

    def __iter__(self) -> Iterator[Item]:
        return iter(self.present())


class Inherited(WeakList[Item]):
    """The living objects of a class; a forked child calls `action` for each that it has of its parent."""

    def __init__(self, action: Callable[[Item], object]) -> None:
        super().__init__()
        os.register_at_fork(after_in_child=lambda: [action(item) for item in self])


class ThreadLock:
    """A thread lock with the face of an asynchronous one; waiting for it blocks the thread.

    A thread that has it, in a `__del__` for example, does not wait for itself. `let_go` is for after Ctrl-C.
    """

    __slots__ = ("__weakref__", "_lock")

    def __init__(self) -> None:
        self._lock = threading.RLock()

    async def __aenter__(self) -> None:
        self._lock.acquire()

    async def __aexit__(self, *_: Any) -> None:
        try:
            self._lock.release()
        except RuntimeError:  # a call in a `__del__` has let go of all
            return

    def let_go(self) -> None:
        with contextlib.suppress(RuntimeError):
            while True:
                self._lock.release()


class Descriptor:
    """A file descriptor that is closed with this object, unless its number is another file's by then.

    A program that becomes a daemon closes all descriptors, and the numbers are its own files' afterwards.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self._file = self._now()

    @property
    def inode(self) -> int:
        return self._file[1]

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
