"""What `reem foxglove` and `reem rerun` share: keys that are followed for a viewer, without slowing down a publisher.

The program runs at the lowest priority. Updates wait for each other, and are taken many at a time. A key is followed
only while the viewer wants it, and its arrays are fetched only while the viewer wants these.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from typing import Any

from ...concurrency.queues import EMPTY, BoundedQueue, Ended, Policy
from ...connection import RedisInterface
from ...errors import BadKey, MissingKey, RedisError, ReemError
from ...plan.paths import Pattern, parse_patterns, shorten
from ...plan.reads import first_read, read
from ...pubsub.events import Update
from ...pubsub.follower import Follower
from ...pubsub.manager import SubscriptionManager
from ...pubsub.refresh import BACKGROUND, find_regularly, present_keys
from ...pubsub.subscribers import Link
from ...session import Session
from ...store.document import opened

logger = logging.getLogger("reem.viewing")

TICK = 0.02  # seconds in which updates wait for each other: a viewer draws 60 pictures a second at most
_IDLE_TICK = 0.1  # the same while no key is followed
_LONGEST_REST = 0.2  # seconds
SMALL = 4096  # bytes up to which an array is fetched with its document
_MOST_KEYS = 1000
"""Keys that a viewer is offered: it lists each, and each is read to learn what is in it."""
_LOOK_AGAIN = 5.0  # seconds until a key that is not followed is read again, to find new arrays in it
_MOST_LOOKS = 50  # keys that are read in one search
_CLOCKS_AGREE = 10.0  # seconds; a publisher's clock that is farther away from this one is not used


def extra(name: str, package: str) -> Any:
    """Import what an extra brings; raises ModuleNotFoundError that names the extra."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise ModuleNotFoundError(f"needs {package}: pip install 'reem-async[{name}]'", name=name) from None


def top_patterns(texts: Sequence[str]) -> list[Pattern]:
    """Return what globs of top-level keys name, all keys if there is none; raises BadKey."""
    patterns = parse_patterns(texts or ["*"])
    for text, pattern in zip(texts, patterns, strict=False):
        if pattern.rest:
            raise BadKey(f"{shorten(text)} names a place in a key; use the name of the key, {pattern.top!r}")
    return patterns


def time_of(update: Update) -> int:
    """Return when an update was published, in ns since 1970; now if that is not known or its clock is wrong."""
    now = time.time()
    is_plausible = update.time is not None and abs(now - update.time) < _CLOCKS_AGREE
    return int((update.time if is_plausible and update.time is not None else now) * 1e9)


class ViewedKey:
    """One key that is followed: the updates that wait for the viewer."""

    def __init__(self, session: Session, name: str, policy: Policy, *, arrays: bool) -> None:
        self.name = name
        self.arrays = arrays  # arrays of all sizes are fetched
        self.queue = BoundedQueue(policy)
        self.lost = 0  # updates that were lost on the way here
        self._link = Link(session, partial(self._follower, session), [self.queue])

    def _follower(self, session: Session, manager: SubscriptionManager) -> Follower:
        largest = math.inf if self.arrays else SMALL
        keys = session.keys(self.name)
        follower = Follower(
            keys, (), session.ships, session.cache, manager, stored=True, largest=largest, pace=BACKGROUND
        )
        follower.max_batch_delay = TICK
        return follower

    async def begin(self) -> None:
        await self._link.follow()

    async def end(self) -> None:
        await self._link.unfollow()

    def take(self) -> list[Update]:
        """Return the updates that have arrived; raises Ended if no more will."""
        updates: list[Update] = []
        while (update := self.queue.take()) is not EMPTY:
            self.lost += update.missed or 0
            updates.append(update)
        return updates


class Viewer:
    """Follows what a viewer wants of the keys that some patterns name. Base of the bridges to Foxglove and Rerun.

    Args:
        interface: The server.
        patterns: Globs of top-level keys, such as "arm" or "cam_*"; all if there is none.
        policy: Makes what a key keeps of the updates that wait for a slow viewer.
    """

    def __init__(self, interface: RedisInterface, patterns: Sequence[str], policy: Callable[[], Policy]) -> None:
        self.session = interface.session.raw  # pictures are passed on as they are
        self._tops = [pattern.top for pattern in top_patterns(patterns)]
        self._policy = policy
        self._looked: dict[str, float] = {}  # when a key was last read or followed
        self._keys: dict[str, ViewedKey] = {}
        self._losses: Counter[str] = Counter()  # of keys that are not followed any more
        self.names: set[str] = set()
        self.skipped: Counter[str] = Counter()  # what came faster than it could be shown, by key

    # What a viewer overrides.

    def wants(self, name: str) -> bool | None:
        """Return whether it wants a key with its arrays; None if it wants nothing of it."""
        raise NotImplementedError

    def show(self, name: str, tree: Any, at: int) -> None:
        """Show what is at a key, at a time in ns since 1970; raises nothing over odd values."""
        raise NotImplementedError

    def gone(self, name: str) -> None:
        """Take note that a key is gone."""

    async def tick(self) -> None:
        """Do what is to be done regularly."""

    # What it does.

    async def run(self) -> None:
        """Follow until it is cancelled."""
        await self._search()
        searching = asyncio.create_task(find_regularly(self._search))
        try:
            while True:
                began = time.monotonic()
                await self._choose()
                for key in list(self._keys.values()):
                    await self._show_updates(key)
                await self.tick()
                # It works half of its time at most, so that it does not fill a processor.
                took = min(time.monotonic() - began, _LONGEST_REST)
                await asyncio.sleep(max(TICK if self._keys else _IDLE_TICK, took))
        finally:
            searching.cancel()
            await asyncio.gather(searching, return_exceptions=True)
            for name in list(self._keys):
                await self._end(name)

    @property
    def losses(self) -> Counter[str]:
        """How many updates were lost on the way or dropped here, by key."""
        lost = Counter({name: key.lost + key.queue.dropped for name, key in self._keys.items()})
        return lost + self._losses + self.skipped

    async def _search(self) -> bool:
        """Find which keys there are, and read those that are not followed now and then."""
        found = set(sorted(await present_keys(self.session, self._tops))[:_MOST_KEYS])
        for name in self.names - found:
            self._looked.pop(name, None)
            self.gone(name)
        self.names = found
        due = time.monotonic() - _LOOK_AGAIN
        idle = [name for name in sorted(found - self._keys.keys()) if self._looked.get(name, -math.inf) < due]
        for name in idle[:_MOST_LOOKS]:
            self._looked[name] = time.monotonic()
            with suppress(ReemError, RedisError, OSError):  # gone meanwhile, of another program, or not readable
                self.show(name, await self._read(name), time.time_ns())
        return True

    async def _read(self, name: str) -> Any:
        session, keys = self.session, self.session.keys(name)
        await session.ships.ready()
        plan = read(keys, (), session.ships, session.cache, largest=SMALL, tolerant=True)
        return await opened(await session.run(first_read(plan, keys, (), session.cache)))

    async def _choose(self) -> None:
        for name in sorted(self.names | self._keys.keys()):
            arrays, key = self.wants(name), self._keys.get(name)
            if key is not None and key.arrays != arrays:
                await self._end(name)
            if arrays is not None and name not in self._keys and name in self.names:
                key = ViewedKey(self.session, name, self._policy(), arrays=arrays)
                try:
                    await key.begin()
                except (MissingKey, ReemError, RedisError, OSError) as error:
                    logger.debug("%s is not followed yet: %s", name, error)
                    continue
                self._keys[name] = key

    async def _end(self, name: str) -> None:
        key = self._keys.pop(name)
        self._losses[name] += key.lost + key.queue.dropped
        self._looked[name] = time.monotonic()
        with suppress(ReemError, RedisError, OSError):
            await key.end()

    async def _show_updates(self, key: ViewedKey) -> None:
        try:
            updates = key.take()
        except Ended:
            updates = []
        except ReemError as error:  # following has ended over an error: it is begun again
            logger.warning("%s: %s", key.name, error)
            await self._end(key.name)
            return
        for update in updates:
            if update.deleted and update.data is None:
                self.gone(key.name)
            elif not update.silent:
                self.show(key.name, update.data, time_of(update))
