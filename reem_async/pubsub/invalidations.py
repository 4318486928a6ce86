"""Has servers say which keys were changed: CLIENT TRACKING, of what is read over a subscription connection."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable

from ..errors import ServerNotReady, is_of_command
from ..plan import Reply, blamed
from ..transport.wire import Wire

__all__ = ["Invalidations"]

logger = logging.getLogger("reem.subscribe")

_TRACK = ("CLIENT", "TRACKING", "ON")
"""Not BCAST: that has the server look through the prefixes of all who watch for each write of anybody."""


class Invalidations:
    """Turns the server's messages on; who may not have them is warned, once for each interface."""

    def __init__(self) -> None:
        self._warned = False

    async def turn_on(self, wire: Wire) -> None:
        """Have the server tell of changes of what is read over a connection; at most one round trip.

        Raises:
            ServerNotReady: It answers nobody now; to be tried again.
        """
        if wire.tracked is not None:
            return
        (reply,) = await wire.roundtrip([_TRACK])
        if isinstance(reply, ServerNotReady):
            raise blamed(reply, _TRACK)
        if isinstance(reply, Exception):
            self._refused(wire, blamed(reply, _TRACK), "+client|tracking")
        else:
            wire.tracked = True

    async def touch(self, wire: Wire, names: Iterable[str], touched: Callable[[], None]) -> bool:
        """Read keys over a connection, so that the server tells once when they are changed. One round trip.

        Returns whether it will tell. `touched` is called in order with what it tells: what it has told of before was
        changed before. When this returns it may have told more.
        """
        if not wire.alive or not wire.tracked:
            return False
        answered = asyncio.get_running_loop().create_future()

        def done(outcome: list[Reply] | Exception) -> None:
            touched()
            if not answered.done():  # cancelled
                answered.set_result(outcome)

        wire.send([("TYPE", name) for name in names], done)
        outcome = await answered
        if isinstance(outcome, Exception):
            raise outcome
        refused = [reply for reply in outcome if isinstance(reply, Exception)]
        if any(is_of_command(reply) for reply in refused):
            self.may_not_touch(wire, refused[0])
        return not refused

    def may_not_touch(self, wire: Wire, refusal: Exception) -> None:
        """Take it that the user may not read keys so, and warn."""
        self._refused(wire, blamed(refusal, ("TYPE",)), "+type")

    def _refused(self, wire: Wire, reason: Exception, right: str) -> None:
        wire.tracked = False
        if not self._warned:
            self._warned = True
            logger.warning(
                "what is only stored cannot be followed at this server, only what is published is told; a recording "
                "has the rest at its keyframes, and the page looks for it: %s "
                "(the user needs the right %s, as in deploy/users.acl)",
                reason,
                right,
            )
