"""Keys of other programs in the rolling buffer. They are only read.

Separated numbers (`0.1 0.2 0.3`) are kept as a list, and bytes for which there is a hint as an array, so that the page
draws them.
"""

from __future__ import annotations

import asyncio
import re
from collections import deque
from typing import Any, NamedTuple

import numpy as np

from ...concurrency.queues import Last
from ...errors import BadKey, BadType, BadValue, NotAllowed
from ...plan.keys import DOCUMENT
from ...plan.paths import Path, check_top_key, show
from ...plan.placeholders import Unfetched
from ...plan.raw import RawValue, read
from ...plan.trees import MISSING, get, walk
from ...pubsub.raw_watch import MOST, RawUpdate, RawWatch
from ...pubsub.refresh import BACKGROUND_RATE
from ...session import Session
from .follower import UNSEEN
from .history import History
from .trees import Frame, framed, thawed

_WAITING = 50_000  # updates that wait for this program before the oldest are skipped
_PACE = 0.1  # seconds between two readings: the page draws ten times a second
_RATE_SECONDS = 5.0  # over which changes are counted
_READINGS = int(_RATE_SECONDS / _PACE)
_LARGEST = 16 << 20  # bytes of a key that are fetched
_SEPARATOR = re.compile(r"[\s,;]+")
_NUMBERS = re.compile(r"[-+.\d][-+.\deE\s,;]*")
_MOST_NUMBERS = 1000  # in one text
_HINT = re.compile(r"\s*(?P<dtype>[<>|]?\w+)\s*\[(?P<shape>\d+(?:\s*,\s*\d+)*)\]\s*(?:\+\s*(?P<offset>\d+))?\s*")


class Hint(NamedTuple):
    """What packed bytes are: an array from a byte on."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int

    @property
    def size(self) -> int:
        return self.offset + self.dtype.itemsize * int(np.prod(self.shape, dtype=object))


def hint_of(text: str) -> Hint:
    """Return what `uint8[480,640,3]`, or `float32[7]+8` with an offset in bytes, says; raises BadValue."""
    found = _HINT.fullmatch(text[:200])
    try:
        dtype = np.dtype(found["dtype"]) if found is not None else None
    except TypeError:
        dtype = None
    if found is None or dtype is None or dtype.kind not in "biuf":
        raise BadValue(f"{text[:40]!r} does not say what bytes are; write it like uint8[480,640,3] or float32[7]+8")
    return Hint(dtype, tuple(map(int, found["shape"].split(","))), int(found["offset"] or 0))


def numbers_of(text: str) -> list[float] | str:
    """Return numbers that are separated by blanks, commas or semicolons as a list, anything else as it is."""
    if _NUMBERS.fullmatch(text.strip()) is None:
        return text
    words = [word for word in _SEPARATOR.split(text) if word]
    try:
        return [float(word) for word in words] if 1 < len(words) <= _MOST_NUMBERS else text
    except ValueError:
        return text


class RawFollower:
    """Follows all keys of other programs, if the interface has no namespace."""

    def __init__(self, session: Session, history: History) -> None:
        self.kinds: dict[str, str] = {}  # the keys, with their Redis types
        self._refused = ""  # why there are none, if the user may not look
        self._session, self._history = session, history
        self._hints: dict[Path, Hint] = {}
        # When each key was read lately, and how many changes that were: more than the buffer has
        self._changes: dict[str, deque[tuple[float, int]]] = {}
        self._watch = RawWatch(session, (), Last(_WAITING), _LARGEST, pace=_PACE, rate=BACKGROUND_RATE, lazy=True)
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        if self._session.namespace or self._task is not None:
            return
        try:
            await self._watch.listen()
        except NotAllowed as error:
            self._refused = f"keys of programs without REEM are not shown: {error}"
        else:
            self.shown_on(0)
            self._task = asyncio.create_task(self._follow())

    @property
    def note(self) -> str:
        """What a page says of keys that it does not show."""
        if self._watch.is_partial:
            return f"{MOST} keys of programs without REEM are shown; others appear when they change"
        return self._refused

    def shown_on(self, pages: int) -> None:
        self._watch.limit_rate(BACKGROUND_RATE * (1 if pages else UNSEEN))

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
            await self._watch.close()

    async def _follow(self) -> None:
        try:
            async for update in self._watch:
                await self._take(update)
        except NotAllowed as error:
            self._refused = f"keys of programs without REEM are not shown: {error}"

    async def find(self, name: str) -> bool:
        """Have the buffer know a key that was stored just now; return whether it is of another program."""
        if self._task is not None and name not in self.kinds:
            it: RawValue = await self._session.run(read(name, _LARGEST))
            if it.kind not in (DOCUMENT, "none"):
                await self._take(RawUpdate(name, it.value, it.value, missed=0, kind=it.kind, size=it.size))
        return name in self.kinds

    async def _take(self, update: RawUpdate) -> None:
        name, history = update.path, self._history
        try:
            check_top_key(name)
        except BadKey:  # a brace: no path leads there
            return
        if update.deleted:
            self._changes.pop(name, None)
            if self.kinds.pop(name, None) is not None:
                history.add((name,), MISSING, 0, history.clock.now())
            return
        tree = await asyncio.to_thread(self._drawable, update.value, (name,))
        when = history.clock.now()
        if name not in self.kinds and not update.initial:
            history.begin(name, None)
        self.kinds[name] = update.kind
        self._changes.setdefault(name, deque(maxlen=_READINGS)).append((when, update.changes))
        place: Path | None = (name,)
        # Of two pictures nothing is known but that they are alike.
        if history.knows(name) and not any(isinstance(it, Frame) for _, it in walk(tree, ())):
            place = history.difference(name, tree, None, when)
        if place is not None:
            history.add_read(place, get(tree, place[1:]), when)

    def rate(self, name: str) -> float | None:
        """Return how often a key has changed in the last seconds, as the server has told; None for never."""
        now = self._history.clock.now()
        lately = [each for each in self._changes.get(name, ()) if each[0] > now - _RATE_SECONDS]
        return sum([count for _, count in lately[1:]]) / max(now - lately[0][0], 1.0) if len(lately) > 1 else None

    def _drawable(self, value: Any, path: Path) -> Any:
        """Return a value as the page keeps it."""
        if isinstance(value, dict):
            return {key: self._drawable(item, (*path, key)) for key, item in value.items()}
        if isinstance(value, str):
            return numbers_of(value)
        hint = self._hints.get(path)
        if isinstance(value, bytes) and hint is not None and len(value) >= hint.size:
            value = np.frombuffer(value, hint.dtype, offset=hint.offset, count=int(np.prod(hint.shape))).reshape(
                hint.shape
            )
        return framed(value)

    def hint(self, path: Path, text: str) -> None:
        """Have bytes at a path shown as an array from now on; those of the past stay as they are.

        Raises:
            BadType: No bytes are there.
            BadValue: The text says nothing, or more bytes than there are.
        """
        hint, history = hint_of(text), self._history
        if not path or path[0] not in self.kinds:
            raise BadType(f"{show(path)} is no key of another program, so REEM knows what it is")
        value = history.tree(path, history.clock.now())
        size = value.described.size if isinstance(value, Frame) else 0
        if not isinstance(value, Frame | Unfetched):
            raise BadType(f"{show(path)} holds no bytes")
        if size < hint.size:
            raise BadValue(f"{text.strip()} needs {hint.size} bytes, and {show(path)} has {size}")
        self._hints[path] = hint
        held = thawed(value)
        data = held.tobytes() if isinstance(held, np.ndarray) else held
        if isinstance(data, bytes):
            history.add_read(path, self._drawable(data, path), history.clock.now())
