"""Following every change of all keys that some patterns name: those there are, and those that come to be.

Each key has a `Follower`. Publishers are heard through the patterns too: of a key that is not followed yet that is the
first word, and what is heard until it is followed is handed on. Keys that are only stored are looked for every second.
"""

from __future__ import annotations

import asyncio
import logging
import weakref
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import replace

from ..concurrency.queues import BoundedQueue, Last, Policy, chosen
from ..errors import InterfaceClosed, NotAllowed, RedisError, ReemError, WrongKind
from ..plan.notices import Notice
from ..plan.paths import Path, name_of, parse_patterns, parse_shown, show, spelled_out
from ..session import Session
from .events import Update
from .finder import find_regularly, present_keys
from .follower import Follower, checked_largest
from .listeners import Listener, Topic
from .manager import SubscriptionManager
from .patterns import PatternStream

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
    deleted in that moment, once more.

    Args:
        session: The server.
        patterns: Globs of paths such as "arm", "cam_*" or "robot.*.battery"; all keys if there is none.
        policy: What to keep for a loop that is slower than the updates; `Last(1000)` if not given.
        largest: Bytes of an array up to which it is fetched; None for no limit. See `Mirror`.

    Raises:
        BadKey: Not a pattern.
    """

    def __init__(
        self, session: Session, patterns: Sequence[str], policy: Policy | None = None, *, largest: int | None = None
    ) -> None:
        super().__init__(session, parse_patterns(patterns), chosen(policy, Last(_MOST_WAITING)))
        self._largest = checked_largest(largest)
        self._followed: dict[str, list[Follower]] = {}
        self._born: dict[str, list[Notice]] = {}  # about to be followed
        self._failed: set[str] = set()  # could not be followed: what is there later was not made just then
        self._unreadable: dict[str, tuple[Path, ...]] = {}  # places in keys, because of what is there, or of rights
        self._warned: set[tuple[str, Path]] = set()

    def _listener(self, topic: Topic) -> Listener:
        return _Publishers(self, topic)

    async def _begin(self, manager: SubscriptionManager) -> None:
        # The patterns are subscribed to by now: a key that is made during the search is heard of.
        await self._follow(self._new(await present_keys(self._session, self.tops)), late=False)
        manager.tasks.start(find_regularly(_searching(weakref.ref(self))), "reem discovery")

    def _leaving(self) -> list[Listener]:
        leaving = [*self._listeners, *(each for there in self._followed.values() for each in there)]
        self._followed = {}
        self._born.clear()
        self._failed.clear()
        self._unreadable.clear()
        self._warned.clear()
        return leaving

    def _new(self, found: set[str]) -> list[str]:
        lacking = (found - self._followed.keys()) | (found & self._unreadable.keys())
        return sorted(name for name in lacking if self._paths(name))

    def _paths(self, name: str) -> list[Path]:
        """Return the places to follow in a key: what the patterns spell out, but not what is below another of these."""
        paths = {spelled_out(pattern.rest) for pattern in self.patterns if pattern.concerns((name,))}
        return [path for path in paths if not any(path[: len(other)] == other for other in paths - {path})]

    async def _follow(self, names: Iterable[str], *, late: bool) -> None:
        """Follow some keys. A warning names what cannot be read; each search tries it again."""
        manager = self._manager
        if manager is None or self._closed:  # meanwhile
            return
        coming: dict[str, dict[Path, Follower]] = {}
        for name in names:
            is_new = late and name not in self._failed and name not in self._followed
            self._failed.discard(name)
            if places := self._lacking(name):
                born = self._born.setdefault(name, [])
                there = {path: self._follower(name, path, born if is_new else None, manager) for path in places}
                self._followed.setdefault(name, []).extend(there.values())
                coming[name] = there
        followers = [follower for there in coming.values() for follower in there.values()]
        try:
            await manager.subscribe_all(followers)
            for name in list(coming):
                await self._begin_key(name, coming[name], manager)
                self._born.pop(name, None)  # not earlier: each follower of the key is to have what was heard
                del coming[name]
        finally:
            for name, there in coming.items():  # they are found again
                self._born.pop(name, None)
                self._put_off(name, there)
            if self._closed:  # meanwhile
                for follower in followers:
                    self._let_go(follower)

    def _lacking(self, name: str) -> Iterable[Path]:
        unreadable = self._unreadable.pop(name, ())
        return unreadable if name in self._followed else self._paths(name)

    def _follower(self, name: str, path: Path, born: list[Notice] | None, manager: SubscriptionManager) -> Follower:
        session, keys = self._session, self._session.keys(name)
        follower = Follower(keys, path, session.ships, session.cache, manager, stored=True, largest=self._largest)
        follower.queues = [_Fitting(self, name, path)]
        follower.born = born
        return follower

    async def _begin_key(self, name: str, there: dict[Path, Follower], manager: SubscriptionManager) -> None:
        """Begin to follow places in one key, and take them out; those that cannot be read are put off."""
        unreadable: dict[Path, Follower] = {}
        for path, follower in list(there.items()):
            try:
                await manager.follow_here(follower)
            except ReemError as error:
                if isinstance(error, RedisError | InterfaceClosed) and not isinstance(error, NotAllowed | WrongKind):
                    raise
                unreadable[path] = follower
                if (name, path) not in self._warned:
                    self._warned.add((name, path))
                    logger.warning("%s cannot be watched until that is mended: %s", show((name, *path)), error)
            else:
                self._warned.discard((name, path))
            del there[path]
        if unreadable:
            self._put_off(name, unreadable)
            self._unreadable[name] = tuple(unreadable)

    def _put_off(self, name: str, there: dict[Path, Follower]) -> None:
        """Drop followers that could not begin, which is tried again; those of other places in the key go on."""
        left = [each for each in self._followed.get(name, []) if each not in there.values()]
        for follower in there.values():
            self._let_go(follower)
        if left:
            self._followed[name] = left
            self._unreadable[name] = (*self._unreadable.get(name, ()), *there)
        else:
            self._followed.pop(name, None)
            self._failed.add(name)

    def heard(self, notice: Notice, channel: bytes) -> None:
        name = name_of(channel, self._session.namespace)
        born = self._born.get(name)
        if born is not None:
            if len(born) < _MOST_BORN:
                born.append(notice)
            return
        # The follower of a deleted key has told that; an unreadable one waits for a search.
        if (notice.deleted and not notice.path) or name in self._followed or name in self._unreadable:
            return
        if name and self._manager is not None and self._paths(name):
            self._born[name] = [notice]
            self._manager.tasks.start(self._follow_late([name]), "reem discovery of new keys")

    async def _follow_late(self, names: Iterable[str]) -> None:
        try:
            await self._follow(names, late=True)
        except (RedisError, OSError, InterfaceClosed) as error:
            logger.debug("new keys are not followed yet: %s", error)

    def gone(self, name: str) -> None:
        """Stop following a key that is gone; if it comes to be again, it is found like any other.

        Not at once: its follower may be about to tell that it has come to be again, and would be the only one that
        knows.
        """
        asyncio.get_running_loop().call_soon(self._drop_if_gone, name)

    def _drop_if_gone(self, name: str) -> None:
        if all(follower.gone for follower in self._followed.get(name, [])):
            self._drop(name)

    def _drop(self, name: str) -> None:
        self._unreadable.pop(name, None)
        for follower in self._followed.pop(name, []):
            self._let_go(follower)

    def _let_go(self, follower: Follower) -> None:
        follower.queues = []  # it reports nothing more: the next follower of the place does
        if self._manager is not None:
            self._manager.tasks.start(self._manager.unfollow_here(follower), "reem unfollow")

    async def look(self) -> None:
        followed = list(self._followed)
        found = await present_keys(self._session, self.tops)
        self._failed &= found
        for name in self._unreadable.keys() - found:
            del self._unreadable[name]
        self._warned = {each for each in self._warned if each[0] in found}
        for name in followed:  # of a place in a key, no update says that all of the key is gone
            if name not in found:
                self._drop_if_gone(name)
        await self._follow_late(self._new(found))


def _searching(reference: weakref.ref[PatternWatch]) -> Callable[[], Awaitable[bool]]:
    """Return what searches for a watch, which it does not keep from being dropped."""

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
