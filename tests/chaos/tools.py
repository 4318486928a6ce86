"""Small things that several rows need."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from slotkit import shared_in

import reem_async
from reem_async.local import LEAST

from .scoreboard import ROOT

PAUSE = 0.005
"""Seconds between two looks at a condition."""


def frame(number: int) -> np.ndarray[Any, Any]:
    return np.full(LEAST // 8, number)


def rss() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def descriptors() -> tuple[int, int]:
    """How many files and sockets this process has open, and how many of shared memory: those come and go with views."""
    shared = others = 0
    for entry in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):  # the one that this listing takes, or one that another thread has closed
            if os.readlink(f"/proc/self/fd/{entry}").startswith("/memfd:reem"):
                shared += 1
            else:
                others += 1
    return others, shared


def quantile(values: list[float], part: float) -> float:
    """The value that `part` of the values do not exceed."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(part * len(ordered)))]


async def became(condition: Callable[[], Any], seconds: float) -> float | None:
    """Wait until the condition holds; returns the seconds that took, None if it never did."""
    begun = time.monotonic()
    while not condition():
        if time.monotonic() - begun > seconds:
            return None
        await asyncio.sleep(PAUSE)
    return time.monotonic() - begun


@contextlib.asynccontextmanager
async def background(*coroutines: Any):
    """Run coroutines beside the block and cancel them after it; the first failure of one is raised."""
    tasks = [asyncio.ensure_future(coroutine) for coroutine in coroutines]
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()
        outcomes = await asyncio.gather(*tasks, return_exceptions=True)
    for outcome in outcomes:
        if isinstance(outcome, Exception):
            raise outcome


@contextlib.contextmanager
def measured(times: list[float]) -> Iterator[None]:
    """Add to `times` the seconds that the block takes, however it ends."""
    begun = time.perf_counter()
    try:
        yield
    finally:
        times.append(time.perf_counter() - begun)


@contextlib.contextmanager
def program(name: str, *arguments: Any):
    """Start one of the programs; both ways of talking to it are pipes."""
    command = [sys.executable, "-W", "error", "-m", "tests.chaos.programs", name, *map(str, arguments)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            with contextlib.suppress(OSError):
                process.stdin.close()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()


def said(process: subprocess.Popen[str]) -> dict[str, Any]:
    line = process.stdout.readline()
    assert line, f"the program ended with {process.wait(5)}"
    return json.loads(line)


def order(process: subprocess.Popen[str], word: object) -> None:
    process.stdin.write(f"{word}\n")
    process.stdin.flush()


def say(**facts: Any) -> None:
    """Tell the row: what a program does."""
    print(json.dumps(facts), flush=True)


def heard() -> str:
    """Wait for the row's next word: what a program does."""
    return sys.stdin.readline().strip()


class Log:
    """What one subscriber was told, update by update: repetitions, steps back, and losses that nobody flagged.

    Numbers of one publisher go up one by one. If one is skipped, then an update in between, or the one
    after it, must say `gap`, or the loop itself has skipped it and counted that. That counter runs ahead of
    the updates that still wait in the loop, so it is drawn on like an account: never more than it says.

    Attributes:
        told: How many updates came.
        gaps: How many of them were flagged.
        repeated: Updates that came again.
        backward: Updates that came after newer ones of the same publisher.
        silent: Losses that were not flagged.
        shared: Updates with arrays in the memory of their publisher.
    """

    def __init__(self, updates: reem_async.pubsub.subscribers.Watch) -> None:
        self.updates = updates
        self.told = self.gaps = self.shared = 0
        self.repeated: list[Any] = []
        self.backward: list[Any] = []
        self.silent: list[Any] = []
        self._last: dict[str, int] = {}
        self._delivered: set[tuple[str, int]] = set()
        self._excused: dict[str, bool] = {}
        self._drawn = 0  # how many of the loop's own skipped updates have been met

    async def follow(self) -> None:
        async for update in self.updates:
            self.take(update)

    def take(self, update: Any) -> None:
        self.told += 1
        self.gaps += update.gap
        self.shared += shared_in(update.data) > 0
        if update.gap:
            self._excused = dict.fromkeys(self._last, True)
        publisher, sequence = update.publisher, update.sequence
        if publisher is None:
            return
        if (publisher, sequence) in self._delivered:
            self.repeated.append(update)
            return
        self._delivered.add((publisher, sequence))
        last = self._last.get(publisher)
        if last is not None and sequence < last:
            self.backward.append(update)
            return
        if last is not None and sequence > last + 1 and not self._excused.get(publisher):
            self._drawn += sequence - last - 1
            if self._drawn > self.updates.dropped:
                self.silent.append((publisher, last, sequence))
        self._last[publisher] = sequence
        self._excused[publisher] = False
