"""The hub: the one subscription connection of an interface, kept alive for all that follow."""

from __future__ import annotations

import asyncio
import logging
import os
import random
import weakref
from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple, Protocol

from .background import in_background
from .errors import BadData, InterfaceClosed, RedisError
from .plan import Reply
from .plan.notices import Notice, decode
from .policy import Mailbox
from .ships.registry import Ships
from .transport.aio import AsyncTransport
from .transport.wire import Wire

__all__ = ["Hub", "Listener", "Topic"]

logger = logging.getLogger("reem.subscribe")

_LONGEST_PAUSE = 0.5
"""Seconds between tries to connect: with one that hangs before it, still less than two in all."""

_HEARTBEAT = 1.0
"""Seconds between looks at a subscribed connection; one that is dead shows a call's time limit later."""


class Topic(NamedTuple):
    """What to subscribe to.

    Attributes:
        name: A channel, or
        pattern: if this is set, a glob pattern of channels.
    """

    name: bytes
    pattern: bool = False

    @property
    def prefix(self) -> str:
        """What the server's commands for this kind of topic begin with."""
        return "P" if self.pattern else ""


class Listener(Protocol):
    """Who is told of updates.

    Attributes:
        topic: What it subscribes to.
        note: The key where the server keeps a note of the last update, None if there are many.
        ready: Done when it has begun to follow.
        mailboxes: Where each update goes.
    """

    topic: Topic
    note: str | None
    ready: asyncio.Future[None] | None
    mailboxes: list[Mailbox]

    def start(self, wire: Wire, kind: str) -> None:
        """Begin over `wire`, which is subscribed; `kind` is "initial", or "gap" after a broken connection."""

    def lost(self, reason: Exception) -> None:
        """Note that the connection is gone."""

    def doubt(self) -> None:
        """Note that something was published that could not be read."""

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        """Take one update."""

    def on_note(self, note: bytes | None) -> None:
        """Compare with the server's note of the last update; all before it has been handed over."""


class _Audience:
    """Who listens to one topic, held weakly. A WeakSet does the same but takes as long as decoding a notice."""

    __slots__ = ("_references",)

    def __init__(self) -> None:
        self._references: list[weakref.ref[Listener]] = []

    def add(self, listener: Listener) -> None:
        if listener not in self.present():
            self._references.append(weakref.ref(listener, self._references.remove))

    def discard(self, listener: Listener) -> None:
        for reference in tuple(self._references):
            if reference() is listener:
                self._references.remove(reference)

    def present(self) -> list[Listener]:
        # A tuple first: another thread may drop its subscriber, which removes a reference, meanwhile.
        return [listener for reference in tuple(self._references) if (listener := reference()) is not None]


_NOBODY = _Audience()


class Hub:
    """The one subscription connection of an interface in one event loop, and who listens, by topic.

    Attributes:
        place: The process and the event loop it belongs to.
    """

    def __init__(self, transport: AsyncTransport, ships: Ships) -> None:
        self._transport = transport
        self._ships = ships
        self._wire: Wire | None = None
        self._topics: dict[Topic, _Audience] = {}
        self._subscribed: set[Topic] = set()
        self._lock = asyncio.Lock()
        self._reconnecting: asyncio.Task[Any] | None = None
        self._beating: asyncio.Task[Any] | None = None
        self._closed = False
        self._warned = False
        self.place = os.getpid(), asyncio.get_running_loop()

    async def follow(self, listener: Listener) -> None:
        """Subscribe, then let the listener begin; when this returns, no later update is missed."""
        self._transport.check()
        await self._ships.ready()
        ready = listener.ready = asyncio.get_running_loop().create_future()
        try:
            async with self._lock:
                if ready.done():
                    ready.result()
                # Entered before the server confirms: a notice right behind the confirmation must find somebody.
                self._topics.setdefault(listener.topic, _Audience()).add(listener)
                wire = await self._connected()
                if listener.topic not in self._subscribed:
                    await _subscribe(wire, [listener.topic])
                    self._subscribed.add(listener.topic)
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

    async def _connected(self) -> Wire:
        """Return a live connection, with all topics subscribed and all listeners started anew if it is new."""
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")
        if self._wire is not None and self._wire.alive:
            return self._wire
        wire = await self._transport.listen(self._on_push, self._on_lost)
        try:
            topics = [topic for topic, audience in self._topics.items() if audience.present()]
            await _subscribe(wire, topics)
        except BaseException:
            await wire.close()
            raise
        self._wire, self._subscribed = wire, set(topics)
        self._beating = in_background(self._beat(wire), "reem heartbeat")
        for listener in self._listeners():
            listener.start(wire, "gap")
        return wire

    def _listeners(self) -> list[Listener]:
        return [listener for audience in list(self._topics.values()) for listener in audience.present()]

    async def unfollow(self, listener: Listener) -> None:
        """Stop following. Idempotent."""
        self._drop(listener)
        for mailbox in listener.mailboxes:
            mailbox.close()

    def _drop(self, listener: Listener) -> None:
        listener.lost(InterfaceClosed("this subscription was closed before it began"))
        audience = self._topics.get(listener.topic, _NOBODY)
        if listener in audience.present():
            audience.discard(listener)
            self._forget_if_empty(listener.topic)

    def _forget_if_empty(self, topic: Topic) -> None:
        if not self._topics.get(topic, _NOBODY).present():
            self._topics.pop(topic, None)
            self._subscribed.discard(topic)
            if self._wire is not None and self._wire.alive:
                self._wire.send([(f"{topic.prefix}UNSUBSCRIBE", topic.name)], lambda _: None)

    def _on_push(self, message: list[Any]) -> None:
        topic: Any = (message[1], message[0] == b"pmessage")  # equal to a Topic, and cheaper to make
        channel, payload = message[-2:]
        listeners = self._topics.get(topic, _NOBODY).present()
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
            if wire is not self._wire or not wire.alive:
                return
            notes = sorted({listener.note for listener in self._listeners() if listener.note is not None})
            wire.send([("GET", note) for note in notes] or [("PING",)], partial(self._on_notes, notes))

    def _on_notes(self, names: list[str], notes: list[Reply] | Exception) -> None:
        if isinstance(notes, Exception):
            return
        found = {name: note for name, note in zip(names, notes, strict=False) if not isinstance(note, Exception)}
        for listener in self._listeners():
            if listener.note in found:
                listener.on_note(found[listener.note])

    def _warn_unreadable(self, channel: bytes, error: Exception) -> None:
        if not self._warned:
            self._warned = True
            logger.warning("a message on %r could not be read: %s (said once)", channel, error)

    def _on_lost(self, wire: Wire, reason: Exception) -> None:
        if wire is not self._wire:
            return
        self._subscribed.clear()
        for listener in self._listeners():
            listener.lost(reason)
        if not self._closed and self._reconnecting is None:
            logger.warning("the subscription connection was lost and is made again: %s", reason)
            self._transport.states.retrying()
            self._reconnecting = in_background(self._reconnect(), "reem reconnect")

    async def _reconnect(self) -> None:
        """Connect, subscribe, and have every listener begin anew; tries until it works."""
        pause = 0.05
        try:
            while self._is_wanted():
                await asyncio.sleep(pause * random.uniform(0.5, 1.0))  # noqa: S311 - only spreads the load
                pause = min(pause * 2, _LONGEST_PAUSE)
                if not self._is_wanted():
                    return
                try:
                    async with self._lock:
                        await self._connected()
                except (RedisError, OSError) as error:
                    logger.debug("not connected yet: %s", error)
                except InterfaceClosed:
                    return
        finally:
            self._reconnecting = None

    def _is_wanted(self) -> bool:
        """Return whether somebody follows and the connection is gone."""
        followed = bool(self._listeners()) and not self._closed
        return followed and (self._wire is None or not self._wire.alive)

    async def close(self) -> None:
        """End all listeners and the connection. Idempotent."""
        self._closed = True
        for task in (self._reconnecting, self._beating):
            if task is not None:
                task.cancel()
        for listener in self._listeners():
            await self.unfollow(listener)
        if self._wire is not None:
            await self._wire.close()


async def _subscribe(wire: Wire, topics: Iterable[Topic]) -> None:
    """Subscribe and wait until the server has confirmed each topic."""
    commands = [(f"{topic.prefix}SUBSCRIBE", topic.name) for topic in topics]
    for reply in await wire.roundtrip(commands):
        if isinstance(reply, Exception):
            raise reply
