"""Finding messages by channel and time, without reading more chunks than need be."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from .container import Container, Message, Progress
from .mcap_reader import ChunkInfo, Index, Numbers

__all__ = ["Ref", "Timeline", "Totals"]

# A channel's number has 16 bits: arrays by channel have so many places.
_CHANNELS = 1 << 16
_BLOCK = 128
"""Chunks of which it is noted together which channels they have: a list for each channel would be as long as the
index of the whole file, and take seconds to make."""


class Ref(NamedTuple):
    """Where a message is.

    Attributes:
        time: Its log time in ns.
        chunk: The chunk.
        offset: Its place in the chunk.
        channel: Its channel. The last field: of one instant, messages come in the order of the file, whatever numbers
            another tool has given to the channels.
    """

    time: int
    chunk: ChunkInfo
    offset: int
    channel: int


class Totals(NamedTuple):
    """How many messages a channel has, their bytes (with a few of framing), and the first and last log time in ns."""

    messages: int = 0
    bytes: int = 0
    first: int = 0
    last: int = 0


class Timeline:
    """The messages of a file by channel and time, in whatever order the file has them.

    Args:
        container: The file.
    """

    def __init__(self, container: Container) -> None:
        self._container = container
        self._chunks = container.every_chunk
        # In order: chunks are numbered so.
        self._starts = np.array([info.start for info in self._chunks], np.uint64)
        self._ends = np.array([info.end for info in self._chunks], np.uint64)
        # Chunks may overlap in time: when the last one up to a place ends.
        self._all_end = np.maximum.accumulate(self._ends)
        self._blocks: Numbers | None = None

    def _holders(self, channel: int, before: int) -> Iterator[ChunkInfo]:
        """Yield the chunks that have messages of a channel, from that with the number `before` - 1 backwards."""
        if self._blocks is None:
            self._blocks = np.zeros((-(-len(self._chunks) // _BLOCK), _CHANNELS), bool)
            for info in self._chunks:
                self._blocks[info.number // _BLOCK, info.channels] = True
        # Backwards, since the newest message before an instant is what is asked for most.
        for block in np.flatnonzero(self._blocks[:, channel])[::-1].tolist():
            for info in reversed(self._chunks[block * _BLOCK : min((block + 1) * _BLOCK, before)]):
                if info.number not in self._container.lost and (info.channels == channel).any():
                    yield info

    def latest(self, channel: int, until: int, after: int = -1) -> Ref | None:
        """Return the last message of a channel that is not later than `until` and later than `after`, or None."""
        if until < 0:
            return None
        # No chunk from this one on has a message so early.
        before = int(np.searchsorted(self._starts, np.uint64(until), side="right"))
        best: Ref | None = None
        for info in self._holders(channel, before):
            # Neither this chunk nor one that begins before it has a later message.
            if int(self._all_end[info.number]) <= after:
                break
            if info.end <= after:
                continue
            times, offsets = self._container.index(info).of(channel)
            position = int(np.searchsorted(times, np.uint64(until), side="right")) - 1
            if position >= 0 and int(times[position]) > after:
                after = int(times[position])
                best = Ref(after, info, int(offsets[position]), channel)
        return best

    def between(self, channels: Iterable[int], after: int, until: int) -> Iterator[Ref]:
        """Yield the messages of some channels that are later than `after` and not later than `until`, by time."""
        wanted = _mask(channels)
        waiting: list[Ref] = []
        for info in self._with(wanted, after, until):
            # What is earlier than the beginning of the next chunk cannot be overtaken any more.
            while waiting and waiting[0].time < info.start:
                yield heapq.heappop(waiting)
            waiting.extend(_inside(info, self._container.index(info), wanted, after, until))
            heapq.heapify(waiting)
        while waiting:
            yield heapq.heappop(waiting)

    def _with(self, wanted: Numbers, after: int, until: int) -> Iterator[ChunkInfo]:
        """Yield the chunks between two instants that have messages of wanted channels, by their beginning."""
        if until < 0:
            return
        inside = (self._ends > np.uint64(max(after, 0))) if after >= 0 else np.ones(len(self._chunks), bool)
        for number in np.flatnonzero(inside & (self._starts <= np.uint64(until))).tolist():
            info = self._chunks[number]
            if number not in self._container.lost and wanted[info.channels].any():
                yield info

    def times(self, channels: Iterable[int]) -> Numbers:
        """Return the log times of all messages of some channels, in ns, sorted: uint64."""
        wanted, found = _mask(channels), [np.empty(0, np.uint64)]
        for info in self._with(wanted, -1, _END):
            index = self._container.index(info)
            found.append(index.times[wanted[index.entries()]])
        return np.sort(np.concatenate(found))

    def channels_between(self, after: int, until: int) -> set[int]:
        """Return the channels that have a message later than `after` and not later than `until`."""
        found = np.zeros(_CHANNELS, bool)
        for info in self._with(~found, after, until):
            # A chunk that lies wholly inside: its list of channels says it all, and its index is not read.
            if info.start > after and info.end <= until:
                found[info.channels] = True
            elif not found[info.channels].all():
                index = self._container.index(info)
                found[index.entries()[_between(index.times, after, until)]] = True
        return set(np.flatnonzero(found).tolist())

    def exactly(self, channel: int, time: int) -> Ref | None:
        """Return the message of a channel with this very log time, or None."""
        found = self.latest(channel, time)
        return found if found is not None and found.time == time else None

    def totals(self, progress: Progress | None = None) -> dict[int, Totals]:
        """Return what each channel has, by the indexes of all chunks."""
        messages, sizes, lasts = np.zeros((3, _CHANNELS), np.int64)
        firsts = np.full(_CHANNELS, _END)
        for info in self._chunks:
            if info.number not in self._container.lost:
                index = self._container.index(info)
                entries, times = index.entries(), index.times.astype(np.int64)
                np.add.at(messages, entries, 1)
                np.add.at(sizes, entries, self._sizes(info, index))
                np.minimum.at(firsts, entries, times)
                np.maximum.at(lasts, entries, times)
            if progress is not None:
                progress(info.number + 1, len(self._chunks))
        some = np.flatnonzero(messages).tolist()
        figures = zip(*[each[some].tolist() for each in (messages, sizes, firsts, lasts)], strict=True)
        return {channel: Totals(*each) for channel, each in zip(some, figures, strict=True)}

    def _sizes(self, info: ChunkInfo, index: Index) -> Numbers:
        """Return the bytes from each message of a chunk to the next of any channel."""
        offsets = index.offsets.astype(np.int64)
        # By place in the chunk, in which channels are mixed.
        order = np.argsort(offsets)
        sizes = np.empty(len(offsets), np.int64)
        sizes[order] = np.diff(offsets[order], append=self._container.unpacked_size(info))
        return np.maximum(sizes, 0)

    def message(self, ref: Ref) -> Message | None:
        """Return a message; None, and its chunk is left out, if it is damaged. Then find again what it was part of."""
        return self._container.message(ref.chunk, ref.channel, ref.offset, ref.time)


_END = 2**63 - 1


def _mask(channels: Iterable[int]) -> Numbers:
    wanted = np.zeros(_CHANNELS, bool)
    wanted[list(channels)] = True
    return wanted


def _between(times: Numbers, after: int, until: int) -> Numbers:
    """Return of each time whether it is later than `after` and not later than `until`."""
    begun = times > np.uint64(after) if after >= 0 else np.ones(len(times), bool)
    return begun & (times <= np.uint64(until)) if until >= 0 else np.zeros(len(times), bool)


def _inside(info: ChunkInfo, index: Index, wanted: Numbers, after: int, until: int) -> Iterator[Ref]:
    """Yield the messages of a chunk that are of a wanted channel and between two instants, in any order."""
    channels = index.entries()
    chosen = wanted[channels] & _between(index.times, after, until)
    columns = (index.times[chosen].tolist(), channels[chosen].tolist(), index.offsets[chosen].tolist())
    for time, channel, offset in zip(*columns, strict=True):
        yield Ref(time, info, offset, channel)
