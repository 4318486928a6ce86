"""When to read: what the server says was changed soon, and every second which keys there are.

Neither more often than is good for the server. Nothing announces a key that is only stored, so the server is asked.
"""

from __future__ import annotations

import asyncio
import logging
import time
import weakref
from collections.abc import Awaitable, Callable, Iterable
from typing import Generic, NamedTuple, TypeVar

from ..errors import Misuse, RedisError, ReemError
from ..plan.paths import Pattern
from ..session import Session

logger = logging.getLogger("reem.subscribe")

Owner = TypeVar("Owner")

_PERIOD = 1.0  # seconds between searches
_PAUSE = 10  # times as long as the last search took, at least, until the next one: a million keys are a thousand pages


class Pace(NamedTuple):
    """How soon a change is read that no notice explains; in seconds."""

    quickest: float  # until it is read where notices come too, after a read that found something
    slowest: float  # the same, at most: each read that finds nothing doubles the time
    notice_delay: float = 0.0  # in which the notice of a change may come behind the report of it


LIVE = Pace(0.001, 0.02)  # of subscribers. A key that is stored at any rate is read 1,000 times a second at most.
BACKGROUND = Pace(0.02, 0.5, 0.015)
"""Of recordings and the page. Their notices wait for each other up to 10 ms, which is less than the notice delay."""
BACKGROUND_RATE = 8 << 20  # bytes a second that recordings read of each key for what is stored, the page of all keys


class RefreshTimer(Generic[Owner]):
    """Calls for looks at one thing that changes. Belongs to an event loop.

    Most looks at what is published find nothing: its notice explains the change. So where a notice has come with the
    change the look waits, after each look that found nothing twice as long.
    """

    def __init__(self, owner: Owner, look: Callable[[Owner], None], pace: Pace) -> None:
        self.heard = 0  # counts the notices; the owner adds them
        self.earliest = 0.0  # when the next look may be, on the loop's clock
        # Not a WeakMethod, which runs some Python when its owner goes: the exception of a signal handler in it would be
        # lost.
        self._owner, self._function = weakref.ref(owner), look
        self._pace = pace
        self._wait = pace.quickest
        self._loop = asyncio.get_running_loop()
        self._next: asyncio.Handle | None = None

    @property
    def due(self) -> bool:
        return self._next is not None

    def ask(self) -> None:
        """A change was reported. Notices in the same turn of the loop, or in the notice delay, explain it."""
        if self._next is None:
            if self._pace.notice_delay:
                self._next = self._loop.call_later(self._pace.notice_delay, self._look_or_wait, self.heard)
            else:
                self._next = self._loop.call_soon(self._look_or_wait, self.heard)

    def found(self) -> None:
        self._wait = self._pace.quickest

    def cancel(self) -> None:
        if self._next is not None:
            self._next.cancel()
            self._next = None

    def now(self) -> None:
        if self._next is not None:
            self.cancel()
            self._do()

    def _look_or_wait(self, heard: int) -> None:
        now = self._loop.time()
        due = self.earliest
        if heard != self.heard:
            due = max(due, now + self._wait)
        if due > now:
            self._next = self._loop.call_at(due, self._look)
        else:
            self._look()

    def _look(self) -> None:
        self._next = None
        self._wait = min(2 * self._wait, self._pace.slowest)
        self._do()

    def _do(self) -> None:
        if (owner := self._owner()) is not None:
            self._function(owner)


async def present_keys(session: Session, tops: Iterable[str]) -> set[str]:
    """Return the top-level keys that some globs name; a round trip for about 1000 keys and each glob."""
    return {name for top in dict.fromkeys(tops) async for name in session.names(Pattern(top))}


async def find_regularly(find: Callable[[], Awaitable[bool]]) -> None:
    """Call `find` every second from the next one on, less often where it takes long, until it returns False.

    After a call that fails the next one is a second later. `Misuse` ends this, such as a closed interface.
    """
    while True:
        await asyncio.sleep(_PERIOD)
        began = time.monotonic()
        try:
            if not await find():
                return
        except Misuse:
            raise
        except (ReemError, RedisError, OSError) as error:
            logger.debug("keys could not be listed: %s", error)
            continue
        await asyncio.sleep(max(_PAUSE * (time.monotonic() - began) - _PERIOD, 0.0))
