"""The subscription manager: the subscription connections of an interface, kept alive for all that follow.

One server needs one. In a cluster a channel belongs to a node, as its key does, so there is one for
each node with listeners; when a slot moves, its listeners resynchronise on its new node, with a gap.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from ..concurrency.queues import noop
from ..concurrency.tasks import Tasks
from ..errors import ClusterNode, InterfaceClosed, NotConnected, RedisError, ReemError
from ..local import LocalPath
from ..plan import Command, Reply
from ..plan.placeholders import Unreadable
from ..session import Session
from ..ships.registry import Ships
from ..transport import Transport
from ..transport.route import Moved, is_unapplied
from ..transport.wire import Wire, close_all
from .key_watcher import KeyWatcher
from .listeners import NO_LISTENERS, Beginning, Inbox, Invalidations, Listener, ListenerGroup, Subscribing, Topic

if TYPE_CHECKING:
    from ..transport.aio import AsyncTransport

logger = logging.getLogger("reem.subscribe")

_PERIOD = 1.0  # seconds between looks at a connection; one that is dead shows a call's time limit later
_LONGEST_PAUSE = 0.5  # seconds between tries to connect: with one that hangs before it, still less than two in all
_MOST_REPORTED = 1000  # places that cannot be read of which is warned: programs may publish under ever new names


def manager_of(session: Session) -> SubscriptionManager:
    """Return the subscription manager of a session in the running event loop; made when first asked for."""
    session.transport.check()
    place = os.getpid(), asyncio.get_running_loop()
    manager = session.subscriptions
    if not isinstance(manager, SubscriptionManager) or manager.place != place:
        manager = session.subscriptions = SubscriptionManager(session.transport, session.ships, session.local)
    return manager


class SubscriptionManager:
    def __init__(self, transport: Transport, ships: Ships, local: LocalPath) -> None:
        self.transport = transport
        self._local = local
        self._ships = ships
        self._wires: dict[Transport, Wire] = {}
        self._topics: dict[Topic, ListenerGroup] = {}
        self._subscribed: dict[Topic, Wire] = {}
        self._beginners: Sequence[Listener] = ()  # they begin by themselves once their topics are subscribed
        self._lock = asyncio.Lock()
        self.tasks = Tasks()  # all that runs in the background for what is followed; ended by `close`
        self._reconnecting: asyncio.Task[Any] | None = None
        self._key_watcher = KeyWatcher(self)
        self._pace = 0.0
        self._closed = False
        self._inbox = Inbox(transport, ships, self._topics, local, self._moved, self._forget_if_empty)
        self._subscribing = Subscribing(transport, local.host, self._confirmed, self._inbox.early.joined)
        self.invalidations = Invalidations()  # what has servers say which keys were changed
        self._heartbeats = Heartbeats(self)
        self.callers: set[Any] = set()  # what makes calls for updates, kept here although the program may not hold it
        self.kept: dict[object, Any] = {}  # what of coordination/ lives as long as this
        self.place = os.getpid(), asyncio.get_running_loop()  # the process and the event loop it belongs to

    async def follow(self, listener: Listener) -> None:
        """Subscribe, then let the listener begin; when this returns, no later update is missed."""
        self.transport.check()
        await self._ships.ready()
        if listener.topic.pattern and self.transport.sharded:
            await self._key_watcher.follow(listener)
        else:
            await self.follow_here(listener)

    async def follow_all(self, listeners: Sequence[Listener]) -> None:
        """Follow many channels: one round trip for each node, and more only where a slot has moved."""
        await self.subscribe_all(listeners)
        for listener in listeners:
            await self.follow_here(listener)

    async def watch(self, watcher: Listener) -> None:
        """Have a listener told by `changed` of every key that was read over a subscription connection and was changed.

        What is read with `touch` is; a warning says so if a server does not tell. It is let go when it is dropped.
        """
        async with self._lock:
            self._inbox.watchers.add(watcher)
            for wire in list(self._wires.values()):
                await self.invalidations.turn_on(wire)

    def unwatch(self, watcher: Listener) -> None:
        self._inbox.watchers.discard(watcher)

    def report(self, unreadable: Iterable[Unreadable] | None) -> None:
        states = self.transport.states
        for it in unreadable or ():
            if it.place not in states.reported and len(states.reported) < _MOST_REPORTED:
                states.reported.add(it.place)
                states.unreadable += 1
                logger.warning("%s cannot be read, the values beside it can: %s (reported once)", it.place, it.reason)

    @property
    def hears_of_changes(self) -> bool:
        return all(wire.tracked is not False for wire in self._wires.values())

    async def touch(self, channel: str, names: Iterable[str], touched: Callable[[], None]) -> bool:
        """Read keys of a channel's top-level key, so that the server tells once when they are changed. One round trip.

        Returns whether it will tell. `touched` is called in order with what it tells: what it has told of before was
        changed before. When this returns it may have told more.
        """
        wire = self._subscribed.get(Topic(channel.encode()))
        if wire is None and not self.transport.sharded:  # all are on one connection
            wire = next(iter(self._wires.values()), None)
        return wire is not None and await self.invalidations.touch(wire, names, touched)

    async def subscribe_all(self, listeners: Sequence[Listener]) -> None:
        """Subscribe to many channels ahead of following them, which tries again what cannot be subscribed now."""
        self.transport.check()
        await self._ships.ready()
        nodes: dict[Transport, list[Listener]] = {}
        with contextlib.suppress(RedisError):
            async with self._lock:
                for listener in listeners:
                    if listener.topic not in self._subscribed:
                        nodes.setdefault(await self.transport.owner(listener.topic.name), []).append(listener)
                with self._beginning(listeners):
                    for node, there in nodes.items():
                        for listener in there:
                            self._enter(listener)
                        await self._subscribe_at(node, [listener.topic for listener in there])

    @contextlib.contextmanager
    def _beginning(self, listeners: Sequence[Listener]) -> Iterator[None]:
        """Have these listeners begin by themselves when their topics are subscribed."""
        self._beginners = listeners
        try:
            yield
        finally:
            self._beginners = ()

    async def follow_here(self, listener: Listener) -> None:
        deadline = time.monotonic() + self.transport.timeout
        retry = False
        while True:
            try:
                await self._follow(listener, retry=retry)
                return
            except RedisError as error:
                if await self.transport.states.startup.allows(self.transport, error):
                    continue
                unapplied = is_unapplied(error) or isinstance(error, NotConnected | ClusterNode)
                if not self.transport.sharded or not unapplied or self._closed:
                    raise
                if time.monotonic() > deadline:
                    fact = error.fact if isinstance(error, ClusterNode) else str(error)
                    raise NotConnected(f"{fact}; the cluster is being changed: nothing is followed yet") from error
            retry = True
            await self.transport.pause(0.02)

    async def _follow(self, listener: Listener, *, retry: bool) -> None:
        ready = listener.ready = asyncio.get_running_loop().create_future()
        try:
            async with self._lock:
                if ready.done():
                    ready.result()
                self._enter(listener)
                wire = self._subscribed.get(listener.topic)
                if wire is None or not wire.alive:
                    with self._beginning([listener]):
                        node = await self.transport.owner(listener.topic.name, refresh=retry)
                        wire = await self._subscribe_at(node, [listener.topic])
                if listener.stored:
                    await self.invalidations.turn_on(wire)
                self._invite(wire, listener)
                listener.start(wire, Beginning.FIRST)
            await ready
        except BaseException as error:
            self._drop(listener)
            if self._closed and isinstance(error, RedisError):
                raise InterfaceClosed("this RedisInterface was closed during the call") from None
            raise
        finally:
            listener.ready = None
            if ready.done() and not ready.cancelled():
                ready.exception()  # it was raised, or is overtaken by a cancellation

    def _enter(self, listener: Listener) -> None:
        """Add a listener before the server confirms: a notice right behind that must find it."""
        if not self._topics:
            self._pace = listener.max_batch_delay
        self.limit_batch_delay(listener.max_batch_delay)
        self._heartbeats.limit_period(listener.heartbeat)
        self._topics.setdefault(listener.topic, ListenerGroup()).add(listener)

    def limit_batch_delay(self, max_batch_delay: float) -> None:
        """Have updates wait for each other at most so many seconds from now on, whatever listens."""
        self._pace = min(self._pace, max_batch_delay)
        for wire in self._wires.values():
            wire.pace = self._pace

    async def _connected(self, node: Transport) -> Wire:
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")
        wire = self._wires.get(node)
        if wire is None or not wire.alive:
            wire = await cast("AsyncTransport", node).listen(self._inbox.take, self._on_lost)
            if self._closed:  # meanwhile: nothing else would close it
                await wire.discard()
                raise InterfaceClosed("this RedisInterface was closed during the call")
            self._wires[node], wire.pace = wire, self._pace
            self._heartbeats.start(wire)
        return wire

    def _confirmed(self, topic: Topic, wire: Wire) -> None:
        """Note a subscription. Its listeners resynchronise, except those that are just beginning."""
        if self._subscribed.get(topic) is wire:
            return
        self._subscribed[topic] = wire
        self._forget_if_empty(topic)  # who asked for it was cancelled
        for listener in self._listeners([topic]):
            if listener not in self._beginners:
                self._invite(wire, listener)
                listener.start(wire, Beginning.AFTER_LOSS)

    def _invite(self, wire: Wire, listener: Listener) -> None:
        if listener.local:
            self._subscribing.invite(wire, listener.topic)

    def _listeners(self, topics: Iterable[Topic] | None = None) -> list[Listener]:
        wanted = list(self._topics if topics is None else topics)
        return [listener for topic in wanted for listener in self._topics.get(topic, NO_LISTENERS).present()]

    async def fence(self, channels: Iterable[str] | None = None) -> None:
        """Return when all that was published before now has been delivered; raises ConnectionLost.

        One round trip; in a cluster, up to a second more for keys that a pattern has found just now. `channels` are
        those of the keys that matter; of all if not given.
        """
        await asyncio.gather(*[wire.roundtrip([("PING",)]) for wire in self._wires.values() if wire.alive])
        await self._key_watcher.settled(None if channels is None else [each.encode() for each in channels])

    async def unfollow(self, listener: Listener) -> None:
        if listener.topic.pattern:
            await self._key_watcher.unfollow(listener)
        await self.unfollow_here(listener)

    async def unfollow_here(self, listener: Listener) -> None:
        self._drop(listener)
        for queue in listener.queues:
            queue.close()

    async def retire(self, listener: Listener) -> None:
        """Unsubscribe the one listener to a topic; it gets what the server has delivered until then. One round trip."""
        try:
            wire = self._subscribed.pop(listener.topic, None)
            self._subscribing.leave(wire, listener.topic)
            if wire is not None and wire.alive:
                with contextlib.suppress(ReemError, RedisError, OSError):  # its subscriptions end with a connection
                    await wire.roundtrip([("PING",)])
        finally:
            await self.unfollow_here(listener)

    def _drop(self, listener: Listener) -> None:
        listener.lost(InterfaceClosed("this subscription was closed before it began"))
        group = self._topics.get(listener.topic, NO_LISTENERS)
        if listener in group.present():
            group.discard(listener)
            self._forget_if_empty(listener.topic)

    def _forget_if_empty(self, topic: Topic) -> None:
        if self._topics.get(topic, NO_LISTENERS).present():
            return
        self._topics.pop(topic, None)
        self._subscribing.leave(self._subscribed.pop(topic, None), topic)

    def forget_empty(self) -> list[Listener]:
        if self._local.host:
            self._local.reader.let_go()
        for topic in [topic for topic, group in self._topics.items() if not group.present()]:
            self._forget_if_empty(topic)  # all were dropped without closing
        return self._listeners()

    def listeners_over(self, wire: Wire) -> list[Listener]:
        return self._listeners([topic for topic, there in self._subscribed.items() if there is wire])

    def answered(self) -> None:
        if not self.transport.sharded:  # a node says nothing of the others
            self.transport.states.answered()

    def on_note(self, listener: Listener, note: Reply) -> None:
        if isinstance(note, Moved):  # this node is only a replica now
            self._moved([listener.topic], str(note))
        elif not isinstance(note, Exception):
            listener.on_note(note)

    def _moved(self, topics: list[Topic], reason: str) -> None:
        for topic in topics:
            wire = self._subscribed.pop(topic, None)
            if wire is None:  # we have left it ourselves
                continue
            if wire.alive:
                wire.leave(topic.name)
            for listener in self._listeners([topic]):
                listener.lost(NotConnected(f"{topic.name.decode(errors='replace')}: {reason}"))
            self._repair()

    def _on_lost(self, wire: Wire, reason: Exception) -> None:
        self._heartbeats.lost(wire)
        topics = [topic for topic, there in self._subscribed.items() if there is wire]
        for topic in topics:
            del self._subscribed[topic]
        for node, there in list(self._wires.items()):
            if there is wire:
                del self._wires[node]
        listeners = self._listeners(topics)
        for listener in listeners:
            listener.lost(reason)
        if listeners and not self._closed:
            why = str(reason).removesuffix("; the call was applied once or not at all")  # this is no call
            logger.warning("the subscription connection was lost, reconnecting: %s", why)
            self.transport.states.lost(reason)
            self.transport.states.retrying()
        self._repair()

    def _repair(self) -> None:
        if not self._closed and self._reconnecting is None and self._missing():
            self._reconnecting = self.tasks.start(self._reconnect(), "reem reconnect")

    def _missing(self) -> list[Topic]:
        if self._closed:
            return []
        return [
            topic
            for topic, group in self._topics.items()
            if ((wire := self._subscribed.get(topic)) is None or not wire.alive) and group.present()
        ]

    async def _reconnect(self) -> None:
        pause = 0.05
        try:
            while self._missing():
                await asyncio.sleep(pause * random.uniform(0.5, 1.0))  # noqa: S311 - only spreads the load
                pause = min(pause * 2, _LONGEST_PAUSE)
                if not self._missing():
                    return
                try:
                    async with self._lock:
                        await self._resubscribe()
                except InterfaceClosed:
                    return
                except (ReemError, RedisError, OSError) as error:  # a file of certificates that is being replaced, too
                    logger.debug("not connected yet: %s", error)
        finally:
            self._reconnecting = None

    async def _resubscribe(self) -> None:
        """Subscribe what is missing, node by node; raise the last failure when all that could be done is done."""
        missing: dict[Transport, list[Topic]] = {}
        for place, topic in enumerate(self._missing()):
            missing.setdefault(await self.transport.owner(topic.name, refresh=place == 0), []).append(topic)
        failure: Exception | None = None
        for node, topics in missing.items():
            try:
                await self._subscribe_at(node, topics)
            except (ReemError, RedisError, OSError) as error:
                failure = error
        if failure is not None:
            raise failure

    async def _subscribe_at(self, node: Transport, topics: list[Topic]) -> Wire:
        """Subscribe to topics at `node`. Existing listeners resynchronise; new ones start by themselves."""
        wire = await self._connected(node)
        if self._inbox.watchers.present() or any(listener.stored for listener in self._listeners(topics)):
            await self.invalidations.turn_on(wire)
        await self._subscribing.subscribe(wire, topics)
        return wire

    async def close(self) -> None:
        self._closed = True
        if self.is_here:
            self._inbox.early.close()
        if self.place != (os.getpid(), asyncio.get_running_loop()):
            return  # its connections are the parent's, or went with their event loop
        # First, since a task may be slow to end: loops over what is followed do not wait for it.
        for listener in self._everybody():
            await self.unfollow(listener)
        try:
            await self.tasks.end()
        finally:
            await close_all(list(self._wires.values()))

    def end_loops(self) -> None:
        """End the loops of threads over updates, though the event loop may be busy. Any thread may."""
        for listener in self._everybody():
            for queue in listener.queues:
                if queue.wake is noop:  # else it wakes something in the event loop, which no other thread may
                    queue.close()

    def _everybody(self) -> list[Listener]:
        """Return all listeners, also those to patterns in a cluster. Any thread may ask."""
        return [*self._key_watcher.listeners(), *self._listeners()]

    @property
    def is_here(self) -> bool:
        """Whether it goes on: not in a forked child, nor when its event loop was closed. Any thread may ask."""
        pid, loop = self.place
        return pid == os.getpid() and not loop.is_closed()


class Heartbeats:
    """Asks over each connection for the notes of the last updates each second, and for the types of documents.

    These also make the server notice a key whose time to live has passed.
    """

    def __init__(self, manager: SubscriptionManager) -> None:
        self._manager = manager
        self._period = _PERIOD
        self._beating: dict[Wire, asyncio.Task[Any]] = {}

    def start(self, wire: Wire) -> None:
        self._beating[wire] = self._manager.tasks.start(self._beat(wire), "reem heartbeat")

    def lost(self, wire: Wire) -> None:
        self._beating.pop(wire, None)

    def limit_period(self, seconds: float) -> None:
        if seconds < self._period:
            self._period = seconds
            for wire, task in list(self._beating.items()):
                task.cancel()
                self.start(wire)

    async def _beat(self, wire: Wire) -> None:
        loop = asyncio.get_running_loop()
        looked = loop.time()
        while True:
            await asyncio.sleep(self._period)
            if not wire.alive:
                return
            notes, answered, now = [], loop.create_future(), loop.time()
            if now - looked > _PERIOD - self._period / 2:
                looked = now
                self._period = self._needed()
                notes = self._notes(wire)
            asked: list[Command] = [("GET", note) for note in notes] or [("PING",)]
            self._probe(wire, now)
            wire.send(asked, partial(self._on_notes, wire, notes, answered))
            await answered  # a connection breaks only if nothing newer waits on it

    # Functions of their own, since a task that held listeners while it waits would keep those that are dropped.

    def _needed(self) -> float:
        return min([_PERIOD, *(listener.heartbeat for listener in self._manager.forget_empty())])

    def _notes(self, wire: Wire) -> list[str]:
        return sorted({listener.note for listener in self._manager.listeners_over(wire) if listener.note is not None})

    def _probe(self, wire: Wire, now: float) -> None:
        """Ask for the types of the documents that are due by the middle of this period."""
        documents: dict[str, list[weakref.ref[Listener]]] = {}
        for listener in self._manager.listeners_over(wire):
            if (document := listener.probe(now + self._period / 2)) is not None:
                documents.setdefault(document, []).append(weakref.ref(listener))
        if documents:
            asked: list[Command] = [("TYPE", document) for document in documents]
            wire.send(asked, partial(self._on_probes, list(documents.values()), now))

    def _on_probes(self, asked: list[list[weakref.ref[Listener]]], sent: float, kinds: list[Reply] | Exception) -> None:
        if isinstance(kinds, Exception):
            return
        for group, kind in zip(asked, kinds, strict=True):
            for reference in group:
                if (listener := reference()) is not None:
                    listener.on_probe(kind, sent)

    def _on_notes(
        self, wire: Wire, names: list[str], answered: asyncio.Future[None], notes: list[Reply] | Exception
    ) -> None:
        if not answered.done():  # cancelled
            answered.set_result(None)
        if isinstance(notes, Exception):
            return
        self._manager.answered()
        if not names:
            return
        found = dict(zip(names, notes, strict=False))
        for listener in self._manager.listeners_over(wire):
            if listener.note in found:
                self._manager.on_note(listener, found[listener.note])
