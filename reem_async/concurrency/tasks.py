"""Tasks and threads beside the caller: their owners, and how they give way to others that wait for the processor.

A kernel without full preemption takes the processor from a busy thread only at its next tick, up to 4 ms later,
however nice the thread is. A control loop on the same core would wait that long. So a thread that computes or copies
for more than a few tenths of a millisecond calls `give_way` in between.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import struct
import sys
import time
from collections.abc import Coroutine
from contextvars import copy_context
from typing import Any

from .timeouts import forget

_LONGEST_END = 1.0  # seconds to wait for cancelled tasks: a ship of a user's own may be at work in one


def started(coroutine: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
    """Run a coroutine as a named task. The caller keeps it: asyncio alone would let it be collected."""
    context = copy_context()
    context.run(forget)  # a time limit given for one call is not meant for what goes on after it
    return asyncio.get_running_loop().create_task(coroutine, name=name, context=context)


def is_being_cancelled() -> bool:
    """Return whether this task is, and not only what it awaits."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


class Tasks:
    def __init__(self) -> None:
        self._running: set[asyncio.Task[Any]] = set()

    def start(self, coroutine: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        task = started(coroutine, name)
        self._running.add(task)
        task.add_done_callback(self._running.discard)
        return task

    @property
    def place(self) -> object:
        return os.getpid(), asyncio.get_running_loop()

    async def pause(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def end(self) -> None:
        """Cancel all tasks and wait until they have ended, but for the one that asks for it. Idempotent.

        Tasks of another event loop are left alone: after a fork, say, they are the parent's, and end there.
        """
        here = asyncio.get_running_loop()
        ending = {task for task in self._running if task.get_loop() is here} - {asyncio.current_task()}
        for task in ending:
            task.cancel()
        if ending:
            await asyncio.wait(ending, timeout=_LONGEST_END)


# Niceness: added to that of a program which comes second, and the highest there is.
_NICER, _NICEST = 5, 19
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # what glibc's mallopt calls them
_SET_ATTRIBUTES = {"x86_64": 314, "aarch64": 274}  # Linux's system call sched_setattr, which the C library lacks
# SCHED_FLAG_RESET_ON_FORK: programs that this one starts are scheduled as usual.
_RESET_ON_FORK = 1
_SESSION = "/proc/self/autogroup"  # the niceness of all programs of a session together
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

    Where there is no SCHED_IDLE (not Linux), or it is not allowed, it is niceness 19. Raises AttributeError or OSError
    where neither works.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except (AttributeError, OSError):
        os.nice(_NICEST)


def come_last() -> None:
    """Give this thread, and all threads that it begins, the lowest priority, where the system allows that.

    Niceness decides how much a thread gets. A thread that was woken waits up to a whole turn of any other, 1.4 ms by
    default, so the turns are short. Linux with autogroup=1 shares processors among sessions first, where niceness
    counts for nothing: a process that is alone in its session, such as a service, also lowers the session.
    """
    with contextlib.suppress(AttributeError, OSError):
        os.nice(_NICEST)
    take_short_turns(inherited=True)
    with contextlib.suppress(AttributeError, OSError):
        if _is_alone_in_session():
            with open(_SESSION, "w", encoding="ascii") as file:
                file.write(str(_NICEST))


def _is_alone_in_session() -> bool:
    others = {int(name) for name in os.listdir("/proc") if name.isdecimal()} - {os.getpid()}
    return os.getsid(0) == os.getpid() and not any(_session_of(each) == os.getpid() for each in others)


def _session_of(process: int) -> int:
    try:
        return os.getsid(process)
    except ProcessLookupError:  # it has ended meanwhile
        return 0


def take_short_turns(*, inherited: bool = False) -> None:
    """Have this thread, and if `inherited` those that it begins, take turns of 0.1 ms: Linux from 6.12 on.

    When it is woken it comes before threads of its niceness with longer turns. Not with another policy.
    """
    if sys.platform != "linux" or sys.maxsize < 1 << 32 or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return
    if number := _SET_ATTRIBUTES.get(os.uname().machine):
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        flags = 0 if inherited else _RESET_ON_FORK
        wish = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, flags, nice, 0, _SHORTEST_TURN, 0, 0)
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
