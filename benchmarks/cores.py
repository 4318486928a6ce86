"""Keeping the processes of one measurement on one core.

A small call takes as long as waking the other process, which on a virtual machine costs 10 us or 100 depending on
which core it sleeps on, at random. On one core, what is left is what the programs do: such figures come back within
a few percent.
"""

import contextlib
import os
import pathlib
from collections.abc import Iterator


@contextlib.contextmanager
def on_one_core(pids: list[int]) -> Iterator[None]:
    """Hold these processes, with all their threads, on one core inside the block; where the system can do that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    everywhere = os.sched_getaffinity(0)
    _move(pids, {max(everywhere)})
    try:
        yield
    finally:
        _move(pids, everywhere)


def _move(pids: list[int], cores: set[int]) -> None:
    for pid in pids:
        for thread in pathlib.Path(f"/proc/{pid}/task").glob("*"):
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(int(thread.name), cores)
