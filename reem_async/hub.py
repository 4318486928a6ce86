"""The hub: the subscription connections of an interface, kept alive for all that follow.

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
from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from .audience import NOBODY, Audience, Listener, Topic, is_message
from .background import in_background
from .errors import BadData, ClusterNode, InterfaceClosed, NotConnected, RedisError
from .plan import Reply, blamed
from .plan.notices import decode
from .ships.registry import Ships
from .transport import Transport
from .transport.redirects import is_moved, is_unapplied
from .transport.wire import Wire

if TYPE_CHECKING:
    from .discovery import Discovery
    from .transport.aio import AsyncTransport

__all__ = ["Hub", "Listener", "Topic"]

logger = logging.getLogger("reem.subscribe")

_LONGEST_PAUSE = 0.5
"""Seconds between tries to connect: with one that hangs before it, still less than two in all."""

_HEARTBEAT = 1.0
"""Seconds between looks at a subscribed connection; one that is dead shows a call's time limit later."""


class Hub:
    """The subscription connections of an interface in one event loop, and who listens, by topic.

    Attributes:
        place: The process and the event loop it belongs to.
        callers: What makes calls for updates, kept here although nobody else may hold on to it.
    """

    def __init__(self, transport: Transport, ships: Ships) -> None:
        self.transport = transport
        self._ships = ships
        self._wires: dict[Transport, Wire] = {}
        self._topics: dict[Topic, Audience] = {}
        self._subscribed: dict[Topic, Wire] = {}
        self._unsure: set[Topic] = set()  # their keys are on their way to another node
        self._lock = asyncio.Lock()
        self._reconnecting: asyncio.Task[Any] | None = None
        self._beating: dict[Wire, asyncio.Task[Any]] = {}
        self._discovery: Discovery | None = None
        self._pace = 0.0
        self._closed = False
        self._warned = False
        self.callers: set[Any] = set()
        self.place = os.getpid(), asyncio.get_running_loop()

    async def follow(self, listener: Listener) -> None:
        """Subscribe, then let the listener begin; when this returns, no later update is missed."""
        self.transport.check()
        await self._ships.ready()
        if listener.topic.pattern and self.transport.sharded:
            await self._discover().follow(listener)
        else:
            await self.follow_here(listener)

    async def follow_all(self, listeners: Sequence[Listener]) -> None:
        """Follow many channels: one round trip for each node, and more only where a slot has moved."""
        self.transport.check()
        await self._ships.ready()
        with contextlib.suppress(RedisError):  # what could not be subscribed now is tried one by one
            async with self._lock:
                await self._subscribe_all(listeners)
        for listener in listeners:
            await self.follow_here(listener)

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
                    raise NotConnected(f"{error}; the cluster is being changed: nothing is followed yet") from error
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
                listener.start(wire, "initial")
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
        self._topics.setdefault(listener.topic, Audience()).add(listener)

    def hurry(self, patience: float) -> None:
        """Have updates wait for each other no longer than so many seconds from now on, whoever listens."""
        self._pace = min(self._pace, patience)
        for wire in self._wires.values():
            wire.pace = self._pace

    def _discover(self) -> Discovery:
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")
        if self._discovery is None:
            from .discovery import Discovery

            self._discovery = Discovery(self)
        return self._discovery

    async def _connected(self, node: Transport) -> Wire:
        """Return a live connection to `node`."""
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")
        wire = self._wires.get(node)
        if wire is None or not wire.alive:
            wire = await cast("AsyncTransport", node).listen(self._on_push, self._on_lost)
            if self._closed:  # meanwhile: nobody else would close it
                await wire.close()
                raise InterfaceClosed("this RedisInterface was closed during the call")
            self._wires[node], wire.pace = wire, self._pace
            self._beating[wire] = in_background(self._beat(wire), "reem heartbeat")
        return wire

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
        if self._discovery is not None:
            await self._discovery.settled()

    async def unfollow(self, listener: Listener) -> None:
        """Stop following. Idempotent."""
        if self._discovery is not None and listener.topic.pattern:
            await self._discovery.unfollow(listener)
        await self.unfollow_here(listener)

    async def unfollow_here(self, listener: Listener) -> None:
        """Stop following what the servers themselves know as a topic."""
        self._drop(listener)
        for mailbox in listener.mailboxes:
            mailbox.close()

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
        if wire is None or not wire.alive:
            return
        if self._prefix(topic) == "S":
            wire.leave(topic.name)
        else:
            wire.send([(f"{self._prefix(topic)}UNSUBSCRIBE", topic.name)], lambda _: None)

    def _on_push(self, message: list[Any]) -> None:
        if not is_message(message):
            self._warn_unreadable(b"?", BadData(f"the server pushed {message!r:.60}"))
            return
        topic: Any = (message[1], message[0] == b"pmessage")  # equal to a Topic, and cheaper to make
        if message[0] == b"sunsubscribe":
            self._moved([Topic(*topic)], "its slot has moved to another node")
            return
        channel, payload = message[-2:]
        listeners = self._topics.get(topic, NOBODY).present()
        if not listeners:  # all were dropped without closing
            self._forget_if_empty(Topic(*topic))
            return
        try:
            notice = decode(payload, self._ships)
        except BadData as error:
            self._warn_unreadable(channel, error)
            for listener in listeners:
                listener.doubt()
            return
        for listener in listeners:
            listener.on_notice(notice, channel)

    async def _beat(self, wire: Wire) -> None:
        """Ask every second for the notes of the last updates: shows a dead connection, and a lost last notice."""
        while True:
            await asyncio.sleep(_HEARTBEAT)
            if not wire.alive:
                return
            listeners = self._listeners([topic for topic, there in self._subscribed.items() if there is wire])
            notes = sorted({listener.note for listener in listeners if listener.note is not None})
            wire.send([("GET", note) for note in notes] or [("PING",)], partial(self._on_notes, wire, notes))

    def _on_notes(self, wire: Wire, names: list[str], notes: list[Reply] | Exception) -> None:
        if isinstance(notes, Exception):
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
                    each.doubt()
            listener.on_note(note)

    def _warn_unreadable(self, channel: bytes, error: Exception) -> None:
        if not self._warned:
            self._warned = True
            logger.warning("a message on %r could not be read: %s (said once)", channel, error)

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
            self.transport.states.retrying()
        self._repair()

    def _repair(self) -> None:
        """See to it that all that is followed is subscribed, in the background."""
        if not self._closed and self._reconnecting is None and self._missing():
            self._reconnecting = in_background(self._reconnect(), "reem reconnect")

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
        try:
            await self._subscribe(wire, topics)
        finally:
            for topic in topics:
                if self._subscribed.get(topic) is wire and wire.alive:
                    for listener in self._listeners([topic]):
                        if id(listener) not in first:
                            listener.start(wire, "gap")
        return wire

    async def close(self) -> None:
        """End all listeners and the connections. Idempotent."""
        self._closed = True
        if self._discovery is not None:
            await self._discovery.close()
        for task in (self._reconnecting, *self._beating.values()):
            if task is not None:
                task.cancel()
        for listener in self._listeners():
            await self.unfollow(listener)
        for wire in list(self._wires.values()):
            await wire.close()
