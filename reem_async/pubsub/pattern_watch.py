"""Following every change of all keys that some patterns name: those there are, and those that come to be.

Each key has a `Follower`. Publishers are heard through the patterns too: of a key that is not followed yet that is the
first word, and what is heard until it is followed is handed on. Keys that are only stored are looked for every second.
"""

from __future__ import annotations

import asyncio
import logging
import weakref
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace

from ..concurrency.queues import BoundedQueue, Last, Policy, chosen
from ..errors import InterfaceClosed, NotAllowed, RedisError, ReemError, WrongKind
from ..plan.notices import Notice
from ..plan.paths import Path, name_of, parse_patterns, parse_shown, show, spelled_out
from ..session import Session
from .events import Update
from .follower import Follower, checked_largest
from .listeners import Listener, Topic
from .manager import SubscriptionManager
from .monitor import PatternStream
from .refresh import find_regularly, present_keys

logger = logging.getLogger("reem.subscribe")

_MOST_WAITING = 1000  # updates that wait for a loop that is slower, if no policy is given
_MOST_BORN = 1000  # notices of a key that is about to be followed; more are read with it


class PatternWatch(PatternStream[Update]):
    """Follows all keys that some patterns name and yields their changes: an async iterator.

    What is there when following begins comes first, an update for each key (`initial`). Then every change, published or
    only stored, by any client; new keys, and keys that go (`deleted`). A key that is only stored is found
    within a second of its making. `update.data` is all that is at the key, or at the path below it that the pattern
    spells out: of `imu.temp` what is at `imu.temp`, of `robot1.*` all of `robot1`.

    In a cluster what is published in the first moment of a key may be told as what it led to, and, if the key is
    deleted in that moment, once more. `watch` of a store makes one, and explains
    the arguments.
    """

    def __init__(
        self, session: Session, patterns: Sequence[str], policy: Policy | None = None, *, largest: int | None = None
    ) -> None:
        super().__init__(session, parse_patterns(patterns), chosen(policy, Last(_MOST_WAITING)))
        self._largest = checked_largest(largest)
        self._followed: dict[str, dict[Path, Follower]] = {}  # by top-level key, and the place in it
        self._born: dict[str, list[Notice]] = {}  # what was heard of keys that are about to be followed
        # Because of what is there, or of rights; tried again in each search
        self._unreadable: set[tuple[str, Path]] = set()

    def _listener(self, topic: Topic) -> Listener:
        return _Publishers(self, topic)

    async def _begin(self, manager: SubscriptionManager) -> None:
        # The patterns are subscribed to by now: a key that is made during the search is heard of.
        await self._follow(await present_keys(self._session, self.tops), late=False)
        manager.tasks.start(find_regularly(_searching(weakref.ref(self))), "reem discovery")

    def _leaving(self) -> list[Listener]:
        leaving = [*self._listeners, *(each for there in self._followed.values() for each in there.values())]
        self._followed = {}
        self._born.clear()
        self._unreadable.clear()
        return leaving

    def _paths(self, name: str) -> list[Path]:
        """Return the places to follow in a key: what the patterns spell out, but not what is below another of these."""
        paths = {spelled_out(pattern.rest) for pattern in self.patterns if pattern.concerns((name,))}
        return [path for path in paths if not any(path[: len(other)] == other for other in paths - {path})]

    async def _follow(self, found: set[str], *, late: bool) -> None:
        """Follow what is not followed yet of some keys. A warning names what cannot be read."""
        manager = self._manager
        if manager is None or self._closed:  # meanwhile
            return
        unreadable = {name for name, _ in self._unreadable}
        coming: dict[tuple[str, Path], Follower] = {}
        for name in sorted((found - self._followed.keys()) | (found & unreadable)):
            is_new = late and name not in unreadable
            for path in self._paths(name):
                there = self._followed.setdefault(name, {})
                if path not in there:
                    born = self._born.setdefault(name, [])
                    there[path] = coming[name, path] = self._follower(name, path, born if is_new else None, manager)
        followers = list(coming.values())
        try:
            await manager.subscribe_all(followers)
            for place, follower in list(coming.items()):
                await self._begin_place(place, follower, manager)
                del coming[place]
        finally:
            for follower in followers:
                self._born.pop(follower.keys.name, None)
                if self._closed:  # meanwhile
                    self._let_go(follower)
            for name, path in coming:  # they are found again
                self._drop(name, path)

    def _follower(self, name: str, path: Path, born: list[Notice] | None, manager: SubscriptionManager) -> Follower:
        session, keys = self._session, self._session.keys(name)
        follower = Follower(keys, path, session.ships, session.cache, manager, stored=True, largest=self._largest)
        follower.queues = [_Fitting(self, name, path)]
        follower.born = born
        return follower

    async def _begin_place(self, place: tuple[str, Path], follower: Follower, manager: SubscriptionManager) -> None:
        name, path = place
        try:
            await manager.follow_here(follower)
        except ReemError as error:
            if isinstance(error, RedisError | InterfaceClosed) and not isinstance(error, NotAllowed | WrongKind):
                raise
            self._drop(name, path)
            if place not in self._unreadable:
                self._unreadable.add(place)
                logger.warning("%s cannot be watched until that is mended: %s", show((name, *path)), error)
        else:
            self._unreadable.discard(place)

    def heard(self, notice: Notice, channel: bytes) -> None:
        name = name_of(channel, self._session.namespace)
        born = self._born.get(name)
        if born is not None:
            if len(born) < _MOST_BORN:
                born.append(notice)
            return
        # The follower of a deleted key has told that; an unreadable one waits for a search.
        if (notice.deleted and not notice.path) or name in self._followed:
            return
        paths = self._paths(name) if name else []
        if paths and self._manager is not None and self._unreadable.isdisjoint((name, path) for path in paths):
            self._born[name] = [notice]
            self._manager.tasks.start(self._follow_late({name}), "reem discovery of new keys")

    async def _follow_late(self, found: set[str]) -> None:
        try:
            await self._follow(found, late=True)
        except (RedisError, OSError, InterfaceClosed) as error:
            logger.debug("new keys are not followed yet: %s", error)

    def gone(self, name: str) -> None:
        """Stop following a key that is gone; if it comes to be again, it is found like any other."""
        # Not at once: its follower may be about to report that it is there again.
        asyncio.get_running_loop().call_soon(self._drop_if_gone, name)

    def _drop_if_gone(self, name: str) -> None:
        there = self._followed.get(name, {})
        if all(follower.gone for follower in there.values()):
            for path in list(there):
                self._drop(name, path)

    def _drop(self, name: str, path: Path) -> None:
        there = self._followed.get(name, {})
        if path in there:
            self._let_go(there.pop(path))
        if not there:
            self._followed.pop(name, None)

    def _let_go(self, follower: Follower) -> None:
        follower.queues = []  # it reports nothing more: the next follower of the place does
        if self._manager is not None:
            self._manager.tasks.start(self._manager.unfollow_here(follower), "reem unfollow")

    async def look(self) -> None:
        followed = list(self._followed)
        found = await present_keys(self._session, self.tops)
        self._unreadable = {place for place in self._unreadable if place[0] in found}
        for name in followed:  # of a place in a key, no update says that all of the key is gone
            if name not in found:
                self._drop_if_gone(name)
        await self._follow_late(found)


def _searching(reference: weakref.ref[PatternWatch]) -> Callable[[], Awaitable[bool]]:
    async def search() -> bool:
        watch = reference()
        if watch is None or watch._closed:
            return False
        try:
            await watch.look()
        except InterfaceClosed:
            return False
        return True

    return search


class _Fitting(BoundedQueue):
    """Where the updates of one key go: those that a pattern names on to the watch's queue."""

    def __init__(self, watch: PatternWatch, name: str, path: Path) -> None:
        super().__init__(Last(1))
        self._watch = weakref.ref(watch)
        self._name = name
        self._path = path
        self._owes = False  # the next update that fits says that some were lost, and
        self._missed: int | None = 0  # how many; None if that is not known

    def put(self, update: Update) -> None:
        watch = self._watch()
        if watch is None:
            return
        if self._owes:
            missed = None if self._missed is None or update.missed is None else self._missed + update.missed
            update = replace(update, gap=True, missed=missed)
        where = parse_shown(update.path)
        fits = any(pattern.concerns(where) for pattern in watch.patterns)
        if fits:
            watch.queue.put(update)
        # What was lost before one that no pattern names may have been at a place that one does.
        self._owes, self._missed = update.gap and not fits, 0 if fits else update.missed
        if update.deleted and not self._path and update.data is None:
            watch.gone(self._name)

    def overtaken(self, update: Update | None) -> None:
        if (watch := self._watch()) is not None:
            watch.queue.skip()

    def close(self, end: Exception | None = None) -> None:
        """End the watch for an error. Else its queue goes on."""
        if end is not None and (watch := self._watch()) is not None:
            watch.queue.close(end)


class _Publishers(Listener):
    """What is published under a pattern: a listener of the subscription manager, which holds it weakly."""

    def __init__(self, watch: PatternWatch, topic: Topic) -> None:
        super().__init__(topic, queues=[watch.queue])
        self._watch = weakref.ref(watch)

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        if (watch := self._watch()) is not None:
            watch.heard(notice, channel)
