"""Waiting for a server that is not up yet: what `RedisInterface(wait=)` does."""

from __future__ import annotations

import logging
import time
from typing import Any

from ..errors import NotConnected, ServerNotReady

logger = logging.getLogger("reem.connection")

_PAUSE = 0.1  # seconds between two attempts


class StartupWait:
    """How long the calls of one interface wait for a server that is not up yet.

    Nothing is asked or counted while calls succeed. The time begins with the first call that finds no server.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._deadline: float | None = None

    async def allows(self, transport: Any, error: Exception) -> bool:
        """Pause and return True if a call over a `Transport` that ended in `error`, unapplied, is to be tried again."""
        if not self._seconds or not isinstance(error, NotConnected | ServerNotReady):
            return False
        now, opened = time.monotonic(), transport.states.first_opened
        # A server that has been reached is lost, and not starting: but it may still load its data, and a cluster may
        # have nodes that start later than the first one.
        if opened is not None and not isinstance(error, ServerNotReady) and not transport.sharded:
            return False
        if self._deadline is None:
            self._deadline = (now if opened is None else opened) + self._seconds
            if now < self._deadline:
                logger.warning("waiting up to %g s for the server: %s", self._deadline - now, error)
        if now >= self._deadline:
            return False
        await transport.pause(min(_PAUSE, self._deadline - now))
        return True
