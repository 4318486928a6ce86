"""Filling the rolling buffer: every published update, and what the server says was only stored."""

from __future__ import annotations

import asyncio
import math
import time
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any

from ...concurrency.queues import Last
from ...concurrency.streams import arrived
from ...connection import RedisInterface
from ...errors import RedisError, ReemError
from ...plan.paths import Path
from ...plan.trees import MISSING
from ...pubsub.finder import find_regularly, present_keys
from ...pubsub.manager import manager_of
from ...pubsub.monitor import ANNOUNCED, Event, Monitor
from ...pubsub.refresh import BACKGROUND_RATE
from .fetcher import Allowance, Fetcher, Readings
from .history import History
from .stored_changes import StoredChanges

_WAITING = 50_000
"""Updates that wait for this program before the oldest are skipped."""

_MOST_SHARED = 10_000
"""Keys of which is remembered when their publisher has shared memory."""
_SHARED_SECONDS = 10.0
"""For so long a publisher is said to share memory after it has; as in `reem top`."""


class Follower:
    """Keeps a `History` up to date.

    Args:
        interface: The server.
        history: Where changes go.

    Attributes:
        names: The top-level keys, sorted.
        lost: Why the server cannot be read at the moment; empty if all is well.
    """

    def __init__(self, interface: RedisInterface, history: History) -> None:
        self._interface = interface
        self._history = history
        allowance = Allowance(0.5 * history.budget / history.seconds, history.budget / 4)
        arrays = Allowance(BACKGROUND_RATE, history.budget / 2)  # four pictures a second each of two cameras
        session = interface.session
        self._readings = Readings()
        self._fetcher = Fetcher(session, history, arrays, self._readings, self._fence, self._touch)
        self._stored = StoredChanges(
            session, history, self._fetcher, allowance, self._readings, self._pump, self._fence
        )
        self._monitor = Monitor(interface, policy=Last(_WAITING))
        self._fetcher.failed = self._monitor.invalidated = self._stored.doubt
        self._monitor.broken, self._monitor.changed = self._stored.lost, self._stored.changed
        self._tasks: list[asyncio.Task[None]] = []
        self._shared: dict[str, float] = {}  # when the last value of a key came that is in shared memory too
        self.names: list[str] = []
        self.lost = ""

    async def start(self) -> None:
        """List the keys and begin to follow."""
        if self._tasks:
            return
        await self._interface.initialize()
        await self._monitor.listen()
        await self._monitor.watch_changes()
        self.names = sorted(await self._present())
        self._stored.begin(self.names)
        for work in (self._follow(), self._fetcher.run(), self._stored.run(), find_regularly(self._search)):
            self._tasks.append(asyncio.create_task(work))

    async def close(self) -> None:
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._stored.close()
        await self._monitor.close()

    @property
    def skipped(self) -> int:
        """How many updates were dropped because they came too fast."""
        return self._monitor.dropped

    @property
    def hears_of_changes(self) -> bool:
        """Whether no server has refused to report which keys are changed."""
        return manager_of(self._interface.session).hears_of_changes

    def is_told(self, name: str) -> bool:
        """Return whether the server reports changes of the arrays of a key."""
        return self._stored.is_told(name)

    def is_shared(self, name: str) -> bool:
        """Return whether programs on the publisher's host could of late take what is published from its memory."""
        return time.monotonic() - self._shared.get(name, -math.inf) < _SHARED_SECONDS

    # --- what is published

    async def _follow(self) -> None:
        async for event in self._monitor:
            self._take(event)

    async def _fence(self) -> None:
        """Take all updates that were published before now."""
        await manager_of(self._interface.session).fence()
        self._pump()

    def _pump(self) -> None:
        """Take the updates that have arrived already."""
        for event in arrived(self._monitor):
            self._take(event)

    async def _touch(self, path: Path, tree: Any) -> None:
        await self._stored.touch(path, tree)

    def _take(self, event: Event) -> None:
        name = event.name
        if event.local:
            if len(self._shared) > _MOST_SHARED:
                self._shared.clear()
            self._shared[name] = time.monotonic()
        self._readings.hear(event)
        self._stored.heard(event)
        if len(event.path) == 1 and event.deleted:
            self._forget(name)
        elif len(event.path) == 1 or name not in self._history.names:
            self._note_name(name)
        when = self._history.clock.of(event.received)
        if event.value is ANNOUNCED:
            self._fetcher.want(event.path, when)
        else:
            value = MISSING if event.deleted else event.value
            self._history.add(event.path, value, event.size, when)

    def _note_name(self, name: str) -> None:
        if not self._history.knows(name) and self._stored.is_new(name):
            self._history.begin(name, None)
        index = _place(self.names, name)
        if index == len(self.names) or self.names[index] != name:
            self.names = [*self.names[:index], name, *self.names[index:]]

    def _forget(self, name: str) -> None:
        index = _place(self.names, name)
        if index < len(self.names) and self.names[index] == name:
            self.names = [*self.names[:index], *self.names[index + 1 :]]

    # --- which keys there are

    async def _search(self) -> bool:
        try:
            await self._find()
        except (RedisError, ReemError, OSError) as error:
            self.lost = str(error)
        else:
            self.lost = self._ended()
        return True

    async def _present(self) -> set[str]:
        return await present_keys(self._interface.session, ["*"])

    def _ended(self) -> str:
        """Return why following ended, if it did: what is shown would no longer be news."""
        ended = [task for task in self._tasks if task.done() and not task.cancelled()]
        return f"following ended: {ended[0].exception()!r}" if ended else ""

    async def _find(self) -> None:
        before = set(self.names)
        present = await self._present()
        # The list may be older than what was heard meanwhile.
        present.update(set(self.names) - before)
        self.names = sorted(present)
        self._stored.listed(self.names, before - present)


def _place(ordered: Sequence[str], name: str) -> int:
    return bisect_left(ordered, name)
