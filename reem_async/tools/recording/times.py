"""Instants: seconds since 1970 for users, integer nanoseconds in the file."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from ...errors import BadType, BadValue
from ...plan.paths import shorten

Instant = float | np.datetime64
"""A point in time: seconds since 1970, or a numpy datetime64."""

STEP = 2000
"""Nanoseconds between two log times at least: whole microseconds, which seconds as float tell apart until 2100."""

PATIENCE = 0.01
"""Seconds that updates may wait to be recorded, several at once. The publisher's time in them is not touched."""

HURRIED = 0.002
"""The same, once large updates were seen to come fast: each is to be fetched before the next one replaces it."""

LATEST = 9 * 10**18
"""Nanoseconds since 1970 up to which there are instants: the year 2255."""
# Nanoseconds: what readers of MCAP that use signed numbers can take.
_LATEST = 2**63 - 1
# Whose clocks are compared with that of this machine.
_MOST_PUBLISHERS = 10_000
_FORGET = 1e-4
"""How much of a longer way each update makes the least one longer: clocks drift."""

AFTER = 1000
"""Nanoseconds after an update at which a state that includes it is put."""


def nanoseconds(instant: Any) -> int:
    """Return an instant in ns since 1970; floats are rounded to microseconds."""
    if isinstance(instant, np.datetime64):
        return int(instant.astype("datetime64[ns]").astype(np.int64))
    if isinstance(instant, bool) or not isinstance(instant, int | float | np.integer | np.floating):
        raise BadType(f"an instant is a float, in seconds since 1970, or a numpy datetime64, not {shorten(instant)}")
    since = float(instant)
    if not math.isfinite(since) or abs(since) > LATEST / 1e9:
        raise BadValue(f"the instant {instant!r} is out of range; give seconds since 1970")
    return _rounded(since)


def up_to(instant: Any) -> int:
    """Return the last ns of an instant: a float is a whole microsecond, in which other programs have several times."""
    return nanoseconds(instant) + (0 if isinstance(instant, np.datetime64) else AFTER - 1)


def before(instant: Any) -> int:
    """Return the last ns before an instant."""
    return nanoseconds(instant) - (1 if isinstance(instant, np.datetime64) else AFTER)


def _rounded(since: float) -> int:
    whole = int(since)
    # The fraction by itself: a product of more than 2**51 microseconds would be rounded before it is rounded here.
    return whole * 1_000_000_000 + round((since - whole) * 1e6) * 1000


def published(time: float) -> int:
    """Return a publisher's time stamp in ns, as near to it as a file can hold: its clock may be set to anything."""
    return min(max(_rounded(time), 0), _LATEST) if math.isfinite(time) else 0


def seconds(ns: int) -> float:
    return ns / 1e9


class Clock:
    """Gives out log times: this machine's clock as it was at the beginning, never set back, always growing."""

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()
        self._last = 0

    def stamp(self, received: float | None = None) -> int:
        """Return the log time of what was received now, or at `received` on this machine's clock, a moment ago."""
        # At most a second: `received` is on a clock that may have been set in between.
        ago = 0.0 if received is None else min(max(time.time() - received, 0.0), 1.0)
        now = time.monotonic_ns() + self._offset - int(ago * 1e9)
        # No two calls return the same log time, so no two values of a path have it. Messages of one item share it.
        self._last = max(now // STEP * STEP, self._last + STEP)
        return self._last

    def since(self, stamp: int) -> float:
        return (time.monotonic_ns() + self._offset - stamp) / 1e9


class Arrivals:
    """Tells when updates arrived that were taken a little later, several at once.

    The least time from a publisher's stamp to receiving is that of an update that did not wait; by as much as
    another took longer, it has waited. Clocks that differ do no harm: the result is never over `patience`
    before the update was taken, and never after.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._least: dict[str, float] = {}

    def of(self, publisher: str, published: float, received: float) -> float:
        """Return when an update arrived that was `received` now; all in seconds since 1970."""
        took = received - published
        if publisher not in self._least and len(self._least) >= _MOST_PUBLISHERS:
            # A program that starts often has a new id each time.
            self._least.clear()
        # A first update that took hardly longer than it may have waited comes from a clock like this one.
        least = self._least.get(publisher, 0.0 if 0.0 <= took <= 2 * self._patience else took)
        self._least[publisher] = min(took, least + _FORGET * (took - least))
        return min(received, max(received - self._patience, published + least))
