"""What a subscriber keeps when updates come faster than they are taken."""

from __future__ import annotations

import collections
import dataclasses
import threading
from collections.abc import Callable
from typing import Any

from .errors import BadValue, QueueFull
from .tickets import Tickets, tickets

__all__ = ["EMPTY", "Ended", "Every", "Last", "Mailbox", "Newest", "Policy"]


class Policy:
    """How many updates wait at most, and what happens to the next one. Use one of the subclasses.

    Args:
        bound: How many updates may wait.

    Attributes:
        fails: One more ends the iterator with QueueFull; else the oldest is dropped.
    """

    fails = False

    def __init__(self, bound: int) -> None:
        if bound < 1:
            raise BadValue(f"{type(self).__name__}({bound}) keeps nothing; use at least 1")
        self.bound = bound

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.bound})"


class Newest(Policy):
    """Keep only the newest update: a slow loop skips what is out of date."""

    def __init__(self) -> None:
        super().__init__(1)

    def __repr__(self) -> str:
        return "Newest()"


class Last(Policy):
    """Keep the last `bound` updates and drop older ones."""


class Every(Policy):
    """Keep every update, up to `bound`; one more raises QueueFull in the loop that should take them."""

    fails = True


class Ended(Exception):
    """The queue was closed and all of it was taken."""


EMPTY: Any = object()
"""What `Mailbox.take` returns when nothing waits."""


class Mailbox:
    """The queue between the event loop, which puts updates in, and whoever takes them out.

    Attributes:
        dropped: How many updates were skipped and will never be taken out.
        wake: Called after each change, from the putting thread.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._items: collections.deque[Any] = collections.deque()
        self._lock = threading.Lock()
        # A threading.Condition does the same in Python, at several times the cost.
        self._sleeping = 0  # threads that wait for a ticket, and
        self._tickets: Tickets | None = None
        self._end: BaseException | None = None
        self.dropped = 0
        self.wake: Callable[[], None] = lambda: None

    def put(self, update: Any) -> None:
        """Add an update, dropping or failing as the policy says."""
        with self._lock:
            if self._end is not None:
                return
            if len(self._items) >= self._policy.bound and self._skip():
                update = self._without_oldest(update)
            if self._end is None:
                self._items.append(update)
        self._tell()

    def _without_oldest(self, update: Any) -> Any:
        """Drop the oldest; return `update`. A gap before what is dropped is one before what comes next."""
        gone = self._items.popleft()
        if not getattr(gone, "gap", False):
            return update
        if not self._items:
            return _after_gap(update, gone)
        self._items[0] = _after_gap(self._items[0], gone)
        return update

    def skip(self) -> None:
        """Note that an update will never come: a newer one of the same path has taken its place."""
        with self._lock:
            self._skip()
        self._tell()

    def _tell(self) -> None:
        """Wake all who wait; who then has nothing to take waits again."""
        if self._sleeping and self._tickets is not None:
            with self._lock:
                sleeping, self._sleeping = self._sleeping, 0
            for _ in range(sleeping):
                self._tickets.put(None)
        self.wake()

    def _skip(self) -> bool:
        """Count a skipped update; return whether the policy allows it."""
        self.dropped += 1
        if self._policy.fails and self._end is None:
            self._end = QueueFull(
                f"an update was skipped, {self._policy!r} allows none; take them faster, use a larger bound, or "
                "Last(n), which drops the oldest (of large values, only the newest is ever fetched)"
            )
        return not self._policy.fails

    def take(self) -> Any:
        """Return the oldest update that waits, or EMPTY; raises Ended after the last, or QueueFull."""
        with self._lock:
            return self._take()

    def _take(self) -> Any:
        if self._items:
            return self._items.popleft()
        if self._end is not None:
            raise self._end
        return EMPTY

    def take_waiting(self) -> Any:
        """As `take`, but block this thread until there is something. Any number of threads may."""
        while True:
            with self._lock:
                if (item := self._take()) is not EMPTY:
                    return item
                waiting = self._tickets = self._tickets or tickets()
                self._sleeping += 1
            waiting.get()  # left by Ctrl-C, its ticket wakes somebody in vain

    def close(self) -> None:
        """End the queue after what waits."""
        with self._lock:
            if self._end is None:
                self._end = Ended()
        self._tell()


def _after_gap(update: Any, gone: Any) -> Any:
    """Return `update` with what was lost before one that is dropped."""
    missed = None if gone.missed is None or update.missed is None else gone.missed + update.missed
    return dataclasses.replace(update, gap=True, missed=missed)
