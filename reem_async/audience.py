"""Who is told of updates, and how many of them wait for one topic."""

from __future__ import annotations

import asyncio
import weakref
from typing import Any, NamedTuple, Protocol

from .plan.notices import Notice
from .policy import Mailbox
from .transport.wire import Wire

__all__ = ["NOBODY", "Audience", "Listener", "Topic", "is_message"]


class Topic(NamedTuple):
    """What to subscribe to.

    Attributes:
        name: A channel, or
        pattern: if this is set, a glob pattern of channels.
    """

    name: bytes
    pattern: bool = False


class Listener(Protocol):
    """Who is told of updates.

    Attributes:
        topic: What it subscribes to.
        note: The key where the server keeps a note of the last update, None if there are many.
        ready: Done when it has begun to follow.
        mailboxes: Where each update goes.
        patience: Seconds that updates may wait for each other before it is told.
    """

    topic: Topic
    note: str | None
    ready: asyncio.Future[None] | None
    mailboxes: list[Mailbox]
    patience: float

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


class Audience:
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


NOBODY = Audience()

_LENGTHS = {b"message": 3, b"pmessage": 4, b"smessage": 3, b"sunsubscribe": 3}


def is_message(message: list[Any]) -> bool:
    """Return whether what was pushed is what a hub is told: its kind, the pattern if any, channel, and payload."""
    length = _LENGTHS.get(message[0]) if message and type(message[0]) is bytes else None
    return len(message) == length and type(message[1]) is bytes and type(message[-2]) is bytes
