"""Sampling: paths that are read at given periods, as the manual's key file says them."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterable
from pathlib import Path as FilePath
from typing import NamedTuple

from ...concurrency.tasks import Tasks
from ...errors import BadInput, BadValue, RedisError
from ...plan.arguments import check_instance, check_number
from ...plan.paths import Path, check_top_key, counts_from_end, parse, show
from ...session import Session
from .key_recorder import fetch


class Sample(NamedTuple):
    path: Path
    seconds: float

    def __str__(self) -> str:
        return f"{show(self.path)} every {self.seconds:g} s"


def samples_of(given: dict[str, float] | str | FilePath | None) -> list[Sample]:
    if given is None:
        return []
    if isinstance(given, dict):
        return [sample(path, period) for path, period in given.items()]
    check_instance("sample", given, (str, FilePath), 'use a dict such as {"arm": 0.1}, or the name of a key file')
    return read_key_file(given)


def read_key_file(file: str | FilePath) -> list[Sample]:
    """Return the samples that a key file asks for: a line `path, seconds` for each; `#` begins a comment."""
    try:
        # utf-8-sig: spreadsheets put a byte order mark at the beginning.
        text = FilePath(file).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise BadValue(f"the key file {file} cannot be read: {why}") from None
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.split("#")[0].strip()]
    samples = [
        _sample(file, number, line) for number, line in lines if line.partition(",")[0].strip().lower() != "path"
    ]
    if not samples:
        raise BadValue(f"the key file {file} names no path; write a line like: foo.bar, 0.1")
    return samples


def _sample(file: str | FilePath, number: int, line: str) -> Sample:
    try:
        name, period = line.split("#")[0].split(",")
        return sample(name.strip().strip('"'), float(period))
    except BadInput as error:
        raise BadValue(f"{file}, line {number}: {error}") from None
    except ValueError:
        raise BadValue(f"{file}, line {number}: {line.strip()[:60]!r} is not of the form: foo.bar, 0.1") from None


def sample(path: str, period: float) -> Sample:
    """Return a checked sample; raises BadKey or BadValue."""
    place = parse(path)
    check_top_key(place[0] if place else "")
    if counts_from_end(place):
        raise BadValue(f"{path}: an index from the end names another item from one time to the next; count from 0")
    check_number(f"the period of {path}", period, "use seconds, over 0", above=0)
    if period == math.inf:
        raise BadValue(f"the period of {path}={period} is out of range; use seconds, over 0")
    return Sample(place, period)


class Sampler:
    """Reads paths at their periods, counted from one beginning, so that they do not drift.

    `take` gets each path, what was there (MISSING if nothing was) and its bytes.
    """

    def __init__(self, session: Session, samples: Iterable[Sample], take: Callable[[Path, object, int], None]) -> None:
        self._session = session
        self._samples = list(samples)
        self._take = take
        self._tasks = Tasks()
        self.late = 0  # readings that were left out since the one before took too long
        self.failed = 0

    def start(self) -> None:
        begin = asyncio.get_running_loop().time()
        for each in self._samples:
            self._tasks.start(self._follow(each, begin), f"reem sample {show(each.path)}")

    async def stop(self) -> None:
        await self._tasks.end()

    async def _follow(self, each: Sample, begin: float) -> None:
        loop, count = asyncio.get_running_loop(), 0
        keys = self._session.keys(each.path[0])
        while True:
            await asyncio.sleep(begin + count * each.seconds - loop.time())
            try:
                value, size = await fetch(self._session, keys, each.path[1:])
            except (RedisError, OSError, ValueError):
                self.failed += 1
            else:
                self._take(each.path, value, size)
            # Periods that have passed meanwhile are left out and counted, so that a slow server is not asked ever
            # faster.
            due = math.floor((loop.time() - begin) / each.seconds) + 1
            self.late += max(due - count - 1, 0)
            count = max(due, count + 1)
