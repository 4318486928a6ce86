"""The connection that notices come on, as the recorder needs it."""

from __future__ import annotations

import asyncio
from typing import Any, Protocol

from ..hub import Topic
from ..plan.patterns import Pattern, channel_pattern
from ..policy import Mailbox
from ..session import Session
from ..transport.wire import Wire

__all__ = ["HURRIED", "PATIENCE", "Line"]

PATIENCE = 0.01
"""Seconds that updates may wait to be recorded, several at once. The publisher's time in them is not touched."""

HURRIED = 0.002
"""The same, once large updates were seen to come fast: each is to be fetched before the next one replaces it."""


class Told(Protocol):
    """Who is told that updates may be lost."""

    session: Session
    patterns: list[Pattern]

    def lost(self) -> None:
        """Take note."""


class Line:
    """The connection that notices come on, and word of its loss: a listener of the hub.

    Args:
        recorder: Who is told of a loss.

    Attributes:
        wire: The connection, None while there is none.
    """

    def __init__(self, recorder: Told) -> None:
        self._recorder = recorder
        session = recorder.session
        name = channel_pattern(recorder.patterns[0]._replace(rest=()), session.namespace, session.options.database)
        self.topic = Topic(name, pattern=True)  # one that the monitor has anyway
        self.note: str | None = None
        self.ready: asyncio.Future[None] | None = None
        self.mailboxes: list[Mailbox] = []
        self.patience = PATIENCE
        self.wire: Wire | None = None

    @property
    def leisurely(self) -> bool:
        """Whether nobody waits for the notices."""
        return self.wire is not None and self.wire.leisurely

    def start(self, wire: Wire, kind: str) -> None:
        """Take the connection; after a broken one, have all keys read anew."""
        self.wire = wire
        if kind == "gap":
            self._recorder.lost()
        if self.ready is not None and not self.ready.done():
            self.ready.set_result(None)

    def lost(self, reason: Exception) -> None:
        """Note that the connection is gone."""
        self.wire = None
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(reason)

    def doubt(self) -> None:
        """Have all keys read anew: something was published that could not be read."""
        self._recorder.lost()

    def on_notice(self, notice: Any, channel: bytes) -> None:
        """Do nothing: the monitor has it too."""

    def on_note(self, note: bytes | None) -> None:
        """Do nothing: many keys have one note each."""
