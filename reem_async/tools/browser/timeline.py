"""One top-level key over time: what it was at the beginning, and each change since."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterator, Sequence
from typing import Any, NamedTuple

from ...errors import BadData
from ...plan.past import Past
from ...plan.paths import Path, related
from ...plan.trees import MISSING, changed, get
from .trees import strip, tree_of, weight

PENDING: Any = type("Pending", (), {"__repr__": lambda self: "PENDING"})()
"""In place of a value that was announced, and is not known."""

UNKNOWN: Any = type("Unknown", (), {"__repr__": lambda self: "UNKNOWN"})()
"""What a key held before anything is known of it."""

_LOOK_BACK = 2000  # changes looked at to find when a path last changed; after them, the changes of up to so many paths
_FEW_PATHS = 200


class BufferedChange(NamedTuple):
    time: float  # seconds since 1970
    path: Path  # what changed, top-level key first
    value: Any  # what is there since; MISSING if it was removed, PENDING if it is not known
    size: int  # about how many bytes this takes in memory
    answer: bool = False  # it is what was found where a change was announced before: not one more change


class Kept(NamedTuple):
    value: Any  # the value; MISSING if there was none, UNKNOWN if it is not known what there was
    late: float = 0.0  # seconds from this value to a later change before the instant asked for, which was not kept


class ChangeIndex:
    __slots__ = ("_numbers",)

    def __init__(self) -> None:
        self._numbers: dict[Path, list[int]] = {}

    def add(self, path: Path, number: int) -> None:
        """Note a change; its number is larger than all before."""
        self._numbers.setdefault(path, []).append(number)

    @property
    def paths(self) -> Collection[Path]:
        return self._numbers.keys()

    def drop(self, end: int) -> None:
        # Numbers of changes that are forgotten; a path without any is forgotten too.
        for path in list(self._numbers):
            numbers = self._numbers[path]
            del numbers[: bisect_left(numbers, end)]
            if not numbers:
                del self._numbers[path]

    def last(self, path: Path, end: int) -> int:
        """Return the last number below `end` of a change at just this path, -1 if there is none."""
        numbers = self._numbers.get(path, [])
        index = bisect_left(numbers, end)
        return numbers[index - 1] if index else -1

    def lasts(self, end: int, path: Path = ()) -> Iterator[int]:
        """Yield the last number below `end` of each path that concerns `path`; of all for the root."""
        for where in self._numbers:
            if not path or related(where, path):
                number = self.last(where, end)
                if number >= 0:
                    yield number

    def of(self, path: Path) -> list[int]:
        found = [numbers for where, numbers in self._numbers.items() if related(where, path)]
        return found[0].copy() if len(found) == 1 else sorted([number for numbers in found for number in numbers])


class BufferedPast(Past[int]):
    """What is known of one top-level key. Positions of changes are their numbers, from the first one ever."""

    def __init__(self, name: str, base: Any, text: bytes | None = None) -> None:
        self._name = name
        self._base = base  # what it held at first: a document's text, a tree, MISSING or UNKNOWN
        self._times: list[float] = []
        self._gone = 0  # the number of the first change that is still here
        self._known, self._pending = ChangeIndex(), ChangeIndex()
        self._moves: list[int] = []  # where an item was removed from a list: those behind it have other paths since
        self.base_size = len(base) if isinstance(base, bytes) else 0  # about how many bytes `base` takes
        self.changes: list[BufferedChange] = []  # the changes since, oldest first
        # The document's text when it was last looked at, a digest of a long one; None if it changed since
        self.text = text

    def add(self, change: BufferedChange) -> None:
        """Append a change; times never go back."""
        # Numbers only grow; what was folded into the base keeps its number, so indexes stay valid.
        number = self._gone + len(self.changes)
        self.text = None
        self.changes.append(change)
        # A clock may be set back: for searching, times must be in order.
        self._times.append(max(change.time, self._times[-1] if self._times else 0.0))
        (self._pending if change.value is PENDING else self._known).add(change.path, number)
        if change.value is MISSING and isinstance(change.path[-1], int):
            self._moves.append(number)

    @property
    def is_over(self) -> bool:
        """Whether there is no such key, and was not as far back as is known."""
        return not self.changes and self._base is MISSING

    def upto(self, at: float) -> int:
        return bisect_right(self._times, at)

    def fold(self, count: int) -> int:
        """Make the first `count` changes part of the base; returns by how many bytes all of it became smaller."""
        before = self.base_size + sum([change.size for change in self.changes[:count]])
        # The state after these changes is what the past begins with from now on.
        self._base = self._state(count)
        del self.changes[:count], self._times[:count]
        self._gone += count
        self._known.drop(self._gone)
        self._pending.drop(self._gone)
        self._moves = [number for number in self._moves if number >= self._gone]
        self.base_size = 0 if self._base is MISSING or self._base is UNKNOWN else weight(self._base)
        return before - self.base_size

    def strip(self) -> int:
        """Let go of the arrays of the base; returns how many bytes that saved."""
        before = self.base_size
        if not isinstance(self._base, bytes) and self._base is not UNKNOWN:
            self._base = strip(self._base)
            self.base_size = weight(self._base)
        return before - self.base_size

    def state(self, when: float) -> Any:
        """Return the tree at an instant, MISSING or UNKNOWN. Not to be changed."""
        return self._state(self.upto(when))

    def _state(self, count: int) -> Any:
        return self.at((self._name,), self._gone + count - 1)

    def _path(self, change: int) -> Path:
        return self.changes[change - self._gone].path

    def _value(self, change: int) -> Any:
        return self.changes[change - self._gone].value

    def _anchor(self, path: Path) -> Path:
        return path[:1]

    def _newest_whole(self, path: Path, until: int) -> tuple[int, int] | None:
        number = self._known.last(path, until + 1)
        return None if number < 0 else (number, number)

    def _has_moves(self, path: Path, after: int, until: int) -> bool:
        return bisect_right(self._moves, until) > bisect_right(self._moves, after)

    def _inner(self, path: Path, after: int, until: int) -> Iterator[int]:
        numbers = range(max(after + 1, self._gone), until + 1)
        return (number for number in numbers if self._value(number) is not PENDING)

    def _inner_lasts(self, path: Path, after: int, until: int) -> Iterator[tuple[int, int]]:
        return ((number, number) for number in self._known.lasts(until + 1) if number > after)

    def _applied(self, tree: Any, path: Path, change: int, value: Any) -> Any:
        return changed(tree, path, value)

    def _first(self, path: Path) -> Any:
        if not isinstance(self._base, bytes):
            return self._base
        try:
            return tree_of(self._base, "a document")
        except BadData:
            return UNKNOWN

    def _inside(self, tree: Any, path: Path) -> Any:
        return tree if tree is UNKNOWN else get(tree, path)

    def kept(self, path: Path, at: float) -> Kept:
        """Return what was at `path`, and how old it is if the value of that very instant was not kept."""
        end = self._gone + self.upto(at)
        value = self.at(path, end - 1)
        waiting = [number for number in self._pending.lasts(end, path) if not self._answered(number, end, path)]
        if not waiting:
            return Kept(value)
        known = max(self._known.lasts(min(waiting), path), default=-1)
        since = self._times[max(known - self._gone, 0)]
        return Kept(value, max(self._times[max(waiting) - self._gone] - since, 1e-3))

    def _answered(self, number: int, end: int, path: Path) -> bool:
        """Return whether all that a pending change left unknown of `path` was told later: not by one inside of it."""
        place = max(self.changes[number - self._gone].path, path, key=len)
        return any(self._known.last(place[:depth], end) > number for depth in range(1, len(place) + 1))

    def newest(self, path: Path, at: float) -> float:
        """Return when there was the last change of what is at `path`, known or not; 0 if none is left."""
        end = self._gone + self.upto(at)
        number = max([*self._known.lasts(end, path), *self._pending.lasts(end, path)], default=-1)
        return self._times[number - self._gone] if number >= self._gone else 0.0

    def moved(self, path: Path, at: float) -> float:
        """Return since when a path is that of the same item: before, items of lists had others."""
        if not any(isinstance(key, int) for key in path):
            return 0.0
        numbers = self._moves[: bisect_left(self._moves, self._gone + self.upto(at))]
        return self._times[numbers[-1] - self._gone] if numbers else 0.0

    def last(self, paths: Sequence[Path], at: float) -> dict[Path, float]:
        """Return when each of the paths last changed before `at`, as far as that is known."""
        found: dict[Path, float] = {}
        wanted = set(paths)
        count = self.upto(at)
        for change in reversed(self.changes[max(count - _LOOK_BACK, 0) : count]):
            hit = [path for path in wanted if related(change.path, path)]
            for path in hit:
                found[path] = change.time
                wanted.discard(path)
            if not wanted:
                break
        if len(self._known.paths) + len(self._pending.paths) <= _FEW_PATHS:  # beside one that changes very often
            found |= {path: when for path in wanted if (when := self.newest(path, at))}
        return found

    def times(self, path: Path) -> list[float]:
        """Return when there were changes that concern `path`, in order."""
        numbers = self._known.of(path) + self._pending.of(path)
        answers = {number for number in numbers if self.changes[number - self._gone].answer}
        return sorted([self._times[number - self._gone] for number in numbers if number not in answers])

    def values(self, path: Path, start: float, end: float) -> Iterator[tuple[float, Any]]:
        first = self._gone + self.upto(start)
        value = self.at(path, first - 1)
        yield start, value
        numbers, last = self._known.of(path), self._gone + self.upto(end)
        for number in numbers[bisect_left(numbers, first) : bisect_left(numbers, last)]:
            value = self.after(value, path, number, self._value(number))
            yield self.changes[number - self._gone].time, value
