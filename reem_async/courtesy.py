"""Giving way to whoever waits for the processor.

A kernel without full preemption takes the processor from a busy thread only at its next tick, up to 4 ms later,
however nice the thread is. On a small computer, whoever computes or copies for longer than a few tenths of
a millisecond should therefore give way himself now and then: a set point may be waiting.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import time

__all__ = ["come_second", "give_way", "keep_memory", "stand_back"]

_NICER, _NICEST = 5, 19
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""What glibc's mallopt calls them."""


def give_way() -> None:
    """Let whoever waits for the processor run."""
    if hasattr(os, "sched_yield"):
        os.sched_yield()
    else:
        time.sleep(0)


def come_second() -> None:
    """Come a little after others for the processor from now on, with all threads begun later, where that can be.

    A batch thread that wakes does not take the processor from whoever has it.
    """
    with contextlib.suppress(AttributeError, OSError):
        os.nice(_NICER)
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def stand_back() -> None:
    """Take only processor time that nobody else wants from now on, with all threads begun later: perhaps none.

    There is no way back without rights. Where there is no SCHED_IDLE (not Linux), it is niceness 19.

    Raises:
        AttributeError, OSError: This system has neither, or does not allow it.
    """
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    else:
        os.nice(_NICEST)


def keep_memory() -> None:
    """Have this process keep the memory it frees for what comes next, up to 64 MiB a thread, where that can be.

    Large blocks are given back to the system otherwise, and each page that is taken anew costs a fault: for a
    camera of 28 MB/s twelve thousand a second.
    """
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError, OSError):  # another C library
            library = ctypes.CDLL(None)
            library.mallopt(_MMAP_THRESHOLD, 32 << 20)
            library.mallopt(_TRIM_THRESHOLD, 64 << 20)
