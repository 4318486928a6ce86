"""When to look at what the server says was changed: soon, but not more often than is good for the server."""

from __future__ import annotations

import asyncio
import weakref
from collections.abc import Callable
from typing import Generic, TypeVar

__all__ = ["RefreshTimer"]

Owner = TypeVar("Owner")


class RefreshTimer(Generic[Owner]):
    """Calls for looks at one thing that changes. Belongs to an event loop.

    A published update is a change too, which its notice tells of, so most looks at what is published find nothing:
    where a notice has come with the change the look waits, after each look that found nothing twice as long.

    Args:
        owner: Whose looks they are; held weakly, since whoever follows ends by being dropped.
        look: Called with the owner when a look is due.
        quickest: Seconds that a look waits where notices come, after one that found something.
        slowest: The same, at most.
        patience: Seconds in which the notice of a change may come behind the word of it.

    Attributes:
        heard: Counts the notices; whoever hears them counts.
        earliest: When the next look may be at the earliest, on the loop's clock.
    """

    def __init__(
        self, owner: Owner, look: Callable[[Owner], None], quickest: float, slowest: float, patience: float = 0.0
    ) -> None:
        self.heard = 0
        self.earliest = 0.0
        # Not a WeakMethod, which runs some Python when its owner goes: a handler of signals that raises in it would be
        # heard of by nobody.
        self._owner, self._function = weakref.ref(owner), look
        self._quickest, self._slowest, self._patience = quickest, slowest, patience
        self._pace = quickest
        self._loop = asyncio.get_running_loop()
        self._next: asyncio.Handle | None = None

    @property
    def due(self) -> bool:
        """Whether something was changed that was not looked at."""
        return self._next is not None

    def ask(self) -> None:
        """Something was changed. What comes in the same turn of the loop, or in the patience, is heard first."""
        if self._next is None:
            if self._patience:
                self._next = self._loop.call_later(self._patience, self._look_or_wait, self.heard)
            else:
                self._next = self._loop.call_soon(self._look_or_wait, self.heard)

    def found(self) -> None:
        """The last look has found something that no notice told of."""
        self._pace = self._quickest

    def cancel(self) -> None:
        """Do not look."""
        if self._next is not None:
            self._next.cancel()
            self._next = None

    def now(self) -> None:
        """Look at once, if a look is due."""
        if self._next is not None:
            self.cancel()
            self._do()

    def _look_or_wait(self, heard: int) -> None:
        now = self._loop.time()
        due = self.earliest
        if heard != self.heard:
            due = max(due, now + self._pace)
        if due > now:
            self._next = self._loop.call_at(due, self._look)
        else:
            self._look()

    def _look(self) -> None:
        self._next = None
        self._pace = min(2 * self._pace, self._slowest)
        self._do()

    def _do(self) -> None:
        if (owner := self._owner()) is not None:
            self._function(owner)
