"""Listeners, and the inbox that hands them what the server pushes: updates, invalidation messages, moved slots."""

from __future__ import annotations

import asyncio
import functools
import logging
import math
from collections.abc import Callable, Iterable, Mapping
from enum import Enum, auto
from typing import Any, Concatenate, NamedTuple, ParamSpec

from ..concurrency.locks import WeakList
from ..concurrency.queues import BoundedQueue
from ..errors import BadData
from ..local.path import LocalPath
from ..plan import Reply
from ..plan.notices import ANNOUNCED, Notice, decode
from ..plan.paths import names_key, shorten
from ..ships.registry import Ships
from ..transport import Transport
from ..transport.wire import Wire
from .early import EarlyInbox

logger = logging.getLogger("reem.subscribe")

Arguments = ParamSpec("Arguments")
_MOST_WARNINGS = 100  # channels of whose unreadable messages a warning is logged: any client may make up channels


class Topic(NamedTuple):
    """What to subscribe to: a channel, or a glob pattern of channels."""

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
    """Return whether a push names keys that were changed, or says that all were (None)."""
    if len(message) != 2 or message[0] != b"invalidate":
        return False
    return message[1] is None or (type(message[1]) is list and all(type(name) is bytes for name in message[1]))


def is_message(message: list[Any]) -> bool:
    """Return whether a push is a message for subscribers: its kind, the pattern if any, channel, and payload."""
    length = _LENGTHS.get(message[0]) if message and type(message[0]) is bytes else None
    return len(message) == length and type(message[1]) is bytes and type(message[-2]) is bytes


class Inbox:
    """Notifies each listener of what is pushed for it."""

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
        self._view = local.view if local.host else None
        # The end of the channels on which publishers of this host ask for subscribers; None if that is off
        self._asks = f"@{local.host}".encode() if local.host else None
        self._moved = moved  # called with topics that their server does not have any more, and why
        self._empty = empty  # called with a topic that has no listener any more
        self.early = EarlyInbox(self._take_early)
        # The bytes are decoded once if the server's are equal
        self._last_early: tuple[bytes, Notice | None] = b"", None
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
        if self._asks is not None and channel.endswith(self._asks) and not topic[1]:
            self.early.answer(channel.removesuffix(self._asks), payload)  # empty if its publisher is not an early one
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
            early, notice = self._last_early
            if view is None or payload != early or notice is None:
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

    def _take_early(self, channel: bytes, payload: bytes) -> None:
        topic: Any = (channel, False)
        listeners = [listener for listener in self._topics.get(topic, NO_LISTENERS).present() if listener.local]
        if not listeners:
            return
        try:
            notice = decode(payload, self._ships, self._view)
            self._last_early = payload, notice if notice.slot is None else None  # no slot is kept from its publisher
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
