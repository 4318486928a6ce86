"""What starts with a `with` block and stops with it, in blocking and in asyncio programs."""

from __future__ import annotations

import os
import threading
import weakref
from abc import ABC, abstractmethod
from typing import Any, Self

import anyio
import anyio.to_thread


class Startable(ABC):
    """A server, or several."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._owner: int | None = None  # the process that has started it; None if none has
        self._finalizer: weakref.finalize[..., Any] | None = None

    @abstractmethod
    def start(self) -> None:
        """Start it, and wait until it answers."""

    def stop(self) -> None:
        """Stop it and wait until it is gone; nothing if it does not run. Kept data is on disk afterwards."""
        if not self._is_in_fork():
            with self._lock:
                self._clear()
                self._owner = None

    def _clear(self) -> None:
        if self._finalizer is not None:
            self._finalizer()  # runs once, here or at exit
        self._finalizer = None

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
