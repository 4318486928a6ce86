"""Following updates: one subscription connection per interface, one `Follower` per subscriber.

Notices and replies share that connection (RESP3), so all a follower learns is in one order: what
came before a snapshot is in it, what comes after is newer. There is no arithmetic and no race.
"""

from __future__ import annotations

import asyncio
import collections
import inspect
import logging
import random
import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from .errors import BadData, InterfaceClosed, MissingKey, RedisError, ReemError
from .plan import Plan, Reply, unwrap, wire_commands
from .plan.keys import Keys
from .plan.memory import Memory
from .plan.notices import ANNOUNCED, Notice, decode
from .plan.paths import Path, show
from .plan.reads import Sealed, interpret, read
from .plan.trees import MISSING, CannotApply, copied, get, removed, replaced
from .policy import Mailbox
from .ships.registry import Ships
from .transport.aio import AsyncTransport
from .transport.wire import Wire

__all__ = ["Follower", "Hub", "Update"]

logger = logging.getLogger("reem.subscribe")

_MOST_PUBLISHERS = 10_000


@dataclass(frozen=True, slots=True)
class Update:
    """One update of what a subscriber follows.

    Attributes:
        path: What was updated, such as "callback_channel.number".
        data: The whole structure below the channel after the update, None if it is gone; the
            containers are the receiver's own, arrays are read-only.
        value: What was written: the value at `path`, or the part of it below the channel; None if
            it was deleted.
        initial: This is the value that was there when following began.
        time: When it was published, in seconds since 1970 on the publisher's clock; None if initial.
        publisher: The id of the interface that published it; None if initial.
        sequence: Its number among this publisher's updates of the top-level key; None if initial.
        gap: Updates were lost between this one and the last: a connection broke.
    """

    path: str
    data: Any
    value: Any
    initial: bool = False
    time: float | None = None
    publisher: str | None = None
    sequence: int | None = None
    gap: bool = False


class Follower:
    """Keeps a local copy of one path equal to the server's, and hands out each update.

    All methods but `value` are called on the event loop.

    Attributes:
        keys: The top-level key's names.
        path: What is followed, below the top-level key.
        tree: The local copy, never changed in place.
    """

    def __init__(self, keys: Keys, path: Path, ships: Ships, memory: Memory) -> None:
        self.keys = keys
        self.path = path
        self.tree: Any = MISSING
        self.mailboxes: list[Mailbox] = []
        self.ready: asyncio.Future[None] | None = None
        self._ships = ships
        self._memory = memory
        self._wire: Wire | None = None
        self._fetching = False
        self._settling = False
        self._again = False
        self._covered: list[Notice] = []  # arrived while a snapshot was on its way: it has them
        self._later: list[Notice] = []  # arrived after a snapshot that ships are still opening
        self._sequences: dict[str, int] = {}
        self._kind = "initial"

    def start(self, wire: Wire, kind: str) -> None:
        """Take a snapshot over `wire`; `kind` is "initial", or "gap" after a broken connection."""
        self._wire, self._kind = wire, kind
        self._covered.clear()
        self._later.clear()
        self._fetching, self._settling = True, False
        self._send(read(self.keys, self.path, self._ships, self._memory))

    def lost(self) -> None:
        """Stop applying: the connection is gone."""
        self._wire, self._fetching, self._settling = None, False, False

    def on_notice(self, notice: Notice, gap: bool | None = None) -> None:
        """Apply one update, or note that a snapshot on its way has it."""
        if gap is None:
            gap = self._count(notice)
            if gap is None:
                return
        if self._wire is None or _relation(notice.path, self.path) is None:
            return
        if self._settling:
            self._later.append(notice)
        elif self._fetching:
            self._covered.append(notice)
        elif notice.deleted or notice.value is not ANNOUNCED:
            self._apply(notice, gap)
        else:
            self._fetch(notice)

    def _count(self, notice: Notice) -> bool | None:
        """Return whether updates of this publisher are missing; None for one that was already seen."""
        last = self._sequences.get(notice.publisher)
        if last is not None and notice.sequence <= last:
            return None
        if len(self._sequences) >= _MOST_PUBLISHERS:
            self._sequences.clear()
        self._sequences[notice.publisher] = notice.sequence
        return last is not None and notice.sequence > last + 1

    def _apply(self, notice: Notice, gap: bool) -> None:
        inner = notice.path[len(self.path) :]
        try:
            if len(notice.path) <= len(self.path):
                rest = self.path[len(notice.path) :]
                self.tree = MISSING if notice.deleted else get(notice.value, rest)
            elif notice.deleted:
                self.tree = removed(self.tree, inner)
            else:
                self.tree = replaced(self.tree, inner, notice.value)
        except CannotApply:  # the server has refused it too, or this copy is behind: look
            self._fetch(notice)
            return
        self._emit(notice, gap)

    def _fetch(self, notice: Notice) -> None:
        self._covered.append(notice)
        self._fetching = True
        self._send(read(self.keys, self.path, self._ships, self._memory))

    def _send(self, plan: Plan) -> None:
        wire = self._wire
        if wire is not None:
            wire.send(wire_commands(plan), lambda outcome: self._on_replies(plan, wire, outcome))

    def _on_replies(self, plan: Plan, wire: Wire, outcome: list[Reply] | Exception) -> None:
        """Go on with a read: called in order with notices, so what has arrived until now is older."""
        if wire is not self._wire:
            return
        if isinstance(outcome, Exception):
            self._failed(outcome)
            return
        try:
            result = plan.decode(unwrap(plan, outcome))
        except MissingKey:
            self._settle(MISSING)
        except (ReemError, RedisError) as error:
            self._failed(error)
        else:
            if isinstance(result, Plan):
                self._send(result)
            else:
                self._open(result)

    def _open(self, sealed: Sealed) -> None:
        """Have the ships make values of their replies; those that must be awaited get a task."""
        waiting: list[tuple[Any, Any, Any]] = []
        try:
            for crate, ship, reply in sealed.crates:
                value = interpret(sealed.name, crate, ship, reply)
                if inspect.isawaitable(value):
                    waiting.append((crate.container, crate.key, value))
                else:
                    crate.container[crate.key] = value
        except Exception as error:
            self._failed(error)
            return
        if not waiting:
            self._settle(sealed.holder[0])
            return
        self._settling = True
        _in_background(self._await_ships(sealed, waiting), f"reem ships {self.keys.name}")

    async def _await_ships(self, sealed: Sealed, waiting: Iterable[tuple[Any, Any, Any]]) -> None:
        try:
            for container, key, value in waiting:
                container[key] = await value
        except Exception as error:
            self._failed(error)
        else:
            self._settle(sealed.holder[0])

    def _failed(self, error: Exception) -> None:
        """Report a snapshot that could not be taken; the next update tries again."""
        self._fetching = self._settling = False
        self._covered.clear()
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(error)
        elif self._wire is not None:
            logger.warning(
                "%s: an update could not be read and is skipped: %s",
                show((self.keys.name, *self.path)),
                error,
            )

    def _settle(self, tree: Any) -> None:
        """Take a snapshot as the local copy; tell of the updates it has, then apply what came later."""
        covered, self._covered = self._covered, []
        later, self._later = self._later, []
        self.tree, kind, self._kind = tree, self._kind, ""
        self._fetching = self._settling = False
        if kind == "gap" or (kind == "initial" and tree is not MISSING):
            self._emit_snapshot(initial=kind == "initial")
        newest: dict[Path, Notice] = {}
        for notice in covered if not kind else ():
            if newest.pop(notice.path, None) is not None:
                for mailbox in self.mailboxes:
                    mailbox.dropped += 1
            newest[notice.path] = notice
        for notice in newest.values():
            self._emit(notice, False)
        if self.ready is not None and not self.ready.done():
            self.ready.set_result(None)
        for notice in later:
            self.on_notice(notice, gap=False)

    def _emit_snapshot(self, *, initial: bool) -> None:
        for mailbox in self.mailboxes:
            data, value = self.value(), self.value()
            mailbox.put(Update(show((self.keys.name, *self.path)), data, value, initial=initial, gap=not initial))

    def _emit(self, notice: Notice, gap: bool) -> None:
        path = show((self.keys.name, *notice.path))
        for mailbox in self.mailboxes:
            value = self.value(notice.path[len(self.path) :])
            mailbox.put(Update(path, self.value(), value, False, notice.time, notice.publisher, notice.sequence, gap))

    def value(self, inner: Path = ()) -> Any:
        """Return a copy of what is at `inner` below the followed path, None if nothing is. Any thread may."""
        found = get(self.tree, inner)
        return None if found is MISSING else copied(found)


def _relation(updated: Path, followed: Path) -> bool | None:
    """Return None if an update at one path leaves the other as it was."""
    shared = min(len(updated), len(followed))
    # Indexes may count from either end, so two different ones may mean the same item.
    alike = all(
        ours == theirs or (isinstance(ours, int) and isinstance(theirs, int))
        for ours, theirs in zip(updated[:shared], followed[:shared], strict=True)
    )
    return True if alike else None


_tasks: set[asyncio.Task[Any]] = set()


def _in_background(coroutine: Any, name: str) -> asyncio.Task[Any]:
    """Run a coroutine as a task that is not forgotten before it ends."""
    task = asyncio.get_running_loop().create_task(coroutine, name=name)
    _tasks.add(task)
    task.add_done_callback(_tasks.discard)
    return task


class Hub:
    """The one subscription connection of an interface, and its followers by channel."""

    def __init__(self, transport: AsyncTransport, ships: Ships, memory: Memory) -> None:
        self._transport = transport
        self._ships = ships
        self._memory = memory
        self._wire: Wire | None = None
        self._channels: dict[bytes, weakref.WeakSet[Follower]] = collections.defaultdict(weakref.WeakSet)
        self._lock = asyncio.Lock()
        self._reconnecting: asyncio.Task[Any] | None = None
        self._closed = False
        self._warned = False

    def follower(self, keys: Keys, path: Path) -> Follower:
        """Return a follower of `path` that is not following yet."""
        return Follower(keys, path, self._ships, self._memory)

    async def follow(self, follower: Follower) -> None:
        """Subscribe, then take the first snapshot; when this returns, no later update is missed."""
        await self._ships.ready()
        channel = follower.keys.channel.encode()
        async with self._lock:
            self._check()
            wire = self._wire
            if wire is None or not wire.alive:
                wire = self._wire = await self._transport.listen(self._on_push, self._on_lost)
            known = bool(self._channels[channel])
            self._channels[channel].add(follower)
            try:
                if not known:
                    await _subscribe(wire, [channel])
                follower.ready = asyncio.get_running_loop().create_future()
                follower.start(wire, "initial")
                await follower.ready
            except BaseException:
                self._channels[channel].discard(follower)
                follower.lost()
                self._check()
                raise
            finally:
                follower.ready = None

    def _check(self) -> None:
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")

    async def unfollow(self, follower: Follower) -> None:
        """Stop following. Idempotent."""
        channel = follower.keys.channel.encode()
        follower.lost()
        for mailbox in follower.mailboxes:
            mailbox.close()
        if channel in self._channels:
            self._channels[channel].discard(follower)
            self._forget_if_empty(channel)

    def _forget_if_empty(self, channel: bytes) -> None:
        if not self._channels[channel]:
            del self._channels[channel]
            if self._wire is not None and self._wire.alive:
                self._wire.send([("UNSUBSCRIBE", channel)], lambda _: None)

    def _on_push(self, message: list[Any]) -> None:
        channel, payload = message[-2:]
        followers = self._channels.get(channel)
        if followers is None:
            return
        if not followers:  # all were dropped without closing
            self._forget_if_empty(channel)
            return
        try:
            notice = decode(payload, self._ships)
        except BadData as error:
            if not self._warned:
                self._warned = True
                logger.warning("a message on %r was ignored: %s (said once)", channel, error)
            return
        for follower in list(followers):
            follower.on_notice(notice)

    def _on_lost(self, reason: Exception) -> None:
        for followers in self._channels.values():
            for follower in followers:
                follower.lost()
                if follower.ready is not None and not follower.ready.done():
                    follower.ready.set_exception(reason)
        if not self._closed and self._channels and self._reconnecting is None:
            logger.warning("the subscription connection was lost and is made again: %s", reason)
            self._reconnecting = _in_background(self._reconnect(), "reem reconnect")
            self._reconnecting.add_done_callback(self._reconnected)

    def _reconnected(self, task: asyncio.Task[Any]) -> None:
        self._reconnecting = None
        if not task.cancelled() and task.exception() is not None:
            logger.error("reconnecting failed for good", exc_info=task.exception())

    async def _reconnect(self) -> None:
        """Connect, subscribe, and have every follower take a snapshot; tries until it works."""
        pause = 0.05
        while not self._closed:
            await asyncio.sleep(pause * random.uniform(0.5, 1.0))  # noqa: S311 - only spreads the load
            pause = min(pause * 2, 1.0)
            try:
                async with self._lock:
                    wire = await self._transport.listen(self._on_push, self._on_lost)
                    self._wire = wire
                    await _subscribe(wire, list(self._channels))
                    for followers in list(self._channels.values()):
                        for follower in list(followers):
                            follower.start(wire, "gap")
                return
            except (RedisError, OSError) as error:
                logger.debug("not connected yet: %s", error)

    async def close(self) -> None:
        """End all followers and the connection. Idempotent."""
        self._closed = True
        if self._reconnecting is not None:
            self._reconnecting.cancel()
        for followers in list(self._channels.values()):
            for follower in list(followers):
                await self.unfollow(follower)
        if self._wire is not None:
            await self._wire.close()
        async with self._lock:  # whoever is just subscribing has now failed
            self._channels.clear()


async def _subscribe(wire: Wire, channels: list[bytes]) -> None:
    """Subscribe and wait until the server has confirmed each channel."""
    for reply in await wire.roundtrip([("SUBSCRIBE", channel) for channel in channels]):
        if isinstance(reply, Exception):
            raise reply
