"""What a subscriber keeps when updates come faster than they are taken."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import os
import queue
import time
from collections.abc import Callable
from typing import Any

from ..errors import QueueFull
from ..plan.arguments import check_instance, whole
from .locks import Wakeups, wakeups


class Policy:
    """How many updates wait at most, and what happens to the next one. Use one of the subclasses.

    Args:
        bound: How many updates may wait: an int of at least 1.

    Attributes:
        fails: One more ends the iterator with QueueFull; else the oldest is dropped.

    Raises:
        BadType: `bound` is not a whole number.
        BadValue: It is below 1.
    """

    fails = False

    def __init__(self, bound: int) -> None:
        self.bound = whole("bound", bound, f"use {type(self).__name__}(n), n an int of at least 1")

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


def chosen(policy: Policy | None, otherwise: Policy) -> Policy:
    """Return a policy that a user has given, or the other one for None; raise BadType for anything else."""
    if policy is None:
        return otherwise
    check_instance("policy", policy, Policy, "use Newest(), Last(n) or Every(n)")
    return policy


class Ended(Exception):
    """The queue was closed and all of it was taken."""


EMPTY: Any = object()  # what `BoundedQueue.take` returns when nothing waits


class BoundedQueue:
    """The updates that wait for one loop; one thread puts them in at a time, any number of threads take them out.

    Ctrl-C may interrupt a taking thread at any step, and must not block the putting thread. So there is no lock: each
    step that matters is one of C, which Python does not divide. Updates are numbered, so that the one that is dropped
    is named. A loss is noted before the update after it is put in, and the next one that is taken reports it.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._items: collections.OrderedDict[int, Any] = collections.OrderedDict()
        self._last = 0
        self._gaps: dict[int, int | None] = {}  # what was lost before which update
        self._sleepers: collections.deque[Wakeups] = collections.deque()  # one for each thread that waits
        # Those of threads that do not wait now, by process: a forked child must not take its parent's
        self._idle: dict[int, collections.deque[Wakeups]] = {}
        self._end: BaseException | None = None
        self.dropped = 0  # how many updates were skipped and will never be taken out
        self.wake: Callable[[], None] = noop  # called after each change, from the putting thread

    @property
    def is_empty(self) -> bool:
        return not self._items

    def put(self, update: Any) -> None:
        if self._end is not None:
            return
        if self._policy.fails and len(self._items) >= self._policy.bound:
            self._skip()
        else:
            self._last += 1
            if getattr(update, "gap", False):
                self._gaps[self._last] = update.missed
            self._items[self._last] = update
            if self._items.pop(self._last - self._policy.bound, EMPTY) is not EMPTY:
                self._skip()
                # What was lost before dropped updates is kept in one.
                gone = [number for number in self._gaps.copy() if number <= self._last - self._policy.bound]
                if len(gone) > 1:
                    self._gaps[gone[-1]] = total([self._gaps.pop(number, 0) for number in gone])
        self._tell()

    def skip(self) -> None:
        """Note that an update will never come: a newer one has taken its place."""
        self._skip()
        self._tell()

    def overtaken(self, update: Any) -> None:
        """Note that later updates changed what one wrote before it was read; None if one of its path is delivered."""
        self.skip()

    def _skip(self) -> None:
        """Count a skipped update, and fail if the policy says so."""
        self.dropped += 1
        if self._policy.fails and self._end is None:
            self._end = QueueFull(
                f"an update was skipped, {self._policy!r} allows none; take them faster, use a larger bound, or "
                "Last(n), which drops the oldest (of large values, only the newest is ever fetched)"
            )

    def _tell(self) -> None:
        """Wake all waiting threads; one that finds nothing waits again."""
        # Not those that wait again meanwhile: such a thread would be woken as often as it is quicker than this one.
        for _ in range(len(self._sleepers)):
            with contextlib.suppress(IndexError):  # it has found something meanwhile
                self._sleepers.popleft().put(None)
        self.wake()

    def take(self) -> Any:
        """Return the oldest update that waits, or EMPTY; raises Ended after the last, or what else ended it."""
        end = self._end  # looked at first: what was put in before it is there
        try:
            number, update = self._items.popitem(last=False)
        except KeyError:
            if end is not None:
                raise end from None
            return EMPTY
        return self._with_gaps(number, update) if self._gaps else update

    def _with_gaps(self, number: int, update: Any) -> Any:
        """Return an update with all that was lost before it and not told yet."""
        told = [self._gaps.pop(each, EMPTY) for each in self._gaps.copy() if each <= number]
        told = [missed for missed in told if missed is not EMPTY]  # another thread tells those
        return dataclasses.replace(update, gap=True, missed=total(told)) if told else update

    def take_within(self, seconds: float) -> Any:
        """As `take_waiting`, for so many seconds at most; then return EMPTY."""
        end = time.monotonic() + seconds
        while (item := self.take()) is EMPTY and (left := end - time.monotonic()) > 0:
            wakeup: queue.SimpleQueue[None] = queue.SimpleQueue()
            self._sleepers.append(wakeup)
            if not self._items and self._end is None:
                with contextlib.suppress(queue.Empty):
                    wakeup.get(timeout=left)
            with contextlib.suppress(ValueError):  # it was woken
                self._sleepers.remove(wakeup)
        return item

    def take_waiting(self) -> Any:
        """As `take`, but block this thread until there is something. Any number of threads may."""
        if (item := self.take()) is not EMPTY:
            return item
        idle = self._idle.setdefault(os.getpid(), collections.deque())
        try:
            wakeup = idle.pop()
        except IndexError:
            wakeup = wakeups()
        try:
            while (item := self.take()) is EMPTY:
                if wakeup not in self._sleepers:  # else it was one that the thread had left over
                    self._sleepers.append(wakeup)
                if not self._items and self._end is None:  # else it was put in before this thread was seen to sleep
                    wakeup.get()
        finally:
            idle.append(wakeup)
        return item

    def close(self, end: Exception | None = None) -> None:
        """End the queue after what waits: the loop over it ends, or gets an error if one is given."""
        if self._end is None:
            self._end = end or Ended()
        self._tell()


class PlaceQueue(BoundedQueue):
    """A bounded queue that delivers which places were updated and their present value, not what was written."""

    def overtaken(self, update: Any) -> None:
        if update is None:
            self.skip()
        else:
            self.put(update)


def noop() -> None:
    """Do nothing."""


def total(missed: list[int | None]) -> int | None:
    return None if None in missed else sum(number for number in missed if number is not None)
