"""What the server pushes over subscription connections: updates, and word of what was changed or has moved."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

from ..errors import BadData
from ..local.path import LocalPath
from ..plan.notices import ANNOUNCED, Notice, decode
from ..plan.paths import shorten
from ..plan.patterns import names_key
from ..ships.registry import Ships
from ..transport import Transport
from .listeners import NOBODY, ListenerGroup, Topic, is_invalidation, is_message

__all__ = ["Inbox"]

logger = logging.getLogger("reem.subscribe")

_MOST_WARNINGS = 100
"""Channels of whose unreadable messages is told: anybody may publish on any number of them."""


class Inbox:
    """Tells each listener what is pushed for him.

    Args:
        transport: Whose server it is.
        ships: What carries values that are not JSON.
        topics: Who listens to what.
        local: How values in the memory of publishers of the same host are looked at.
        moved: Called with topics that their server does not have any more, and why.
        empty: Called with a topic that nobody listens to any more.

    Attributes:
        watchers: Who is told of every key that the server says was changed, whoever read it.
    """

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
        self._early = f"@{local.host}".encode() if local.host else None
        self._moved = moved
        self._empty = empty
        self._warned: set[bytes] = set()
        self.watchers = ListenerGroup()
        database = transport.options.database
        self._tail = b"}:notices" + (f"@{database}".encode() if database else b"")

    def take(self, message: list[Any]) -> None:
        """Take one message."""
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
        if self._early is not None and channel.endswith(self._early) and not topic[1]:
            self._take_early(channel.removesuffix(self._early), payload)
            return
        listeners = self._topics.get(topic, NOBODY).present()
        if not listeners:  # all were dropped without closing
            self._empty(Topic(*topic))
            return
        if topic[1] and not names_key(channel):
            self._unreadable(channel, BadData("no key can have it for a channel"))
            return
        try:
            # A loop, since a generator would take as long as the rest.
            view = self._view if [1 for listener in listeners if listener.local] else None
            notice = decode(payload, self._ships, view)
        except BadData as error:
            self._unreadable(channel, error)
            for listener in listeners:
                listener.doubt(channel)
            return
        for listener in listeners:
            try:
                listener.on_notice(notice if listener.local or notice.slot is None else _unseen(notice), channel)
            except Exception as error:  # one message must not end the connection for all that follow
                self._unreadable(channel, error)
                listener.doubt(channel)

    def _take_early(self, channel: bytes, payload: bytes) -> None:
        """Take what a publisher near by says before the server has it; an empty message only asks who listens."""
        topic: Any = (channel, False)
        listeners = [listener for listener in self._topics.get(topic, NOBODY).present() if listener.local]
        if not payload or not listeners:
            return
        try:
            notice = decode(payload, self._ships, self._view)._replace(early=True)
            for listener in listeners:
                listener.on_early(notice)
        except Exception as error:  # as above; what the server has then is told as ever
            self._unreadable(channel, error)

    def _changed(self, names: Any) -> None:
        """Tell who follows a document that the server says was changed; names of keys, or None for all."""
        if names is None:
            for group in (*self._topics.values(), self.watchers):
                for listener in group.present():
                    listener.changed(None)
            return
        for name in names:
            document = name[1:].partition(b"}")[0] if name[:1] == b"{" else name
            topic: Any = (b"{" + document + self._tail, False)
            text = name.decode(errors="replace")
            for listener in (*self._topics.get(topic, NOBODY).present(), *self.watchers.present()):
                listener.changed(text)

    def _unreadable(self, channel: bytes, error: Exception) -> None:
        """Count a message, and tell of the first of each channel."""
        self._transport.states.unreadable += 1
        if channel not in self._warned and len(self._warned) < _MOST_WARNINGS:
            self._warned.add(channel)
            logger.warning(
                "a message on %s could not be read and is left out: %s (said once for each channel; "
                "interface.unreadable counts them)",
                shorten(channel),
                error,
            )


def _unseen(notice: Notice) -> Notice:
    """Return a notice for who does not look into the memory of others."""
    return notice._replace(value=ANNOUNCED)
