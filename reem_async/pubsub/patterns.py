"""Subscriptions to patterns of channels: what a `Monitor` and a `PatternWatch` have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TypeVar

from ..concurrency.queues import Policy
from ..concurrency.streams import Stream
from ..errors import InterfaceClosed
from ..plan.paths import Pattern, channel_pattern
from ..session import Session
from .listeners import Listener, Topic
from .manager import SubscriptionManager, manager_of

Item = TypeVar("Item")


class PatternStream(Stream[Item]):
    """Subscribes to the channels of all keys that some patterns name."""

    def __init__(self, session: Session, patterns: Sequence[Pattern], policy: Policy) -> None:
        super().__init__(policy)
        self.patterns = list(patterns) or [Pattern("*")]
        self.tops = list(dict.fromkeys(pattern.top for pattern in self.patterns))  # globs of top-level keys
        self._session = session
        self._listeners: list[Listener] = []
        self._manager: SubscriptionManager | None = None

    @property
    def _begun(self) -> bool:
        """Whether it has begun, in this process and in an event loop that is not closed."""
        return self._manager is not None and self._manager.is_here

    @property
    def _following(self) -> bool:
        return self._begun or self._closed

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later change is missed. Idempotent.

        One round trip for each pattern, and a few for each key that a watch of patterns follows.
        """
        if self._closed:
            raise InterfaceClosed(f"this {type(self).__name__} is closed; make a new one")
        if self._begun:
            return
        await self._leave()  # what was begun in another event loop or process
        manager = self._manager = manager_of(self._session)
        try:
            for top in self.tops:
                listener = self._listener(Topic(self._channels(Pattern(top)), pattern=True))
                self._listeners.append(listener)
                await manager.follow(listener)
            await self._begin(manager)
        except BaseException:
            for listener in self._listeners:
                listener.queues = []  # the stream goes on: listen() may be called again
            await self._leave()
            self._manager = None
            raise

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await super().close()
        await self._leave()

    async def _leave(self) -> None:
        leaving, self._listeners = self._leaving(), []
        for listener in leaving:
            if self._manager is not None and self._begun:
                self._manager.unwatch(listener)
                await self._manager.unfollow(listener)

    def _leaving(self) -> list[Listener]:
        """Return all listeners that must be unsubscribed."""
        return self._listeners

    def _channels(self, pattern: Pattern) -> bytes:
        return channel_pattern(pattern, self._session.namespace, self._session.options.database)

    @abstractmethod
    def _listener(self, topic: Topic) -> Listener:
        """Return a new listener to one pattern of channels."""

    async def _begin(self, manager: SubscriptionManager) -> None:
        """Do what follows on the subscriptions."""
