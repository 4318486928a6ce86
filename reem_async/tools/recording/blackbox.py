"""The last seconds in memory, to be saved once something has happened.

In place of the thread that writes: what it would be handed is kept, with what each key held before the oldest of it.
Saved, this becomes the file that a recorder would have written that had begun then.
"""

from __future__ import annotations

import asyncio
import collections
from collections.abc import Mapping
from typing import Any

import numpy as np
import orjson

from ...plan.paths import Path, show
from ...plan.placeholders import Unreadable
from ...plan.trees import MISSING, mapped, walk
from ...ships.images import EncodedImage
from .format import Kind, Role
from .stored import New, NotWritten, Unchanged, applied
from .times import STEP
from .writer_thread import LARGE, Counts, Operation, Packed, WriterThread

_OVERHEAD = 400  # bytes of memory that an operation takes besides its value
_NODE = 100  # the same for each place in a tree
_WEIGHED = 1_000_000_000  # nanoseconds between two looks at how much the oldest states take
# As orjson reads it back: what only looks like JSON is kept as it is.
_OPTIONS = orjson.OPT_PASSTHROUGH_DATACLASS | orjson.OPT_PASSTHROUGH_DATETIME | orjson.OPT_PASSTHROUGH_SUBCLASS


class BlackBox:
    """The operations of the last seconds, in at most so many bytes. Belongs to the event loop of its recorder.

    What has to go before its time, for want of memory, is counted as dropped; it is still in the states that the rest
    begins with. Large values of these go last, each counted as lost, with an `Unreadable` in its place.
    """

    failure: Exception | None = None  # those of a file are of the one who saves it
    waiting = 0

    def __init__(self, seconds: float, memory: int) -> None:
        self.counts = Counts()
        self.behind: set[str] = set()
        self.stored: set[str] = set()
        self.saves: list[WriterThread] = []  # files in the making, which get what follows
        self.bytes = 0  # of memory, of all operations
        self.seconds = seconds
        self._memory = memory
        self._kept: collections.deque[tuple[Operation, int]] = collections.deque()
        self._states: dict[str, Any] = {}  # what each key held before the first operation
        self._weights: dict[str, int] = {}  # bytes of memory of each of them, as last looked at
        self._changed: set[str] = set()  # keys of which the state was changed since
        self._weighed = 0  # the log time of that look
        self._stripped: set[str] = set()  # keys that are to be read again

    def start(self) -> None:
        """Nothing is written yet."""

    def stop(self, metadata: Mapping[str, str]) -> None:
        """Forget everything."""
        self._kept.clear()
        self._states.clear()

    async def saved(self) -> None:
        """Wait until no file is in the making."""
        while self.saves:  # noqa: ASYNC110 - at the end of a recording, for a moment
            await asyncio.sleep(0.01)

    @property
    def messages(self) -> int:
        return len(self._kept)

    def put(self, operation: Operation, size: int) -> bool:
        """Keep an operation of about `size` bytes; return whether what was read of it may serve again."""
        name, at = str(operation.path[0]), operation.stamp[0]
        if operation.role is Role.GAP:
            self.counts.gaps += 1
        try:
            operation = operation._replace(value=mapped(operation.value, _plain))
        except NotWritten:
            self.behind.add(name)
            return False
        if operation.role in (Role.STATE, Role.STORED):
            self.behind.discard(name)
        if size > self._memory // 2:
            operation = operation._replace(value=self._stripped_of(operation.value, operation.path))
            self._stripped.add(name)
            size = 0
        for save in self.saves:
            save.put(operation, size)
        operation, size = _packed(operation, size)
        self._kept.append((operation, size))
        self.bytes += size
        while self._kept[0][0].stamp[0] < at - self.seconds * 1e9:
            self._fold()
        if at > self._weighed + _WEIGHED:
            self._weigh(at)
        while self.bytes + sum(self._weights.values()) > self._memory and len(self._kept) > 1:
            if self._kept[0][0].role in LARGE:
                self.counts.drop(self._kept[0][0].path)
            self._fold()
            if not len(self._kept) % 100:
                self._weigh(at)
        if name in self._stripped:
            self._stripped.discard(name)
            return False
        return True

    def _fold(self) -> None:
        """Make the oldest operation part of the state before the others."""
        it, size = self._kept.popleft()
        self.bytes -= size
        it, name = it.loaded(), str(it.path[0])
        before = self._states.get(name, MISSING)
        if it.role in (Role.UPDATE, Role.DELETE):
            after = applied(before, it.path[1:], it.role, it.kind, it.value)
        elif it.role in (Role.STATE, Role.STORED):
            after = it.value
        else:
            return
        self._changed.add(name)
        if after is MISSING:
            self._states.pop(name, None)
        else:
            self._states[name] = after

    def _weigh(self, at: int) -> None:
        """Look how much memory the states take, and let go of large values if it is too much."""
        self._weighed = at
        for name in self._changed:
            self._weights.pop(name, None)
            if name in self._states:
                self._weights[name] = _weight(self._states[name])
        self._changed.clear()
        for name in sorted(self._weights, key=self._weights.__getitem__, reverse=True):
            if self.bytes + sum(self._weights.values()) <= self._memory or len(self._kept) > 1:
                break
            self._states[name] = self._stripped_of(self._states[name], (name,))
            self._weights[name] = _weight(self._states[name])
            self._stripped.add(name)

    def _stripped_of(self, value: Any, path: Path) -> Any:
        """Return a value with an `Unreadable` in the place of each array and the like; count them."""

        def strip(it: Any) -> Any:
            if _content(it) < _NODE:
                return it
            self.counts.lose(path)
            return Unreadable(show(path), f"not kept: the black box may take {self._memory} bytes")

        return mapped(value, strip)

    def operations(self) -> list[Operation]:
        """Return what makes a recording of the last seconds: what each key held first, then what came."""
        kept = [it for it, _ in self._kept]
        start = min([it.stamp[0] for it in kept], default=0) - STEP
        states = self._states.items() if kept else ()
        first = [Operation(Role.STATE, (name,), tree, (start, 0, 0), Kind.READ) for name, tree in states]
        return first + kept


def _plain(it: Any) -> Any:
    """Return what a read has brought, or brought before; raises NotWritten if that is not here any more."""
    if type(it) is New:
        it.later.written = it.value
        return it.value
    if type(it) is Unchanged:
        if it.written is None:
            raise NotWritten
        return it.written
    return it


def _packed(it: Operation, size: int) -> tuple[Operation, int]:
    """Return an operation as it is kept, and its bytes of memory: plain values as text, which takes a tenth."""
    if type(it.value) is dict or type(it.value) is list:
        try:
            text = orjson.dumps(it.value, option=_OPTIONS)
        except TypeError:
            return it, _OVERHEAD + max(size, 0) + _NODE * sum(1 for _ in walk(it.value, ()))
        return it._replace(value=Packed(text)), _OVERHEAD + len(text)
    return it, _OVERHEAD + max(size, _content(it.value))


def _content(it: Any) -> int:
    if isinstance(it, np.ndarray):
        return it.nbytes
    if isinstance(it, EncodedImage):
        return len(it.data)
    return len(it) if isinstance(it, bytes | str) else 0


def _weight(tree: Any) -> int:
    return sum([_NODE + _content(it) for _, it in walk(tree, ())])
