"""Where the bytes of an update are in shared memory, as its notice says it. Names and arithmetic; no memory here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

__all__ = ["Slot", "named", "starts"]

_ALIGNED = 64
"""Bytes: each part of a slot begins at a multiple, as the data of an .npy file does; numpy is slow on odd addresses."""

_MOST = 1 << 53
"""As for every number in a notice."""


class Slot(NamedTuple):
    """One place in the shared memory of a publisher.

    Attributes:
        host: Which processes can reach it: those of one user in one host, or container, that was not restarted since.
        process: The publisher's process id.
        descriptor: Its file descriptor of the memory.
        inode: What it must be of: descriptors and process ids are used again.
        number: Which slot, from 0.
        stamp: A random number that the slot has as long as it holds these bytes.
    """

    host: str
    process: int
    descriptor: int
    inode: int
    number: int
    stamp: int


def starts(sizes: Iterable[int]) -> list[int]:
    """Return where parts of these sizes begin in a slot, and where the last one ends."""
    sizes = list(sizes)
    begins = list(accumulate((-(-size // _ALIGNED) * _ALIGNED for size in sizes), initial=0))
    return [*begins[:-1], begins[-2] + sizes[-1]] if sizes else [0]


def named(words: Any) -> tuple[Slot, int] | None:
    """Return the slot that a notice names, and the bytes of the text in it; None if these are no such words."""
    if type(words) is not list or len(words) != len(Slot._fields) + 1 or type(words[0]) is not str:
        return None
    numbers: Sequence[Any] = words[1:]
    if not all(type(number) is int and 0 <= number < _MOST for number in numbers):
        return None
    return Slot(*words[:-1]), words[-1]
