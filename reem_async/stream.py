"""An async iterator over a mailbox: what loops over updates have in common."""

from __future__ import annotations

import asyncio
from types import TracebackType
from typing import Generic, Self, TypeVar

from .errors import BadType
from .policy import EMPTY, Ended, Mailbox, Policy

__all__ = ["Stream"]

Item = TypeVar("Item")


class Stream(Generic[Item]):
    """Yields what arrives in a mailbox, one by one. Cancelling a waiting loop loses nothing.

    Args:
        policy: What to keep for a loop that is slower than what arrives.
    """

    def __init__(self, policy: Policy) -> None:
        self.mailbox = Mailbox(policy)
        self._closed = False
        self._waiter: asyncio.Future[None] | None = None

    @property
    def dropped(self) -> int:
        """How many updates were skipped since they were not taken in time."""
        return self.mailbox.dropped

    @property
    def _following(self) -> bool:
        """Whether it follows, or did until it was closed."""
        raise NotImplementedError

    async def listen(self) -> None:
        """Begin to follow."""
        raise NotImplementedError

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        self._closed = True
        self.mailbox.close()

    async def aclose(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await self.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Item:
        if not self._following:
            await self.listen()
        while True:
            try:
                item = self.mailbox.take()
            except Ended:
                raise StopAsyncIteration from None
            if item is not EMPTY:
                return item  # type: ignore[no-any-return]
            await self._changed()

    async def _changed(self) -> None:
        """Wait until something was put into the mailbox."""
        if self._waiter is not None:
            raise BadType("two tasks take updates from one subscription; make one for each")
        self._waiter = asyncio.get_running_loop().create_future()
        self.mailbox.wake = self._wake
        try:
            await self._waiter
        finally:
            self._waiter = None

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            try:
                self._waiter.set_result(None)
            except asyncio.InvalidStateError:  # Ctrl-C cancels between any two steps of Python
                return

    async def __aenter__(self) -> Self:
        await self.listen()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()
