"""What is sent over a subscription connection, and the inbox that hands listeners what the server pushes.

Sent: SUBSCRIBE, CLIENT TRACKING, and TYPE to touch keys. Pushed: updates, invalidation messages, moved slots.
"""

from __future__ import annotations

import asyncio
import collections
import functools
import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum, auto
from functools import partial
from typing import Any, Concatenate, NamedTuple, ParamSpec

from ..concurrency.locks import Descriptor, WeakList
from ..concurrency.queues import BoundedQueue
from ..errors import BadData, ServerNotReady, is_of_command
from ..local import LocalPath
from ..plan import Reply, blamed
from ..plan.notices import ANNOUNCED, Notice, decode
from ..plan.paths import names_key, shorten
from ..ships.registry import Ships
from ..transport import Transport
from ..transport.wire import Wire
from .early import EarlyInbox

logger = logging.getLogger("reem.subscribe")

Arguments = ParamSpec("Arguments")
_MOST_EARLY = 100  # early updates that wait for those of the server
_MOST_WARNINGS = 100  # channels of whose unreadable messages a warning is logged: any client may make up channels


class Topic(NamedTuple):
    name: bytes
    pattern: bool = False


class Beginning(Enum):
    FIRST = auto()
    AFTER_LOSS = auto()  # of a connection, or a slot has moved: what was published meanwhile is unknown


def contained(method: Callable[Concatenate[Any, Arguments], None]) -> Callable[Concatenate[Any, Arguments], None]:
    """Have an exception in a listener's method end only that listener: others share the connection."""

    @functools.wraps(method)
    def call(listener: Any, /, *args: Arguments.args, **kwargs: Arguments.kwargs) -> None:
        try:
            method(listener, *args, **kwargs)
        except Exception as error:
            listener.fail(error)

    return call


class Listener:
    """What is notified of updates. Its methods do nothing unless a listener needs them."""

    def __init__(self, topic: Topic, max_batch_delay: float = 0.0, queues: Iterable[BoundedQueue] = ()) -> None:
        self.topic = topic
        self.max_batch_delay = max_batch_delay  # seconds that updates may wait for each other before it is notified
        self.queues: list[BoundedQueue] = [*queues]
        # The key where the server keeps a note of the last update; None if there are many, or others compare it
        self.note: str | None = None
        self.ready: asyncio.Future[None] | None = None  # done when it has begun to follow
        self.stored = False  # it is notified of keys that were changed, not only of what is published
        self.heartbeat = math.inf  # seconds between probes that it needs; infinite if those that all get will do
        self.takes_messages = False  # what comes on its channel are no notices: `on_message` takes it
        self.local = False  # it takes large values from the memory of publishers of the same host

    def start(self, wire: Wire, beginning: Beginning) -> None:
        """Begin over `wire`, which is subscribed."""
        if self.ready is not None and not self.ready.done():
            self.ready.set_result(None)

    def lost(self, reason: Exception) -> None:
        """The connection is gone. A call that waits for the beginning gets `reason`."""
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(reason)

    def invalidate(self, channel: bytes) -> None:
        """A message on `channel` could not be read."""

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        """Take one update."""

    def on_message(self, payload: bytes) -> None:
        """Take one message that is no notice; raises BadData for what is none of its kind either."""

    def on_early(self, notice: Notice) -> None:
        """Take an update that the server may not have yet, and may yet refuse."""

    def changed(self, key: str | None) -> None:
        """A document or attachment was changed; None for every key."""

    def on_note(self, note: bytes | None) -> None:
        """Compare with the server's note of the last update; all before it has been handed over."""

    def probe(self, now: float) -> str | None:
        """Return the document whose type the server is to be asked for now, None if it is not."""
        return None

    def on_probe(self, kind: Reply, sent: float) -> None:
        """Compare with the type of the document, asked for at `sent`; all before it has been handed over."""

    def fail(self, error: Exception) -> None:
        """End for an exception in this listener: readers of its queues get the error."""
        logger.error("a subscription of %s has ended over an error of its own", self.topic.name, exc_info=error)
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(error)
        for queue in self.queues:
            queue.close(error)


class ListenerGroup(WeakList[Listener]):
    """The listeners to one topic, in the order in which they came."""

    def add(self, item: Listener) -> None:
        if item not in self.present():
            super().add(item)

    def discard(self, listener: Listener) -> None:
        for reference in tuple(self._references):
            if reference() is listener:
                self._references.remove(reference)


NO_LISTENERS = ListenerGroup()

_LENGTHS = {b"message": 3, b"pmessage": 4, b"smessage": 3, b"sunsubscribe": 3}


def is_invalidation(message: list[Any]) -> bool:
    if len(message) != 2 or message[0] != b"invalidate":
        return False
    return message[1] is None or (type(message[1]) is list and all(type(name) is bytes for name in message[1]))


def is_message(message: list[Any]) -> bool:
    length = _LENGTHS.get(message[0]) if message and type(message[0]) is bytes else None
    return len(message) == length and type(message[1]) is bytes and type(message[-2]) is bytes


class Inbox:
    def __init__(
        self,
        transport: Transport,
        ships: Ships,
        topics: Mapping[Topic, ListenerGroup],
        local: LocalPath,
        moved: Callable[[list[Topic], str], None],
        empty: Callable[[Topic], None],
    ) -> None:
        self._transport = transport
        self._ships = ships
        self._topics = topics
        self._local = local
        self._view = local.view if local.host else None
        # The end of the channels on which publishers of this host ask for subscribers; None if that is off
        self._asks = f"@{local.host}".encode() if local.host else None
        self._moved = moved  # called with topics that their server does not have any more, and why
        self._empty = empty  # called with a topic that has no listener any more
        self.early = EarlyInbox(self._take_early)
        # Early updates by their bytes: those of the server are equal, and are not decoded again
        self._early: collections.OrderedDict[bytes, Notice] = collections.OrderedDict()
        self._warned: set[bytes] = set()
        # Notified of every key that the server says was changed, whichever listener read it
        self.watchers = ListenerGroup()
        database = transport.options.database
        self._tail = b"}:notices" + (f"@{database}".encode() if database else b"")

    def take(self, message: list[Any]) -> None:
        if not is_message(message):
            if is_invalidation(message):
                self._changed(message[1])
                return
            self._unreadable(b"?", BadData(f"the server pushed {message!r:.60}"))
            return
        topic: Any = (message[1], message[0] == b"pmessage")  # equal to a Topic, and cheaper to make
        if message[0] == b"sunsubscribe":
            self._moved([Topic(*topic)], "its slot has moved to another node")
            return
        channel, payload = message[-2:]
        if self._asks is not None and channel.endswith(self._asks):
            if not topic[1]:  # what follows a pattern has large values from shared memory, and no early updates
                self.early.answer(channel.removesuffix(self._asks), payload)  # empty if its publisher is not early
            return
        self.early.read()  # first what was sent before: a busy program finds both at once
        listeners = self._topics.get(topic, NO_LISTENERS).present()
        if not listeners:  # all were dropped without closing
            self._empty(Topic(*topic))
            return
        if listeners[0].takes_messages:
            for listener in listeners:
                try:
                    listener.on_message(payload)
                except Exception as error:  # as below
                    self._unreadable(channel, error)
            return
        if topic[1] and not names_key(channel):
            self._unreadable(channel, BadData("no key can have it for a channel"))
            return
        try:
            # A loop, since a generator would take as long as the rest.
            view = self._view if [1 for listener in listeners if listener.local] else None
            notice = None if view is None else self._early.pop(payload, None)
            if notice is None:
                notice = decode(payload, self._ships, view)
        except BadData as error:
            self._unreadable(channel, error)
            for listener in listeners:
                listener.invalidate(channel)
            return
        for listener in listeners:
            try:
                seen = listener.local or notice.slot is None  # else the listener does not read the publisher's memory
                listener.on_notice(notice if seen else notice._replace(value=ANNOUNCED), channel)
            except Exception as error:  # one message must not end the connection for all that follow
                self._unreadable(channel, error)
                listener.invalidate(channel)

    def _take_early(self, channel: bytes, payload: bytes, memory: Descriptor | None) -> None:
        topic: Any = (channel, False)
        listeners = [listener for listener in self._topics.get(topic, NO_LISTENERS).present() if listener.local]
        if not listeners:
            return
        try:
            notice = decode(payload, self._ships, partial(self._local.view, passed=memory))
            if notice.slot is None:  # none is kept from its publisher
                self._early[payload] = notice
                if len(self._early) > _MOST_EARLY:
                    self._early.popitem(last=False)
            early = notice._replace(early=True)
            for listener in listeners:
                listener.on_early(early)
        except Exception as error:  # as above; what the server has then is delivered in any case
            self._unreadable(channel, error)

    def _changed(self, names: Any) -> None:
        if names is None:
            for group in (*self._topics.values(), self.watchers):
                for listener in group.present():
                    listener.changed(None)
            return
        for name in names:
            document = name[1:].partition(b"}")[0] if name[:1] == b"{" else name
            topic: Any = (b"{" + document + self._tail, False)
            text = name.decode(errors="replace")
            for listener in (*self._topics.get(topic, NO_LISTENERS).present(), *self.watchers.present()):
                listener.changed(text)

    def _unreadable(self, channel: bytes, error: Exception) -> None:
        """Count a message, and warn of the first of each channel."""
        self._transport.states.unreadable += 1
        if channel not in self._warned and len(self._warned) < _MOST_WARNINGS:
            self._warned.add(channel)
            logger.warning(
                "a message on %s could not be read and is left out: %s (reported once for each channel; "
                "interface.unreadable counts them)",
                shorten(channel),
                error,
            )


_TRACK = ("CLIENT", "TRACKING", "ON")  # not BCAST: the server would compare each write with the prefixes of all


class Subscribing:
    def __init__(
        self,
        transport: Transport,
        host: str | None,  # what names this host to publishers that share memory with it; none if that is off
        confirmed: Callable[[Topic, Wire], None],  # called when the server has confirmed a subscription
        joined: Callable[[bytes], None],  # called with a channel of which publishers here can count the listeners now
    ) -> None:
        self._transport = transport
        self._host = host
        self._on_confirmed = confirmed
        self._on_joined = joined
        self._invited: set[Topic] = set()  # publishers of this host know of a listener

    async def subscribe(self, wire: Wire, topics: Sequence[Topic]) -> None:
        """Subscribe and wait until the server has confirmed each topic; raise the first refusal."""
        answers: list[asyncio.Future[None]] = []
        if len(topics) > 1:
            wire.send([("PING",)], lambda _: None)  # what is sent behind it in this turn is confirmed in one turn, too
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
