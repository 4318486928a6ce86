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
        except (Exception, asyncio.CancelledError):  # of something that was cancelled, and whose result it asked for
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

    They are made in the loop's next turn, when all that arrived in this one has been told to everybody. A task of
    their own would do the same at a higher price; only what must be awaited gets one.

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
        self._awaited: asyncio.Task[Any] | None = None
        self._over = self.loop.create_future()
        self._context = copy_context()
        self._context.run(forget)  # a time limit given for listen() is not meant for what callbacks do
        kept.add(self)
        updates.mailbox.wake = self._go_on
        self._go_on()

    def _go_on(self) -> None:
        """Have the calls made that are due, unless that is under way."""
        if not self._busy:
            self._busy = True
            self.loop.call_soon(self._call_waiting, context=self._context)

    def _call_waiting(self) -> None:
        mailbox = self._updates.mailbox
        try:
            while (update := mailbox.take()) is not EMPTY:
                result = self._caller.call(update, mailbox.dropped)
                if result is not None and inspect.isawaitable(result):
                    in_background(self._wait(update, result), "reem callback")
                    return
            self._busy = False
        except (Ended, QueueFull) as reason:
            self._caller.ended(reason)
            self._end()
        except BaseException:
            self._end()
            raise

    async def _wait(self, update: Update, result: Awaitable[Any]) -> None:
        self._awaited = asyncio.current_task()
        try:
            await result
        except (Exception, asyncio.CancelledError):
            if _is_being_cancelled():
                self._end()
                raise
            self._caller.failed(update)
        self._busy = False
        self._go_on()

    def _end(self) -> None:
        self._kept.discard(self)
        self._updates.mailbox.wake = lambda: None
        if not self._over.done():
            self._over.set_result(None)

    async def done(self) -> None:
        """Wait until the mailbox, which is closed, is empty and all calls were made, unless one of them asks for it."""
        if self._awaited is not asyncio.current_task():
            await asyncio.wait([self._over])


def _is_being_cancelled() -> bool:
    """Return whether this task is, and not only what it awaits."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0
