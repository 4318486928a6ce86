"""A recording as a source."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import suppress
from functools import lru_cache
from pathlib import Path as FilePath
from typing import Any, NamedTuple, TypeVar

import anyio
import anyio.from_thread
import anyio.to_thread
import numpy as np

from ...errors import MissingKey, ReadOnly
from ...plan.paths import Path, parse, related, show
from ...plan.placeholders import Unfetched
from ...plan.trees import MISSING, get, mapped
from ..recording.align import stacked
from ..recording.log import ArrayHandle, Log, open_log
from .source import (
    MOST_LINES,
    MOST_POINTS,
    Loss,
    Node,
    Page,
    Sample,
    Series,
    Source,
    Status,
    counted,
    is_small_vector,
    matching,
    node_of,
    numbers_in,
    rate_span,
    silences,
    thinned,
)
from .trees import differing, strip

Result = TypeVar("Result")
Step = Callable[[int, int], None]
"""Called with how much is read and how much there is; ends the reading when no page waits for it any more."""

_CACHED = 8  # states that are kept: neighbouring instants are asked for together
_COUNTED = 64  # paths of which the numbers of updates over time are kept
_PART = 0.2  # of a recording; the numbers of less than that are read each time, those of more are kept
_SERIES_BYTES = 64 << 20  # of the numbers over time that are kept, for a page that zooms
_THINNED = 100_000  # rows that are kept of more than that
_ROUNDING = 1e-6
"""Seconds: instants here are floats, those in the file nanoseconds; what happens at an instant belongs to it."""
_AT_ONCE = 1.0  # seconds that opening may take before the page begins without it
_PAUSE = 0.05  # seconds between two looks whether the file is open


class _Closed(Exception):
    """The page ends while the file is opened."""


class LogSource(Source):
    """What a recording says that a server held.

    Reading takes place in threads: what takes a moment in one, what reads much of the file in another, one at a time
    in each. A file that was not ended properly is read from record to record first. The page shows how far this is.

    Args:
        path: The file that `reem record` or another program wrote, or several that are shown as one.
        ships: What makes values of what is not JSON; None for the default ones.

    Raises:
        DamagedRecording: It is no recording.
        OSError: It cannot be read.
    """

    live = False
    writable = False

    def __init__(self, path: str | FilePath | Sequence[FilePath], ships: Sequence[Any] | None = None) -> None:
        files = [path] if isinstance(path, str | FilePath) else list(path)
        self.title = FilePath(files[0]).name + (f" and {len(files) - 1} more" if files[1:] else "")
        self._state = lru_cache(_CACHED)(self._read_state)
        self._gaps = lru_cache(1)(lambda: self.log.gaps())
        self._counts: OrderedDict[tuple[Path, int], list[int]] = OrderedDict()
        self._series: OrderedDict[Path, _Columns] = OrderedDict()
        self._quick, self._slow = anyio.CapacityLimiter(1), anyio.CapacityLimiter(1)
        self._parts: dict[object, float] = {}  # how much is done of each reading that goes on
        self._closing = False
        self._opening: Future[Log] = Future()
        threading.Thread(target=self._open, args=(files, ships), name="reem log", daemon=True).start()
        with suppress(FutureTimeout):
            self._opening.result(_AT_ONCE)

    def _open(self, files: Sequence[str | FilePath], ships: Sequence[Any] | None) -> None:
        def step(done: int, every: int) -> None:
            self._parts[self] = done / max(every, 1)
            if self._closing:
                raise _Closed

        try:
            self._opening.set_result(open_log(files, ships, progress=step).raw)  # pictures are shown as they are
        except BaseException as error:
            self._opening.set_exception(error)
        finally:
            self._parts.pop(self, None)

    @property
    def log(self) -> Log:
        return self._opening.result()

    async def start(self) -> None:
        """Nothing is to be done."""

    async def opened(self) -> None:
        """Wait until the file is open; raises what opening it has raised."""
        while not self._opening.done():  # noqa: ASYNC110 - by a thread
            await anyio.sleep(_PAUSE)
        self._opening.result()

    async def close(self) -> None:
        self._closing = True
        with suppress(ValueError, OSError, _Closed):  # what opening has raised
            await self.opened()
            self.log.close()

    def status(self) -> Status:
        part = min([1.0, *self._parts.values()])
        if not self._opening.done():
            return Status(0, 0, part=part)
        if self._opening.exception() is not None:
            return Status(0, 0, str(self._opening.exception()))
        notes = [] if self.log.indexed else ["the recording was not ended properly"]
        if self.log.damaged:
            notes.append(f"{self.log.damaged} damaged records are skipped")
        if self.log.undecoded:
            count = len(self.log.undecoded)
            notes.append(f"{count} topic{' is' if count == 1 else 's are'} left out, see reem log info")
        start, end = (instant and instant + _ROUNDING for instant in (self.log.start, self.log.end))
        return Status(start, end, "", "; ".join(notes), part)

    def shown_on(self, pages: int) -> None:
        """Do nothing: a recording is read only for a page."""

    def snippets(self, path: Path, at: float | None) -> dict[str, str]:
        files = [str(file.resolve()) for file in self.log.files]
        code = f"from reem.recording import open_log\n\nlog = open_log({(files if files[1:] else files[0])!r})\n"
        when = "log.end" if at is None else repr(at)
        return {"recording": f"{code}value = log[{path!r}].at({when})\ntimes, values = log[{path!r}].history()\n"}

    async def _do(self, work: Callable[[], Result]) -> Result:
        await self.opened()
        return await anyio.to_thread.run_sync(work, limiter=self._quick)

    async def _read(self, work: Callable[[Step], Result]) -> Result:
        """Return what `work` does, which may read much of the file; it ends soon after the request is cancelled."""
        await self.opened()
        reading = object()

        def step(done: int, every: int) -> None:
            anyio.from_thread.check_cancelled()
            self._parts[reading] = done / max(every, 1)

        try:
            return await anyio.to_thread.run_sync(work, step, limiter=self._slow)
        finally:
            self._parts.pop(reading, None)

    def _read_state(self, at: float) -> dict[str, Any]:
        trees = self.log.tree_at(at)
        return {name: strip(mapped(tree, _unfetched)) for name, tree in trees.items()}

    def _rate(self, name: str, at: float) -> float | None:
        # The same span as of a live server, so that both show the same rate.
        span = rate_span(at, self.log.start, max(self.log.end, at))
        since, until = span or (self.log.start, at)  # a recording of less than a second counts as one
        count = self.log.news_count((name,), since, until)
        return count / max(until - since, 1.0) if count else None

    def _when(self, at: float | None) -> float:
        return self.log.end + _ROUNDING if at is None else at

    async def nodes(self, paths: Sequence[Path], at: float | None) -> list[Node | None]:
        return await self._do(lambda: [self._node(path, self._when(at)) for path in paths])

    def _node(self, path: Path, at: float) -> Node | None:
        value = get(self._state(at), path)
        if value is MISSING:
            return None
        rate = self._rate(str(path[0]), at) if len(path) == 1 else None
        return node_of(path, value).stamped(self.log.last_news(path, at), rate)

    async def children(self, path: Path, start: int, count: int, at: float | None) -> Page:
        return await self._do(lambda: self._children(path, start, count, self._when(at)))

    def _children(self, path: Path, start: int, count: int, at: float) -> Page:
        value = get(self._state(at), path)
        if not isinstance(value, dict | list):
            raise MissingKey(f"nothing was below {show(path)} then")
        keys: Sequence[str | int] = range(len(value)) if isinstance(value, list) else list(value)
        keys = keys if path else sorted([str(key) for key in keys])
        nodes = [self._node((*path, key), at) for key in keys[start : start + count]]
        return Page(len(keys), start, [node for node in nodes if node is not None])

    async def value(self, path: Path, at: float | None) -> Sample:
        return Sample(await self._do(lambda: self.log.value_at(path, self._when(at))))

    async def changes(self, since: float, until: float, most: int) -> list[Path]:
        if since >= until:  # as for the stream of events, which does not wait for what is read
            return []
        return sorted(await self._do(lambda: self.log.changes(since, until)), key=show)[:most]

    async def differing(self, since: float, until: float, most: int) -> set[Path]:
        return await self._do(lambda: self._differing(since, until, most))

    def _differing(self, since: float, until: float, most: int) -> set[Path]:
        before, after = self._state(since), self._state(until)
        paths = self.log.changes(since, until)
        return differing(paths, lambda name: before.get(name, MISSING), lambda name: after.get(name, MISSING), most)

    async def activity(self, start: float, end: float, bins: int, path: Path) -> list[int]:
        return await self._read(lambda step: self._activity(start, end, bins, path, step))

    def _activity(self, start: float, end: float, bins: int, path: Path, step: Step) -> list[int]:
        if (path, bins) not in self._counts:
            self._counts[path, bins] = counted(self.log.news_times(path, step), start, end, bins)
            if len(self._counts) > _COUNTED:
                self._counts.popitem(last=False)
        self._counts.move_to_end((path, bins))
        return self._counts[path, bins]

    async def series(self, path: Path, start: float, end: float) -> Series:
        return await self._read(lambda step: self._numbers(path, start, end, step).between(start, end))

    def _numbers(self, path: Path, start: float, end: float, step: Step) -> _Columns:
        kept, is_part = self._series.get(path), end - start < _PART * self.log.duration
        if kept is not None and (kept.is_whole or not is_part):
            self._series.move_to_end(path)
            return kept
        at_end = get(self._state(self._when(None)), path)
        if isinstance(at_end, Unfetched | np.ndarray) and not is_small_vector(at_end):
            return _NONE  # large arrays are not read for this
        if is_part:
            return _columns(self._outlines(path, self.log.last_news(path, start) or start, end, step))
        found = self._series[path] = _columns(self._outlines(path, None, None, step))
        while sum([it.bytes for it in self._series.values()]) > _SERIES_BYTES and len(self._series) > 1:
            self._series.popitem(last=False)
        return found

    def _outlines(
        self, path: Path, start: float | None, end: float | None, step: Step
    ) -> Iterator[tuple[np.ndarray[Any, Any], list[Any]]]:
        first, every = self.log.start, int(self.log.duration * 1e3)
        for instants, values in self.log[path].outlines(start, end):
            times = np.array(instants, np.int64).astype(np.float64) / 1e9
            step(int((times[-1] - first) * 1e3), every)
            yield times, values

    async def losses(self, path: Path, start: float, end: float) -> list[Loss]:
        return await self._do(lambda: list(self._losses(path, start, end)))

    def _losses(self, path: Path, start: float, end: float) -> Iterator[Loss]:
        for when, where, count in self._gaps():
            if start <= when <= end and related(parse(where), path):
                yield Loss(self.log.last_news(path, when - _ROUNDING) or when, when, count)

    async def search(self, text: str, at: float | None, most: int) -> list[Path]:
        state = await self._do(lambda: self._state(self._when(at)))
        return await self._do(lambda: matching(text.lower(), sorted(state), state.items(), most))

    async def write(self, path: Path, value: Any, *, retype: bool = False) -> list[str]:
        raise ReadOnly("a recording cannot be changed; play it into a server with `reem play`")

    async def save_layout(self, name: str, layout: dict[str, Any] | None) -> None:
        raise ReadOnly("a recording cannot be changed; share a layout by its link")

    def hint(self, path: Path, text: str) -> None:
        raise ReadOnly("the type of bytes cannot be set for a recording; set it on the page of the server")


class _Columns(NamedTuple):
    """The numbers of a path over time: an instant for each row, and a column for each line."""

    names: list[str]
    times: np.ndarray[Any, Any]
    rows: np.ndarray[Any, Any]  # NaN where there was no number
    is_whole: bool = True  # else there were so many that only some rows are kept, the extremes among them

    @property
    def bytes(self) -> int:
        return int(self.times.nbytes + self.rows.nbytes)

    def between(self, start: float, end: float) -> Series:
        """Return the part from what was there at the start on, as much of it as is drawn."""
        first, last = np.searchsorted(self.times, [start, end + _ROUNDING])
        times, rows = self.times[first:last], self.rows[first:last]
        if first and (first == len(self.times) or self.times[first] > start):
            times, rows = np.append(start, times), self.rows[first - 1 : last]
        if not times.size:
            return Series([], [], [])
        places = thinned(rows, MOST_POINTS)
        lines = [[None if number != number else number for number in line] for line in rows[places].T.tolist()]
        return Series(self.names, times[places].tolist(), lines, silences(times, end))


_NONE = _Columns([], np.empty(0), np.empty((0, 0)))


def _columns(parts: Iterable[tuple[np.ndarray[Any, Any], list[Any]]]) -> _Columns:
    """Return what `numbers_in` makes of values that come in parts, mostly as arrays from the beginning."""
    blocks: list[tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]] = []
    is_list, is_whole, size = False, True, 0
    for instants, values in parts:
        array, has_items = stacked(values), isinstance(values[0], np.ndarray | list)
        if isinstance(array, np.ndarray) and array.ndim == 1 + has_items and array[:1].size <= MOST_LINES:
            block = array.reshape(len(values), -1).astype(np.float64)
            block[~np.isfinite(block)] = np.nan
            is_list = is_list or array.ndim == 2
        else:
            found = numbers_in(zip(instants.tolist(), values, strict=True))
            block = np.array(found.lines, np.float64).T if found.lines else np.full((len(values), 1), np.nan)
            is_list = is_list or found.names[:1] == ["[0]"]
        blocks.append((instants, block))
        size += block.nbytes + instants.nbytes
        if size > _SERIES_BYTES:
            times, rows = _joined(blocks)
            places = thinned(rows, _THINNED)
            blocks, is_whole = [(times[places], rows[places])], False
            size = sum([each.nbytes for each in blocks[0]])
    times, rows = _joined(blocks)
    if np.isnan(rows).all():
        return _NONE
    names = [f"[{index}]" for index in range(rows.shape[1])] if is_list else [""]
    return _Columns(names, times, rows, is_whole)


def _joined(blocks: list[tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]]) -> tuple[Any, Any]:
    width = max([rows.shape[1] for _, rows in blocks], default=0)
    rows = [np.pad(each, ((0, 0), (0, width - each.shape[1])), constant_values=np.nan) for _, each in blocks]
    return np.concatenate([np.empty(0), *[times for times, _ in blocks]]), np.concatenate([np.empty((0, width)), *rows])


def _unfetched(it: Any) -> Any:
    return Unfetched(it.label, it.size, it.summary) if type(it) is ArrayHandle else it
