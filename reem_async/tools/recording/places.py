"""Finding messages by channel and time, reading as few chunks as possible."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode

from .container import Container, Progress, Ref
from .mcap_reader import HEAD, MESSAGE, ChunkInfo, Index, Numbers

# A channel's number has 16 bits: arrays by channel have so many places.
_CHANNELS = 1 << 16
_BLOCK = 128
"""Chunks of which it is noted together which channels they have: a list for each channel would be as long as the
index of the whole file, and take seconds to make."""


class Batch(NamedTuple):
    """Where messages of one chunk are, by time."""

    chunk: ChunkInfo
    times: Numbers  # log times in ns
    channels: Numbers
    offsets: Numbers


def messages_in(content: bytes, batch: Batch, channels: Numbers) -> list[bytes] | None:
    """Return the data of messages in the content of their chunk; None if one is not what the index names.

    `channels` are those of the batch by the numbers that they have in the content.
    """
    found, unpack, size = [], MESSAGE.unpack_from, len(content)
    for offset, channel, time in zip(batch.offsets.tolist(), channels.tolist(), batch.times.tolist(), strict=True):
        start = offset + MESSAGE.size
        if start > size:
            return None
        opcode, length, number, _, at, _ = unpack(content, offset)
        end = offset + HEAD.size + length
        if opcode != _MESSAGE or number != channel or at != time or end > size:
            return None
        found.append(content[start:end])
    return found


_MESSAGE = int(Opcode.MESSAGE)


class Totals(NamedTuple):
    """How many messages a channel has, their bytes (with a few of framing), and the first and last log time in ns."""

    messages: int = 0
    bytes: int = 0
    first: int = 0
    last: int = 0


@dataclass(frozen=True, slots=True)
class ChannelSummary:
    """What a channel of the file holds.

    Attributes:
        topic: What viewers call it.
        path: The path it is about; "" if it is about the recording itself.
        role: "update", "part", "delete", "state", "keyframe", "gap", "skip", or "".
        kind: "pub", "stored", "kvs" or "".
        schema: The name of its schema.
        messages: How many.
        bytes: Their size, before compression.
        first: The instant of the first, 0 if there is none.
        last: The instant of the last.
        skipped: Why its messages are left out, in a file that another program has written; else "".
    """

    topic: str
    path: str
    role: str
    kind: str
    schema: str
    messages: int
    bytes: int
    first: float
    last: float
    skipped: str = ""

    @property
    def rate(self) -> float:
        """Messages a second, from the first to the last."""
        return (self.messages - 1) / (self.last - self.first) if self.last > self.first else 0.0


class Timeline:
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
            blocks = np.zeros((-(-len(self._chunks) // _BLOCK), _CHANNELS), bool)
            for info in self._chunks:
                blocks[info.number // _BLOCK, info.channels] = True
            self._blocks = blocks  # now and not before: another thread may use it
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
        for info in self.chunks_with(wanted, after, until):
            # What is earlier than the beginning of the next chunk cannot be overtaken any more.
            while waiting and waiting[0].time < info.start:
                yield heapq.heappop(waiting)
            rows = _rows(self._container.index(info), wanted, after, until)
            waiting.extend([Ref(time, info, offset, channel) for time, channel, offset in rows])
            heapq.heapify(waiting)
        while waiting:
            yield heapq.heappop(waiting)

    def batches(self, channels: Iterable[int], after: int, until: int) -> Iterator[Batch | None]:
        """Yield chunk by chunk the places of what `between` yields.

        None, at the end, if the rest is to be put in order: the index of the next chunk is damaged, it has two messages
        of one instant, or a later chunk may have earlier messages.
        """
        wanted = _mask(channels)
        chunks = list(self.chunks_with(wanted, after, until))
        for info, following in zip_longest(chunks, chunks[1:]):
            parts = [
                (channel, self._container.part_of_index(info, channel))
                for channel in info.channels[wanted[info.channels]].tolist()
            ]
            batch = _joined(info, parts, after, until)
            if batch is not None and not len(batch.times):
                continue
            if batch is None or (following is not None and int(batch.times[-1]) >= following.start):
                yield None
                return
            yield batch

    def chunks_with(self, wanted: Numbers, after: int, until: int) -> Iterator[ChunkInfo]:
        """Yield the chunks between two instants that have messages of wanted channels, by their beginning."""
        if until < 0:
            return
        inside = (self._ends > np.uint64(max(after, 0))) if after >= 0 else np.ones(len(self._chunks), bool)
        for number in np.flatnonzero(inside & (self._starts <= np.uint64(until))).tolist():
            info = self._chunks[number]
            if number not in self._container.lost and wanted[info.channels].any():
                yield info

    def times(self, channels: Iterable[int], progress: Progress | None = None) -> Numbers:
        """Return the log times of all messages of some channels, sorted."""
        wanted, found = _mask(channels), [np.empty(0, np.uint64)]
        chunks = list(self.chunks_with(wanted, -1, _END))
        for done, info in enumerate(chunks):
            index = self._container.index(info)
            found.append(index.times[wanted[index.entries()]])
            if progress is not None:
                progress(done + 1, len(chunks))
        return np.sort(np.concatenate(found))

    def count(self, channels: Iterable[int], after: int, until: int) -> int:
        """Return how many messages of some channels are later than `after` and not later than `until`."""
        wanted, total = _mask(channels), 0
        for info in self.chunks_with(wanted, after, until):
            index = self._container.index(info)
            total += int(np.count_nonzero(wanted[index.entries()] & _between(index.times, after, until)))
        return total

    def channels_between(self, after: int, until: int) -> set[int]:
        found = np.zeros(_CHANNELS, bool)
        for info in self.chunks_with(~found, after, until):
            # A chunk that lies wholly inside: its list of channels says it all, and its index is not read.
            if info.start > after and info.end <= until:
                found[info.channels] = True
            elif not found[info.channels].all():
                index = self._container.index(info)
                found[index.entries()[_between(index.times, after, until)]] = True
        return set(np.flatnonzero(found).tolist())

    def totals(self, progress: Progress | None = None) -> dict[int, Totals]:
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


_END = 2**63 - 1


def _joined(
    info: ChunkInfo, parts: list[tuple[int, tuple[Numbers, Numbers] | None]], after: int, until: int
) -> Batch | None:
    """Return the messages of some channels between two instants; None if damaged, or if two are of one instant."""
    columns = []
    for channel, part in parts:
        if part is None:
            return None
        times, offsets = part
        if not len(times):
            continue
        first, last = int(times[0]), int(times[-1])
        if (times[1:] <= times[:-1]).any() or first < info.start or last > info.end:
            return None
        if first <= after or last > until:
            chosen = _between(times, after, until)
            times, offsets = times[chosen], offsets[chosen]
        columns.append((times, np.full(len(times), channel), offsets))
    if not columns:
        return Batch(info, *[np.empty(0, np.uint64)] * 3)
    times, channels, offsets = columns[0] if len(columns) == 1 else map(np.concatenate, zip(*columns, strict=True))
    if len(columns) > 1:
        order = np.argsort(times)
        times, channels, offsets = times[order], channels[order], offsets[order]
        if (times[1:] <= times[:-1]).any():
            return None
    return Batch(info, times, channels, offsets)


def _mask(channels: Iterable[int]) -> Numbers:
    wanted = np.zeros(_CHANNELS, bool)
    wanted[list(channels)] = True
    return wanted


def _between(times: Numbers, after: int, until: int) -> Numbers:
    begun = times > np.uint64(after) if after >= 0 else np.ones(len(times), bool)
    return begun & (times <= np.uint64(until)) if until >= 0 else np.zeros(len(times), bool)


def _rows(index: Index, wanted: Numbers, after: int, until: int) -> Iterator[tuple[int, int, int]]:
    """Yield time, channel and place of the messages that are of a wanted channel and between two instants, by time."""
    channels = index.entries()
    chosen = np.flatnonzero(wanted[channels] & _between(index.times, after, until))
    chosen = chosen[np.argsort(index.times[chosen], kind="stable")]
    columns = index.times[chosen], channels[chosen], index.offsets[chosen]
    return zip(*[each.tolist() for each in columns], strict=True)
