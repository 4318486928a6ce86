"""The connection that notices and word of changes come on, as the recorder needs it."""

from __future__ import annotations

from typing import Any, Protocol

from ...plan.patterns import Pattern, channel_pattern
from ...pubsub.listeners import Beginning, ForwardingListener
from ...pubsub.manager import Topic
from ...session import Session
from ...transport.wire import Wire

__all__ = ["HURRIED", "PATIENCE", "Subscription"]

PATIENCE = 0.01
"""Seconds that updates may wait to be recorded, several at once. The publisher's time in them is not touched."""

HURRIED = 0.002
"""The same, once large updates were seen to come fast: each is to be fetched before the next one replaces it."""


class Told(Protocol):
    """Who is told what was changed, and that updates may be lost."""

    session: Session
    patterns: list[Pattern]

    def lost(self) -> None:
        """Take note."""

    def changed(self, key: str | None) -> None:
        """Take the server's word that a key was changed."""


class Subscription(ForwardingListener):
    """The connection that notices come on, word of its loss and of changes: a listener of the subscription manager.

    Args:
        recorder: Who is told.

    Attributes:
        wire: The connection, None while there is none.
    """

    def __init__(self, recorder: Told) -> None:
        self._recorder = recorder
        session = recorder.session
        name = channel_pattern(recorder.patterns[0]._replace(rest=()), session.namespace, session.options.database)
        super().__init__(Topic(name, pattern=True), PATIENCE)  # one that the monitor has anyway
        self.wire: Wire | None = None

    @property
    def leisurely(self) -> bool:
        """Whether nobody waits for the notices."""
        return self.wire is not None and self.wire.leisurely

    def start(self, wire: Wire, beginning: Beginning) -> None:
        """Take the connection; after a broken one, have all keys read anew."""
        self.wire = wire
        if beginning is Beginning.AFTER_LOSS:
            self._recorder.lost()
        super().start(wire, beginning)

    def lost(self, reason: Exception) -> None:
        """Note that the connection is gone."""
        self.wire = None
        super().lost(reason)

    def changed(self, key: str | None) -> None:
        """Hand it on."""
        self._recorder.changed(key)

    def doubt(self, channel: bytes) -> None:
        """Do nothing: the monitor has it too."""

    def on_notice(self, notice: Any, channel: bytes) -> None:
        """Do nothing: the monitor has it too."""
