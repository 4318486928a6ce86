"""The keys of a recording: which there are, what each of them waits for, and which are looked at."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence

from ...plan.paths import Pattern
from ...pubsub.finder import present_keys
from .key_recorder import Collector, KeyRecorder

_MOST_SILENT_READS = 500
"""Keys that are read again at one keyframe, if the server does not tell which were changed."""


class RecordedKeys:
    """One `KeyRecorder` for each key that was met.

    Args:
        collector: The recorder.
        patterns: What is recorded of all that is published.
    """

    def __init__(self, collector: Collector, patterns: Sequence[Pattern]) -> None:
        self._collector = collector
        self._patterns = patterns
        self.tops = list(dict.fromkeys(pattern.top for pattern in patterns))
        self._recorders: dict[str, KeyRecorder] = {}
        self._over: set[str] = set()  # keys that were gone at the last keyframe

    def of(self, name: str) -> KeyRecorder:
        recorder = self._recorders.get(name)
        if recorder is None:
            recorder = self._recorders[name] = KeyRecorder(self._collector, name)
        return recorder

    def concerns(self, name: str) -> bool:
        return any(pattern.concerns((name,)) for pattern in self._patterns)

    async def present(self) -> set[str]:
        """Return the keys there are, of those that are recorded; those that are recorded by name always."""
        globs = {top for top in self.tops if "*" in top or "?" in top}
        return {*self.tops} - globs | await present_keys(self._collector.session, globs)

    def changed(self, key: str | None) -> None:
        if key is None:
            for recorder in self._recorders.values():
                recorder.changed(None)
            return
        document = key[1:].partition("}")[0] if key.startswith("{") else key
        name = document.removeprefix(self._collector.session.namespace)
        if name in self._recorders:
            self._recorders[name].changed(key)

    def follow(self, present: set[str]) -> None:
        """Have the server report changes of keys that are there and that it does not report yet."""
        for name in present:
            if self.concerns(name):
                self.of(name).follow()

    def be_due(self) -> None:
        """Let the next look read every key, however much was read of it of late."""
        for recorder in self._recorders.values():
            recorder.looks.earliest = 0.0

    def look_at_once(self) -> None:
        for recorder in self._recorders.values():
            recorder.looks.now()

    def lost(self) -> None:
        """Note that updates of any key may be lost, and read all keys again."""
        for recorder in self._recorders.values():
            recorder.lost(None)

    async def settled(self, patience: float) -> None:
        """Wait until no key is being fetched, at most so many seconds."""
        deadline = time.monotonic() + patience
        while (
            busy := [recorder.busy for recorder in self._recorders.values() if recorder.busy]
        ) and time.monotonic() < deadline:
            await asyncio.wait(busy, timeout=deadline - time.monotonic())

    def cancel(self) -> None:
        for recorder in self._recorders.values():
            recorder.looks.cancel()
            if recorder.busy is not None:
                recorder.busy.cancel()

    def read_silent(self, present: set[str]) -> None:
        """Read keys that were not published as a whole since the last keyframe: they may have been stored.

        Args:
            present: The keys there are.
        """
        now, reads = asyncio.get_running_loop().time(), 0
        for name in sorted(present | self._recorders.keys(), key=lambda name: self.of(name).looks.earliest):
            recorder = self.of(name)
            if recorder.news or not self.concerns(name) or (name not in present and recorder.absent):
                continue
            if recorder.looks.earliest <= now and reads < _MOST_SILENT_READS:
                reads += 1
                recorder.read()

    def forget_news(self) -> None:
        for recorder in self._recorders.values():
            recorder.news = False

    def keyframe(self, number: int) -> None:
        self._let_go()
        for recorder in self._recorders.values():
            recorder.keyframe(number)
        self.forget_news()

    def _let_go(self) -> None:
        """Keep nothing of keys that were gone at the last keyframe, too. One that comes again is a new one.

        Programs may publish under ever new names. Those that were asked for by name stay: they are listed as if they
        were there, and would be read again each time.
        """
        over = {name for name, recorder in self._recorders.items() if recorder.is_over and name not in self.tops}
        for name in over & self._over:
            del self._recorders[name]
            self._collector.writer_thread.stored.discard(name)
        self._over = over
