"""Reading what was only announced into the rolling buffer, between the updates where it belongs."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import numpy as np

from ...errors import BadData, RedisError, ReemError, WrongKind
from ...plan import Reply
from ...plan.notices import note_of
from ...plan.paths import Path, below
from ...plan.placeholders import marked
from ...plan.trees import MISSING, changed, get, walk
from ...pubsub.division import Division, Heard, divided_read
from ...pubsub.gaps import GapDetector
from ...pubsub.monitor import ANNOUNCED, Event
from ...session import Session
from ..recording.key_reader import fetch
from .history import History
from .partial_reads import noted_text
from .timeline import PENDING
from .trees import Leaf, framed, identical, leaf_of, tree_of

_RECENT = 16
"""Updates that are known again if they come twice while something is read."""

_MOST_NOTES = 100_000
"""Keys whose last notice is remembered."""

_PAUSE = 0.1
"""Seconds after a read that failed."""

_REST = 4
"""How many times as long as reading arrays took nothing of the kind is read: a slow connection is left to others."""


class Allowance:
    """So many bytes a second, saved up to a limit.

    Args:
        rate: Bytes a second.
        most: Bytes that can be saved up.
    """

    def __init__(self, rate: float, most: float) -> None:
        self._rate, self._most, self._saved, self._then = rate, most, most, time.monotonic()

    def take(self, size: int) -> bool:
        """Take so many bytes if they are there; else nothing, and return False."""
        if self.wait(size) > 0:
            return False
        self._saved -= size
        return True

    def wait(self, size: int) -> float:
        """Return the seconds until so many bytes are there; infinite if there never are so many."""
        now = time.monotonic()
        self._saved = min(self._saved + (now - self._then) * self._rate, self._most)
        self._then = now
        return math.inf if size > self._most else max((size - self._saved) / self._rate, 0.0)


class Readings:
    """The reads that are under way, each with the division that says which updates are in what is read.

    Attributes:
        notes: The last notice of each key, as the server notes it.
    """

    def __init__(self) -> None:
        self.notes: dict[str, str] = {}
        self._under_way: dict[str, list[Division[Event]]] = {}

    def hear(self, event: Event) -> None:
        """Take an update of any key."""
        if len(self.notes) > _MOST_NOTES:
            self.notes.clear()
        self.notes[event.name] = note_of(event.publisher, event.sequence)
        for division in self._under_way.get(event.name, ()):
            if division.gaps.count(event) is not None:
                division.hear(Heard(event, None if event.gap else 0))

    @contextmanager
    def begin(self, names: Sequence[str]) -> Iterator[list[Division[Event]]]:
        """Have divisions of new reads, one for each key, hear the updates of their keys."""
        divisions: list[Division[Event]] = [Division(GapDetector(_RECENT)) for _ in names]
        for name, division in zip(names, divisions, strict=True):
            division.gaps.begin_with(self.notes.get(name, "").encode())
            self._under_way.setdefault(name, []).append(division)
        try:
            yield divisions
        finally:
            for name, division in zip(names, divisions, strict=True):
                self._under_way[name].remove(division)
                if not self._under_way[name]:
                    del self._under_way[name]


class Fetcher:
    """Reads one announced value after the other, the newest of each path.

    Arrays are read in turn as far as the allowance goes, so that of each path there is one now and then, in even
    intervals: what was announced and could not be read yet is read when its turn comes, as it is then.

    What is read goes into the buffer once it is known which updates it has, with those applied that it has not: no
    update is applied twice, or undone.

    Args:
        session: The server.
        history: Where the values go.
        allowance: Bytes of arrays that may be read.
        readings: The reads that are under way.
        fence: Returns when `readings` have all updates that were published before.
        touch: Called with a path, and what is known of it, directly before the arrays there are read.

    Attributes:
        behind: Keys with an announcement that has not been answered.
        finished: Keys of which something was read; the reader of it empties it before.
        failed: Called with a key of which something could not be read, and may be later.
    """

    def __init__(
        self,
        session: Session,
        history: History,
        allowance: Allowance,
        readings: Readings,
        fence: Callable[[], Awaitable[None]],
        touch: Callable[[Path, Any], Awaitable[None]],
    ) -> None:
        self._session = session
        self._history = history
        self._allowance = allowance
        self._readings = readings
        self._fence = fence
        self._touch = touch
        self._paths: dict[Path, None] = {}
        self._checks: set[Path] = set()  # those of them that may be what the buffer has
        self._owed: dict[Path, int] = {}  # whose arrays are to be read, and how many bytes they have
        self._rested = 0.0  # the instant from which on arrays may be read again, on the monotonic clock
        self._news = asyncio.Event()
        self._name = ""  # what is being read
        self.behind: set[str] = set()
        self.finished: set[str] = set()
        self.failed: Callable[[str], None] = lambda name: None

    def concerns(self, name: str) -> bool:
        """Return whether a part of a key is being read, is about to be, or was read since `finished` was emptied."""
        return name == self._name or name in self.finished or any(path[0] == name for path in self._paths)

    def want(self, path: Path, when: float) -> None:
        """Note that the buffer lacks what is at a path since an instant."""
        self._history.add(path, PENDING, 0, when)
        self.behind.add(str(path[0]))
        self._checks.discard(path)
        self._paths.setdefault(path)
        self._news.set()

    def check(self, path: Path) -> None:
        """Read what is at a path: the buffer may have another array there."""
        if path not in self._paths and path not in self._owed:
            self._checks.add(path)
            self._paths[path] = None
            self._news.set()

    async def run(self) -> None:
        while True:
            path, with_arrays = await self._next()
            try:
                await self._fetch_one(path, with_arrays)
            except (BadData, WrongKind):  # it is no value, now and later
                self._checks.discard(path)
            except (ReemError, RedisError, OSError):
                self._checks.discard(path)
                self.failed(str(path[0]))
                await asyncio.sleep(_PAUSE)

    async def _next(self) -> tuple[Path, bool]:
        """Return what is to be read next, and whether the turn of its arrays has come."""
        while True:
            self._news.clear()
            owed = next(iter(self._owed), None)
            wait = None if owed is None else self._until_turn(self._owed[owed])
            if owed is not None and wait == 0:
                del self._owed[owed]
                self._paths.pop(owed, None)
                return owed, True
            for path in self._paths:
                del self._paths[path]
                return path, not self._owed
            with suppress(TimeoutError):
                async with asyncio.timeout(wait):  # wait_for of Python 3.11 loses a cancellation that comes with news
                    await self._news.wait()

    def _until_turn(self, size: int) -> float:
        return max(self._allowance.wait(size), self._rested - time.monotonic(), 0.0)

    async def _fetch_one(self, path: Path, with_arrays: bool) -> None:
        self._name = name = str(path[0])
        try:
            with self._readings.begin([name]) as (division,):
                tree = await divided_read(division, partial(self._read, division, path, with_arrays), self._fence)
                later = [each.update for each in division.take()[1] if each.update is not None]
        finally:
            self._name = ""
            self.finished.add(name)
        tree = rebased(tree, path, later)
        self._note(path, tree)
        if not any(event.value is ANNOUNCED for event in later):
            self.behind.discard(name)

    def _note(self, path: Path, tree: Any) -> None:
        if path not in self._checks:
            self._history.add_read(path, tree, self._history.clock.now(), answer=True)
        elif path not in self._owed:  # else its turn comes
            self._checks.discard(path)
            if not identical(tree, self._history.tree(path, self._history.clock.now())):
                self._history.add_read(path, tree, self._history.clock.now())

    async def _read(self, division: Division[Event], path: Path, with_arrays: bool) -> tuple[Any, Reply]:
        """Return the document's part, with its arrays if it is their turn, and the note of what it includes."""
        division.asked(in_order=False)
        text, note = await noted_text(self._session, path)
        if text is None:
            return MISSING, note
        tree = tree_of(text, str(path[0]))
        size = _array_bytes(tree) if marked(text) else 0
        if not size or self._allowance.wait(size) == math.inf:
            return tree, note
        if not with_arrays or self._until_turn(size) > 0 or not self._allowance.take(size):
            self._owed.setdefault(path, size)
            return tree, note
        began = time.monotonic()
        await self._touch(path, tree)
        division.asked(in_order=False)
        value, _, note = await fetch(self._session, self._session.keys(path[0]), path[1:])
        now = time.monotonic()
        self._rested = now + _REST * (now - began)
        return await asyncio.to_thread(framed, value), note


def _array_bytes(tree: Any) -> int:
    """Return how many bytes the arrays in a tree have."""
    return sum([leaf_of(it).size for _, it in walk(tree, ()) if isinstance(it, Leaf | np.ndarray | bytes)])


def rebased(tree: Any, path: Path, later: Iterable[Event]) -> Any:
    """Return what was read at a path with the updates applied that it does not include; those announced are to come."""
    for event in later:
        value = MISSING if event.deleted else event.value
        if value is ANNOUNCED:
            continue
        if below(path, event.path):
            rest = path[len(event.path) :]
            tree = MISSING if value is MISSING else get(value, rest)
        elif below(event.path, path):
            tree = changed(tree, event.path[len(path) :], value)
    return tree
