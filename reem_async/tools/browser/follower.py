"""Filling the rolling buffer: every published update, and a look at the documents for what is not published."""

from __future__ import annotations

import asyncio
import hashlib
import math
import time
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from ...concurrency.queues import Last
from ...concurrency.streams import arrived
from ...connection import RedisInterface
from ...errors import BadData, RedisError, ReemError
from ...plan.notices import note_of
from ...plan.placeholders import marked
from ...plan.trees import MISSING
from ...pubsub.manager import manager_of
from ...pubsub.monitor import ANNOUNCED, Event, Monitor
from ...store.catalog import names
from ...store.reader import DocumentReader
from .fetcher import Allowance, Fetcher, array_bytes
from .history import History
from .partial_reads import document_texts, noted_texts
from .timeline import PENDING
from .trees import framed, tree_of, walk

__all__ = ["Follower"]

_WAITING = 50_000
"""Updates that wait for this program before the oldest are skipped."""

# Between looks at the documents: how late a page shows what is only stored.
_LOOK_SECONDS = 0.5
_LOOK_KEYS = 400
"""Documents that are looked at each time, in turn if there are more."""

# Documents that are asked for in one round trip.
_BATCH = 100
_LOOK_BYTES = 1 << 20
"""Bytes of documents a second that looking may cost the server, and as many of arrays."""

_READ_BYTES = 8 << 20
"""Bytes of published arrays a second that are read for the past: four pictures a second each of two cameras."""

_LARGE = 1 << 18
"""Bytes of a document from which it is looked at less often: a quarter of the time that its bytes allow."""

_LARGEST_LOOK = 32 << 20
"""Bytes of arrays in a document up to which they are read again to see whether they have changed."""

# Keys whose last notice is remembered.
_MOST_HEARD = 100_000
_SHARED_SECONDS = 10.0
"""For so long a publisher is said to share memory after it has; as in `reem top`."""

_QUIET_SECONDS = 1.0
"""A key that was just published is looked at with the note of its last notice: it may not have been heard yet."""


class Heard(NamedTuple):
    """The last notice of a key.

    Attributes:
        when: When it came, on the monotonic clock.
        note: Which it was, as the server notes it.
        shared: When the last one came whose value is in shared memory too, on the same clock.
    """

    when: float = 0.0
    note: str = ""
    shared: float = -math.inf


class Follower:
    """Keeps a `History` up to date.

    Args:
        interface: The server.
        history: Where changes go.

    Attributes:
        names: The top-level keys, sorted.
        doubtful: Keys with more arrays than are read again: what only a KeyValueStore writes is not noticed.
        lost: Why the server cannot be read at the moment; empty if all is well.
    """

    def __init__(self, interface: RedisInterface, history: History) -> None:
        self._interface = interface
        self._history = history
        self._allowance = Allowance(0.5 * history.budget / history.seconds, history.budget / 4)
        arrays = Allowance(_READ_BYTES, history.budget / 2)
        self._fetcher = Fetcher(
            interface.session, history, arrays, lambda name: self._last_heard(name).note, self._fence
        )
        self._looks = Allowance(_LOOK_BYTES, _LARGEST_LOOK)
        self._monitor = Monitor(interface, policy=Last(_WAITING))
        self._tasks: list[asyncio.Task[None]] = []
        self._shown: dict[str, None] = {}
        self._heard: dict[str, Heard] = {}
        self._seldom: dict[str, float] = {}
        self._unsure: dict[str, int] = {}  # keys whose arrays are to be looked at, and how many bytes these are
        self._digests: dict[str, bytes] = {}
        self.doubtful: set[str] = set()
        self._turn = 0
        self._complete = False
        self.names: list[str] = []
        self.lost = ""

    async def start(self) -> None:
        """List the keys and begin to follow."""
        if self._tasks:
            return
        await self._interface.initialize()
        await self._monitor.listen()
        self.names = sorted([name async for name in names(self._interface)])
        for work in (self._follow(), self._fetcher.run(), self._look()):
            self._tasks.append(asyncio.create_task(work))

    async def close(self) -> None:
        """End."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._monitor.close()

    @property
    def skipped(self) -> int:
        """How many updates came too fast to be taken."""
        return self._monitor.dropped

    def is_shared(self, name: str) -> bool:
        """Return whether programs on the publisher's host could of late take what is published from its memory."""
        return time.monotonic() - self._last_heard(name).shared < _SHARED_SECONDS

    def shown(self, shown: Iterable[str]) -> None:
        """Note that somebody looks at these keys: they are looked at first."""
        for name in shown:
            self._shown[name] = None

    # --- what is published

    async def _follow(self) -> None:
        async for event in self._monitor:
            self._take(event)

    async def _fence(self) -> None:
        """Take all that was published before now."""
        await manager_of(self._interface.session).fence()
        for event in arrived(self._monitor):
            self._take(event)

    def _take(self, event: Event) -> None:
        name = event.name
        if len(self._heard) > _MOST_HEARD:
            self._heard.clear()
        now = time.monotonic()
        shared = now if event.local else self._last_heard(name).shared
        self._heard[name] = Heard(now, note_of(event.publisher, event.sequence), shared)
        self._fetcher.heard(event)
        self._digests.pop(name, None)
        if len(event.path) == 1 and event.deleted:
            self._forget(name)
        elif len(event.path) == 1 or name not in self._history.names:
            self._note_name(name)
        if event.value is ANNOUNCED:
            self._fetcher.want(event.path, event.received)
        else:
            value = MISSING if event.deleted else event.value
            self._history.add(event.path, value, event.size, event.received)

    def _last_heard(self, name: str) -> Heard:
        return self._heard.get(name, Heard())

    def _note_name(self, name: str) -> None:
        if not self._history.knows(name) and self._complete:
            self._history.begin(name, None)
        index = _place(self.names, name)
        if index == len(self.names) or self.names[index] != name:
            self.names = [*self.names[:index], name, *self.names[index:]]

    def _forget(self, name: str) -> None:
        index = _place(self.names, name)
        if index < len(self.names) and self.names[index] == name:
            self.names = [*self.names[:index], *self.names[index + 1 :]]

    # --- what is not published

    async def _look(self) -> None:
        """Look at documents again and again."""
        while True:
            began = time.monotonic()
            try:
                seen = await self._look_once()
                self.lost = self._ended()
            except (RedisError, ReemError, OSError) as error:
                self.lost, seen = str(error), 0
            took = time.monotonic() - began
            await asyncio.sleep(max(_LOOK_SECONDS - took, 4 * took, seen / _LOOK_BYTES))

    def _ended(self) -> str:
        """Return why following ended, if it did: what is shown would no longer be news."""
        ended = [task for task in self._tasks if task.done() and not task.cancelled()]
        return f"following ended: {ended[0].exception()!r}" if ended else ""

    async def _look_once(self) -> int:
        """Look which keys there are and at some of their documents; returns how many bytes those had."""
        began = time.monotonic()
        listed = {name async for name in names(self._interface)}
        # The list may be older than what was heard meanwhile.
        listed.update([name for name in self.names if self._is_busy(name, began)])
        present = sorted(listed)
        gone = set(self.names).difference(present)
        appeared = set(present).difference(self.names)
        self.names = present
        seen = await self._compare([*appeared, *gone, *self._chosen(present)])
        await self._look_at_arrays()
        return seen

    def _chosen(self, present: Sequence[str]) -> list[str]:
        """Return the keys whose turn it is, those that somebody sees first; all of them at the beginning."""
        now = time.monotonic()
        if not self._complete:
            return list(present)
        shown, self._shown = list(self._shown), {}
        turn = [present[(self._turn + index) % len(present)] for index in range(min(_LOOK_KEYS, len(present)))]
        self._turn = (self._turn + len(turn)) % max(len(present), 1)
        names = dict.fromkeys([*shown[:_LOOK_KEYS], *turn])
        return [name for name in names if self._seldom.get(name, 0.0) < now]

    async def _compare(self, chosen: Sequence[str]) -> int:
        total = 0
        for start in range(0, len(chosen), _BATCH):
            batch = chosen[start : start + _BATCH]
            asked = time.monotonic()
            busy = [name for name in batch if self._history.is_whole(name) and self._is_busy(name, asked)]
            total += await self._compare_quiet([name for name in batch if name not in busy], asked)
            total += await self._compare_busy(busy)
            await asyncio.sleep(0.002)  # a page that is asked for meanwhile goes first
        self._complete = True
        return total

    async def _compare_quiet(self, quiet: Sequence[str], asked: float) -> int:
        """Compare documents with what the changes led to; return how many bytes they have."""
        texts = await document_texts(self._interface.session, quiet)
        for name, text in zip(quiet, texts, strict=True):
            if not self._is_busy(name, asked) or not self._history.is_whole(name):
                self._compare_one(name, text)
        return sum([len(text or b"") for text in texts])

    async def _compare_busy(self, busy: Sequence[str]) -> int:
        """The same for those that are published all the time, where all that is in the document was heard of."""
        found = await noted_texts(self._interface.session, [(name,) for name in busy])
        for name, (text, note) in zip(busy, found, strict=True):
            if note and note == self._last_heard(name).note and name not in self._fetcher.behind:
                self._compare_one(name, text)
                self._unsure.pop(name, None)  # its arrays would be published anew before they are read
        return sum([len(text or b"") for text, _ in found])

    def _is_busy(self, name: str, now: float) -> bool:
        return self._last_heard(name).when > now - _QUIET_SECONDS

    def _compare_one(self, name: str, text: bytes | None) -> None:
        if text is not None and len(text) > _LARGE:
            self._seldom[name] = time.monotonic() + 4 * len(text) / _LOOK_BYTES
        if not self._history.knows(name):
            self._history.begin(name, None if self._complete else text)
        with suppress(BadData):
            if self._history.differs(name, text, time.time()):
                self._differs(name, text)
            elif text is not None and name not in self._unsure and marked(text):
                self._unsure[name] = array_bytes(tree_of(text, name))
        self._history.remember(name, text)

    def _differs(self, name: str, text: bytes | None) -> None:
        when = time.time()
        self._digests.pop(name, None)
        if text is None:
            self._history.add((name,), MISSING, 0, when)
        elif marked(text):
            self._fetcher.want((name,), when)
        elif len(text) <= _LARGE or self._allowance.take(len(text)):
            self._history.add((name,), tree_of(text, name), len(text), when)
        else:
            self._history.add((name,), PENDING, 0, when)

    async def _look_at_arrays(self) -> None:
        """Read the arrays of documents whose text is the same: what is only stored is told by nothing else."""
        while self._unsure:
            name, size = next(iter(self._unsure.items()))
            if size > _LARGEST_LOOK:
                self.doubtful.add(name)
            elif not self._looks.take(size):
                return  # those behind it wait too, else it never had its turn
            else:
                self.doubtful.discard(name)
                with suppress(ReemError):
                    await self._look_at_arrays_of(name)
            self._unsure.pop(name, None)

    async def _look_at_arrays_of(self, name: str) -> None:
        heard, before = self._heard.get(name), self._digests.get(name)
        tree = await DocumentReader(self._interface.session, name).read(())
        found = await asyncio.to_thread(_digest, tree)
        if self._heard.get(name) != heard:
            return  # published meanwhile: this may be older
        self._digests[name] = found
        if before is not None and before != found:
            kept = await asyncio.to_thread(framed, tree)
            if self._heard.get(name) == heard:
                self._history.add_read((name,), kept, time.time())


def _digest(tree: Any) -> bytes:
    """Return what tells the arrays in a tree from others of the same shapes at the same places."""
    total = hashlib.blake2b(digest_size=16)
    for _, it in walk(tree, ()):
        if isinstance(it, np.ndarray | bytes):
            total.update(it if isinstance(it, bytes) else it.tobytes())
    return total.digest()


def _place(ordered: Sequence[str], name: str) -> int:
    return bisect_left(ordered, name)
