"""Whether arrays look into the memory of their publisher: the tests and the chaos say so of what they have heard."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np


def in_slot(array: Any) -> bool:
    """Whether an array looks into memory that somebody else writes: it is not its own, nor in bytes of this process."""
    while isinstance(array, np.ndarray) and array.base is not None:
        array = array.base
    while isinstance(array, memoryview):
        array = array.obj
        while isinstance(array, np.ndarray) and array.base is not None:
            array = array.base
    return type(array).__name__ == "mmap"


def shared_in(value: Any) -> int:
    """Return how many arrays in dicts look into the memory of their publisher; lists are not looked through."""
    if isinstance(value, dict):
        return sum(map(shared_in, value.values()))
    return int(in_slot(value))


def resident() -> float:
    """Return the megabytes of this process's own, without what it shares with others."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("RssAnon:")) / 1024


def at_step(place, action, call):
    """Make a call, and take an action before its step of this number, as a handler of signals might.

    A step is one instruction of Python on this thread, wherever it is. In a finalizer the action waits for the
    first step behind it: Python keeps from the call what is raised there. Returns whether it was taken.
    """
    left, taken = place, False

    def local(frame, event, arg):
        nonlocal left, taken
        if event == "opcode":
            left -= 1
            if left <= 0 and not taken and not in_finalizer(frame):
                taken = True
                sys.settrace(None)
                action()
        return local

    def begin(frame, event, arg):
        frame.f_trace = local  # Python 3.13 takes no heed of the next line if nothing traces the frame yet
        frame.f_trace_opcodes = True
        return local

    sys._getframe().f_trace_opcodes = True  # Python 3.12 looks, as tracing begins, whether anybody has ever wanted it
    before = sys.gettrace()
    sys.settrace(begin)
    try:
        call()
    finally:
        sys.settrace(before)
    return taken


def in_finalizer(frame):
    """Tell whether a frame, or one that called it, is an object's `__del__`."""
    while frame is not None and frame.f_code.co_name != "__del__":
        frame = frame.f_back
    return frame is not None
