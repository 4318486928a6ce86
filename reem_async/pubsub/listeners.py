"""Who is told of updates, and how many of them wait for one topic."""

from __future__ import annotations

import asyncio
import functools
import logging
import math
import weakref
from collections.abc import Callable, Iterable
from enum import Enum, auto
from typing import Any, Concatenate, NamedTuple, ParamSpec, Protocol

from ..concurrency.queues import BoundedQueue
from ..plan import Reply
from ..plan.notices import Notice
from ..transport.wire import Wire

__all__ = [
    "NOBODY",
    "Beginning",
    "ForwardingListener",
    "Listener",
    "ListenerGroup",
    "Topic",
    "contained",
    "give_error",
    "is_invalidation",
    "is_message",
]

logger = logging.getLogger("reem.subscribe")

Arguments = ParamSpec("Arguments")


class Topic(NamedTuple):
    """What to subscribe to.

    Attributes:
        name: A channel, or
        pattern: if this is set, a glob pattern of channels.
    """

    name: bytes
    pattern: bool = False


class Beginning(Enum):
    """How a listener begins over a connection."""

    FIRST = auto()
    """For the first time: it has missed nothing."""

    AFTER_LOSS = auto()
    """After a connection was lost, or a slot moved: nobody knows what was published meanwhile."""


def contained(method: Callable[Concatenate[Any, Arguments], None]) -> Callable[Concatenate[Any, Arguments], None]:
    """Have an exception in a listener's method end that listener: others share the connection that it came over."""

    @functools.wraps(method)
    def call(listener: Any, /, *args: Arguments.args, **kwargs: Arguments.kwargs) -> None:
        try:
            method(listener, *args, **kwargs)
        except Exception as error:
            listener.fail(error)

    return call


class Listener(Protocol):
    """Who is told of updates.

    Attributes:
        topic: What it subscribes to.
        note: The key where the server keeps a note of the last update, None if there are many.
        ready: Done when it has begun to follow.
        queues: Where each update goes.
        patience: Seconds that updates may wait for each other before it is told.
        stored: It wants to know of keys that were changed, not only of what is published.
        heartbeat: Seconds between probes that it needs; infinite if those that all get will do.
        local: It takes large values from the memory of publishers of the same host.
    """

    topic: Topic
    note: str | None
    ready: asyncio.Future[None] | None
    queues: list[BoundedQueue]
    patience: float
    stored: bool
    heartbeat: float
    local: bool

    def start(self, wire: Wire, beginning: Beginning) -> None:
        """Begin over `wire`, which is subscribed."""

    def lost(self, reason: Exception) -> None:
        """Note that the connection is gone."""

    def doubt(self, channel: bytes) -> None:
        """Note that something was published on `channel` that could not be read."""

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        """Take one update."""

    def on_early(self, notice: Notice) -> None:
        """Take an update that the server may not have yet, and may yet refuse."""

    def changed(self, key: str | None) -> None:
        """Note that a key of what is followed was changed, the document's or an attachment's; None for every key."""

    def on_note(self, note: bytes | None) -> None:
        """Compare with the server's note of the last update; all before it has been handed over."""

    def probe(self, now: float) -> str | None:
        """Return the document whose type the server is to be asked for now, None if it is not."""

    def on_probe(self, kind: Reply, sent: float) -> None:
        """Compare with the type of the document, asked for at `sent`; all before it has been handed over."""

    def fail(self, error: Exception) -> None:
        """End for an exception in this listener: those who take updates from it get the error."""


def give_error(listener: Listener | ForwardingListener, error: Exception) -> None:
    """Report the exception that has ended a listener, and give it to those who wait for its updates."""
    logger.error("a subscription of %s has ended over an error of its own", listener.topic.name, exc_info=error)
    if listener.ready is not None and not listener.ready.done():
        listener.ready.set_exception(error)
    for queue in listener.queues:
        queue.close(error)


class ForwardingListener:
    """What listeners have in common that keep no copy of a key and only hand on what they hear.

    Args:
        topic: What it subscribes to.
        patience: Seconds that updates may wait for each other before it is told.
        queues: What ends when it is followed no more.
    """

    def __init__(self, topic: Topic, patience: float = 0.0, queues: Iterable[BoundedQueue] = ()) -> None:
        self.topic = topic
        self.patience = patience
        self.queues: list[BoundedQueue] = [*queues]
        self.note: str | None = None  # there are many, or others compare it
        self.ready: asyncio.Future[None] | None = None
        self.stored = False
        self.heartbeat = math.inf
        self.local = False

    def fail(self, error: Exception) -> None:
        """End for an exception in this listener: those who take updates from it get the error."""
        give_error(self, error)

    def start(self, wire: Wire, beginning: Beginning) -> None:
        """Begin: there is nothing to fetch."""
        if self.ready is not None and not self.ready.done():
            self.ready.set_result(None)

    def lost(self, reason: Exception) -> None:
        """Tell whoever waits for the beginning."""
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(reason)

    def on_early(self, notice: Notice) -> None:
        """It comes again when the server has it."""

    def changed(self, key: str | None) -> None:
        """Nothing is asked for."""

    def on_note(self, note: bytes | None) -> None:
        """Nothing to compare."""

    def probe(self, now: float) -> str | None:
        """No document is followed."""

    def on_probe(self, kind: Reply, sent: float) -> None:
        """Nothing to compare."""


class ListenerGroup:
    """Who listens to one topic, held weakly. A WeakSet does the same but takes as long as decoding a notice."""

    __slots__ = ("_references",)

    def __init__(self) -> None:
        self._references: list[weakref.ref[Listener]] = []

    def add(self, listener: Listener) -> None:
        """Take somebody in; once is enough."""
        if listener not in self.present():
            self._references.append(weakref.ref(listener, self._references.remove))

    def discard(self, listener: Listener) -> None:
        """Let somebody go who may be there."""
        for reference in tuple(self._references):
            if reference() is listener:
                self._references.remove(reference)

    def present(self) -> list[Listener]:
        """Return all who are still there, in the order in which they came."""
        # A tuple first: another thread may drop its subscriber, which removes a reference, meanwhile.
        return [listener for reference in tuple(self._references) if (listener := reference()) is not None]


NOBODY = ListenerGroup()

_LENGTHS = {b"message": 3, b"pmessage": 4, b"smessage": 3, b"sunsubscribe": 3}


def is_invalidation(message: list[Any]) -> bool:
    """Return whether what was pushed names keys that were changed, or says that all were (None)."""
    if len(message) != 2 or message[0] != b"invalidate":
        return False
    return message[1] is None or (type(message[1]) is list and all(type(name) is bytes for name in message[1]))


def is_message(message: list[Any]) -> bool:
    """Return whether what was pushed is what a manager is told: its kind, the pattern if any, channel, and payload."""
    length = _LENGTHS.get(message[0]) if message and type(message[0]) is bytes else None
    return len(message) == length and type(message[1]) is bytes and type(message[-2]) is bytes
