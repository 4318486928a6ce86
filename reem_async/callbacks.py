"""The calls of callback subscribers."""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections.abc import Awaitable, Callable, Mapping
from contextvars import copy_context
from typing import TYPE_CHECKING, Any

from .background import in_background
from .errors import QueueFull
from .policy import EMPTY, Ended
from .transport.patience import forget

if TYPE_CHECKING:
    from .follow import Update
    from .subscribe import Watch

__all__ = ["Caller", "Calls"]

logger = logging.getLogger("reem.subscribe")


class Caller:
    """Calls one callback; both fronts use it, each on a thread of its own choice."""

    def __init__(self, channel: str, function: Callable[..., Any], kwargs: Mapping[str, Any]) -> None:
        self._channel = channel
        self._function = function
        self._kwargs = kwargs
        self._dropped = 0

    def call(self, update: Update, dropped: int) -> Any:
        """Call the function, unless the update is only the value that was there already; what it raises is logged.

        Args:
            update: What to tell.
            dropped: How many updates were skipped until now; if they are more than at the last call, that is logged.
        """
        if dropped > self._dropped:
            self._dropped = dropped
            logger.warning(
                "%s: %d updates were skipped so far; newer ones came before the callback was done",
                self._channel,
                dropped,
            )
        if update.initial:
            return None
        try:
            return self._function(update.data, update.path, **self._kwargs)
        except Exception:
            self.failed(update)
            return None

    def failed(self, update: Update) -> None:
        """Log the exception that is being handled."""
        logger.exception("the callback for %s raised at %s; the subscription goes on", self._channel, update.path)

    def ended(self, reason: Ended | QueueFull) -> None:
        """Log the end of the calls if it is not by closing: the policy allowed no skipped update."""
        if isinstance(reason, QueueFull):
            logger.error("the callback for %s is not called any more: %s", self._channel, reason)


class Calls:
    """The calls of one subscriber on the event loop, one after the other, until its mailbox is closed.

    A plain function is called right where the update arrives: a task would be woken a turn of the loop later.

    Args:
        caller: Makes a call.
        updates: Where the updates come from.
        kept: Where to be as long as there may be calls.

    Attributes:
        loop: The event loop.
    """

    def __init__(self, caller: Caller, updates: Watch, kept: set[Any]) -> None:
        self.loop = asyncio.get_running_loop()
        self._caller = caller
        self._updates = updates
        self._kept = kept
        self._busy = False
        self._awaited: asyncio.Task[None] | None = None
        self._context = copy_context()
        self._context.run(forget)  # a time limit given for listen() is not meant for what callbacks do
        kept.add(self)
        updates.mailbox.wake = self._go_on
        self._go_on()

    def _go_on(self) -> None:
        """Make the calls that are due, unless one is being made."""
        if not self._busy:
            self._context.run(self._call_waiting)

    def _call_waiting(self) -> None:
        self._busy, mailbox = True, self._updates.mailbox
        try:
            while (update := mailbox.take()) is not EMPTY:
                result = self._caller.call(update, mailbox.dropped)
                if result is not None and inspect.isawaitable(result):
                    self._awaited = in_background(self._wait(update, result), "reem callback")
                    return
        except (Ended, QueueFull) as reason:
            self._caller.ended(reason)
            self._kept.discard(self)
            mailbox.wake = lambda: None
        self._busy = False

    async def _wait(self, update: Update, result: Awaitable[Any]) -> None:
        try:
            await result
        except Exception:
            self._caller.failed(update)
        self._busy, self._awaited = False, None
        self._go_on()

    async def done(self) -> None:
        """Wait for the calls that are being made, unless this is called by one of them."""
        while (task := self._awaited) is not None and not task.done() and task is not asyncio.current_task():
            await asyncio.wait([task])
