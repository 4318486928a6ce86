"""An async iterator over a bounded queue: what loops over updates have in common."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Generic, Self, TypeVar

from ..errors import BadType, InterfaceClosed
from .queues import EMPTY, BoundedQueue, Ended, Policy, noop
from .timeouts import waiting_limit

Item = TypeVar("Item")


class Following:
    """What begins to follow in `listen` and ends in `close`; `async with` calls both."""

    async def listen(self) -> None:
        """Begin to follow."""
        raise NotImplementedError

    async def close(self) -> None:
        """Stop following."""
        raise NotImplementedError

    async def __aenter__(self) -> Self:
        await self.listen()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class Stream(Following, Generic[Item]):
    """Yields what arrives in a bounded queue, one by one. Cancelling a waiting loop loses nothing."""

    def __init__(self, policy: Policy, queue: BoundedQueue | None = None) -> None:
        self.queue = queue or BoundedQueue(policy)
        self._closed = False
        self._waiter: asyncio.Future[None] | None = None

    @property
    def dropped(self) -> int:
        """How many updates were skipped since they were not taken in time."""
        return self.queue.dropped

    @property
    def _following(self) -> bool:
        """Whether it follows, or did until it was closed; what began elsewhere does not (after a fork, say)."""
        raise NotImplementedError

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        self._closed = True
        self.queue.close()

    async def aclose(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await self.close()

    async def next(self, timeout: float | None = None) -> Item:  # noqa: ASYNC109
        """Return the next update: as the loop does, but with a time limit.

        It begins to follow first, if need be, which the limit does not count. A call that times out loses no update.

        Args:
            timeout: Seconds to wait, 0 for what has arrived already. None for the limit of a
                `with reem_async.timeout(...)` block around the call; outside of one there is no limit.

        Raises:
            TimeoutError: No update has arrived in time.
            InterfaceClosed: It was closed, and all updates were taken.
            QueueFull: The policy allows no skipped update.
        """
        limit = waiting_limit(timeout)
        if not self._following:
            await self.listen()
        try:
            async with asyncio.timeout(limit):
                return await anext(self)
        except StopAsyncIteration:
            raise _closed() from None
        except TimeoutError:
            raise _timed_out(limit) from None

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Item:
        while True:
            try:
                item = self.queue.take()
            except Ended:
                raise StopAsyncIteration from None
            if item is not EMPTY:
                return item  # type: ignore[no-any-return]
            await (self._changed() if self._following else self.listen())

    async def _changed(self) -> None:
        if self._waiter is not None and not self._waiter.get_loop().is_closed():
            raise BadType("two tasks take updates from one subscription; make one for each")
        waiter = self._waiter = asyncio.get_running_loop().create_future()
        self.queue.wake = self._wake
        try:
            await waiter
        finally:
            if self._waiter is waiter:  # else it was left behind by an event loop that was closed
                self._waiter = None
                self.queue.wake = noop  # a reference back would keep a stream that was dropped

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done() and not self._waiter.get_loop().is_closed():
            try:
                self._waiter.set_result(None)
            except asyncio.InvalidStateError:  # Ctrl-C cancels between any two steps of Python
                return


def next_on_thread(queue: BoundedQueue, timeout: float | None) -> Any:
    limit = waiting_limit(timeout)
    try:
        item = queue.take_waiting() if limit is None else queue.take_within(limit)
    except Ended:
        raise _closed() from None
    if item is EMPTY:
        raise _timed_out(limit)
    return item


def _closed() -> InterfaceClosed:
    return InterfaceClosed("this subscription is closed; make a new one")


def _timed_out(seconds: float | None) -> TimeoutError:
    return TimeoutError(f"no update has arrived within {seconds:g} s")


def arrived(stream: Stream[Item]) -> Iterator[Item]:
    with suppress(Ended):
        while (item := stream.queue.take()) is not EMPTY:
            yield item
