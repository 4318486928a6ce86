"""One top-level key while it is recorded: its updates in order, those that are only announced fetched.

While a value is on its way the updates behind it wait, so that what is written is in the order in which it
was published. Each fetch brings the note of the last notice that it includes: so it is known which update
the value belongs to, and which ones before it will never be seen.
"""

from __future__ import annotations

import asyncio
import collections
import dataclasses
import logging
import time
from typing import Any, Protocol

from ..background import in_background
from ..errors import BadData, RedisError, WrongKind
from ..monitor import ANNOUNCED, Event
from ..plan.paths import Path, below, show
from ..plan.patterns import Pattern
from ..plan.trees import MISSING, get
from ..session import Session
from .fetch import fetch
from .scribe import Operation, Scribe
from .state import pruned
from .times import AFTER, Arrivals, Clock, published

__all__ = ["Collector", "Feed", "Item"]

logger = logging.getLogger("reem.recording")

_PAUSE = 0.1
"""Seconds after a read that failed."""
_LET_PASS = 0.004
"""Seconds, at most, from a large update to reading it. The server is busy with its publisher, others wait behind
that: reading it in the same moment would make them wait twice as long. A recorder has time."""
_FAST = 20_000_000
"""Nanoseconds between large updates that come so fast that the next one might not find this one fetched."""
_READ_RATE = 8e6
"""Bytes a second that are read of keys of which nothing is published."""


@dataclasses.dataclass(slots=True, eq=False)
class Item:
    """One piece of news that waits for its turn.

    Attributes:
        role: "update", "delete", "state" or "keyframe".
        path: The full path.
        value: What is there; ANNOUNCED if it must be fetched.
        stamp: Log time, publish time and number.
        size: Its bytes.
        kind: "pub", or "kvs" if it was sampled or read.
    """

    role: str
    path: Path
    value: Any
    stamp: tuple[int, int, int]
    size: int = 0
    kind: str = "pub"


class Collector(Protocol):
    """What a feed needs of the recorder."""

    session: Session
    scribe: Scribe
    clock: Clock
    arrivals: Arrivals
    patterns: list[Pattern]
    fetching: asyncio.Semaphore

    async def fence(self) -> None:
        """Wait until everything published before now has been handed to the feeds."""

    def hurry(self) -> None:
        """Look more often at what was published: large updates come fast."""

    def failed(self, error: Exception) -> None:
        """End the recording: something went wrong that should not."""


class Feed:
    """The updates of one top-level key.

    Args:
        collector: The recorder.
        name: The key.

    Attributes:
        busy: The task that fetches, None if there is nothing to fetch.
        news: The whole was published since the last keyframe.
        next_read: When it may be read again for nothing, on the monotonic clock.
    """

    def __init__(self, collector: Collector, name: str) -> None:
        self._collector = collector
        self._name = name
        self._keys = collector.session.keys(name)
        self._items: collections.deque[Item] = collections.deque()
        self._heard: dict[str, int] = {}
        self._since: list[tuple[str, int, int]] = []  # notices that arrived while a fetch was on its way
        self._known = False
        self._complaint = ""  # why it could not be read the last time
        self._last_large = 0  # the log time of the last update that was fetched
        self._whole = any(not pattern.rest and pattern.concerns((name,)) for pattern in collector.patterns)
        self.busy: asyncio.Task[None] | None = None
        self.news = False
        self.next_read = 0.0

    def on_event(self, event: Event) -> None:
        """Take one update."""
        arrived = self._collector.arrivals.of(event.publisher, event.time, event.received)
        stamp = self._collector.clock.stamp(arrived), published(event.time), event.sequence
        self._heard[event.publisher] = event.sequence
        if len(self._heard) > 1000:
            del self._heard[next(iter(self._heard))]
        if self.busy is not None:
            self._since.append((event.publisher, event.sequence, stamp[0]))
        self.news = self.news or len(event.path) == 1
        if event.missed:  # a broken connection is noticed by the recorder, for all keys
            self.lost(event.missed)
        elif not self._known and len(event.path) > 1:
            self.read()
        self._known = self._known or len(event.path) == 1
        if self._whole or any(pattern.concerns(event.path) for pattern in self._collector.patterns):
            self._add(Item("delete" if event.deleted else "update", event.path, event.value, stamp, event.size))

    def lost(self, missed: int | None) -> None:
        """Note that updates were lost, and read the key anew."""
        stamp = self._collector.clock.stamp(), 0, 0
        self._collector.scribe.put(Operation("gap", (self._name,), missed, stamp), 0)
        self.read()

    def read(self) -> None:
        """Read the whole key from the server, if that is not about to happen anyway."""
        self._known = True
        if not any(item.role == "state" for item in self._items):
            self._add(Item("state", (self._name,), ANNOUNCED, (self._collector.clock.stamp(), 0, 0), kind="kvs"))

    def gone(self) -> None:
        """Note that the server does not have the key any more."""
        self._add(Item("state", (self._name,), MISSING, (self._collector.clock.stamp(), 0, 0), kind="kvs"))

    def keyframe(self, number: int) -> None:
        """Write the whole key as the recording has it."""
        self._add(Item("keyframe", (self._name,), None, (self._collector.clock.stamp(), 0, number)))

    def sampled(self, path: Path, value: Any, size: int) -> None:
        """Take what was read at a path: MISSING if there was nothing."""
        now = self._collector.clock.stamp()
        self._add(Item("delete" if value is MISSING else "update", path, value, (now, now, 0), size, "kvs"))

    def _add(self, item: Item) -> None:
        if not self._items and item.value is not ANNOUNCED:
            self._emit(item)
            return
        self._items.append(item)
        if self.busy is None:
            self.busy = in_background(self._drain(), f"reem record {self._name}")

    def _emit(self, item: Item) -> None:
        """Hand an item to the writing thread."""
        role, value = item.role, item.value
        if not self._whole and (role == "state" or (role == "update" and item.kind == "pub")):
            value = value if value is MISSING else pruned(value, item.path, self._collector.patterns)
            role = "delete" if role == "update" and value is MISSING else role
        self._collector.scribe.put(Operation(role, item.path, value, item.stamp, item.kind), item.size)

    async def _drain(self) -> None:
        """Emit what waits, in order, fetching what has to be."""
        try:
            while self._items:
                head = self._items[0]
                if head.value is not ANNOUNCED:
                    self._emit(self._items.popleft())
                elif not await self._fetched(head):
                    await asyncio.sleep(_PAUSE)
        except Exception as error:  # nobody waits for this task: the recording must not go on as if nothing were
            self._collector.failed(error)
        finally:
            self.busy = None

    async def _fetched(self, head: Item) -> bool:
        """Fetch what the first item announces and put it where it belongs; return whether that worked."""
        collector = self._collector
        try:
            if head.role == "update":
                since, self._last_large = head.stamp[0] - self._last_large, head.stamp[0]
                if since < _FAST:
                    collector.hurry()
                let_pass = min(_LET_PASS, since / 1e9 / 5)  # not if they come fast: none should be missed
                await asyncio.sleep(let_pass - collector.clock.since(head.stamp[0]))
            async with collector.fetching:
                self._since.clear()
                last = self._items[-1].stamp[0]  # what has been announced until now is older than the reply
                value, size, publisher, number = await fetch(collector.session, self._keys, head.path[1:])
            # What deleted it may not have been heard of yet: that there is nothing has no number.
            if value is MISSING or (number and self._heard.get(publisher, 0) < number):
                await collector.fence()
        except (RedisError, OSError, BadData) as error:
            self._give_up(head, error)
            return False
        known = [log for who, count, log in self._since if who == publisher and count == number]
        self._complaint = ""
        if head.role == "state":
            self.next_read = time.monotonic() + size / _READ_RATE
        covered = max([last, *known])
        if head.role == "update" and self._is_overtaken(head, value, covered):
            collector.scribe.counts.skip(self._items.popleft().path)
        else:
            self._place(head, value, size, covered)
        return True

    def _is_overtaken(self, head: Item, value: Any, covered: int) -> bool:
        """Return whether what was fetched is not what an update announced, but what others made of its place since.

        That there is nothing may be what an update did that had not been heard of when it was fetched.
        """
        overtaken = False
        for item in self._items:
            included = item.stamp[0] <= covered
            if item is head or item.role not in ("update", "delete") or item.kind != "pub":
                continue
            if item.path == head.path and item.value is ANNOUNCED:
                overtaken = overtaken and not included  # if it is included, what was fetched is its value
            elif below(head.path, item.path) and (included or value is MISSING):
                overtaken = True
        return overtaken

    def _give_up(self, head: Item, error: Exception) -> None:
        """Leave out what cannot be fetched; the key is read anew later: soon, or at a keyframe if it is no value."""
        if self._complaint != str(error):
            logger.warning("%s could not be read and is not recorded: %s", show(head.path), error)
        counts, first, self._complaint = self._collector.scribe.counts, not self._complaint, str(error)
        self._items.popleft()
        if head.role == "update":
            counts.skip(head.path)
        elif first:
            counts.lose(head.path)
        if not isinstance(error, BadData | WrongKind):
            self._collector.scribe.behind.add(self._name)

    def _place(self, head: Item, value: Any, size: int, covered: int) -> None:
        """Emit a fetched value as that of the newest update it includes; the older ones of its path are skipped.

        A state comes behind all that it includes, and brings the values of those that were only announced.
        """
        items = [self._items.popleft() for _ in range(self._newest(head, covered) + 1)]
        announced = [item for item in items if item.path == head.path and item.value is ANNOUNCED]
        target = head if head.role == "state" else announced[-1]
        stamp = target.stamp
        if target is not items[-1] or target.role == "state":  # it goes behind all that it includes
            stamp = items[-1].stamp[0] + AFTER, *target.stamp[1:]
        kept: list[Item] = []
        keyframes: list[Item] = []  # these come behind all, since they have what was fetched
        for place, item in enumerate(items):
            if item is target:
                continue
            if item.role == "keyframe":
                keyframes.append(dataclasses.replace(item, stamp=(max(item.stamp[0], stamp[0]), *item.stamp[1:])))
            elif not below(item.path, head.path):
                kept.append(item)
            elif item.value is not ANNOUNCED:
                self._emit(item)
            elif item.role == "update":
                self._emit_part(
                    item, items[place + 1 :], get(value, item.path[1:]) if target.role == "state" else MISSING
                )
        role = "delete" if value is MISSING and target.role == "update" else target.role
        self._emit(dataclasses.replace(target, role=role, value=value, size=size, stamp=stamp))
        self._items.extendleft(reversed(kept + keyframes))

    def _emit_part(self, item: Item, later: list[Item], value: Any) -> None:
        """Emit an update with what a state has in its place, if that is its value; else it is skipped."""
        if value is MISSING or any(below(it.path, item.path) or below(item.path, it.path) for it in later):
            self._collector.scribe.counts.skip(item.path)
        else:
            self._emit(dataclasses.replace(item, value=value))

    def _newest(self, head: Item, covered: int) -> int:
        """Return the place of the last item that a fetched value includes."""
        newest = 0
        for place, item in enumerate(self._items):
            if item.stamp[0] > covered:
                break
            if head.role == "state" or (item.role != "keyframe" and below(item.path, head.path)):
                newest = place
            elif item.role in ("update", "delete") and below(head.path, item.path):
                break  # what holds it was written as a whole
        return newest
