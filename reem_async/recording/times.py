"""Instants: seconds since 1970 for users, integer nanoseconds in the file."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from ..errors import BadType, BadValue
from ..plan.paths import shorten

__all__ = ["AFTER", "STEP", "Clock", "Instant", "nanoseconds", "seconds"]

Instant = float | np.datetime64
"""A point in time: seconds since 1970, or a numpy datetime64."""

STEP = 2000
"""Nanoseconds between two log times at least: whole microseconds, which seconds as float tell apart until 2100."""

AFTER = 1000
"""Nanoseconds after an update at which a state that includes it is put."""


def nanoseconds(instant: Any) -> int:
    """Return an instant in ns since 1970; floats are rounded to microseconds.

    Raises:
        BadType, BadValue: Not an instant.
    """
    if isinstance(instant, np.datetime64):
        return int(instant.astype("datetime64[ns]").astype(np.int64))
    if isinstance(instant, bool) or not isinstance(instant, int | float | np.integer | np.floating):
        raise BadType(f"an instant is a float, in seconds since 1970, or a numpy datetime64, not {shorten(instant)}")
    since = float(instant)
    if not math.isfinite(since) or abs(since) > 9e9:
        raise BadValue(f"the instant {instant!r} is out of range; give seconds since 1970")
    return round(since * 1e6) * 1000


def seconds(ns: int) -> float:
    """Return an instant in seconds since 1970."""
    return ns / 1e9


class Clock:
    """Gives out log times: this machine's clock as it was at the beginning, never set back, always growing."""

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()
        self._last = 0

    def stamp(self, received: float | None = None) -> int:
        """Return the log time of what was received now, or at `received` on this machine's clock, a moment ago."""
        ago = 0.0 if received is None else min(max(time.time() - received, 0.0), 1.0)
        now = time.monotonic_ns() + self._offset - int(ago * 1e9)
        self._last = max(now // STEP * STEP, self._last + STEP)
        return self._last
