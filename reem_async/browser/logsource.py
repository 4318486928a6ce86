"""A recording as a source."""

from __future__ import annotations

import bisect
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path as FilePath
from typing import Any, TypeVar

import anyio
import anyio.to_thread
import numpy as np

from ..errors import MissingKey, ReadOnly
from ..plan.paths import Path, below, show
from ..plan.trees import MISSING, get
from ..recording.container import Container
from ..recording.log import Log, open_log
from ..recording.past import Past
from ..ships.registry import Ships, default_ships
from ..transport.recorder import CommandRecorder
from .addresses import address
from .nodes import Node, Page, node_of
from .source import Sample, Series, Status, counted, numbers_in
from .trees import tree_of_outline, walk

__all__ = ["LogSource"]

Result = TypeVar("Result")

_NEWS = ("update", "delete", "state")
_CACHED = 8
_RATE_SECONDS = 5.0
_WALKED = 200_000
_LOOKS = 6
_ROUNDING = 1e-6
"""Seconds: instants here are floats, those in the file nanoseconds; what happens at an instant belongs to it."""


class _Times:
    """When there was news of which path."""

    def __init__(self, path: FilePath) -> None:
        container = Container(path)
        try:
            past = Past(container, Ships(default_ships(), CommandRecorder))
            paths = {channel: each.path for each in past.streams if each.role in _NEWS for channel in each.channels}
            found: dict[Path, list[np.ndarray[Any, Any]]] = {}
            for info in container.chunks:
                for channel, (times, _) in container.index(info).items():
                    if channel in paths:
                        found.setdefault(paths[channel], []).append(times)
        finally:
            container.close()
        self._keys: dict[str, list[tuple[Path, np.ndarray[Any, Any]]]] = {}
        for place, pieces in found.items():
            times = np.sort(np.concatenate(pieces)).astype(np.float64) / 1e9
            self._keys.setdefault(str(place[0]), []).append((place, times))
        self._start = min([float(times[0]) for times in self.concerning(()) if len(times)], default=0.0)

    def concerning(self, path: Path) -> list[np.ndarray[Any, Any]]:
        """Return the times of all that concerns `path`, all there are for the root."""
        if not path:
            return [times for each in self._keys.values() for _, times in each]
        return [times for where, times in self._keys.get(str(path[0]), ()) if below(where, path) or below(path, where)]

    def last(self, path: Path, at: float) -> float | None:
        """Return when `path` last changed before `at`."""
        before = [times[: np.searchsorted(times, at, "right")] for times in self.concerning(path)]
        return max([float(times[-1]) for times in before if len(times)], default=None)

    def rate(self, name: str, at: float) -> float | None:
        """Return updates per second of a key in the seconds before `at`."""
        over = min(_RATE_SECONDS, max(at - self._start, 1.0))
        pairs = [np.searchsorted(times, (at - over, at), "right") for times in self.concerning((name,))]
        count = sum([int(last - first) for first, last in pairs])
        return count / over if count else None


class LogSource:
    """What a recording says that a server held.

    Reading takes place in a thread, one at a time.

    Args:
        path: The file that `reem record` wrote.

    Raises:
        DamagedRecording: It is no recording of REEM.
        OSError: It cannot be read.
    """

    live = False
    writable = False

    def __init__(self, path: str | FilePath) -> None:
        self.title = FilePath(path).name
        self.log: Log = open_log(path)
        self._times = _Times(FilePath(path))
        self._states: OrderedDict[float, dict[str, Any]] = OrderedDict()
        self._turns: anyio.CapacityLimiter | None = None

    async def start(self) -> None:
        """Nothing is to be done."""

    async def close(self) -> None:
        """Close the file. Idempotent."""
        self.log.close()

    def status(self) -> Status:
        """Return the span of the recording."""
        notes = [] if self.log.indexed else ["the recording was not ended properly"]
        if self.log.damaged:
            notes.append(f"{self.log.damaged} damaged records are skipped")
        start, end = (instant and instant + _ROUNDING for instant in (self.log.start, self.log.end))
        return Status(start, end, "", "; ".join(notes))

    def snippets(self, path: Path, at: float | None) -> dict[str, str]:
        """Return Python that reads a path from the recording."""
        code = f"from reem.recording import open_log\n\nlog = open_log({str(self.log.path.resolve())!r})\n"
        when = "log.end" if at is None else repr(at)
        return {"recording": f"{code}value = log[{path!r}].at({when})\ntimes, values = log[{path!r}].history()\n"}

    async def _do(self, work: Callable[[], Result]) -> Result:
        if self._turns is None:
            self._turns = anyio.CapacityLimiter(1)
        return await anyio.to_thread.run_sync(work, limiter=self._turns)

    def _state(self, at: float) -> dict[str, Any]:
        """Return the trees of all keys at an instant; the last few are kept."""
        if at not in self._states:
            self._states[at] = {name: tree_of_outline(it) for name, it in self.log.outline_at(at).items()}
            while len(self._states) > _CACHED:
                self._states.popitem(last=False)
        self._states.move_to_end(at)
        return self._states[at]

    def _when(self, at: float | None) -> float:
        return self.log.end + _ROUNDING if at is None else at

    async def nodes(self, paths: Sequence[Path], at: float | None) -> list[Node | None]:
        """Return what was at each path."""
        return await self._do(lambda: [self._node(path, self._when(at)) for path in paths])

    def _node(self, path: Path, at: float) -> Node | None:
        value = get(self._state(at), path)
        if value is MISSING:
            return None
        rate = self._times.rate(str(path[0]), at) if len(path) == 1 else None
        return node_of(path, value).stamped(self._times.last(path, at), rate)

    async def children(self, path: Path, start: int, count: int, at: float | None) -> Page:
        """Return some of what was directly below a path."""
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
        """Return the value at a path; raises MissingKey, DamagedRecording."""
        return Sample(await self._do(lambda: self.log.value_at(path, self._when(at))))

    async def changes(self, since: float, until: float, most: int) -> list[Path]:
        """Return which paths changed."""
        return sorted(await self._do(lambda: self.log.changes(since, until)), key=show)[:most]

    async def step(self, at: float, forward: bool, path: Path) -> float | None:
        """Return the instant of the next or previous change."""
        found: list[float] = []
        for times in self._times.concerning(path):
            index = (
                bisect.bisect_right(times, at + _ROUNDING)
                if forward
                else bisect.bisect_left(times, at - 3 * _ROUNDING) - 1
            )
            if 0 <= index < len(times):
                found.append(float(times[index]) + _ROUNDING)
        return None if not found else min(found) if forward else max(found)

    async def activity(self, start: float, end: float, bins: int, path: Path) -> list[int]:
        """Return how many changes there were in parts of a span."""
        times = self._times.concerning(path)
        whole = np.concatenate(times) if times else np.empty(0)
        return counted(whole.tolist(), start, end, bins)

    async def series(self, path: Path, start: float, end: float) -> Series:
        """Return numbers over time."""
        return await self._do(lambda: numbers_in(self._samples(path, start, end)))

    def _samples(self, path: Path, start: float, end: float) -> Iterable[tuple[float, Any]]:
        news = [float(each) for times in self._times.concerning(path) for each in (times[0], times[-1] - 1e-6)]
        # Arrays are not read for this. What was deleted at the end may have been numbers before.
        if any(isinstance(get(self._state(at), path), bool | int | float | list) for at in {end, *news[:_LOOKS]}):
            yield from self.log[path].values(start, end)

    async def search(self, text: str, at: float | None, most: int) -> list[Path]:
        """Return paths with `text` in them, top-level keys first."""
        return await self._do(lambda: self._search(text.lower(), self._state(self._when(at)), most))

    def _search(self, needle: str, state: dict[str, Any], most: int) -> list[Path]:
        found = [(name,) for name in sorted(state) if needle in address((name,)).lower()][:most]
        inner: list[Path] = list(found)
        for number, (path, _) in enumerate(walk(state, ())):
            if len(inner) >= most or number > _WALKED:
                break
            if len(path) > 1 and needle in address(path).lower():
                inner.append(path)
        return inner

    async def write(self, path: Path, value: Any) -> None:
        """Raise ReadOnly."""
        raise ReadOnly("a recording cannot be changed; play it into a server with `reem play`")
