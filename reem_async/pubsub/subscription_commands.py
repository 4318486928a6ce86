"""What is sent over a subscription connection: SUBSCRIBE, CLIENT TRACKING and periodic probes."""

from __future__ import annotations

import asyncio
import logging
import weakref
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Protocol

from ..concurrency.tasks import Tasks
from ..errors import ServerNotReady, is_of_command
from ..plan import Command, Reply, blamed
from ..transport import Transport
from ..transport.wire import Wire
from .listeners import Listener, Topic

logger = logging.getLogger("reem.subscribe")

_TRACK = ("CLIENT", "TRACKING", "ON")
"""Not BCAST: that has the server look through the prefixes of all who watch for each write of anybody."""
_PERIOD = 1.0  # seconds between looks at a connection; one that is dead shows a call's time limit later


class Subscribing:
    """Subscribes to topics over connections that the caller chooses."""

    def __init__(
        self,
        transport: Transport,
        host: str | None,
        confirmed: Callable[[Topic, Wire], None],
        joined: Callable[[bytes], None],
    ) -> None:
        self._transport = transport
        self._host = host  # what names this host to publishers that share memory with it; none if that is off
        # Called with a topic and the connection when the server has confirmed a subscription
        self._on_confirmed = confirmed
        # Called with a channel of which publishers on this host can count the listeners now
        self._on_joined = joined
        self._invited: set[Topic] = set()  # publishers of this host know of a listener

    async def subscribe(self, wire: Wire, topics: Iterable[Topic]) -> None:
        """Subscribe and wait until the server has confirmed each topic; raise the first refusal."""
        answers: list[asyncio.Future[None]] = []
        for topic in topics:
            answer = asyncio.get_running_loop().create_future()
            answers.append(answer)
            # Noted in order with what is pushed: the word that the slot has moved may come right behind.
            wire.send([self._command(topic)], partial(self._confirmed, topic, wire, answer))
        outcomes = await asyncio.gather(*answers, return_exceptions=True)
        for outcome in outcomes:
            if outcome is not None:
                raise outcome

    def _confirmed(
        self, topic: Topic, wire: Wire, answer: asyncio.Future[None], replies: list[Reply] | Exception
    ) -> None:
        refusal = replies if isinstance(replies, Exception) else replies[0]
        if not isinstance(refusal, Exception):
            self._on_confirmed(topic, wire)
        if answer.done():  # cancelled
            return
        if isinstance(refusal, Exception):
            answer.set_exception(refusal if self._transport.sharded else blamed(refusal, self._command(topic)))
        else:
            answer.set_result(None)

    def invite(self, wire: Wire, topic: Topic) -> None:
        """Have publishers of this host know that a listener reads their memory; a refusal means that they do not."""
        if self._host:
            self._invited.add(topic)
            wire.send([self._command(self._near(topic))], lambda _: self._on_joined(topic.name))

    def leave(self, wire: Wire | None, topic: Topic) -> None:
        left = [topic, self._near(topic)] if topic in self._invited else [topic]
        self._invited.discard(topic)
        if wire is None or not wire.alive:
            return
        for each in left:
            if self._prefix(each) == "S":
                wire.leave(each.name)
            else:
                wire.send([(f"{self._prefix(each)}UNSUBSCRIBE", each.name)], lambda _: None)

    def _near(self, topic: Topic) -> Topic:
        return Topic(topic.name + f"@{self._host}".encode(), topic.pattern)

    def _command(self, topic: Topic) -> tuple[str, bytes]:
        return f"{self._prefix(topic)}SUBSCRIBE", topic.name

    def _prefix(self, topic: Topic) -> str:
        return "P" if topic.pattern else "S" if self._transport.sharded else ""


class Invalidations:
    """Turns the server's messages on; a user without the right is warned, once for each interface."""

    def __init__(self) -> None:
        self._warned = False

    async def turn_on(self, wire: Wire) -> None:
        """Have the server tell of changes of what is read over a connection; at most one round trip."""
        if wire.tracked is not None:
            return
        (reply,) = await wire.roundtrip([_TRACK])
        if isinstance(reply, ServerNotReady):
            raise blamed(reply, _TRACK)
        if isinstance(reply, Exception):
            self._refused(wire, blamed(reply, _TRACK), "+client|tracking")
        else:
            wire.tracked = True

    async def touch(self, wire: Wire, names: Iterable[str], touched: Callable[[], None]) -> bool:
        """Do as `SubscriptionManager.touch`, over a connection."""
        if not wire.alive or not wire.tracked:
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
            self.may_not_touch(wire, refused[0])
        return not refused

    def may_not_touch(self, wire: Wire, refusal: Exception) -> None:
        self._refused(wire, blamed(refusal, ("TYPE",)), "+type")

    def _refused(self, wire: Wire, reason: Exception, right: str) -> None:
        wire.tracked = False
        if not self._warned:
            self._warned = True
            logger.warning(
                "the server does not report what is stored without publishing: only published updates are delivered; "
                "recordings read the rest at keyframes, and the page every second: %s "
                "(the user needs the right %s, as in deploy/users.acl)",
                reason,
                right,
            )


class Connections(Protocol):
    """What is needed of the subscription manager, which imports this module."""

    tasks: Tasks

    def listeners_over(self, wire: Wire) -> list[Listener]: ...
    def forget_empty(self) -> list[Listener]: ...
    def answered(self) -> None: ...
    def on_note(self, listener: Listener, note: Reply) -> None: ...


class Heartbeats:
    """Asks over each connection for the notes of the last updates, every second.

    Asks for the types of documents as often as their listeners need it. This also makes the server notice a key whose
    time to live has passed. Belongs to an event loop.
    """

    def __init__(self, manager: Connections) -> None:
        self._manager = manager
        self._period = _PERIOD
        self._beating: dict[Wire, asyncio.Task[Any]] = {}

    def start(self, wire: Wire) -> None:
        self._beating[wire] = self._manager.tasks.start(self._beat(wire), "reem heartbeat")

    def lost(self, wire: Wire) -> None:
        self._beating.pop(wire, None)

    def limit_period(self, seconds: float) -> None:
        """Send probes at least that often as long as a listener needs it."""
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
        """Return the seconds between looks that those who still listen need."""
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
