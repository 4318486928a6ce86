"""Replaying: what was recorded, published again at the recorded pace."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import Any

import numpy as np

from ...connection import RedisInterface
from ...errors import BadKey, BadValue, MissingKey, PathRefused
from ...plan.paths import Path, Pattern, check_top_key, has_index, parse, parse_pattern
from ...plan.trees import MISSING
from ...plan.writes import make_parents
from ...store.store import PublishSpace
from .format import Kind
from .log import Log, LogUpdate
from .times import AFTER, Instant, nanoseconds, seconds


@dataclass(frozen=True, slots=True)
class ReplayStatus:
    """How a replay is getting on.

    Attributes:
        position: The instant of the recording it is at, in seconds since 1970.
        published: How many updates it has published.
        refused: How many the server refused: their parent is not there, as it was not when they were recorded.
        lag: Seconds it is behind the pace asked for.
        most_lag: The most it was.
        rounds: How often it has come to the end.
        unreadable: How many values were left out, since they are damaged or of a type that was not recorded.
    """

    position: float
    published: int
    refused: int
    lag: float
    most_lag: float
    rounds: int
    unreadable: int = 0


class Replayer:
    """Publishes a recording again: first all that was there at the start, then every update in its turn.

    What is read from the server afterwards equals what was recorded, bit for bit. The pace is kept from
    one beginning, so it does not drift; a server that is slower than the pace makes the replay lag, and
    `status.lag` says by how much. Nothing is left out but what is damaged or was not recorded: that value
    alone, an item of a list being None then, and it is counted.

    Args:
        interface: The server.
        log: The recording.
        rate: How many times faster than it was recorded.
        start: The first instant; the beginning of the recording if not given.
        end: The last instant; the end of the recording if not given.
        loop: Begin again at the end; keys that were not there at the start are deleted.
        patterns: Which paths; everything if not given.
        remap: New names for top-level keys.

    Raises:
        BadValue: A rate or range that cannot be, patterns or names of which nothing was recorded, or two keys that
            would become one. BadKey: A name that cannot be.
    """

    def __init__(
        self,
        interface: RedisInterface,
        log: Log,
        *,
        rate: float = 1.0,
        start: Instant | None = None,
        end: Instant | None = None,
        loop: bool = False,
        patterns: Sequence[str] = ("*",),
        remap: Mapping[str, str] | None = None,
    ) -> None:
        if not 0 < rate < float("inf"):
            raise BadValue(f"rate={rate!r} cannot be; give a number over 0")
        self.start = log.start if start is None else seconds(nanoseconds(start))
        self.end = log.end if end is None else seconds(nanoseconds(end))
        if self.start > self.end:
            raise BadValue(
                f"the replay would end before it starts; the recording is {log.duration:.3f} s long, "
                f"from {log.start!r} to {log.end!r}"
            )
        self._log = log.raw  # pictures are published as they were
        self._rate = rate
        self._loop = loop
        self._texts = list(patterns)
        self._patterns: list[Pattern] = [parse_pattern(text) for text in patterns]
        self._remap = {_name(old): _name(new) for old, new in (remap or {}).items()}
        self._check_names(log.names())
        self._space: Any = PublishSpace(interface)
        self._session = interface.session
        self._updates: Iterator[LogUpdate] | None = None
        self._position = self.start
        self._stepped = False  # there was an update in this round
        self._names: set[str] = set()
        self._published = self._refused = self._rounds = 0
        self._lag = self._most_lag = 0.0

    def _check_names(self, recorded: Sequence[str]) -> None:
        """Raise BadValue if patterns or new names mean nothing, or if two keys would become one."""
        chosen = [name for name in recorded if self._is_chosen(name)]
        missing = [old for old in self._remap if old not in chosen]
        # Patterns that name nothing at all are most likely misspelt.
        if recorded and not chosen:
            missing = self._texts
        if missing:
            raise BadValue(f"nothing is played of {', '.join(missing)}; recorded are {', '.join(recorded):.200}")
        origin: dict[str, str] = {}
        for name in chosen:
            new = self._remap.get(name, name)
            if new in origin:
                raise BadValue(
                    f"both {origin[new]} and {name} would be played as {new}; choose other names, or patterns"
                )
            origin[new] = name

    def _is_chosen(self, name: str) -> bool:
        return any(pattern.concerns((name,)) for pattern in self._patterns)

    @property
    def status(self) -> ReplayStatus:
        """How it is getting on. Any thread may ask."""
        counts = self._published, self._refused, self._lag, self._most_lag, self._rounds
        return ReplayStatus(self._position, *counts, self._log.unreadable)

    async def play(self) -> ReplayStatus:
        """Publish until the end, or for ever with `loop`; returns how it went.

        One round trip for each update. Cancelling ends it between two updates, or with the last applied
        once or not at all; what was published stays.
        """
        while True:
            self._updates = updates = await self._begin()
            begun = time.monotonic()
            for update in updates:
                # From the beginning and not from the last update: delays do not add up.
                due = begun + (update.time - self.start) / self._rate
                wait = due - time.monotonic()
                if wait > 0:
                    await asyncio.sleep(wait)
                await self._publish(update)
                self._lag = max(time.monotonic() - due, 0.0)
                self._most_lag = max(self._most_lag, self._lag)
            # What is silent at the end of a recording is part of it, and of each round.
            rest = begun + (self.end - self.start) / self._rate - time.monotonic()
            await asyncio.sleep(max(rest, 0.0))
            self._position, self._updates = self.end, None
            self._rounds += 1
            if not self._loop:
                return self.status

    async def step(self) -> LogUpdate | None:
        """Publish the next update, whatever its time, and return it; the first call publishes the start too.

        Returns None at the end (the next call starts again, with `loop` at once).
        """
        while True:
            if self._updates is None:
                self._updates = await self._begin()
                self._stepped = False
            update = next(self._updates, None)
            if update is not None:
                await self._publish(update)
                self._stepped = True
                return update
            self._updates = None
            self._rounds += 1
            if not (self._loop and self._stepped):
                return None

    async def _begin(self) -> Iterator[LogUpdate]:
        """Publish all that was there at the start, delete what this replay has added since, and return the updates."""
        there = {name: await asyncio.to_thread(self._whole, name) for name in self._log.names()}
        now = {str(self._renamed((name,))[0]): tree for name, tree in there.items() if tree is not MISSING}
        # From the second round on: keys that the recording has only made later.
        for name in sorted(self._names - now.keys()):
            await self._delete((name,))
        self._names = set()
        for name, tree in now.items():
            await self._write((name,), tree)
        self._position = self.start
        # A microsecond later: what happened at the start is in the trees already, and times of floats are exact to
        # that.
        after = np.datetime64(nanoseconds(self.start) + AFTER, "ns")
        return self._log.updates(after, self.end, self._texts, partial=True)

    def _whole(self, name: str) -> Any:
        if not self._is_chosen(name):
            return MISSING
        return self._log.readable_at(name, self.start, self._texts)

    async def _publish(self, update: LogUpdate) -> None:
        path = self._renamed(update.path)
        if update.deleted:
            # A sampled item that is gone: the list has become shorter by an unknown number of items.
            sampled = update.kind == Kind.READ and isinstance(path[-1], int)
            while await self._delete(path) and sampled:  # nor was there anything behind it
                pass
        else:
            await self._write(path, update.value, parents=update.kind == Kind.READ)
        self._position = update.time

    async def _delete(self, path: Path) -> bool:
        try:
            await self._at(path).delete()
        except MissingKey:
            return False
        self._published += 1
        return True

    async def _write(self, path: Path, value: Any, *, parents: bool = False) -> None:
        try:
            await self._at(path).write(value)
        except PathRefused:
            # What was sampled has no parents in the recording; lists cannot be made up.
            if not parents or has_index(path):
                self._refused += 1
                return
            await self._session.run(make_parents(self._session.keys(path[0]), path[1:]))
            await self._at(path).write(value)
        self._names.add(str(path[0]))
        self._published += 1

    def _at(self, path: Path) -> Any:
        return reduce(getitem, path, self._space)

    def _renamed(self, path: Path) -> Path:
        name = str(path[0])
        return (self._remap.get(name, name), *path[1:])


def _name(text: str) -> str:
    path = parse(text)
    if len(path) != 1:
        raise BadKey(f"remap: {text!r} is not the name of a top-level key; only these can be renamed")
    return check_top_key(path[0])
