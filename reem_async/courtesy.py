"""Giving way to whoever waits for the processor.

A kernel without full preemption takes the processor from a busy thread only at its next tick, up to 4 ms later,
however nice the thread is. On a small computer, whoever computes or copies for longer than a few tenths of
a millisecond should therefore give way himself now and then: a set point may be waiting.
"""

from __future__ import annotations

import os
import time

__all__ = ["give_way"]


def give_way() -> None:
    """Let whoever waits for the processor run."""
    if hasattr(os, "sched_yield"):
        os.sched_yield()
    else:
        time.sleep(0)
