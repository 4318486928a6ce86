"""By how much the server's clock is ahead of this computer's, as NTP measures it.

Of each reading there are four stamps: sent, read by the server (which is one stamp, as TIME takes no time), received.
The server read its clock somewhere between the first and the last, so half the round trip bounds the error.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from ..errors import RedisError, ReemError
from ..plan import blamed
from ..session import Session
from ..transport import Transport

READINGS = 8  # of which that with the shortest round trip counts
_STEPPED = 0.01  # seconds by which this computer's clock was set, or slept, so that it is measured anew


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """What a measurement of two clocks has given.

    Attributes:
        offset: Seconds by which the server's clock is ahead of this computer's; negative if it is behind.
        bound: Seconds by which the offset may be wrong at most: half the shortest round trip.
        measured: When it was measured, in seconds since 1970 on this computer's clock.
    """

    offset: float
    bound: float
    measured: float

    def __str__(self) -> str:
        side = "ahead" if self.offset > 0 else "behind"
        return f"{abs(self.offset) * 1000:.1f} ms {side}, give or take {self.bound * 1000:.1f} ms"


async def measure(server: Transport, readings: int = READINGS) -> ClockOffset:
    """Measure in so many round trips. Raises NotAllowed if the user may not ask for the time."""
    found: list[tuple[float, float]] = []
    for _ in range(readings):
        # The round trip is timed by the monotonic clock: the other may be set in between.
        wall, start = time.time(), time.monotonic()
        (reply,) = await server.roundtrip([("TIME",)])
        half = (time.monotonic() - start) / 2
        if isinstance(reply, Exception):
            raise blamed(reply, ("TIME",))
        found.append((half, int(reply[0]) + int(reply[1]) / 1e6 - wall - half))
    bound, offset = min(found)
    return ClockOffset(offset, bound, time.time())


class ServerClock:
    """The measurements of one session, of which the last serves as long as it holds."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._last: tuple[ClockOffset, float, float] | None = None  # and this computer's two clocks then

    async def offset(self, max_age: float, readings: int = READINGS) -> ClockOffset:
        """Return the offset, measured no more than so many seconds ago."""
        if self._last is not None:
            found, wall, monotonic = self._last
            age = time.monotonic() - monotonic
            if age <= max_age and abs(time.time() - wall - age) < _STEPPED:
                return found
        nodes = await self._session.transport.nodes()
        found = await measure(nodes[0], readings)
        self._last = found, time.time(), time.monotonic()
        return found

    async def known(self, max_age: float, readings: int = READINGS) -> ClockOffset | None:
        """Return the offset, None if the user may not ask or the server does not answer."""
        try:
            return await self.offset(max_age, readings)
        except (ReemError, RedisError, OSError):
            return None
