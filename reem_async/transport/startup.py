"""Waiting for a server that is not up yet: what `RedisInterface(wait=)` does."""

from __future__ import annotations

import logging
import ssl
import time
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import redis.exceptions

from ..errors import ClusterReply, NotConnected, ServerNotReady

logger = logging.getLogger("reem.connection")

Result = TypeVar("Result")

_PAUSE = 0.1  # seconds between two attempts

_LASTING = (
    redis.exceptions.InvalidResponse,
    redis.exceptions.ResponseError,
    ssl.SSLError,
    TypeError,
    ValueError,
)
"""Reasons that do not end by waiting: a wrong certificate, or something that is no server of Redis and whose answers
redis-py cannot read."""


class StartupWait:
    """How long the calls of one interface wait for a server that is not up yet.

    Nothing is asked or counted while calls succeed. The time begins with the first call that finds no server.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._deadline: float | None = None

    async def allows(self, transport: Any, error: Exception) -> bool:
        """Pause and return True if a call over a `Transport` that ended in `error`, unapplied, is to be tried again."""
        if not self._seconds or not isinstance(error, NotConnected | ServerNotReady) or not _may_pass(error):
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

    async def retried(self, transport: Any, call: Callable[[], Awaitable[Result]]) -> Result:
        """Return what `call` returns, calling it again as long as this waits."""
        while True:
            try:
                return await call()
            except (NotConnected, ServerNotReady) as error:
                if not await self.allows(transport, error):
                    raise


def _may_pass(error: BaseException) -> bool:
    """Return whether waiting may cure an error: nothing listens there, no such host yet, slots without a node."""
    link: BaseException | None = error
    seen: list[BaseException] = []  # Python lets errors be each other's context
    while link is not None and link not in seen:
        seen.append(link)
        # A forwarder whose server is not up yet ends TLS in the middle.
        if isinstance(link, _LASTING) and not isinstance(link, ssl.SSLEOFError | ServerNotReady | ClusterReply):
            return False
        # What is behind an error of the system is not about the server.
        link = None if isinstance(link, OSError) else link.__cause__ or link.__context__
    return True
