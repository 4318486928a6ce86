"""Reading an MCAP file: its bytes, its summary, and the index of the messages in a chunk.

The library turns the channels of each chunk into a dict: 14 million entries for an hour of 1,000 keys. Here each
index is a few numpy arrays.
"""

from __future__ import annotations

import errno
import io
import os
import struct
import threading
import zlib
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, MetadataIndex, Schema, Statistics

Numbers = np.ndarray[Any, Any]

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
"""The head of each record: opcode, length of what follows."""
MESSAGE = struct.Struct("<BQHIQQ")
"""The head of a message record: opcode, length, channel, sequence, log time, publish time; the data follow."""
MALFORMED = (McapError, ValueError, struct.error, EOFError, OverflowError, MemoryError)
"""What the library raises over bytes that are no record."""
# Where the summary and its offsets begin (8 bytes each), and a CRC-32.
_FOOTER = HEAD.size + 20
_FOOTER_HEAD = HEAD.pack(Opcode.FOOTER, 20)
# First and last log time, offset and length of the chunk, bytes of the map from channels to places.
_CHUNK_HEAD = struct.Struct("<QQQQI")
_PLACE = np.dtype([("channel", "<u2"), ("offset", "<u8")])
# The head of a message index: opcode, length, channel, bytes of the pairs (log time, offset) that follow.
_INDEX_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("size", "<u4")])
_HEAD_BYTES = np.arange(_INDEX_HEAD.itemsize)
_PART_HEAD = struct.Struct("<BQHI")  # the same for one record
_FEW = 32
"""Channels of a chunk up to which the records of its index are looked through for one of them."""
_BLOCK = 1 << 20
"""Bytes that are read at once where a file is read from record to record."""
# What must be listed in a summary. Readers have to ignore records with an opcode that they do not know.
_LISTED = frozenset(
    (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.METADATA, 0)
)


class Source:
    """A file, read by position. Any thread may use it, while another program cuts it short or writes over it.

    It is not mapped into memory: the system kills a process that touches a mapped page which the file no longer has.
    What is added to it later is not read.
    """

    def __init__(self, path: FilePath) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._file = path.open("rb", buffering=0)
        self.size = os.fstat(self._file.fileno()).st_size
        self._block, self._block_start = b"", 0

    def read(self, start: int, size: int) -> bytes:
        """Return `size` bytes from `start`; OSError if the file has become shorter than it was."""
        with self._lock:
            found = os.pread(self._file.fileno(), size, start)
        if len(found) < size:
            raise OSError(errno.EIO, "cut short while it was being read; open it again", str(self.path))
        return found

    def peek(self, start: int, size: int) -> bytes:
        """Return what `read` does, or less at the end of the file; quick where the next call is for what follows."""
        size = max(min(size, self.size - start), 0)
        block, first = self._block, self._block_start
        if not first <= start or start + size > first + len(block):
            block, first = self.read(start, max(size, min(_BLOCK, self.size - start))), start
            self._block, self._block_start = block, first
        return block[start - first : start - first + size]

    def close(self) -> None:
        """Close the file. Idempotent; reading raises ValueError then."""
        with self._lock:
            self._file.close()


class Index(NamedTuple):
    """Where the messages of a chunk are, one channel after the other."""

    channels: Numbers  # uint16
    bounds: Numbers  # where the messages of each channel begin in the arrays below, and where the last ends
    times: Numbers  # log times in ns, uint64; of each channel in order
    offsets: Numbers  # places in the chunk, uint64

    def of(self, channel: int) -> tuple[Numbers, Numbers]:
        """Return the log times and places of a channel's messages."""
        (place,) = np.nonzero(self.channels == channel)
        span = slice(int(self.bounds[place[0]]), int(self.bounds[place[0] + 1])) if len(place) else slice(0, 0)
        return self.times[span], self.offsets[span]

    def entries(self) -> Numbers:
        """Return the channel of each message."""
        return np.repeat(self.channels, np.diff(self.bounds))

    def same(self, other: Index) -> bool:
        """Return whether both list the same messages; the channels may be in any order."""
        pair = [index_of(it.entries(), it.times, it.offsets) for it in (self, other)]
        return all(np.array_equal(one, two) for one, two in zip(*pair, strict=True))

    def span(self) -> tuple[int, int]:
        return (int(self.times.min()), int(self.times.max())) if len(self.times) else (0, 0)


@dataclass(frozen=True, slots=True, order=True)
class ChunkInfo:
    number: int  # among the chunks of the file, in order of their first log times
    start: int  # the first and the last log time in it, in ns
    end: int
    offset: int  # of its record in the file
    length: int
    index: int  # where the index of its messages begins
    index_length: int  # 0 if there is none
    channels: Numbers = field(compare=False)  # that have messages in it, uint16
    map: int = 0  # where the summary lists the places of the index's records; 0 if it does not
    bare: bool = False  # it is no chunk record: messages that the file has outside of chunks


@dataclass(slots=True)
class Contents:
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    chunks: list[ChunkInfo] = field(default_factory=list)
    metadata: dict[int, Metadata] = field(default_factory=dict)
    messages: int | None = None  # by the statistics of the summary
    ends: dict[int, int] = field(default_factory=dict)  # of the metadata records that the summary lists
    damaged: int = 0  # records outside of chunks that cannot be read, although the summary lists what follows them

    def unknown(self) -> int:
        """Return how many channels with messages, or their schemas, the file does not describe."""
        mask = np.zeros(1 << 16, bool)
        for chunk in self.chunks:
            mask[chunk.channels] = True
        used = set(np.flatnonzero(mask).tolist())
        described = used & self.channels.keys()
        schemas = {self.channels[number].schema_id for number in described} - self.schemas.keys() - {0}
        return len(used - described) + len(schemas)


class Footer(NamedTuple):
    """The end of a file that was closed properly."""

    data_end: int  # of the data section
    text: bytes | None  # the summary; None if it is damaged, empty if there is none


def read_footer(source: Source) -> Footer | None:
    """Return the end of a file; None if it does not end as a file that was closed."""
    end = source.size - len(MAGIC) - _FOOTER
    if end < 0:
        return None
    footer = source.read(end, _FOOTER + len(MAGIC))
    if footer[_FOOTER:] != MAGIC or not footer.startswith(_FOOTER_HEAD):
        return None
    start, _, checksum = struct.unpack_from("<QQI", footer, HEAD.size)
    if start == 0:
        return Footer(end, b"")
    if not len(MAGIC) <= start <= end:
        return Footer(end, None)
    text = source.read(start, end - start)
    # The checksum covers the summary and the footer up to the checksum; 0 means that the writer made none.
    is_sound = checksum in (0, zlib.crc32(footer[: _FOOTER - 4], zlib.crc32(text)))
    return Footer(start, text if is_sound else None)


def read_summary(source: Source, footer: Footer) -> tuple[Contents, bool]:
    """Return what the summary says, and whether it leaves out nothing that the file has.

    MCAP leaves most of a summary to the program that writes it. So the data section is compared with it, without being
    read: from record to record, the known chunks and metadata are all that it may have. Raises one of MALFORMED if the
    summary is damaged, or lists what the file does not have.
    """
    if footer.text is None:
        raise ValueError("the summary does not have the checksum that the footer names")
    if not footer.text:
        return Contents(), False
    contents = _parsed(source, footer.data_end, footer.text)
    known = all(chunk.index_length and len(chunk.channels) for chunk in contents.chunks) and not contents.unknown()
    return contents, _lists_all(source, footer.data_end, contents) and known


def _parsed(source: Source, data_end: int, text: bytes) -> Contents:
    contents, position = Contents(), 0
    while position < len(text):
        opcode, length = HEAD.unpack_from(text, position)
        body, position = position + HEAD.size, position + HEAD.size + length
        if position > len(text):
            raise ValueError("a record goes beyond the summary")
        if opcode == Opcode.CHUNK_INDEX:
            contents.chunks.append(_chunk(text, body, position, data_end))
            continue
        stream = ReadDataStream(io.BytesIO(text[body:position]))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            contents.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            contents.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            contents.messages = Statistics.read(stream).message_count
        elif opcode == Opcode.METADATA_INDEX:
            _take_metadata(source, MetadataIndex.read(stream), contents)
    return contents


def _chunk(text: bytes, body: int, end: int, start: int) -> ChunkInfo:
    first, last, offset, length, size = _CHUNK_HEAD.unpack_from(text, body)
    places = body + _CHUNK_HEAD.size
    if size % _PLACE.itemsize or places + size + 8 > end:
        raise ValueError("the places of a chunk's messages go beyond its record")
    channels = np.frombuffer(text, _PLACE, size // _PLACE.itemsize, places)["channel"].copy()
    (index_length,) = struct.unpack_from("<Q", text, places + size)
    return ChunkInfo(0, first, last, offset, length, offset + length, index_length, channels, start + places)


def _take_metadata(source: Source, place: MetadataIndex, contents: Contents) -> None:
    if place.offset + place.length > source.size or place.length < HEAD.size:
        raise ValueError("a metadata record goes beyond the file")
    text = source.read(place.offset, place.length)
    contents.ends[place.offset] = place.offset + place.length
    try:
        if HEAD.unpack_from(text) != (Opcode.METADATA, place.length - HEAD.size):
            raise ValueError("not the metadata record that the summary lists")
        contents.metadata[place.offset] = Metadata.read(ReadDataStream(io.BytesIO(text[HEAD.size :])))
    except MALFORMED:
        contents.damaged += 1


def _lists_all(source: Source, data_end: int, contents: Contents) -> bool:
    """Return whether the summary lists all that the reader needs of the data section; ValueError if it lists more."""
    position, listed, is_all = len(MAGIC), 0, True
    ends = {it.offset: it.index + it.index_length for it in contents.chunks} | contents.ends
    first = min(ends, default=data_end)
    while position < data_end:
        end = ends.get(position, 0)
        if end <= position:
            if position + HEAD.size > data_end:
                raise ValueError("the data section ends within a record")
            opcode, length = HEAD.unpack(source.peek(position, HEAD.size))
            end = position + HEAD.size + length
            if position == len(MAGIC) and (opcode != Opcode.HEADER or end > first):
                # The header is damaged. The reader needs nothing of it.
                end, contents.damaged = first, contents.damaged + 1
            else:
                is_all = is_all and opcode not in _LISTED
        listed += position in ends
        position = end
    if position != data_end or listed != len(ends):
        raise ValueError("the summary lists what the file does not have")
    return is_all


def index_places(source: Source, info: ChunkInfo) -> Numbers:
    """Return where the records of a chunk's index begin, from its start, as the summary lists them."""
    text = source.read(info.map, len(info.channels) * _PLACE.itemsize)
    return np.sort(np.frombuffer(text, _PLACE)["offset"].astype(np.int64)) - info.index


def read_part(source: Source, info: ChunkInfo, channel: int) -> tuple[Numbers, Numbers] | None:
    """Return the log times and places of a channel's messages by the index of a chunk; None if it is damaged."""
    text, position = source.read(info.index, info.index_length), 0
    if len(info.channels) > _FEW:
        places = np.frombuffer(source.read(info.map, len(info.channels) * _PLACE.itemsize), _PLACE)
        position = int(places["offset"][places["channel"] == channel][0]) - info.index
    while 0 <= position <= len(text) - _PART_HEAD.size:
        opcode, length, number, size = _PART_HEAD.unpack_from(text, position)
        start = position + _PART_HEAD.size
        if opcode != Opcode.MESSAGE_INDEX or length != size + 6 or size % 16 or start + size > len(text):
            return None
        if number == channel:
            pairs = np.frombuffer(text, "<u8", size // 8, start).reshape(-1, 2)
            return pairs[:, 0], pairs[:, 1]
        position = start + size
    return None


def index_of(channels: Any, times: Any, offsets: Any) -> Index:
    """Return the index of messages, given the channel, the log time and the place of each, in any order."""
    numbers, stamps, places = np.array(channels, np.uint16), np.array(times, np.uint64), np.array(offsets, np.uint64)
    order = np.lexsort((places, stamps, numbers))
    known, starts = np.unique(numbers[order], return_index=True)
    return Index(known, np.append(starts, len(order)), stamps[order], places[order])


def record_starts(text: bytes) -> Numbers:
    """Return where the records of an index begin in its text, as far as they are whole."""
    starts, position = [], 0
    while position + _INDEX_HEAD.itemsize <= len(text):
        opcode, length = HEAD.unpack_from(text, position)
        if opcode != Opcode.MESSAGE_INDEX or position + HEAD.size + length > len(text):
            break
        starts.append(position)
        position += HEAD.size + length
    return np.array(starts, np.int64)


def parse_index(text: bytes, starts: Numbers, first: int, last: int) -> Index | None:
    """Return the index that a text holds.

    None if it is damaged: each of the records that begin at `starts` must be whole, of another channel, with log times
    from `first` to `last`, and nothing may be between them.
    """
    ends = np.append(starts[1:], len(text))
    if not len(starts) or starts[0] != 0 or (ends - starts < _INDEX_HEAD.itemsize).any():
        return None
    raw = np.frombuffer(text, np.uint8)
    heads, body = _parted(raw, starts, ends)
    sizes = ends - starts - _INDEX_HEAD.itemsize
    # All records at once, in numpy: there may be a thousand in each of ten thousand chunks.
    fits = (heads["opcode"] == Opcode.MESSAGE_INDEX) & (heads["size"] == sizes) & (heads["length"] == sizes + 6)
    channels = np.sort(heads["channel"])
    if not fits.all() or (sizes % 16).any() or (channels[1:] == channels[:-1]).any():
        return None
    pairs = body.view("<u8").reshape(-1, 2)
    bounds = np.append(0, np.cumsum(sizes // 16))
    index = Index(heads["channel"].copy(), bounds, pairs[:, 0].copy(), pairs[:, 1].copy())
    begin, end = index.span()
    if len(index.times) and (begin < first or end > last):
        return None
    rises = index.times[1:] >= index.times[:-1]
    rises[bounds[(bounds > 0) & (bounds < len(pairs))] - 1] = True  # another channel begins
    # Other writers need not sort the messages of a channel.
    return index if rises.all() else index_of(index.entries(), index.times, index.offsets)


def _parted(raw: Numbers, starts: Numbers, ends: Numbers) -> tuple[Numbers, Numbers]:
    """Return the heads of the records, and the bytes of all that is behind the heads."""
    if (ends - starts == ends[0]).all():  # mostly each channel has as many messages: 15 times as fast
        table = raw.reshape(len(starts), -1)
        heads, bodies = table[:, : _INDEX_HEAD.itemsize], table[:, _INDEX_HEAD.itemsize :]
        return np.ascontiguousarray(heads).view(_INDEX_HEAD).reshape(-1), np.ascontiguousarray(bodies).reshape(-1)
    places = starts[:, None] + _HEAD_BYTES
    is_body = np.ones(len(raw), bool)
    is_body[places] = False
    return raw[places].view(_INDEX_HEAD).reshape(-1), raw[is_body]
