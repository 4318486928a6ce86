"""The messages of an MCAP file, whichever of the format's optional parts its writer has left out.

With a complete summary only the end of the file is read. Otherwise the file is read from record to record once: its
recorder was killed, or another tool has written it without chunks, without indexes, or without a summary. What is
damaged is left out and counted: a whole chunk, or all that follows a damaged record outside of chunks.
"""

from __future__ import annotations

import heapq
import io
import struct
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from .format import DamagedRecording
from .mcap_reader import (
    HEAD,
    MAGIC,
    MALFORMED,
    MESSAGE,
    ChunkInfo,
    Contents,
    Footer,
    Index,
    Numbers,
    Source,
    index_of,
    index_places,
    parse_index,
    read_footer,
    read_summary,
    record_starts,
)  # fmt: skip

# Unpacked chunks that are kept: neighbours in time are asked for together.
_CACHED_BYTES = 96 << 20
_CACHED_ENTRIES = 4 << 20
"""Messages of which the places are kept, 16 bytes for each."""
_SMALLEST_CHUNK, _LARGEST_CHUNK = 40, 1 << 31
"""Bytes. REEM closes a chunk with the message that takes it over a megabyte."""
_BARE_BYTES = 1 << 20
"""Bytes of messages outside of chunks that are read as one chunk."""
# What other records of these kinds would hide: all that follows.
_END_LENGTHS = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}

Progress = Callable[[int, int], None]
"""Called with how much of something is done, and how much there is."""


class Message(NamedTuple):
    """One message: when it was published (ns), its number, its bytes."""

    publish_time: int
    sequence: int
    data: bytes


def _unpacked(source: Source, info: ChunkInfo) -> bytes | None:
    if info.bare:
        return source.read(info.offset, info.length)
    body = source.read(info.offset + HEAD.size, info.length - HEAD.size)
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
        if chunk.uncompressed_size > _LARGEST_CHUNK or chunk.message_start_time != info.start:
            return None
        # The checksum is of the unpacked bytes, so damage in what unpacks well is found too.
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        content = stream.read(length)
    except Exception:  # zstandard and lz4 have errors of their own for what is damaged
        return None
    return content if len(content) == chunk.uncompressed_size else None


def _take_records(content: bytes, contents: Contents) -> Index | None:
    """Take the schemas and channels out of a chunk; return the index of its messages, None if it is damaged."""
    channels: list[int] = []
    times: list[int] = []
    offsets: list[int] = []
    position = 0
    try:
        while position < len(content):
            opcode, length = HEAD.unpack_from(content, position)
            start, end = position + HEAD.size, position + HEAD.size + length
            if end > len(content):
                return None
            if opcode == Opcode.MESSAGE:
                _, _, channel_id, _, log_time, _ = MESSAGE.unpack_from(content, position)
                channels.append(channel_id)
                times.append(log_time)
                offsets.append(position)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                stream = ReadDataStream(io.BytesIO(content[start:end]))
                record, known = (
                    (Schema.read(stream), contents.schemas)
                    if opcode == Opcode.SCHEMA
                    else (Channel.read(stream), contents.channels)
                )
                # A number has one meaning in the whole file.
                if known.setdefault(record.id, record) != record:
                    return None
            position = end
    except MALFORMED:
        return None
    return index_of(channels, times, offsets)


class _Scan:
    """Reads a file from record to record, as far as it is whole."""

    def __init__(self, source: Source) -> None:
        self.contents = Contents()
        self.messages = 0
        self.damaged = 0  # records that are damaged or cut off
        self._source = source
        self._size = source.size

    def run(self, footer: Footer | None, progress: Progress | None) -> None:
        position = bare = len(MAGIC)  # since where there have been messages outside of chunks
        while position + HEAD.size <= self._size:
            opcode, length = HEAD.unpack(self._source.peek(position, HEAD.size))
            end = position + HEAD.size + length
            # What follows a damaged head could be anything.
            if opcode == 0 or end > self._size or (opcode == Opcode.CHUNK and length < _SMALLEST_CHUNK):
                break
            if length != _END_LENGTHS.get(opcode, length):
                break
            is_bare = opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
            if not is_bare or position - bare >= _BARE_BYTES:
                self._take_bare(bare, position)
                bare = position
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                # Behind an end in the middle of the data there would be more.
                self.damaged += opcode == Opcode.DATA_END and footer is not None and end != footer.data_end
                return
            if opcode == Opcode.CHUNK:
                end = self._take_chunk(position, end)
            elif opcode == Opcode.METADATA:
                self._take_metadata(position + HEAD.size, end)
            elif opcode == Opcode.MESSAGE_INDEX:  # its chunk is not one any more
                self.damaged += 1
            position, bare = end, bare if is_bare else end
            if progress is not None:
                progress(position, self._size)
        self._take_bare(bare, position)
        self.damaged += position < self._size

    def _take_bare(self, start: int, end: int) -> None:
        info = ChunkInfo(0, 0, 0, start, end - start, end, 0, np.empty(0, np.uint16), bare=True)
        if end > start:
            self._take_content(info)

    def _take_content(self, info: ChunkInfo) -> None:
        """Take a chunk without an index: its content says what it has."""
        content = _unpacked(self._source, info)
        found = None if content is None else _take_records(content, self.contents)
        if found is None or (len(found.times) and not info.bare and found.span() != (info.start, info.end)):
            self.damaged += 1
        elif len(found.times):
            first, last = found.span()
            self._add(replace(info, start=first, end=last, index_length=0), found)

    def _add(self, info: ChunkInfo, index: Index) -> None:
        self.contents.chunks.append(replace(info, channels=index.channels))
        self.messages += len(index.times)

    def _take_chunk(self, position: int, end: int) -> int:
        """Take a chunk with the index behind it; return where that ends."""
        start, last = struct.unpack("<QQ", self._source.peek(position + HEAD.size, 16))
        index = end
        while index + HEAD.size <= self._size:
            opcode, length = HEAD.unpack(self._source.peek(index, HEAD.size))
            if opcode != Opcode.MESSAGE_INDEX or index + HEAD.size + length > self._size:
                break
            index += HEAD.size + length
        info = ChunkInfo(0, start, last, position, end - position, end, index - end, np.empty(0, np.uint16))
        # A part of the index may be missing where the file ends there, or a record follows that MCAP does not know.
        is_whole = index + HEAD.size <= self._size and opcode <= Opcode.DATA_END and opcode != Opcode.MESSAGE_INDEX
        text = self._source.read(end, index - end)
        found = parse_index(text, record_starts(text), start, last) if is_whole else None
        self.damaged += is_whole and bool(text) and found is None
        known = found is not None and found.span() == (start, last)
        if found is not None and known and self.contents.channels.keys() >= set(found.channels.tolist()):
            self._add(info, found)
        else:  # it brings new channels, or has no index
            self._take_content(info)
        return index

    def _take_metadata(self, start: int, end: int) -> None:
        try:
            record = Metadata.read(ReadDataStream(io.BytesIO(self._source.read(start, end - start))))
            self.contents.metadata[start] = record
        except MALFORMED:
            self.damaged += 1


class Container:
    """An MCAP file. Any thread may use it.

    `progress` is called if the file is read from record to record. Raises DamagedRecording if it is none, and OSError.
    """

    def __init__(self, path: FilePath, progress: Progress | None = None) -> None:
        self.path = path
        self.damaged = 0  # records that were found to be damaged, cut off or missing
        self.lost: set[int] = set()  # the numbers of damaged chunks
        self._lock = threading.RLock()
        self._cache: OrderedDict[int, bytes] = OrderedDict()
        self._cached = 0
        self._indexes: OrderedDict[int, Index] = OrderedDict()
        self._entries = 0
        self._source = Source(path)
        try:
            if self._source.peek(0, len(MAGIC)) != MAGIC:
                raise DamagedRecording(
                    f"{path} is not an MCAP file; give one that `reem record`, or another program, wrote"
                )
            self.size = self._source.size
            self._contents = self._read_contents(progress)
        except BaseException:
            self._source.close()
            raise
        self.channels, self.schemas = self._contents.channels, self._contents.schemas
        self.metadata = [record for _, record in sorted(self._contents.metadata.items())]
        # Other tools write chunks in any order; what is asked for is asked by time.
        chunks = sorted(self._contents.chunks, key=lambda it: (it.start, it.offset))
        self.every_chunk = [replace(info, number=number) for number, info in enumerate(chunks)]

    def _read_contents(self, progress: Progress | None) -> Contents:
        footer = read_footer(self._source)
        self.indexed = footer is not None
        try:
            contents, is_complete = (Contents(), False) if footer is None else read_summary(self._source, footer)
        except MALFORMED:
            contents, is_complete, self.damaged = Contents(), False, 1
        self._messages = contents.messages  # as the writer has counted them
        if is_complete:
            self.damaged = contents.damaged
            return contents
        scan = _Scan(self._source)
        scan.run(footer, progress)
        self.damaged += scan.damaged + scan.contents.unknown()
        self.damaged += not self.damaged and self._messages not in (None, scan.messages)
        return scan.contents

    def header(self) -> dict[str, str]:
        """Return which profile and library the file names; nothing if that is damaged."""
        try:
            opcode, length = HEAD.unpack(self._source.peek(len(MAGIC), HEAD.size))
            if opcode != Opcode.HEADER:
                return {}
            header = Header.read(ReadDataStream(io.BytesIO(self._source.peek(len(MAGIC) + HEAD.size, length))))
        except MALFORMED:
            return {}
        return {"profile": header.profile, "library": header.library}

    def close(self) -> None:
        with self._lock:
            self._cache.clear()
            self._indexes.clear()
            self._source.close()

    @property
    def chunks(self) -> list[ChunkInfo]:
        return [info for info in self.every_chunk if info.number not in self.lost] if self.lost else self.every_chunk

    def content(self, info: ChunkInfo) -> bytes | None:
        """Return the content of a chunk; None, and the chunk is left out and counted, if it is damaged."""
        with self._lock:
            if info.number in self._cache:
                self._cache.move_to_end(info.number)
                return self._cache[info.number]
            content = _unpacked(self._source, info)
            if content is None:
                self._discard(info)
                return None
            self._cache[info.number] = content
            self._cached += len(content)
            # At least one stays, however large: its caller is about to use it.
            while self._cached > _CACHED_BYTES and len(self._cache) > 1:
                self._cached -= len(self._cache.popitem(last=False)[1])
            return content

    def _discard(self, info: ChunkInfo) -> None:
        with self._lock:
            self.damaged += info.number not in self.lost
            self.lost.add(info.number)

    def index(self, info: ChunkInfo) -> Index:
        """Return the index of a chunk; without messages, if the chunk turns out to be damaged."""
        with self._lock:
            if info.number in self._indexes:
                self._indexes.move_to_end(info.number)
                return self._indexes[info.number]
            index = self._read_index(info)
            if index is None:
                self._discard(info)
                index = index_of((), (), ())
            self._indexes[info.number] = index
            self._entries += len(index.times)
            while self._entries > _CACHED_ENTRIES and len(self._indexes) > 1:
                self._entries -= len(self._indexes.popitem(last=False)[1].times)
            return index

    def _read_index(self, info: ChunkInfo) -> Index | None:
        """Return the index of a chunk, made of its content if the file has none; None if it is damaged."""
        if not info.index_length:
            content = self.content(info)
            index = None if content is None else _take_records(content, self._contents)
        else:
            text = self._source.read(info.index, info.index_length)
            starts = index_places(self._source, info) if info.map else record_starts(text)
            index = parse_index(text, starts, info.start, info.end)
        return index if index is not None and np.isin(index.channels, info.channels).all() else None

    def message(self, ref: Ref) -> Message | None:
        """Return a message; None, and its chunk is left out, if it is damaged. Then find again what it was part of."""
        content, start = self.content(ref.chunk), ref.offset + MESSAGE.size
        if content is None:
            return None
        if start <= len(content):
            opcode, length, channel, sequence, time, published = MESSAGE.unpack_from(content, ref.offset)
            end = ref.offset + HEAD.size + length
            if opcode == Opcode.MESSAGE and (channel, time) == (ref.channel, ref.time) and end <= len(content):
                return Message(published, sequence, content[start:end])
        self._discard(ref.chunk)
        return None

    def unpacked_size(self, info: ChunkInfo) -> int:
        """Return the bytes of a chunk before compression; a wrong number if it is damaged."""
        if info.bare:
            return info.length
        # Behind the head and two times: the size of the content.
        (size,) = struct.unpack("<Q", self._source.read(info.offset + HEAD.size + 16, 8))
        return int(size)

    def verify(self, progress: Progress | None = None) -> int:
        """Read every chunk; return how many records of the file are damaged."""
        messages = 0
        for info in self.chunks:
            content = self.content(info)
            made = None if content is None else _take_records(content, self._contents)
            known = self._read_index(info) if made is not None and info.index_length else made
            if made is None or known is None or not known.same(made) or made.span() != (info.start, info.end):
                self._discard(info)
            messages += 0 if made is None else len(made.times)
            if progress is not None:
                progress(info.number + 1, len(self.every_chunk))
        self.damaged += not self.damaged and self._messages not in (None, messages)
        return self.damaged


# Finding messages by channel and time, reading as few chunks as possible.


# A channel's number has 16 bits: arrays by channel have so many places.
_CHANNELS = 1 << 16
_BLOCK = 128
"""Chunks of which it is noted together which channels they have: a list for each channel would be as long as the
index of the whole file, and take seconds to make."""


class Ref(NamedTuple):
    """Where a message is, and its log time in ns.

    The channel is last: of one instant, messages come in the order of the file, whatever numbers another tool has
    given to the channels.
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
        wanted, found = _mask(channels), [np.empty(0, np.uint64)]
        for info in self._with(wanted, -1, _END):
            index = self._container.index(info)
            found.append(index.times[wanted[index.entries()]])
        return np.sort(np.concatenate(found))

    def channels_between(self, after: int, until: int) -> set[int]:
        found = np.zeros(_CHANNELS, bool)
        for info in self._with(~found, after, until):
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


def _mask(channels: Iterable[int]) -> Numbers:
    wanted = np.zeros(_CHANNELS, bool)
    wanted[list(channels)] = True
    return wanted


def _between(times: Numbers, after: int, until: int) -> Numbers:
    begun = times > np.uint64(after) if after >= 0 else np.ones(len(times), bool)
    return begun & (times <= np.uint64(until)) if until >= 0 else np.zeros(len(times), bool)


def _inside(info: ChunkInfo, index: Index, wanted: Numbers, after: int, until: int) -> Iterator[Ref]:
    """Yield the messages of a chunk that are of a wanted channel and between two instants, in any order."""
    channels = index.entries()
    chosen = wanted[channels] & _between(index.times, after, until)
    columns = (index.times[chosen].tolist(), channels[chosen].tolist(), index.offsets[chosen].tolist())
    for time, channel, offset in zip(*columns, strict=True):
        yield Ref(time, info, offset, channel)
