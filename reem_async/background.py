"""Tasks that run beside the caller."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from contextvars import copy_context
from typing import Any

from .transport.patience import forget

__all__ = ["in_background"]

_tasks: set[asyncio.Task[Any]] = set()


def in_background(coroutine: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
    """Run a coroutine as a named task; asyncio alone would let it be collected before it ends."""
    context = copy_context()
    context.run(forget)  # a time limit given for one call is not meant for what goes on after it
    task = asyncio.get_running_loop().create_task(coroutine, name=name, context=context)
    _tasks.add(task)
    task.add_done_callback(_tasks.discard)
    return task
