"""Joined streams: for each update of one path, those of other paths that arrived nearest in time.

`Joiner` matches, without I/O: an update of the first path waits until each other path has a later one, or until no
nearer one can arrive. `Join` has a follower for each path, which hand their updates over on the event loop.
"""

from __future__ import annotations

import asyncio
import collections
import time
import weakref
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

from ..concurrency.queues import BoundedQueue, Last, Policy, chosen
from ..concurrency.streams import Stream
from ..errors import BadValue
from ..plan.arguments import check_number
from ..plan.keys import Keys
from ..plan.paths import Path, show
from ..session import Session
from .events import Origin, Update
from .follower import Follower
from .subscribers import Link

# Updates of each path that wait for those of the others; of more, the oldest are dropped.
_MOST_WAITING = 1000
# Seconds for which an update of the first path may be fetched: those of the others that arrived with it are kept.
_FETCHING = 0.5
# Joined updates that wait for a loop that is slower, if no policy is given: each may have a picture.
_MOST_JOINED = 10

Joined = tuple[float, tuple[Any, ...]]


class JoinSkips(NamedTuple):
    """Why updates of the first path are in no joined update, for one path.

    Attributes:
        unmatched: No update of this path had arrived within `slop`.
        lost: Updates of this path that were lost on the way, or replaced before they could be fetched.
        crowded: Updates of this path that were dropped, since over 1000 waited for other paths.
    """

    unmatched: int = 0
    lost: int = 0
    crowded: int = 0


class _Arrival(NamedTuple):
    time: float  # on the monotonic clock of this host
    value: Any


class Joiner:
    """Matches the updates of a first path with the nearest of the others."""

    def __init__(self, count: int, slop: float) -> None:
        self._slop = slop
        self._waiting: list[collections.deque[_Arrival]] = [collections.deque() for _ in range(count)]
        self.unmatched = [0] * count
        self.crowded = [0] * count

    def add(self, place: int, arrival: _Arrival) -> None:
        """Take an update of the path with a number; those of a path come in the order of their arrival."""
        waiting = self._waiting[place]
        waiting.append(arrival)
        first = self._waiting[0]
        oldest = (first[0].time if first else arrival.time - _FETCHING) - self._slop
        for others in self._waiting[1:]:
            while others and others[0].time < oldest:
                others.popleft()
        if len(waiting) > _MOST_WAITING:
            waiting.popleft()
            self.crowded[place] += 1

    def take(self, now: float) -> Iterator[Joined]:
        """Yield what can be joined by now."""
        first, *others = self._waiting
        while first and self.due() <= now:
            time, value = first.popleft()
            found = [self._nearest(waiting, time) for waiting in others]
            for place, each in enumerate(found, 1):
                self.unmatched[place] += each is None
            if None not in found:
                yield time, (value, *(each.value for each in found if each is not None))

    def due(self) -> float:
        """Return when the oldest update of the first path can be joined; infinite if there is none."""
        first, *others = self._waiting
        if not first:
            return float("inf")
        # A later update than this one is the last that can be the nearest, and so is one that is as near before it.
        return max(self._settled(waiting, first[0].time) for waiting in others)

    def _settled(self, waiting: Sequence[_Arrival], time: float) -> float:
        if waiting and waiting[-1].time >= time:
            return time
        nearest = self._nearest(waiting, time)
        return time + (self._slop if nearest is None else time - nearest.time)

    def _nearest(self, waiting: Sequence[_Arrival], time: float) -> _Arrival | None:
        best = min(waiting, key=lambda each: abs(each.time - time), default=None)
        return best if best is not None and abs(best.time - time) <= self._slop else None


class Join(Stream[Joined]):
    """Yields the time of each update of a first path, and the nearest values of all: an async iterator.

    `join` of a store makes one, and explains the arguments. Follows from the first `async for` or `async with` on.
    """

    def __init__(
        self, session: Session, places: Sequence[tuple[Keys, Path]], slop: float, policy: Policy | None = None
    ) -> None:
        check_number("slop", slop, "use seconds, such as 0.01")
        self.paths = [show((keys.name, *path)) for keys, path in places]
        if len(places) < 2 or len({*self.paths}) < len(places):
            raise BadValue(f"join({', '.join(map(repr, self.paths))}): give two paths or more, each once")
        super().__init__(chosen(policy, Last(_MOST_JOINED)))
        self._joiner = Joiner(len(places), slop)
        self._lost = [0] * len(places)
        self._timer: asyncio.TimerHandle | None = None
        self._links = []
        for place, (keys, path) in enumerate(places):
            # With a ttl of 0 the follower takes every update, and notes when it arrived.
            make = partial(Follower, keys, path, session.ships, session.cache, ttl=0.0)
            self._links.append(Link(session, make, [_Entry(self, place)]))

    @property
    def skipped(self) -> dict[str, JoinSkips]:
        """By path, a `JoinSkips`: why updates of the first path are in no joined one. See also `dropped`."""
        counts = zip(self._joiner.unmatched, self._lost, self._joiner.crowded, strict=True)
        return dict(zip(self.paths, [JoinSkips(*each) for each in counts], strict=True))

    @property
    def _following(self) -> bool:
        return self._closed or all(link.follows for link in self._links)

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later publish is missed. Idempotent; two or three round trips."""
        await asyncio.gather(*[link.follow() for link in self._links])

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await super().close()
        for link in self._links:
            await link.unfollow()

    def _take(self, place: int, update: Update) -> None:
        if update.gap:
            self._lost[place] += update.missed or 1
        # What was found, or is gone, was not published at this moment.
        if update.origin is Origin.PUBLISHED and not update.deleted and update.arrived is not None:
            self._joiner.add(place, _Arrival(update.arrived, update.data))
            self._hand_over()

    def _hand_over(self) -> None:
        for joined in self._joiner.take(time.monotonic()):
            self.queue.put(joined)
        if self._timer is not None:
            self._timer.cancel()
        left = self._joiner.due() - time.monotonic()
        self._timer = None
        if left != float("inf"):
            self._timer = asyncio.get_running_loop().call_later(max(left, 0.0), _calling(weakref.ref(self)))


def _calling(reference: weakref.ref[Join]) -> Any:
    """Return what hands over what a join has by then; a reference back would keep one that was dropped."""

    def call() -> None:
        if (there := reference()) is not None and not there._closed:
            there._hand_over()

    return call


class _Entry(BoundedQueue):
    """Where the updates of one path go: to the join, at once."""

    def __init__(self, join: Join, place: int) -> None:
        super().__init__(Last(1))
        self._join = weakref.ref(join)
        self._place = place

    def put(self, update: Update) -> None:
        if (join := self._join()) is not None:
            join._take(self._place, update)

    def skip(self) -> None:
        if (join := self._join()) is not None:
            join._lost[self._place] += 1

    def close(self, end: Exception | None = None) -> None:
        if end is not None and (join := self._join()) is not None:
            join.queue.close(end)
