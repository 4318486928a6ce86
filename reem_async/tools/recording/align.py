"""Values of recordings as arrays: those of one path, and those of several paths at common instants.

Each path has a cursor, which has the value before an instant and the one after it. Instants only move on, so each path
is read once, and only the values that a row needs are decoded.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import BadData, BadType, BadValue
from ...plan.arguments import check_number
from ...plan.paths import Path, shorten, show
from ...plan.trees import MISSING
from .log_reader import RecordedPast
from .times import seconds

METHODS = ("previous", "nearest", "linear")

EXACT = 2**53
"""Integers up to this size are floats without loss."""

# A block ends with the row that takes it to so many rows, or bytes of arrays.
_BLOCK_ROWS = 1024
_BLOCK_BYTES = 64 << 20


@dataclass(slots=True)
class AlignedCounts:
    """What became of the values of one path in an alignment. The first four add up to the rows.

    Attributes:
        used: Rows with a value that no earlier row has.
        repeated: Rows with the value of an earlier row.
        interpolated: Rows between two values.
        missing: Rows without a value.
        dropped: Values between the first row and the last that are in no row.
    """

    used: int = 0
    repeated: int = 0
    interpolated: int = 0
    missing: int = 0
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class AlignedBlock:
    """Rows of an alignment.

    Attributes:
        times: The instants of the rows, in seconds since 1970: float64, (N,).
        values: By path: one array, the first axis being the rows, where `LogPath.history` returns one; else a list.
            A missing value is NaN in an array of floats, 0 in another array, and None in a list.
        missing: By path: which rows have no value. bool, (N,).
    """

    times: np.ndarray[Any, Any]
    values: dict[str, np.ndarray[Any, Any] | list[Any]]
    missing: dict[str, np.ndarray[Any, Any]]

    def __getitem__(self, path: str) -> np.ndarray[Any, Any] | list[Any]:
        return self.values[path]

    def __len__(self) -> int:
        return len(self.times)


class Alignment:
    """The values of several paths of a recording at common instants, as `Log.align` makes it.

    A loop yields `AlignedBlock`s of up to 1024 rows or 64 MB of arrays, so memory is bounded however long the recording
    is. `read` returns all rows as one block. Each loop reads the recording anew.

    Attributes:
        counts: By path, an `AlignedCounts` of the last loop, complete when it has ended.
    """

    def __init__(
        self,
        past: RecordedPast,
        whole: Whole,
        places: Mapping[str, Path],
        instants: Callable[[], Iterator[int]],
        start: int,
        *,
        clock: str,
        method: str | Mapping[str, str],
        tolerance: float | Mapping[str, float] | None,
    ) -> None:
        self._clock = clock
        self._past = past
        self._whole = whole
        self._places = places
        self._instants = instants
        self._start = start
        self._methods = {path: _of(path, method, "nearest", "method", places) for path in places}
        for path, each in self._methods.items():
            if each not in METHODS:
                raise BadValue(f"method={shorten(each)} of {path} is none of {', '.join(METHODS)}")
        self._tolerances: dict[str, int] = {}
        for path in places:
            allowed = _of(path, tolerance, None, "tolerance", places)
            if allowed is not None:
                check_number("tolerance", allowed, "use seconds, or None for no limit")
            self._tolerances[path] = _NO_LIMIT if allowed is None else round(min(allowed, 1e9) * 1e9)
        self.counts: dict[str, AlignedCounts] = {}
        for cursor in self._cursors().values():
            cursor.check()

    def __iter__(self) -> Iterator[AlignedBlock]:
        return self._blocks(_BLOCK_ROWS, _BLOCK_BYTES)

    def read(self) -> AlignedBlock:
        """Return all rows as one block: arrays of the whole recording, in memory at once."""
        return next(self._blocks(None, None), self._block([]))

    def rows(self) -> Iterator[tuple[float, dict[str, Any]]]:
        """Yield the instant of each row and its values by path, without those that are missing."""
        cursors = self._cursors()
        self.counts = {path: cursor.counts for path, cursor in cursors.items()}
        for instant in self._instants():
            found = {path: cursor.at(instant) for path, cursor in cursors.items()}
            yield seconds(instant), {path: value for path, value in found.items() if value is not MISSING}

    def _cursors(self) -> dict[str, _Cursor]:
        start = self._start
        return {
            path: _Cursor(
                self._past, self._whole, place, self._clock, self._methods[path], self._tolerances[path], start
            )
            for path, place in self._places.items()
        }

    def _blocks(self, most_rows: int | None, most_bytes: int | None) -> Iterator[AlignedBlock]:
        rows: list[tuple[float, dict[str, Any]]] = []
        size = 0
        for row in self.rows():
            rows.append(row)
            size += sum(getattr(value, "nbytes", 0) for value in row[1].values())
            if (most_rows and len(rows) >= most_rows) or (most_bytes and size >= most_bytes):
                yield self._block(rows)
                rows, size = [], 0
        if rows:
            yield self._block(rows)

    def _block(self, rows: list[tuple[float, dict[str, Any]]]) -> AlignedBlock:
        columns = {path: [found.get(path, MISSING) for _, found in rows] for path in self._places}
        missing = {path: np.array([value is MISSING for value in column], bool) for path, column in columns.items()}
        values = {path: _filled(column, missing[path]) for path, column in columns.items()}
        return AlignedBlock(np.array([time for time, _ in rows], np.float64), values, missing)


_NO_LIMIT = 2**63
CLOCKS = ("recorder", "publisher")
_SET_BACK = 10**9
"""Nanoseconds; two publishers of one path may be received in another order than by their times, within moments."""

Whole = Callable[[Any], Any]
"""Returns a tree with its arrays; MISSING if something in it cannot be read."""


def at_rate(rate: float, start: int, end: int) -> Iterator[int]:
    """Yield the instants of rows, in ns."""
    for number in itertools.count():
        # From the start each time: sums of rounded periods would drift.
        instant = start + round(number * 1e9 / rate)
        if instant > end:
            return
        yield instant


def _of(path: str, given: Any, otherwise: Any, name: str, paths: Mapping[str, Any]) -> Any:
    """Return what an option is for a path: a dict has it by path; raise BadValue if it names another path."""
    if not isinstance(given, Mapping):
        return given
    for each in given:
        if each not in paths:
            raise BadValue(f"{name} names {shorten(each)}, which is none of the paths: {', '.join(paths)}")
    return given.get(path, otherwise)


def _filled(column: list[Any], missing: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | list[Any]:
    there = [value for value in column if value is not MISSING]
    whole = stacked(there)
    if len(there) == len(column):
        return whole
    if not there or not isinstance(whole, np.ndarray):
        return [None if value is MISSING else value for value in column]
    full = np.full((len(column), *whole.shape[1:]), np.nan if whole.dtype.kind in "fc" else 0, whole.dtype)
    full[~missing] = whole
    return full


def by_clock(
    past: RecordedPast, path: Path, clock: str, changes: Iterator[tuple[int, Any]]
) -> Iterator[tuple[int, Any]]:
    """Yield changes with the times of a clock, which never go back; raise BadData if a publisher's was set back."""
    last = 0
    for received, tree in changes:
        time = received if clock == "recorder" else past.published_at(path, received)
        if time < last - _SET_BACK:
            raise BadData(
                f"the clock of the publisher of {show(path)} was set back by {seconds(last - time):.3f} s, in what was "
                f'received at {seconds(received)!r}; use the clock "recorder"'
            )
        last = max(time, last)
        yield last, tree


class _TimedValue:
    """What was at a path from an instant on, in ns."""

    __slots__ = ("time", "tree", "uses", "value")

    def __init__(self, time: int, tree: Any) -> None:
        self.time = time
        self.tree = tree
        self.uses = 0  # rows that have it
        self.value: Any = None  # once `uses` is over 0; MISSING if it cannot be read


class _Cursor:
    """The values of one path before and after an instant that only moves on."""

    def __init__(
        self, past: RecordedPast, whole: Whole, path: Path, clock: str, method: str, tolerance: int, start: int
    ) -> None:
        self.counts = AlignedCounts()
        self._whole = whole
        self._path = path
        self._method = method
        self._tolerance = tolerance
        self._start = start
        newest = past.newest(past.concerning(path), start, -1)
        # From the last value before the start on, if there is one.
        changes = past.changes(path, (start if newest is None else newest[0].time) - 1)
        self._times = by_clock(past, path, clock, changes)
        self._before: _TimedValue | None = None
        self._after = self._next()

    def check(self) -> None:
        """Raise BadType if the first value is not of the kind that the method needs."""
        if self._method == "linear" and self._after is not None and self._after.tree is not MISSING:
            self._numbers(self._after)

    def at(self, instant: int) -> Any:
        """Return the value for a row, MISSING if there is none."""
        while self._after is not None and self._after.time <= instant:
            passed, self._before, self._after = self._before, self._after, self._next()
            if passed is not None and not passed.uses and passed.time >= self._start and passed.tree is not MISSING:
                self.counts.dropped += 1
        value = self._between(instant) if self._method == "linear" else self._chosen(instant)
        if value is MISSING:
            self.counts.missing += 1
        return value

    def _next(self) -> _TimedValue | None:
        change = next(self._times, None)
        return None if change is None else _TimedValue(*change)

    def _near(self, each: _TimedValue | None, instant: int) -> bool:
        return each is not None and each.tree is not MISSING and abs(each.time - instant) <= self._tolerance

    def _chosen(self, instant: int) -> Any:
        near = [self._before] if self._method == "previous" else [self._before, self._after]
        found = [each for each in near if each is not None and self._near(each, instant)]
        if not found:
            return MISSING
        best = min(found, key=lambda each: abs(each.time - instant))
        is_new = best.uses == 0
        value = self._read(best)
        if value is not MISSING:
            self.counts.used += is_new
            self.counts.repeated += not is_new
        return value

    def _between(self, instant: int) -> Any:
        before, after = self._before, self._after
        if before is None or not self._near(before, instant):
            return MISSING
        is_new = before.uses == 0
        if before.time == instant:
            value = self._numbers(before)
            self.counts.used += is_new and value is not MISSING
            self.counts.repeated += not is_new and value is not MISSING
            return value
        if after is None or not self._near(after, instant):
            return MISSING
        first, second = self._numbers(before), self._numbers(after)
        if first is MISSING or second is MISSING:
            return MISSING
        if np.shape(first) != np.shape(second):
            raise BadType(
                f"{show(self._path)} changes from {np.shape(first)} to {np.shape(second)} numbers at "
                f"{seconds(after.time)!r} and cannot be interpolated; use the method previous or nearest"
            )
        self.counts.interpolated += 1
        return first + (second - first) * ((instant - before.time) / (after.time - before.time))

    def _read(self, each: _TimedValue) -> Any:
        if not each.uses:
            each.value = self._whole(each.tree)
        each.uses += 1
        return each.value

    def _numbers(self, each: _TimedValue) -> Any:
        """Return a number as float, and numbers as an array of floats; MISSING if they cannot be read."""
        value = self._read(each)
        if value is MISSING or type(value) is float:
            return value
        if type(value) is int:
            return float(value)
        array = stacked([value]) if isinstance(value, list | np.ndarray) else value
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
            raise BadType(
                f"{show(self._path)} is {shorten(value)} at {seconds(each.time)!r}, and cannot be interpolated; "
                "use the method previous or nearest, or name a path of numbers inside of it"
            )
        return array[0] if array.dtype.kind == "f" else array[0].astype(np.float64)


def stacked(values: list[Any]) -> np.ndarray[Any, Any] | list[Any]:
    """Return values as one array if they are all numbers, arrays of one kind, or lists of as many numbers; else as is.

    Numbers become bool, int64, uint64 or float64, whichever holds them all exactly.
    """
    if not values:
        return np.empty(0)
    kinds = set(map(type, values))
    if kinds == {np.ndarray}:
        forms = {(value.dtype, value.shape) for value in values}
        return np.stack(values) if len(forms) == 1 else values
    if kinds == {list}:
        lengths = set(map(len, values))
        if len(lengths) != 1 or lengths == {0}:
            return values
        flat = numbers(list(itertools.chain.from_iterable(values)))
        return values if flat is None else flat.reshape(len(values), -1)
    flat = numbers(values)
    return values if flat is None else flat


def numbers(values: list[Any]) -> np.ndarray[Any, Any] | None:
    """Return numbers as an array that holds them all exactly, None if there is none."""
    kinds = set(map(type, values))
    if kinds == {bool}:
        return np.array(values, bool)
    if kinds == {int}:
        low, high = min(values), max(values)
        if low >= -(2**63) and high < 2**63:
            return np.array(values, np.int64)
        return np.array(values, np.uint64) if low >= 0 else None
    if kinds == {float}:
        return np.array(values, np.float64)
    if kinds == {int, float} and all(type(value) is float or abs(value) <= EXACT for value in values):
        return np.array(values, np.float64)
    return None
