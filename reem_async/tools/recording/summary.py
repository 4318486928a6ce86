"""The summary at the end of a file that was ended properly: its channels, and where its chunks are.

The library makes a dict of each chunk's channels: of an hour of 1,000 keys 14 million entries. Here each is an array.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass, field

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Metadata, MetadataIndex, Schema

from .index import Numbers
from .source import Source

__all__ = ["MAGIC", "ChunkInfo", "Summary", "index_places", "read_summary"]

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _CHUNK_INDEX, _METADATA_INDEX = 3, 4, 8, 13
# Head of the record, then where the summary and its offsets begin (8 bytes each) and a CRC-32.
_FOOTER = 9 + 20
_FOOTER_HEAD = b"\x02" + (20).to_bytes(8, "little")
# First and last log time, offset and length of the chunk, bytes of the map from channels to places.
_CHUNK_HEAD = struct.Struct("<QQQQI")
_PLACE = np.dtype([("channel", "<u2"), ("offset", "<u8")])
_SMALL = 4096
"""Bytes up to which a file may be whole without a chunk."""


@dataclass(frozen=True, slots=True, order=True)
class ChunkInfo:
    """Where a chunk is and when it is from.

    Attributes:
        number: Its place among the chunks of the file.
        start: The first log time in it, in ns.
        end: The last.
        offset: Where its record begins in the file.
        length: The length of its record.
        index: Where the index of its messages begins.
        index_length: The length of the index, 0 if there is none.
        channels: The channels that have messages in it, uint16.
        map: Where the summary says at which places the records of the index are; 0 if it does not.
    """

    number: int
    start: int
    end: int
    offset: int
    length: int
    index: int
    index_length: int
    channels: Numbers = field(compare=False)
    map: int = 0


@dataclass(slots=True)
class Summary:
    """What the summary says: channels and schemas by number, chunks and metadata in the order of the file."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    chunks: list[ChunkInfo] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)


def read_summary(source: Source) -> Summary | None:
    """Return the summary of a file; None if there is none to trust."""
    found = _sound_text(source)
    if found is None:
        return None
    start, text = found
    try:
        summary = _parsed(source, start, text)
    except (McapError, ValueError, struct.error, EOFError, OverflowError, MemoryError):
        return None
    # A large file without chunks cannot be: it is better gone through.
    if not summary.chunks and source.size > _SMALL:
        return None
    whole = all(each.index + each.index_length <= source.size for each in summary.chunks)
    return summary if whole else None


def _sound_text(source: Source) -> tuple[int, bytes] | None:
    """Return where the summary begins and its bytes, if the file ends as it should and they are undamaged."""
    end = source.size - len(MAGIC) - _FOOTER
    if end < 0:
        return None
    footer = source.read(end, _FOOTER + len(MAGIC))
    if footer[_FOOTER:] != MAGIC or footer[:9] != _FOOTER_HEAD:
        return None
    start, _, checked = struct.unpack_from("<QQI", footer, 9)
    # 0 means that there is no summary.
    if not 0 < start <= end:
        return None
    text = source.read(start, end - start)
    return (start, text) if zlib.crc32(footer[: _FOOTER - 4], zlib.crc32(text)) == checked else None


def _parsed(source: Source, start: int, text: bytes) -> Summary:
    summary, position = Summary(), 0
    read, chunks, records = struct.Struct("<BQ").unpack_from, [], []
    while position + 9 <= len(text):
        opcode, length = read(text, position)
        body, position = position + 9, position + 9 + length
        if position > len(text):
            raise ValueError("a record goes beyond the summary")
        if opcode == _CHUNK_INDEX:
            chunks.append(_chunk(text, body, position, start))
        elif opcode in (_SCHEMA, _CHANNEL, _METADATA_INDEX):
            records.append((opcode, ReadDataStream(io.BytesIO(text[body:position]))))
    for opcode, stream in records:
        if opcode == _SCHEMA:
            schema = Schema.read(stream)
            summary.schemas[schema.id] = schema
        elif opcode == _CHANNEL:
            channel = Channel.read(stream)
            summary.channels[channel.id] = channel
        else:
            summary.metadata.append(_metadata(source, MetadataIndex.read(stream)))
    # By offset: the summary may list them in any order.
    chunks.sort(key=lambda it: it[2])
    summary.chunks = [ChunkInfo(number, *fields) for number, fields in enumerate(chunks)]
    return summary


def _chunk(text: bytes, body: int, end: int, start: int) -> tuple[int, int, int, int, int, int, Numbers, int]:
    """Return the fields of a ChunkInfo but its number."""
    first, last, offset, length, size = _CHUNK_HEAD.unpack_from(text, body)
    places = body + _CHUNK_HEAD.size
    if size % _PLACE.itemsize or places + size + 8 > end:
        raise ValueError("the places of a chunk's messages go beyond its record")
    channels = np.frombuffer(text, _PLACE, size // _PLACE.itemsize, places)["channel"].copy()
    (index_length,) = struct.unpack_from("<Q", text, places + size)
    return first, last, offset, length, offset + length, index_length, channels, start + places


def _metadata(source: Source, it: MetadataIndex) -> Metadata:
    if it.offset + it.length > source.size or it.length < 9:
        raise ValueError("a metadata record goes beyond the file")
    record: Metadata = Metadata.read(ReadDataStream(io.BytesIO(source.read(it.offset + 9, it.length - 9))))
    return record


def index_places(source: Source, info: ChunkInfo) -> Numbers:
    """Return where the records of a chunk's index begin, from its start, as the summary says."""
    text = source.read(info.map, len(info.channels) * _PLACE.itemsize)
    return np.sort(np.frombuffer(text, _PLACE)["offset"].astype(np.int64)) - info.index
