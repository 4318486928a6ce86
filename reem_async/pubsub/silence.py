"""Silence: for how long no update may arrive until what was received last counts for nothing.

The clock is this program's `time.monotonic`, from when the notice of an update arrives. Only published updates count,
equal values too; while the key has an owner, its updates alone: see `plan.leases.FenceFilter`.
"""

from __future__ import annotations

import asyncio
import math
import threading
import time
import weakref
from typing import Any

from ..concurrency.queues import EMPTY, BoundedQueue, PlaceQueue, Policy, total
from ..concurrency.timeouts import LONGEST
from ..errors import BadValue
from ..plan.arguments import check_number
from ..plan.paths import Path, counts_from_end, show
from .events import Origin, Update

_CURE = "use seconds above 0, such as 0.2, up to a million, or None for no limit"

# Seconds from the end of the time to the report: a busy uvloop calls timers before it reads what has arrived.
_LOOK = 0.001


def checked_ttl(ttl: float, path: Path) -> float:
    """Return `ttl` as a float, for a path with the top-level key first; raises BadType or BadValue."""
    check_number("ttl", ttl, _CURE, above=0, most=LONGEST)
    if counts_from_end(path):
        raise BadValue(
            f"ttl={ttl:g} at {show(path)}: an index from the end names another item after each change; follow the list"
        )
    return float(ttl)


class LiveQueue(BoundedQueue):
    """Delivers published updates while they are not older than `ttl`, and one update when silence begins.

    An update's age is for how long it was late at its publisher, and what has passed since its notice arrived. Updates
    that are found or only stored are not delivered. Losses that they report are reported by the next one.
    """

    def __init__(self, policy: Policy, ttl: float, path: Path) -> None:
        if policy.fails:
            raise BadValue(
                f"policy={policy!r} keeps every update, and ttl={ttl:g} drops those that wait too long; "
                "use Newest() or Last(n), or no ttl"
            )
        super().__init__(policy)
        self.ttl = ttl
        self._silent = Update(show(path), None, None, origin=Origin.SILENCE, silent=True)
        self._live_since = -math.inf  # from when on the newest live update counts; or when the clock was started
        self._loop: asyncio.AbstractEventLoop | None = None  # where the clock runs
        self._timer: asyncio.TimerHandle | None = None  # None while there is silence

    def start_clock(self) -> None:
        """Report silence from now on, in this event loop. Idempotent."""
        loop = asyncio.get_running_loop()
        if self._loop is not loop:
            self._live_since = max(self._live_since, time.monotonic())
            self._wait(self.ttl)

    def put(self, update: Update) -> None:
        if update.arrived is not None and self._is_fresh(update):
            self._heard(update)
            super().put(update)
        elif update.gap:
            self._owe(0, update.missed)

    def overtaken(self, update: Update | None) -> None:
        if update is not None and self._is_fresh(update):
            self._heard(update)
        super().overtaken(update)

    def take(self) -> Any:
        while (update := super().take()) is not EMPTY and not (update.silent or self._is_fresh(update)):
            self.dropped += 1
            if update.gap:
                self._owe(-threading.get_ident(), update.missed)  # each thread its own: see `BoundedQueue`
        return update

    def _is_fresh(self, update: Update) -> bool:
        return time.monotonic() - _counts_from(update) <= self.ttl

    def _owe(self, number: int, missed: int | None) -> None:
        """Have the next update that is taken report a loss; `number` is below those of all updates."""
        self._gaps[number] = total([self._gaps.pop(number, 0), missed])

    def _heard(self, update: Update) -> None:
        self._live_since = max(self._live_since, _counts_from(update))
        if self._timer is None or self._loop is not asyncio.get_running_loop():
            self._wait(self._left())

    def _left(self) -> float:
        return self._live_since + self.ttl - time.monotonic()

    def _wait(self, seconds: float, *, looked: bool = False) -> None:
        self._loop = asyncio.get_running_loop()
        # A reference back would keep a watch that was dropped.
        self._timer = self._loop.call_later(seconds, _check, weakref.ref(self), looked)

    def _check(self, looked: bool) -> None:
        left = self._left()
        if self._end is not None:
            self._timer = None
        elif left > 0:  # a timer of its own for each update would cost more
            self._wait(max(left, _LOOK))
        elif not looked:
            self._wait(_LOOK, looked=True)
        else:
            self._timer = None
            super().put(self._silent)


class LivePlaceQueue(LiveQueue, PlaceQueue):
    """As `LiveQueue`, for a caller that needs the present value of places and not what was written."""

    def overtaken(self, update: Update | None) -> None:
        PlaceQueue.overtaken(self, update)


def _counts_from(update: Update) -> float:
    return (update.arrived or 0.0) - update.late


def _check(reference: weakref.ref[LiveQueue], looked: bool) -> None:
    if (queue := reference()) is not None:
        queue._check(looked)
