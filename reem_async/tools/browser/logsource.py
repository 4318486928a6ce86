"""A recording as a source."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path as FilePath
from typing import Any, TypeVar

import anyio
import anyio.to_thread
import numpy as np

from ...errors import MissingKey, ReadOnly
from ...plan.paths import Path, parse, related, show
from ...plan.placeholders import Unfetched
from ...plan.trees import MISSING, get, mapped
from ..recording.log import ArrayHandle, Log, open_log
from .source import (
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
)
from .trees import differing, strip

Result = TypeVar("Result")

_CACHED = 8  # states, and lists of times, that are kept: neighbouring instants are asked for together
# Values that are read to find out whether a path is worth drawing.
_LOOKS = 6
_ROUNDING = 1e-6
"""Seconds: instants here are floats, those in the file nanoseconds; what happens at an instant belongs to it."""


class LogSource(Source):
    """What a recording says that a server held.

    Reading takes place in a thread, one at a time.

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
        self.log: Log = open_log(path, ships).raw  # pictures are shown as they are
        more = len(self.log.files) - 1
        self.title = self.log.path.name + (f" and {more} more" if more else "")
        # When there was news of a path, sorted; read when it is asked for, since all of a long recording takes seconds.
        self._times = lru_cache(_CACHED)(self.log.news_times)
        self._state = lru_cache(_CACHED)(self._read_state)
        self._gaps = lru_cache(1)(self.log.gaps)
        self._turns = anyio.CapacityLimiter(1)

    async def start(self) -> None:
        """Nothing is to be done."""

    async def close(self) -> None:
        self.log.close()

    def status(self) -> Status:
        notes = [] if self.log.indexed else ["the recording was not ended properly"]
        if self.log.damaged:
            notes.append(f"{self.log.damaged} damaged records are skipped")
        if self.log.undecoded:
            notes.append(f"{len(self.log.undecoded)} topics are left out, see reem log info")
        start, end = (instant and instant + _ROUNDING for instant in (self.log.start, self.log.end))
        return Status(start, end, "", "; ".join(notes))

    def shown_on(self, pages: int) -> None:
        """Do nothing: a recording is read only for a page."""

    def snippets(self, path: Path, at: float | None) -> dict[str, str]:
        files = [str(file.resolve()) for file in self.log.files]
        code = f"from reem.recording import open_log\n\nlog = open_log({(files if files[1:] else files[0])!r})\n"
        when = "log.end" if at is None else repr(at)
        return {"recording": f"{code}value = log[{path!r}].at({when})\ntimes, values = log[{path!r}].history()\n"}

    async def _do(self, work: Callable[[], Result]) -> Result:
        return await anyio.to_thread.run_sync(work, limiter=self._turns)

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
        return sorted(await self._do(lambda: self.log.changes(since, until)), key=show)[:most]

    async def differing(self, since: float, until: float, most: int) -> set[Path]:
        return await self._do(lambda: self._differing(since, until, most))

    def _differing(self, since: float, until: float, most: int) -> set[Path]:
        before, after = self._state(since), self._state(until)
        paths = self.log.changes(since, until)
        return differing(paths, lambda name: before.get(name, MISSING), lambda name: after.get(name, MISSING), most)

    async def activity(self, start: float, end: float, bins: int, path: Path) -> list[int]:
        return await self._do(lambda: counted(self._times(path), start, end, bins))

    async def series(self, path: Path, start: float, end: float) -> Series:
        return await self._do(lambda: numbers_in(self._samples(path, start, end)))

    def _samples(self, path: Path, start: float, end: float) -> Iterable[tuple[float, Any]]:
        times = self._times(path)
        places = np.linspace(0, len(times) - 1, min(len(times), _LOOKS)).astype(int)
        news = [float(times[place]) - (place > 0) * _ROUNDING for place in places]
        # Large arrays are not read for this. What was deleted at the end may have been numbers before.
        found = [get(self._state(at), path) for at in {end, *news}]
        if any(isinstance(it, bool | int | float | list) or is_small_vector(it) for it in found):
            if start > self.log.start:  # what was there already
                with suppress(MissingKey):
                    yield start, self.log.value_at(path, start)
            yield from self.log[path].values(start, end)

    async def losses(self, path: Path, start: float, end: float) -> list[Loss]:
        return await self._do(lambda: list(self._losses(path, start, end)))

    def _losses(self, path: Path, start: float, end: float) -> Iterator[Loss]:
        for when, where, count in self._gaps():
            if start <= when <= end and related(parse(where), path):
                yield Loss(self.log.last_news(path, when - _ROUNDING) or when, when, count)

    async def search(self, text: str, at: float | None, most: int) -> list[Path]:
        state = await self._do(lambda: self._state(self._when(at)))
        return await self._do(lambda: matching(text.lower(), sorted(state), state.items(), most))

    async def write(self, path: Path, value: Any) -> None:
        raise ReadOnly("a recording cannot be changed; play it into a server with `reem play`")

    async def save_layout(self, name: str, layout: dict[str, Any] | None) -> None:
        raise ReadOnly("a recording cannot be changed; share a layout by its link")

    def hint(self, path: Path, text: str) -> None:
        raise ReadOnly("what bytes are can be said on the page of a server, and not of a recording")


def _unfetched(it: Any) -> Any:
    return Unfetched(it.label, it.size, it.summary) if type(it) is ArrayHandle else it
