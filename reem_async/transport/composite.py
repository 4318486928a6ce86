"""What the transports to one server have in common, and those to several: one lends its locks to the others."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from typing import Any, Self

from ..concurrency.timeouts import time_limit
from . import Transport
from .options import Options

NewTransport = Callable[[Options], Any]
"""Makes the transport to one server: on an event loop, or for plain threads."""


class OneServer:
    """What the transports to one server have in common."""

    sharded = False

    def __init__(self, options: Options) -> None:
        self._options = options

    @property
    def options(self) -> Options:
        return self._options

    @property
    def timeout(self) -> float:
        return time_limit(self._options.timeout)

    async def owner(self, key: bytes, *, refresh: bool = False) -> Self:
        return self

    async def nodes(self) -> Sequence[Self]:
        return (self,)


class CompositeTransport(ABC):
    """A transport over others, one of which, the root, is there from beginning to end."""

    _root: Transport

    @abstractmethod
    def _all(self) -> Iterable[Transport]:
        """Return the transports there are, the root among them."""

    async def pause(self, seconds: float) -> None:
        await self._root.pause(seconds)

    async def let_pass(self) -> bool:
        """Return False: a node that does not answer must not keep what goes to another one."""
        return False

    def is_settled(self, document: str) -> bool:
        # A key may have moved since: what was sent to any node counts.
        return all(each.is_settled(document) for each in self._all())

    async def settle(self, document: str) -> None:
        for each in list(self._all()):
            await each.settle(document)

    def ordered(self, key: str) -> AbstractAsyncContextManager[None]:
        return self._root.ordered(key)

    def broken_off(self) -> None:
        self._root.broken_off()

    def check(self) -> None:
        self._root.check()

    @property
    def options(self) -> Options:
        return self._root.options

    @property
    def timeout(self) -> float:
        return self._root.timeout

    @property
    def at_end(self) -> Callable[[], Awaitable[None]]:
        return self._root.at_end

    @at_end.setter
    def at_end(self, action: Callable[[], Awaitable[None]]) -> None:
        self._root.at_end = action

    async def release(self) -> None:
        async with AsyncExitStack() as steps:  # the last comes first, and each is taken, also if one is cancelled
            for each in reversed(list(self._all())):
                steps.push_async_callback(each.release)

    async def close(self) -> None:
        async with AsyncExitStack() as steps:  # as above
            for each in reversed(list(self._all())):
                steps.push_async_callback(each.close)
