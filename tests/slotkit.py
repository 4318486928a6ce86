"""Whether arrays look into the memory of their publisher: the tests and the chaos say so of what they have heard."""

from __future__ import annotations

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
