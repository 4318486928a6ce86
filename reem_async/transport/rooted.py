"""What the ways to several servers have in common: one of them lends its locks and its event loop to all."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable
from contextlib import AbstractAsyncContextManager, AsyncExitStack

from . import Transport
from .options import Options
from .state import States

__all__ = ["Rooted", "Standing"]


class Rooted(ABC):
    """A transport over others, one of which, the root, is there from beginning to end."""

    _root: Transport

    @abstractmethod
    def _all(self) -> Iterable[Transport]:
        """Return the transports there are, the root among them."""

    async def pause(self, seconds: float) -> None:
        """Wait."""
        await self._root.pause(seconds)

    async def let_pass(self) -> bool:
        """Return False: a node that does not answer must not keep what goes to another one."""
        return False

    def is_settled(self, document: str) -> bool:
        """Return whether nothing large, sent by callers who were cancelled since, is on its way to `document`."""
        # A key may have moved since: what was sent to any node counts.
        return all(each.is_settled(document) for each in self._all())

    async def settle(self, document: str) -> None:
        """Wait until it has arrived."""
        for each in list(self._all()):
            await each.settle(document)

    def ordered(self, key: str) -> AbstractAsyncContextManager[None]:
        """Return the lock of `key`."""
        return self._root.ordered(key)

    def broken_off(self) -> None:
        """Give back what a call of this thread holds."""
        self._root.broken_off()

    def check(self) -> None:
        """Raise if this cannot be used here."""
        self._root.check()

    @property
    def options(self) -> Options:
        """How the root's server is reached."""
        return self._root.options

    @property
    def timeout(self) -> float:
        """Seconds without a byte moving after which a call made now is given up."""
        return self._root.timeout

    @property
    def at_end(self) -> Callable[[], Awaitable[None]]:
        """What ends subscriptions and connections when the event loop in use ends."""
        return self._root.at_end

    @at_end.setter
    def at_end(self, action: Callable[[], Awaitable[None]]) -> None:
        self._root.at_end = action

    async def release(self) -> None:
        """Close the connections that are not in use; new ones are made when needed."""
        async with AsyncExitStack() as steps:  # the last comes first, and each is taken, also if one is cancelled
            for each in reversed(list(self._all())):
                steps.push_async_callback(each.release)

    async def close(self) -> None:
        """Close all connections. Idempotent."""
        async with AsyncExitStack() as steps:  # as above
            for each in reversed(list(self._all())):
                steps.push_async_callback(each.close)


class Standing(Rooted):
    """A transport that stands for its root: what users get to know of connections is about the root's."""

    @property
    def states(self) -> States:
        """What the interface's user gets to know of the connections; others than the root's do not count."""
        return self._root.states

    @states.setter
    def states(self, states: States) -> None:
        self._root.states = states
