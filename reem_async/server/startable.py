"""What starts with a `with` block and stops with it, in blocking and in asyncio programs."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from typing import Self

import anyio
import anyio.to_thread


class Startable(ABC):
    """A server, or several."""

    _owner: int | None = None
    """The process that has started it; None if none has."""

    @abstractmethod
    def start(self) -> None:
        """Start it, and wait until it answers."""

    @abstractmethod
    def stop(self) -> None:
        """End it. Idempotent."""

    @abstractmethod
    def _start(self) -> None:
        """Do what `start` does; may be interrupted anywhere."""

    def _is_in_fork(self) -> bool:
        # Asked before a lock is touched: a thread that the fork has left behind may hold it.
        return self._owner is not None and self._owner != os.getpid()

    def _start_or_stop(self) -> None:
        try:
            self._start()
        except BaseException:  # an interrupted start leaves nothing running without an owner
            self.stop()
            raise

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    async def __aenter__(self) -> Self:
        try:
            await anyio.to_thread.run_sync(self.start)
        except BaseException:  # cancelled: the thread goes on, and what it starts would have no owner
            await self._stop_shielded()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stop_shielded()

    async def _stop_shielded(self) -> None:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(self.stop)
