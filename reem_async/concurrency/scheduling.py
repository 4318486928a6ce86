"""Giving way to other threads and programs that wait for the processor.

A kernel without full preemption takes the processor from a busy thread only at its next tick, up to 4 ms later,
however nice the thread is. A control loop on the same core would wait that long. So a thread that computes or copies
for more than a few tenths of a millisecond calls `give_way` in between.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
import sys
import time

# Niceness: added to that of a program which comes second, and the highest there is.
_NICER, _NICEST = 5, 19
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # what glibc's mallopt calls them
_SET_ATTRIBUTES = {"x86_64": 314, "aarch64": 274}  # Linux's system call sched_setattr, which the C library lacks
# SCHED_FLAG_RESET_ON_FORK: programs that this one starts are scheduled as usual.
_RESET_ON_FORK = 1
_SHORTEST_TURN = 100_000  # nanoseconds; the least that the kernel accepts as a time slice


def give_way() -> None:
    if hasattr(os, "sched_yield"):
        os.sched_yield()
    else:
        time.sleep(0)


def come_second() -> None:
    """Come a little after others for the processor from now on, with all threads begun later, where that can be."""
    with contextlib.suppress(AttributeError, OSError):
        os.nice(_NICER)
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def stand_back() -> None:
    """Run only when the processor is idle from now on, with all threads begun later; there is no way back.

    Where there is no SCHED_IDLE (not Linux), it is niceness 19. Raises AttributeError or OSError where neither works.
    """
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    else:
        os.nice(_NICEST)


def take_short_turns() -> None:
    """Have this thread, but none that it begins, take turns of 0.1 ms, where that can be: Linux from 6.12 on.

    When it is woken it comes before threads with longer turns. One with another policy is left as it is.
    """
    if sys.platform != "linux" or sys.maxsize < 1 << 32 or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return
    if number := _SET_ATTRIBUTES.get(os.uname().machine):
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        wish = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, _RESET_ON_FORK, nice, 0, _SHORTEST_TURN, 0, 0)
        with contextlib.suppress(AttributeError, OSError):
            ctypes.CDLL(None).syscall(ctypes.c_long(number), 0, ctypes.c_char_p(wish), 0)


def keep_memory() -> None:
    """Have this process keep the memory it frees for what comes next, up to 64 MiB a thread, where that can be.

    Else each page costs a fault when it is taken again: for a camera of 28 MB/s twelve thousand a second.
    """
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError, OSError):  # another C library
            library = ctypes.CDLL(None)
            library.mallopt(_MMAP_THRESHOLD, 32 << 20)
            library.mallopt(_TRIM_THRESHOLD, 64 << 20)
