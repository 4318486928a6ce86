"""The facade's event loop: one named daemon thread per interface, started when first needed.

Plain reads and writes never come here: they run on the caller's thread. The loop serves what has to
wait for others: subscriptions, and ships with `async def` methods.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from reem_async.errors import WrongLoop

__all__ = ["Portal", "finish"]

Result = TypeVar("Result")


def finish(coroutine: Coroutine[Any, Any, Result]) -> Result:
    """Run a coroutine that never suspends, and return its result.

    Over a blocking transport the core's coroutines do all their waiting in system calls, so one step
    takes them to the end.
    """
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value  # type: ignore[no-any-return]
    coroutine.close()
    raise WrongLoop("this call has to wait for something that only an event loop can do")


def _new_loop() -> asyncio.AbstractEventLoop:
    try:
        import uvloop
    except ImportError:
        return asyncio.new_event_loop()
    return uvloop.new_event_loop()


class Portal:
    """An event loop in a daemon thread, and the way into it."""

    def __init__(self, name: str) -> None:
        self._loop = _new_loop()
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_forever()
        finally:
            left = asyncio.all_tasks(self._loop)
            for task in left:
                task.cancel()
            if left:
                self._loop.run_until_complete(asyncio.wait(left, timeout=1.0))
            self._loop.close()

    @property
    def inside(self) -> bool:
        """Whether the caller is on the loop's own thread."""
        return threading.current_thread() is self._thread

    def call(self, coroutine: Coroutine[Any, Any, Result], timeout: float | None = None) -> Result:
        """Run `coroutine` on the loop and wait for its result. Ctrl-C cancels it."""
        if self.inside or not self._thread.is_alive():
            coroutine.close()
            raise WrongLoop(
                "a blocking call of REEM on REEM's own event loop thread would wait for itself; use reem_async there"
                if self.inside
                else "this interface's event loop has ended"
            )
        future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result(timeout)
        except BaseException:
            future.cancel()
            raise

    def stop(self) -> None:
        """End the loop and wait for the thread, unless this is it. Idempotent."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            if not self.inside:
                self._thread.join(2.0)
