"""The time of the rolling buffer: one clock for all that is put in and asked for, which is never set back."""

from __future__ import annotations

import time

__all__ = ["Clock"]

_WAITED = 1.0
"""Seconds before now that something may have been received, at most: the clock may have been set since."""


class Clock:
    """This machine's clock, but for its being set back: it goes on then, ahead of it by as much.

    A step forward is taken, as the one after a computer has slept.
    """

    def __init__(self) -> None:
        self._ahead = time.time() - time.monotonic()

    def now(self) -> float:
        """Return the seconds since 1970."""
        # In this order: whatever takes a while between the two looks makes the difference less, and is not taken.
        self._ahead = max(self._ahead, time.time() - time.monotonic())
        return time.monotonic() + self._ahead

    def of(self, received: float) -> float:
        """Return when something came that was received a moment ago, at an instant of this machine's clock."""
        return self.now() - min(max(time.time() - received, 0.0), _WAITED)
