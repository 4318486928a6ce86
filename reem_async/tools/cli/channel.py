"""Messages that any program publishes on a channel of its own, with plain PUBLISH."""

from __future__ import annotations

from ...concurrency.queues import Last
from ...concurrency.streams import Stream
from ...plan.paths import escaped
from ...pubsub.listeners import Listener, Topic
from ...pubsub.manager import SubscriptionManager, manager_of
from ...session import Session

_WAITING = 10_000  # messages that wait for a slow terminal before the oldest are dropped


class ChannelMessages(Stream[bytes]):
    """Yields the messages on one channel, without its name."""

    def __init__(self, session: Session, channel: str) -> None:
        super().__init__(Last(_WAITING))
        self._session = session
        # A pattern that only this channel fits: in a cluster, other channels would be those of one node.
        self._listener = _MessageListener(Topic(escaped(channel).encode(), pattern=True), queues=[self.queue])
        self._listener.takes_messages = True
        self._manager: SubscriptionManager | None = None

    @property
    def _following(self) -> bool:
        return self._manager is not None

    async def listen(self) -> None:
        """Subscribe; one round trip."""
        if self._manager is None:
            manager = manager_of(self._session)
            await manager.follow_here(self._listener)
            self._manager = manager

    async def close(self) -> None:
        await super().close()
        if self._manager is not None:
            await self._manager.unfollow_here(self._listener)


class _MessageListener(Listener):
    def on_message(self, payload: bytes) -> None:
        for queue in self.queues:
            queue.put(payload)
