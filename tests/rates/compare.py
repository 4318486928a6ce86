"""A recording, update by update and instant by instant, beside what its publishers made."""

from __future__ import annotations

import collections
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reem_async.plan.paths import below, show
from reem_async.plan.trees import MISSING, get, same
from reem_async.recording import Log, LogUpdate

from .streams import STREAMS, Op, after

__all__ = ["Compared", "compare"]

_AHEAD = 200
"""Calls behind a skipped update that may have been in what was read for it."""


class Compared(NamedTuple):
    published: int
    recorded: int
    skipped: int
    missing: int
    instants: int
    faults: list[str]


class Truth(NamedTuple):
    number: int
    op: Op
    tree: Any


def truths(name: str, seed: int) -> Iterator[Truth]:
    """Yield what a publisher made, call by call."""
    tree, number = MISSING, 0
    for ops in STREAMS[name].ops(random.Random(seed)):
        for op in ops:
            number += 1
            tree = after(tree, op)
            yield Truth(number, op, tree)


class Key:
    """Goes through the calls of one publisher and the news of its key at once, and compares a share of the instants."""

    def __init__(self, log: Log, name: str, seed: int, times: Any, share: float) -> None:
        self._log = log
        self._name = name
        self._times = times
        self._share = share
        self._rng = random.Random(seed)
        self._truths = truths(name, seed)
        self._ahead: collections.deque[Truth] = collections.deque()
        self._now = Truth(0, Op("set", ()), MISSING)
        self._stale: set[tuple[Any, ...]] = set()  # places of skipped updates that nothing is known of
        self._skipped: set[int] = set()
        self._recorded = self._missing = self._instants = 0
        self._faults: list[str] = []

    def run(self) -> Compared:
        skips = collections.deque((time, number) for time, path, number in self._log.skipped() if self._is_ours(path))
        news = self._log.updates(patterns=[self._name])
        update = next(news, None)
        while update is not None:
            while skips and skips[0][0] <= update.time:
                self._skip(*skips.popleft(), found=update if update.kind == "kvs" else None)
            following = next(news, None)
            self._take(update)
            if following is None or (following.time != update.time and (not skips or skips[0][0] > update.time)):
                self._look(update, following.time if following else None)
            update = following
        for time, number in skips:
            self._skip(time, number, None)
        self._missing += len(self._times) - self._now.number
        counts = len(self._times), self._recorded, len(self._skipped), self._missing, self._instants
        return Compared(*counts, self._faults)

    def _is_ours(self, path: str) -> bool:
        return path == self._name or path.startswith((f"{self._name}.", f"{self._name}["))

    def _fault(self, text: str) -> None:
        self._faults.append(f"{self._name}, call {self._now.number}: {text}")

    def _go_to(self, number: int) -> bool:
        """Make a call the present one; those between are missing."""
        if number <= self._now.number or number > len(self._times):
            self._fault(f"number {number} comes next")
            return False
        while self._now.number < number:
            self._now = self._ahead.popleft() if self._ahead else next(self._truths)
            if self._now.number < number:
                self._missing += 1
                self._stale.add(self._now.op.path)
        return True

    def _skip(self, time: float, number: int, found: LogUpdate | None) -> None:
        if self._go_to(number):
            self._skipped.add(number)
            if found is None or (found.time, found.path[1:]) != (time, self._now.op.path):
                self._stale.add(self._now.op.path)

    def _take(self, update: LogUpdate) -> None:
        path = update.path[1:]
        if update.kind == "pub":
            if not self._go_to(update.sequence):
                return
            self._recorded += 1
            op, (began, ended) = self._now.op, self._times[update.sequence - 1]
            if (path, update.deleted) != (op.path, op.kind == "delete"):
                self._fault(f"{op.kind} {op.path} was recorded as {update.shown}, deleted: {update.deleted}")
            elif not update.deleted and not same(update.value, get(self._now.tree, path)):
                self._fault(f"{update.shown} has another value: {update.value!r:.200}")
            if not began - 1e-3 <= update.published <= ended + 1e-3:
                self._fault(f"published at {update.published}, called from {began} to {ended}")
        elif update.kind == "stored":
            self._fault(f"{update.shown} was recorded as stored, which nobody did")
        elif update.deleted and get(self._now.tree, path) is not MISSING and not self._is_open(path):
            self._fault(f"{update.shown} was found to be gone")
        self._stale = {place for place in self._stale if not below(place, path)}

    def _look(self, update: LogUpdate, until: float | None) -> None:
        """Compare an instant, and one between this piece of news and the next."""
        if self._rng.random() >= self._share:
            return
        between = [] if until is None or until - update.time < 1e-5 else [(update.time + until) / 2]
        for instant in (update.time, *between):
            self._instants += 1
            place = self._difference((), self._whole(instant), self._now.tree)
            if place is not None:
                self._fault(f"at {instant!r}, {show((self._name, *place))} is not as published")

    def _whole(self, instant: float) -> Any:
        try:
            return self._log.value_at((self._name,), instant)
        except KeyError:
            return MISSING

    def _is_open(self, place: tuple[Any, ...]) -> bool:
        """Return whether a place may lack something: a later call touches it that was in what was read."""
        if any(below(place, stale) for stale in self._stale):
            return True
        while len(self._ahead) < _AHEAD:
            self._ahead.append(next(self._truths))
        near = any(self._now.number - number < _AHEAD for number in self._skipped)
        return near and any(below(each.op.path, place) or below(place, each.op.path) for each in self._ahead)

    def _difference(self, place: tuple[Any, ...], found: Any, truth: Any) -> tuple[Any, ...] | None:
        """Return where two trees differ, but for what cannot be known."""
        if same(found, truth) or any(below(place, stale) for stale in self._stale):
            return None
        if type(found) is dict and type(truth) is dict:
            for key in found.keys() | truth.keys():
                inner = self._difference((*place, key), found.get(key, MISSING), truth.get(key, MISSING))
                if inner is not None:
                    return inner
            return None
        return None if found is MISSING and self._is_open(place) else place


def compare(log: Log, seed: int, folder: Path, instants: int) -> dict[str, Compared]:
    """Compare all keys, about so many instants of each."""
    found = {}
    for name in STREAMS:
        times = np.load(folder / f"{name}.npy")
        share = min(instants / max(len(times), 1), 1.0)
        found[name] = Key(log, name, seed, times, share).run()
    return found
