"""The facade's event loop: one named daemon thread per interface, started when first needed.

Plain reads and writes never come here: they run on the caller's thread. The loop serves what has to
wait for others: subscriptions, and ships with `async def` methods.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from reem_async.errors import InterfaceClosed, WrongLoop

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
        self._gate = threading.Lock()
        self._ended = False
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()
        with self._gate:
            self._ended = True
        self._loop.run_until_complete(self._end_tasks())
        self._loop.close()

    async def _end_tasks(self) -> None:
        """Cancel what still runs, including calls that were handed over just before the end."""
        await asyncio.sleep(0)
        left = asyncio.all_tasks() - {asyncio.current_task()}
        for task in left:
            task.cancel()
        if left:
            await asyncio.wait(left, timeout=1.0)

    @property
    def inside(self) -> bool:
        """Whether the caller is on the loop's own thread."""
        return threading.current_thread() is self._thread

    def call(self, coroutine: Coroutine[Any, Any, Result], timeout: float | None = None) -> Result:
        """Run `coroutine` on the loop and wait for its result. Ctrl-C cancels it."""
        if self.inside:
            coroutine.close()
            raise WrongLoop(
                "a blocking call of REEM on REEM's own event loop thread would wait for itself; use reem_async there"
            )
        with self._gate:
            if self._ended:
                coroutine.close()
                raise InterfaceClosed("this RedisInterface is closed; make a new one")
            future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result(timeout)
        except concurrent.futures.CancelledError:
            raise InterfaceClosed("this RedisInterface was closed during the call") from None
        except BaseException:
            future.cancel()
            raise

    def stop(self) -> None:
        """End the loop and wait for the thread, unless this is it. Idempotent."""
        with self._gate:
            if not self._ended:
                self._loop.call_soon_threadsafe(self._loop.stop)
        if not self.inside:
            self._thread.join(2.0)
