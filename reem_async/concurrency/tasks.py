"""Tasks that run beside the caller, and their owners."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Coroutine
from contextvars import copy_context
from typing import Any

from .timeouts import forget

_LONGEST_END = 1.0  # seconds to wait for cancelled tasks: a ship of a user's own may be at work in one


def started(coroutine: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
    """Run a coroutine as a named task. The caller keeps it: asyncio alone would let it be collected."""
    context = copy_context()
    context.run(forget)  # a time limit given for one call is not meant for what goes on after it
    return asyncio.get_running_loop().create_task(coroutine, name=name, context=context)


def is_being_cancelled() -> bool:
    """Return whether this task is, and not only what it awaits."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


class Tasks:
    """The background tasks of one owner, which ends them when it is closed."""

    def __init__(self) -> None:
        self._running: set[asyncio.Task[Any]] = set()

    def start(self, coroutine: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        task = started(coroutine, name)
        self._running.add(task)
        task.add_done_callback(self._running.discard)
        return task

    @property
    def place(self) -> object:
        return os.getpid(), asyncio.get_running_loop()

    async def pause(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def end(self) -> None:
        """Cancel all tasks and wait until they have ended, but for the one that asks for it. Idempotent.

        Tasks of another event loop are left alone: after a fork, say, they are the parent's, and end there.
        """
        here = asyncio.get_running_loop()
        ending = {task for task in self._running if task.get_loop() is here} - {asyncio.current_task()}
        for task in ending:
            task.cancel()
        if ending:
            await asyncio.wait(ending, timeout=_LONGEST_END)
