"""Reading what was only announced into the rolling buffer, between the updates where it belongs."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from ..errors import RedisError, ReemError
from ..monitor import ANNOUNCED, Event
from ..plan.notices import note_of
from ..plan.paths import Path, below
from ..plan.placeholders import marked
from ..plan.trees import MISSING, get
from ..recording.fetch import fetch
from ..session import Session
from .history import History
from .peek import noted_texts
from .timeline import PENDING
from .trees import Leaf, changed, leaf_of, tree_of, walk, weight

__all__ = ["Allowance", "Fetcher", "array_bytes"]

_HEARD_WITHIN = 0.1
"""Seconds that the notice of what was read may take to come."""


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
        now = time.monotonic()
        self._saved = min(self._saved + (now - self._then) * self._rate, self._most)
        self._then = now
        if size > self._saved:
            return False
        self._saved -= size
        return True


class Fetcher:
    """Reads one announced value after the other, the newest of each path.

    What is read includes updates up to one that the server notes beside it. So it goes into the buffer when
    that one has been heard of, with those applied that came later: no update is applied twice, or undone.

    Args:
        session: The server.
        history: Where the values go.
        allowance: Bytes of arrays that may be kept.
        last_note: Returns the note of the last notice of a key that was heard.

    Attributes:
        behind: Keys with an announcement that has not been answered.
    """

    def __init__(
        self, session: Session, history: History, allowance: Allowance, last_note: Callable[[str], str]
    ) -> None:
        self._session = session
        self._history = history
        self._allowance = allowance
        self._last_note = last_note
        self._paths: dict[Path, None] = {}
        self._news = asyncio.Event()
        self._name = ""  # what is being read, and what was heard of it meanwhile
        self._since: list[Event] = []
        self.behind: set[str] = set()

    def want(self, path: Path, when: float) -> None:
        """Note that the buffer lacks what is at a path since an instant."""
        self._history.add(path, PENDING, 0, when)
        self.behind.add(str(path[0]))
        self._paths.setdefault(path)
        self._news.set()

    def heard(self, event: Event) -> None:
        """Take notice of an update, whatever it is."""
        if event.name == self._name:
            self._since.append(event)

    async def run(self) -> None:
        """Read what is wanted, for ever."""
        while True:
            await self._news.wait()
            self._news.clear()
            while self._paths:
                path = next(iter(self._paths))
                del self._paths[path]
                with suppress(ReemError, RedisError, OSError):
                    await self._fetch_one(path)

    async def _fetch_one(self, path: Path) -> None:
        self._name, self._since = str(path[0]), []
        before = self._last_note(self._name)
        try:
            tree, note = await self._read(path)
            later = await self._later(before, note)
        finally:
            self._name = ""
        tree = _rebased(tree, path, later)
        self._history.add(path, tree, weight(tree), time.time(), answer=True)
        if not any(event.value is ANNOUNCED for event in later):
            self.behind.discard(str(path[0]))

    async def _read(self, path: Path) -> tuple[Any, str]:
        """Return the document's part, with its arrays if there is room, and the note of what it includes."""
        ((text, note),) = await noted_texts(self._session, [path])
        if text is None:
            return MISSING, note
        tree = tree_of(text, str(path[0]))
        if not marked(text) or not self._allowance.take(array_bytes(tree)):
            return tree, note
        value, _, publisher, number = await fetch(self._session, self._session.keys(path[0]), path[1:])
        return value, note_of(publisher, number) if publisher else ""

    async def _later(self, before: str, note: str) -> Sequence[Event]:
        """Return which updates, of those heard of, came after the noted one; wait for that if it is still to come."""
        if not note:
            return ()
        deadline = time.monotonic() + _HEARD_WITHIN
        while True:
            notes = [before, *[note_of(event.publisher, event.sequence) for event in self._since]]
            if note in notes:
                return self._since[notes.index(note) :]
            if time.monotonic() > deadline:
                return ()
            await asyncio.sleep(0.001)


def array_bytes(tree: Any) -> int:
    """Return how many bytes the arrays in a tree have."""
    return sum([leaf_of(it).size for _, it in walk(tree, ()) if isinstance(it, Leaf | np.ndarray | bytes)])


def _rebased(tree: Any, path: Path, later: Iterable[Event]) -> Any:
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
