"""The subscription manager: the subscription connections of an interface, kept alive for all that follow.

One server needs one. In a cluster a channel belongs to a node, as its key does, so there is one for
each node where somebody listens; when a slot moves, what is followed there begins anew on its new
node, with a gap.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from ..concurrency.tasks import Tasks
from ..errors import ClusterNode, InterfaceClosed, NotConnected, RedisError, is_of_command
from ..local.path import LocalPath
from ..plan import Command, Reply, blamed
from ..session import Session
from ..ships.registry import Ships
from ..transport import Transport
from ..transport.redirects import is_moved, is_unapplied
from ..transport.wire import Wire
from .inbox import Inbox
from .listeners import NOBODY, Beginning, Listener, ListenerGroup, Topic

if TYPE_CHECKING:
    from ..transport.aio import AsyncTransport
    from .key_watcher import KeyWatcher

__all__ = ["Listener", "SubscriptionManager", "Topic", "manager_of"]

logger = logging.getLogger("reem.subscribe")

_LONGEST_PAUSE = 0.5
"""Seconds between tries to connect: with one that hangs before it, still less than two in all."""

_HEARTBEAT = 1.0
"""Seconds between looks at a subscribed connection; one that is dead shows a call's time limit later."""


_TRACK = ("CLIENT", "TRACKING", "ON")
"""Not BCAST: that has the server look through the prefixes of all who watch for each write of anybody."""


def manager_of(session: Session) -> SubscriptionManager:
    """Return the subscription manager of a session in the running event loop; made when first asked for."""
    session.transport.check()
    place = os.getpid(), asyncio.get_running_loop()
    manager = session.subscriptions
    if not isinstance(manager, SubscriptionManager) or manager.place != place:
        manager = session.subscriptions = SubscriptionManager(session.transport, session.ships, session.local)
    return manager


class SubscriptionManager:
    """The subscription connections of an interface in one event loop, and who listens, by topic.

    Attributes:
        place: The process and the event loop it belongs to.
        callers: What makes calls for updates, kept here although nobody else may hold on to it.
        tasks: All that runs in the background for what is followed; ended by `close`.
    """

    def __init__(self, transport: Transport, ships: Ships, local: LocalPath) -> None:
        self.transport = transport
        self._local = local
        self._ships = ships
        self._wires: dict[Transport, Wire] = {}
        self._topics: dict[Topic, ListenerGroup] = {}
        self._subscribed: dict[Topic, Wire] = {}
        self._invited: set[Topic] = set()  # publishers of this host know that somebody listens
        self._unsure: set[Topic] = set()  # their keys are on their way to another node
        self._lock = asyncio.Lock()
        self.tasks = Tasks()
        self._reconnecting: asyncio.Task[Any] | None = None
        self._beating: dict[Wire, asyncio.Task[Any]] = {}
        self._key_watcher: KeyWatcher | None = None
        self._pace, self._period = 0.0, _HEARTBEAT
        self._closed = False
        self._warned_of_stored = False
        self._inbox = Inbox(transport, ships, self._topics, local, self._moved, self._forget_if_empty)
        self.callers: set[Any] = set()
        self.place = os.getpid(), asyncio.get_running_loop()

    async def follow(self, listener: Listener) -> None:
        """Subscribe, then let the listener begin; when this returns, no later update is missed."""
        self.transport.check()
        await self._ships.ready()
        if listener.topic.pattern and self.transport.sharded:
            await self._watch_keys().follow(listener)
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
                await self._track(wire)

    def unwatch(self, watcher: Listener) -> None:
        """Tell a listener no more. Idempotent."""
        self._inbox.watchers.discard(watcher)

    @property
    def hears_of_changes(self) -> bool:
        """Whether no server has refused to tell which keys are changed."""
        return all(wire.tracked is not False for wire in self._wires.values())

    async def touch(self, channel: str, names: Iterable[str], touched: Callable[[], None]) -> bool:
        """Read keys of a channel's top-level key, so that the server tells once when they are changed. One round trip.

        Returns whether it will tell. `touched` is called in order with what it tells: what it has told of before was
        changed before. When this returns it may have told more.
        """
        wire = self._subscribed.get(Topic(channel.encode()))
        if wire is None and not self.transport.sharded:  # all are on one connection
            wire = next(iter(self._wires.values()), None)
        if wire is None or not wire.alive or not wire.tracked:
            return False
        answered = asyncio.get_running_loop().create_future()

        def done(outcome: list[Reply] | Exception) -> None:
            touched()
            if not answered.done():  # cancelled
                answered.set_result(outcome)

        wire.send([("TYPE", name) for name in names], done)
        outcome = await answered
        if isinstance(outcome, Exception):
            raise outcome
        refused = [reply for reply in outcome if isinstance(reply, Exception)]
        if any(is_of_command(reply) for reply in refused):
            self._cannot_track(wire, blamed(refused[0], ("TYPE",)), "+type")
        return not refused

    async def subscribe_all(self, listeners: Sequence[Listener]) -> None:
        """Subscribe to many channels ahead of following them, which tries again what cannot be subscribed now."""
        self.transport.check()
        await self._ships.ready()
        with contextlib.suppress(RedisError):
            async with self._lock:
                await self._subscribe_all(listeners)

    async def _subscribe_all(self, listeners: Sequence[Listener]) -> None:
        nodes: dict[Transport, list[Listener]] = {}
        for listener in listeners:
            if listener.topic not in self._subscribed:
                nodes.setdefault(await self.transport.owner(listener.topic.name), []).append(listener)
        for node, there in nodes.items():
            for listener in there:
                self._enter(listener)
            await self._subscribe_at(node, [listener.topic for listener in there], there)

    async def follow_here(self, listener: Listener) -> None:
        """Follow what the servers themselves know as a topic."""
        deadline = time.monotonic() + self.transport.timeout
        anew = False
        while True:
            try:
                await self._follow(listener, anew=anew)
                return
            except RedisError as error:
                unapplied = is_unapplied(error) or isinstance(error, NotConnected | ClusterNode)
                if not self.transport.sharded or not unapplied or self._closed:
                    raise
                if time.monotonic() > deadline:
                    fact = error.fact if isinstance(error, ClusterNode) else str(error)
                    raise NotConnected(f"{fact}; the cluster is being changed: nothing is followed yet") from error
            anew = True
            await self.transport.pause(0.02)

    async def _follow(self, listener: Listener, *, anew: bool) -> None:
        ready = listener.ready = asyncio.get_running_loop().create_future()
        try:
            async with self._lock:
                if ready.done():
                    ready.result()
                self._enter(listener)
                wire = self._subscribed.get(listener.topic)
                if wire is None or not wire.alive:
                    node = await self.transport.owner(listener.topic.name, anew=anew)
                    others = [topic for topic in self._missing() if await self.transport.owner(topic.name) is node]
                    wire = await self._subscribe_at(node, others, [listener])
                if listener.stored:
                    await self._track(wire)
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
        """Note who listens, before the server confirms: a notice right behind that must find somebody."""
        if not self._topics:
            self._pace = listener.patience
        self.hurry(listener.patience)
        self._beat_every(listener.heartbeat)
        self._topics.setdefault(listener.topic, ListenerGroup()).add(listener)

    def hurry(self, patience: float) -> None:
        """Have updates wait for each other no longer than so many seconds from now on, whoever listens."""
        self._pace = min(self._pace, patience)
        for wire in self._wires.values():
            wire.pace = self._pace

    def _beat_every(self, seconds: float) -> None:
        """Look at subscribed connections that often while a listener needs it, if that is more often than until now."""
        if seconds < self._period:
            self._period = seconds
            for wire, task in list(self._beating.items()):
                task.cancel()
                self._beating[wire] = self.tasks.start(self._beat(wire), "reem heartbeat")

    def _watch_keys(self) -> KeyWatcher:
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")
        if self._key_watcher is None:
            from .key_watcher import KeyWatcher

            self._key_watcher = KeyWatcher(self)
        return self._key_watcher

    async def _connected(self, node: Transport) -> Wire:
        """Return a live connection to `node`."""
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")
        wire = self._wires.get(node)
        if wire is None or not wire.alive:
            wire = await cast("AsyncTransport", node).listen(self._inbox.take, self._on_lost)
            if self._closed:  # meanwhile: nobody else would close it
                await wire.close()
                raise InterfaceClosed("this RedisInterface was closed during the call")
            self._wires[node], wire.pace = wire, self._pace
            self._beating[wire] = self.tasks.start(self._beat(wire), "reem heartbeat")
        return wire

    async def _track(self, wire: Wire) -> None:
        """Have the server tell of changes of what is read over a connection; who may not ask for it is warned once."""
        if wire.tracked is not None:
            return
        (reply,) = await wire.roundtrip([_TRACK])
        if isinstance(reply, Exception):
            self._cannot_track(wire, blamed(reply, _TRACK), "+client|tracking")
        else:
            wire.tracked = True

    def _cannot_track(self, wire: Wire, reason: Exception, right: str) -> None:
        wire.tracked = False
        if not self._warned_of_stored:
            self._warned_of_stored = True
            logger.warning(
                "what is only stored cannot be followed at this server, only what is published is told; a recording "
                "has the rest at its keyframes, and the page looks for it: %s "
                "(the user needs the right %s, as in deploy/users.acl)",
                reason,
                right,
            )

    async def _subscribe(self, wire: Wire, topics: Iterable[Topic]) -> None:
        """Subscribe and wait until the server has confirmed each topic; raise the first refusal."""
        answers: list[asyncio.Future[None]] = []
        for topic in topics:
            answer = asyncio.get_running_loop().create_future()
            answers.append(answer)
            # Noted in order with what is pushed: the word that the slot has moved may come right behind.
            wire.send([(f"{self._prefix(topic)}SUBSCRIBE", topic.name)], partial(self._confirmed, topic, wire, answer))
        outcomes = await asyncio.gather(*answers, return_exceptions=True)
        for outcome in outcomes:
            if outcome is not None:
                raise outcome

    def _confirmed(
        self, topic: Topic, wire: Wire, answer: asyncio.Future[None], replies: list[Reply] | Exception
    ) -> None:
        refusal = replies if isinstance(replies, Exception) else replies[0]
        if not isinstance(refusal, Exception):
            self._subscribed[topic] = wire
        if answer.done():  # cancelled
            return
        if isinstance(refusal, Exception):
            command = (f"{self._prefix(topic)}SUBSCRIBE", topic.name)
            answer.set_exception(refusal if self.transport.sharded else blamed(refusal, command))
        else:
            answer.set_result(None)

    def _invite(self, wire: Wire, listener: Listener) -> None:
        """Have publishers of this host know that somebody looks into their memory; a refusal means that they do not."""
        if listener.local and self._local.host:
            near = self._near(listener.topic)
            self._invited.add(listener.topic)
            wire.send([(f"{self._prefix(near)}SUBSCRIBE", near.name)], lambda _: None)

    def _near(self, topic: Topic) -> Topic:
        return Topic(topic.name + f"@{self._local.host}".encode(), topic.pattern)

    def _prefix(self, topic: Topic) -> str:
        """Return what the server's commands for this kind of topic begin with."""
        return "P" if topic.pattern else "S" if self.transport.sharded else ""

    def _listeners(self, topics: Iterable[Topic] | None = None) -> list[Listener]:
        wanted = list(self._topics if topics is None else topics)
        return [listener for topic in wanted for listener in self._topics.get(topic, NOBODY).present()]

    async def fence(self) -> None:
        """Return when all that was published before now to what is followed has been told; one round trip.

        Raises:
            ConnectionLost: A connection broke meanwhile.
        """
        await asyncio.gather(*[wire.roundtrip([("PING",)]) for wire in self._wires.values() if wire.alive])
        if self._key_watcher is not None:
            await self._key_watcher.settled()

    async def unfollow(self, listener: Listener) -> None:
        """Stop following. Idempotent."""
        if self._key_watcher is not None and listener.topic.pattern:
            await self._key_watcher.unfollow(listener)
        await self.unfollow_here(listener)

    async def unfollow_here(self, listener: Listener) -> None:
        """Stop following what the servers themselves know as a topic."""
        self._drop(listener)
        for queue in listener.queues:
            queue.close()

    def _drop(self, listener: Listener) -> None:
        listener.lost(InterfaceClosed("this subscription was closed before it began"))
        audience = self._topics.get(listener.topic, NOBODY)
        if listener in audience.present():
            audience.discard(listener)
            self._forget_if_empty(listener.topic)

    def _forget_if_empty(self, topic: Topic) -> None:
        if self._topics.get(topic, NOBODY).present():
            return
        self._topics.pop(topic, None)
        self._unsure.discard(topic)
        wire = self._subscribed.pop(topic, None)
        invited = [self._near(topic)] if topic in self._invited else []
        self._invited.discard(topic)
        if wire is None or not wire.alive:
            return
        for each in [topic, *invited]:
            if self._prefix(each) == "S":
                wire.leave(each.name)
            else:
                wire.send([(f"{self._prefix(each)}UNSUBSCRIBE", each.name)], lambda _: None)

    async def _beat(self, wire: Wire) -> None:
        """Ask every second for the notes of the last updates: shows a dead connection, and a lost last notice.

        In between ask only for a sign of life, as often as listeners need it.
        """
        loop = asyncio.get_running_loop()
        looked = loop.time()
        while True:
            await asyncio.sleep(self._period)
            if not wire.alive:
                return
            notes, answered = [], loop.create_future()
            if loop.time() - looked > _HEARTBEAT - self._period / 2:
                looked = loop.time()
                self._let_go()
                notes = self._notes(wire)
            asked: list[Command] = [("GET", note) for note in notes] or [("PING",)]
            wire.send(asked, partial(self._on_notes, wire, notes, answered))
            await answered  # a connection breaks only if nothing newer waits on it

    def _let_go(self) -> None:
        """Forget what nobody listens to any more, and heartbeats that nobody needs."""
        if self._local.host:
            self._local.reader.let_go()
        for topic in [topic for topic, audience in self._topics.items() if not audience.present()]:
            self._forget_if_empty(topic)  # all were dropped without closing
        self._period = min([_HEARTBEAT, *(listener.heartbeat for listener in self._listeners())])

    def _notes(self, wire: Wire) -> list[str]:
        """Return the notes to ask for; apart, since a heartbeat that held listeners while it waits would keep them."""
        listeners = self._listeners([topic for topic, there in self._subscribed.items() if there is wire])
        return sorted({listener.note for listener in listeners if listener.note is not None})

    def _on_notes(
        self, wire: Wire, names: list[str], answered: asyncio.Future[None], notes: list[Reply] | Exception
    ) -> None:
        if not answered.done():  # cancelled
            answered.set_result(None)
        if isinstance(notes, Exception):
            return
        if not self.transport.sharded:  # a node says nothing of the others
            self.transport.states.answered()
        if not names:
            return
        found = dict(zip(names, notes, strict=False))
        for listener in self._listeners([topic for topic, there in self._subscribed.items() if there is wire]):
            if listener.note in found:
                self._on_note(listener, found[listener.note])

    def _on_note(self, listener: Listener, note: Reply) -> None:
        if is_moved(note):  # this node is only a replica now
            self._moved([listener.topic], str(note))
        elif is_unapplied(note):
            self._unsure.add(listener.topic)
        elif not isinstance(note, Exception):
            if listener.topic in self._unsure:  # they are back: what was published meanwhile went elsewhere
                self._unsure.discard(listener.topic)
                for each in self._listeners([listener.topic]):
                    each.doubt(listener.topic.name)
            listener.on_note(note)

    def _moved(self, topics: list[Topic], reason: str) -> None:
        """Have what is followed on these topics begin anew where they are now."""
        for topic in topics:
            wire = self._subscribed.pop(topic, None)
            self._unsure.discard(topic)
            if wire is None:  # we have left it ourselves
                continue
            if wire.alive:
                wire.leave(topic.name)
            for listener in self._listeners([topic]):
                listener.lost(NotConnected(f"{topic.name.decode(errors='replace')}: {reason}"))
            self._repair()

    def _on_lost(self, wire: Wire, reason: Exception) -> None:
        self._beating.pop(wire, None)
        topics = [topic for topic, there in self._subscribed.items() if there is wire]
        for topic in topics:
            del self._subscribed[topic]
            self._unsure.discard(topic)
        for node, there in list(self._wires.items()):
            if there is wire:
                del self._wires[node]
        listeners = self._listeners(topics)
        for listener in listeners:
            listener.lost(reason)
        if listeners and not self._closed:
            logger.warning("the subscription connection was lost and is made again: %s", reason)
            self.transport.states.lost(reason)
            self.transport.states.retrying()
        self._repair()

    def _repair(self) -> None:
        """See to it that all that is followed is subscribed, in the background."""
        if not self._closed and self._reconnecting is None and self._missing():
            self._reconnecting = self.tasks.start(self._reconnect(), "reem reconnect")

    def _missing(self) -> list[Topic]:
        """Return what is followed and not subscribed."""
        if self._closed:
            return []
        return [
            topic
            for topic, audience in self._topics.items()
            if ((wire := self._subscribed.get(topic)) is None or not wire.alive) and audience.present()
        ]

    async def _reconnect(self) -> None:
        """Connect, subscribe, and have every listener begin anew; tries until it works."""
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
                except (RedisError, OSError) as error:
                    logger.debug("not connected yet: %s", error)
                except InterfaceClosed:
                    return
        finally:
            self._reconnecting = None

    async def _resubscribe(self) -> None:
        """Subscribe what is missing, node by node; raise the last failure when all that could be done is done."""
        missing: dict[Transport, list[Topic]] = {}
        for place, topic in enumerate(self._missing()):
            missing.setdefault(await self.transport.owner(topic.name, anew=place == 0), []).append(topic)
        failure: Exception | None = None
        for node, topics in missing.items():
            try:
                await self._subscribe_at(node, topics)
            except (RedisError, OSError) as error:
                failure = error
        if failure is not None:
            raise failure

    async def _subscribe_at(self, node: Transport, topics: list[Topic], beginners: Sequence[Listener] = ()) -> Wire:
        """Subscribe topics at `node` and have who listens begin anew, but for beginners."""
        wire, first = await self._connected(node), {id(each) for each in beginners}
        if self._inbox.watchers.present() or any(listener.stored for listener in self._listeners(topics)):
            await self._track(wire)
        try:
            await self._subscribe(wire, topics)
        finally:
            for topic in topics:
                if self._subscribed.get(topic) is wire and wire.alive:
                    for listener in self._listeners([topic]):
                        if id(listener) not in first:
                            self._invite(wire, listener)
                            listener.start(wire, Beginning.AFTER_LOSS)
        return wire

    async def close(self) -> None:
        """End all listeners and the connections. Idempotent."""
        self._closed = True
        await self.tasks.end()
        beyond = self._key_watcher.listeners() if self._key_watcher is not None else []
        for listener in [*beyond, *self._listeners()]:
            await self.unfollow(listener)
        for wire in list(self._wires.values()):
            await wire.close()
