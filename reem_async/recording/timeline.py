"""Finding messages by channel and time, without reading more chunks than need be."""

from __future__ import annotations

import bisect
import heapq
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from .container import ChunkInfo, Container, Message

__all__ = ["Ref", "Timeline"]


class Ref(NamedTuple):
    """Where a message is.

    Attributes:
        time: Its log time in ns.
        channel: Its channel.
        offset: Its place in the chunk.
        chunk: The chunk.
    """

    time: int
    channel: int
    offset: int
    chunk: ChunkInfo


class Timeline:
    """The messages of a file by channel and time.

    Of one channel, messages are in the file in the order of their log times.

    Args:
        container: The file.
    """

    def __init__(self, container: Container) -> None:
        self._container = container
        self._made_of: list[ChunkInfo] = []
        self._chunks: dict[int, list[ChunkInfo]] = {}
        self._spans: dict[int, np.ndarray[Any, Any]] = {}

    def _refresh(self) -> None:
        """Make the lists anew if a chunk was found to be damaged."""
        chunks = self._container.chunks
        if self._made_of is chunks:
            return
        by_channel: dict[int, list[ChunkInfo]] = {}
        for info in chunks:
            for channel in info.channels or ():
                by_channel.setdefault(channel, []).append(info)
        self._spans = {
            channel: np.array([(info.start, info.end) for info in infos], np.uint64)
            for channel, infos in by_channel.items()
        }
        self._chunks, self._made_of = by_channel, chunks

    def latest(self, channel: int, until: int, after: int = -1) -> Ref | None:
        """Return the last message of a channel that is not later than `until` and later than `after`, or None."""
        self._refresh()
        chunks = self._chunks.get(channel)
        if chunks is None or until < 0:
            return None
        spans = self._spans[channel]
        if not ((spans[:, 0] <= until) & (spans[:, 1] > max(after, 0))).any():
            return None
        place = bisect.bisect_right(chunks, until, key=lambda info: self._first(info, channel))
        while place:
            place -= 1
            times, offsets = self._container.index(chunks[place]).get(channel, _NOTHING)
            position = int(np.searchsorted(times, np.uint64(until), side="right")) - 1
            if position >= 0:
                found = int(times[position])
                return Ref(found, channel, int(offsets[position]), chunks[place]) if found > after else None
        return None

    def _first(self, info: ChunkInfo, channel: int) -> int:
        times, _ = self._container.index(info).get(channel, _NOTHING)
        return int(times[0]) if len(times) else info.start

    def between(self, channels: Iterable[int], after: int, until: int) -> Iterator[Ref]:
        """Yield the messages of some channels that are later than `after` and not later than `until`, by time."""
        self._refresh()
        wanted = frozenset(channels)
        chunks = [info for info in self._made_of if info.end > after and info.start <= until]
        waiting: list[Ref] = []
        for info in sorted(chunks, key=lambda info: info.start):
            while waiting and waiting[0].time < info.start:
                yield heapq.heappop(waiting)
            if info.channels is None or not wanted.isdisjoint(info.channels):
                waiting.extend(self._inside(info, wanted, after, until))
                heapq.heapify(waiting)
        while waiting:
            yield heapq.heappop(waiting)

    def _inside(self, info: ChunkInfo, wanted: frozenset[int], after: int, until: int) -> Iterator[Ref]:
        for channel, (times, offsets) in self._container.index(info).items():
            if channel in wanted:
                first, last = np.searchsorted(times, _limits(after, until), side="right").tolist()
                pairs = zip(times[first:last].tolist(), offsets[first:last].tolist(), strict=True)
                for time, offset in pairs:
                    yield Ref(time, channel, offset, info)

    def channels_between(self, after: int, until: int) -> set[int]:
        """Return the channels that have a message later than `after` and not later than `until`."""
        self._refresh()
        found: set[int] = set()
        for info in self._made_of:
            if info.end > after and info.start <= until and not (info.channels or frozenset()) <= found:
                for channel, (times, _) in self._container.index(info).items():
                    first, last = np.searchsorted(times, _limits(after, until), side="right").tolist()
                    if first < last:
                        found.add(channel)
        return found

    def exactly(self, channel: int, time: int) -> Ref | None:
        """Return the message of a channel with this very log time, or None."""
        found = self.latest(channel, time)
        return found if found is not None and found.time == time else None

    def count(self, channel: int) -> tuple[int, int, int, int]:
        """Return how many messages a channel has, the first and last log time, and their bytes (by their places)."""
        self._refresh()
        messages, first, last, size = 0, 0, 0, 0
        for info in self._chunks.get(channel, ()):
            index = self._container.index(info)
            times, offsets = index.get(channel, _NOTHING)
            if len(times):
                messages, first, last = messages + len(times), first or int(times[0]), int(times[-1])
                size += self._bytes(info, offsets)
        return messages, first, last, size

    def _bytes(self, info: ChunkInfo, offsets: np.ndarray[Any, Any]) -> int:
        """Return the bytes from some messages of a chunk to the next of any channel."""
        edges = np.sort(np.concatenate([offsets for _, offsets in self._container.index(info).values()]))
        after = np.searchsorted(edges, offsets, side="right")
        inner = after < len(edges)
        known = int((edges[after[inner]] - offsets[inner]).sum())
        return known + (self._container.tail(info, int(edges[-1])) if not inner.all() else 0)

    def message(self, ref: Ref) -> Message | None:
        """Return a message; None if it turned out to be damaged: what is around it must be looked up again."""
        return self._container.message(ref.chunk, ref.channel, ref.offset, ref.time)


def _limits(after: int, until: int) -> np.ndarray[Any, Any]:
    return np.array([max(after, 0), max(until, 0)], np.uint64)


_NOTHING = (np.empty(0, np.uint64), np.empty(0, np.uint64))
