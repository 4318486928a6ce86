"""What is only stored: documents are read again when the server says that they were changed.

The server tells once of each key that was touched, so a key is touched directly before it is read. What differs then
from all that was published was stored. An array that is stored over another one leaves the document's text as it is:
that its own key was changed is all that tells of it. So arrays that were changed are read and compared.

What the server does not tell of, since it may not be asked or the connection for it is broken, is read each second.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable, Sequence
from itertools import islice, takewhile
from typing import Any

from ...errors import BadData, RedisError, ReemError
from ...plan import Reply
from ...plan.paths import Path, below
from ...plan.placeholders import Unreadable, marked
from ...plan.trees import MISSING, is_addressable, walk
from ...pubsub.division import divided_reads
from ...pubsub.manager import manager_of
from ...pubsub.monitor import ANNOUNCED, Event
from ...pubsub.refresh import BACKGROUND, BACKGROUND_RATE, RefreshTimer
from ...session import Session
from .fetcher import Allowance, Fetcher, Readings, rebased
from .history import History
from .partial_reads import noted_texts
from .timeline import PENDING
from .trees import Leaf, same, tree_of

# Documents that are asked for in one round trip.
_BATCH = 100
_REST = 4
"""How many times as long as reading documents took none are read: others ask the server, and this program, too."""
_PAUSE = 0.1
"""Seconds after a read that failed."""
_SHARE = 4
"""A key may take one in so many of the bytes that are read."""
_LARGE = 1 << 18
"""Bytes of a document from which it is part of the past only as far as there is an allowance."""


class StoredChanges:
    """Puts what is only stored into the rolling buffer.

    Args:
        session: The server.
        history: Where changes go.
        fetcher: What reads arrays into it.
        allowance: Bytes of long documents that may be kept.
        readings: The reads that are under way.
        pump: Takes all notices that have arrived, each of which is to be `heard`.
        fence: Returns when all that was published before has been `heard`.
    """

    def __init__(
        self,
        session: Session,
        history: History,
        fetcher: Fetcher,
        allowance: Allowance,
        readings: Readings,
        pump: Callable[[], None],
        fence: Callable[[], Awaitable[None]],
    ) -> None:
        self._session = session
        self._history = history
        self._fetcher = fetcher
        self._allowance = allowance
        self._readings = readings
        self._pump = pump
        self._fence = fence
        self._unseen: set[str] = set()  # there from the beginning, and not read yet
        self._due: dict[str, None] = {}
        self._news = asyncio.Event()
        self._looks: dict[str, RefreshTimer[StoredChanges]] = {}
        # Names on the server: those whose next change it will tell, the arrays of each key, those that were changed.
        self._told: set[str] = set()
        self._arrays: dict[str, dict[str, Path]] = {}
        self._changed: set[str] = set()

    # --- what is heard

    def begin(self, present: Iterable[str]) -> None:
        """Read the keys that are there at the beginning: what they hold is no change."""
        self._unseen.update(present)
        self.listed(self._unseen, ())

    def listed(self, present: Iterable[str], gone: Iterable[str]) -> None:
        """Read the present keys that the server does not report, and those that are gone."""
        untold = [name for name in present if self._document(name) not in self._told]
        self._read_soon([*untold, *gone])

    def is_new(self, name: str) -> bool:
        """Return whether nothing was at a key when following began."""
        return name not in self._unseen

    def is_told(self, name: str) -> bool:
        """Return whether the server reports changes of the known arrays of a key."""
        return self._arrays.get(name, {}).keys() <= self._told

    def changed(self, key: str | None) -> None:
        self._pump()  # a notice that came before is of an earlier change
        if key is None:
            self.lost()
            self._read_soon(self._history.names)
            return
        self._told.discard(key)
        name = (key[1:].partition("}")[0] if key.startswith("{") else key).removeprefix(self._session.namespace)
        if key in self._arrays.get(name, ()):
            self._changed.add(key)
        elif key != self._document(name):
            return  # another listener's on this connection
        self._ask(name)

    def heard(self, event: Event) -> None:
        name, arrays = event.name, self._arrays.get(event.name, {})
        if name in self._looks:
            self._looks[name].heard += 1
        for key in arrays.keys() - self._told:
            if below(arrays[key], event.path) or below(event.path, arrays[key]):
                # It is touched before it is fetched. Else it may have been stored again behind the update already.
                (self._changed.discard if event.value is ANNOUNCED else self._changed.add)(key)
        if event.gap:
            self.doubt(name)
        elif self._document(name) not in self._told:
            self._ask(name)

    def doubt(self, name: str) -> None:
        """Note that an update of a key was lost."""
        self._changed.update(self._arrays.get(name, ()))
        self._ask(name)

    def lost(self) -> None:
        """Note that changes may be unknown: the connection that reports them is lost."""
        self._told.clear()
        for arrays in self._arrays.values():
            self._changed.update(arrays)

    def _document(self, name: str) -> str:
        return self._session.namespace + name

    def _ask(self, name: str) -> None:
        """Have a key read when its next look is due."""
        if name not in self._looks:
            self._looks[name] = RefreshTimer(self, lambda it: it._read_soon([name]), BACKGROUND)
        self._looks[name].ask()

    def _read_soon(self, names: Iterable[str]) -> None:
        self._due.update(dict.fromkeys(names))
        self._news.set()

    # --- what is read

    async def run(self) -> None:
        while True:
            await self._news.wait()
            self._news.clear()
            while batch := list(islice(self._due, _BATCH)):
                for name in batch:
                    del self._due[name]
                began, size = time.monotonic(), 0
                try:
                    size = await self._look_at(batch)
                except (RedisError, ReemError, OSError):
                    self._read_soon(batch)
                    await asyncio.sleep(_PAUSE)
                took = time.monotonic() - began
                # At the beginning the page waits for it; what it asks for goes first.
                await asyncio.sleep(0.002 if self._unseen else max(_REST * took, size / BACKGROUND_RATE))

    def close(self) -> None:
        for looks in self._looks.values():
            looks.cancel()

    async def touch(self, path: Path, tree: Any) -> None:
        """Have the server report the next change of the arrays in what is about to be read at a path."""
        name = str(path[0])
        self._arrays.setdefault(name, {}).update(self._arrays_in(path, tree))
        await self._touch(name)

    async def _touch(self, name: str) -> None:
        """Have the server report the next change of a key and its arrays."""
        asked = {self._document(name), *self._arrays.get(name, ())} - self._told
        if asked:
            keys = self._session.keys(name)
            # In order with reports: a report before that is of an earlier change.
            if not await manager_of(self._session).touch(keys.channel, asked, lambda: self._told.update(asked)):
                self._told -= asked | {keys.document}

    def _arrays_in(self, path: Path, tree: Any) -> dict[str, Path]:
        """Return which keys on the server have the arrays in a tree, and where in the document each of these is."""
        tag = self._session.keys(path[0]).tag
        found = {where: it.suffix for where, it in walk(tree, path) if isinstance(it, Leaf)}
        return {tag + suffix: where for where, suffix in found.items() if suffix is not None}

    async def _look_at(self, names: Sequence[str]) -> int:
        """Compare documents with what the changes led to; return how many bytes they have."""
        await asyncio.gather(*[self._touch(name) for name in names])
        self._fetcher.finished.clear()
        with self._readings.begin(names) as divisions:

            async def read() -> list[tuple[bytes | None, Reply] | None]:
                for division in divisions:
                    division.asked(in_order=False)
                return await noted_texts(self._session, [(name,) for name in names])

            found = await divided_reads(divisions, read, self._fence)
        for name, division, it in zip(names, divisions, found, strict=True):
            size = len(it[0] or b"") if it else 0
            if name in self._looks:
                self._looks[name].earliest = asyncio.get_running_loop().time() + _SHARE * size / BACKGROUND_RATE
            # It is not known what it has of what is being fetched.
            if it is None or self._fetcher.concerns(name):
                self._ask(name)
                continue
            later = [each.update for each in division.take()[1] if each.update is not None]
            try:
                self._compare(name, it[0], later)
            except BadData as error:  # what was there before is not there any more
                self._history.add((name,), Unreadable(name, str(error)), 0, self._history.clock.now())
            self._unseen.discard(name)
            if it[0] is None:
                self._let_go(name)
        return sum([len(it[0] or b"") for it in found if it])

    def _let_go(self, name: str) -> None:
        """Keep nothing of a key that is gone. If it comes again the server reports it, or it is listed as a new one."""
        self._told.discard(self._document(name))
        if name in self._looks and not self._looks[name].due:
            del self._looks[name]

    def _compare(self, name: str, text: bytes | None, later: Sequence[Event]) -> None:
        """Note what was stored.

        Args:
            name: The key.
            text: Its document's text, None if there is none.
            later: The updates in the buffer that are not in it.
        """
        if text is not None and not self._history.knows(name):
            self._history.begin(name, text if name in self._unseen else None)
        has_arrays, when = text is not None and marked(text), self._history.clock.now()
        # Not if it is not needed: most are what they were.
        tree = tree_of(text, name) if text is not None and (has_arrays or later) else MISSING
        changed = self._changed_in(name, self._arrays_in((name,), tree) if has_arrays else {})
        if later:
            tree = rebased(tree, (name,), later)
            differs = not same(tree, self._history.tree((name,), when))
        else:
            differs = self._history.differs(name, text, when)
        if differs and has_arrays:
            self._fetcher.want((name,), when)
        elif differs and (text is None or len(text) <= _LARGE or self._allowance.take(len(text))):
            found = tree if later or text is None else tree_of(text, name)
            self._history.add((name,), found, len(text or b""), when)
        elif differs:
            self._history.add((name,), PENDING, 0, when)
        for path in () if differs else changed:
            self._fetcher.check(tuple(takewhile(is_addressable, path)))
        if not later:
            self._history.remember(name, text)
        if (differs or changed) and name in self._looks:
            self._looks[name].found()

    def _changed_in(self, name: str, arrays: dict[str, Path]) -> list[Path]:
        """Note a key's arrays; return where those are that were stored again and must be read."""
        before = self._arrays.pop(name, {}).keys()
        if arrays:
            self._arrays[name] = arrays
        self._told -= before - arrays.keys()
        self._changed -= before - arrays.keys()
        new = arrays.keys() - before
        if new and self._document(name) in self._told:
            self._ask(name)  # the server is to tell of them too
        if name not in self._unseen:  # they may have been stored again since they were published
            self._changed |= new
        # Those that were touched since: the next change of the others would be missed.
        changed = [key for key in arrays if key in self._changed and key in self._told]
        self._changed.difference_update(changed)
        return [arrays[key] for key in changed]
