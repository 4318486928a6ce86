"""Reading an MCAP file by its index, and without one: any file that was cut short or damaged opens too.

The library reads the summary and the records; what is done here is to find single messages without taking
whole chunks apart, to make the index of a file that has none, and to leave out what is damaged.
"""

from __future__ import annotations

import io
import mmap
import os
import struct
import threading
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import orjson
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from .errors import DamagedRecording
from .sink import CHANNELS

__all__ = ["ChunkInfo", "Container", "Index", "Message"]

_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _METADATA = 3, 4, 5, 6, 7, 12
_DATA_END = 15
_FOOTER = 9 + 20
_FOOTER_HEAD = b"\x02" + (20).to_bytes(8, "little")
_MAGICAL_NAMES = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
_BEFORE_NAME = 1 + 8 + 8 + 8 + 8 + 4
"""Bytes of a chunk record before the name of its compression."""
_LARGEST_CHUNK = 1 << 31
_CACHED_BYTES = 96 << 20
_CACHED_INDEXES = 4096

Index = dict[int, tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]]
"""Of a chunk: for each channel the log times of its messages, and where they are in it."""


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
        channels: The channels that have messages in it; None if only the chunk can tell.
    """

    number: int
    start: int
    end: int
    offset: int
    length: int
    index: int
    index_length: int
    channels: frozenset[int] | None


@dataclass(frozen=True, slots=True)
class Message:
    """One message: its channel, when it was received and published (ns), its number, its bytes."""

    channel: int
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


class Container:
    """An MCAP file.

    Any thread may use it.

    Args:
        path: The file.

    Attributes:
        chunks: All chunks, in the order of the file; those found to be damaged are taken out.
        channels: By number.
        schemas: By number.
        metadata: The metadata records, in the order of the file.
        indexed: The file has a summary: it was closed properly.
        damaged: How many records were found to be damaged, or cut off.

    Raises:
        DamagedRecording: Not an MCAP file.
        OSError: It cannot be read.
    """

    def __init__(self, path: FilePath) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.metadata: list[Metadata] = []
        self.damaged = 0
        self._lock = threading.RLock()
        self._cache: OrderedDict[int, bytes] = OrderedDict()
        self._cached = 0
        self._indexes: OrderedDict[int, Index] = OrderedDict()
        self._remade: set[int] = set()
        self._file = path.open("rb")
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            if self._file.read(len(_MAGIC)) != _MAGIC:
                raise DamagedRecording(f"{path} is not an MCAP file; give one that `reem record` wrote")
            self._data = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
            chunks = self._summarized()
            self.indexed = chunks is not None
            self.chunks = self._scanned() if chunks is None else chunks
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file. Idempotent."""
        with self._lock:
            self._cache.clear()
            self._data.close()
            self._file.close()

    @property
    def left_out(self) -> int:
        """How many of the damaged records had to be left out; indexes are made anew."""
        return self.damaged - len(self._remade)

    # Opening.

    def _summarized(self) -> list[ChunkInfo] | None:
        """Return the chunks by the summary at the end of the file, None if there is none to trust."""
        if not self._has_sound_summary():
            return None
        try:
            self._file.seek(0)
            reader = make_reader(self._file)
            summary = reader.get_summary()
            if summary is None or (not summary.chunk_indexes and self.size > 4096):
                return None
            self.metadata = list(reader.iter_metadata())
        except (
            McapError,
            ValueError,
            struct.error,
            EOFError,
            OverflowError,
            AssertionError,
            MemoryError,
            StopIteration,
        ):
            return None
        self.channels, self.schemas = dict(summary.channels), dict(summary.schemas)
        chunks = []
        for number, each in enumerate(sorted(summary.chunk_indexes, key=lambda it: it.chunk_start_offset)):
            end = each.chunk_start_offset + each.chunk_length
            if end + each.message_index_length > self.size:
                return None
            known = frozenset(each.message_index_offsets)
            start, last = each.message_start_time, each.message_end_time
            place = each.chunk_start_offset, each.chunk_length, end, each.message_index_length
            chunks.append(ChunkInfo(number, start, last, *place, known))
        return chunks

    def _has_sound_summary(self) -> bool:
        """Return whether the file ends as it should and what is said there is undamaged."""
        end = self.size - len(_MAGIC)
        start = end - _FOOTER
        if start < 0 or self._data[end:] != _MAGIC or self._data[start : start + 9] != _FOOTER_HEAD:
            return False
        summary, _, crc = struct.unpack_from("<QQI", self._data, start + 9)
        return bool(0 < summary <= start) and zlib.crc32(memoryview(self._data)[summary : end - 4].tobytes()) == crc

    def _scanned(self) -> list[ChunkInfo]:
        """Return the chunks that are found by going through the file."""
        chunks: list[ChunkInfo] = []
        self.metadata, position = [], len(_MAGIC)
        while position + 9 <= self.size:
            opcode, length = self._data[position], int.from_bytes(self._data[position + 1 : position + 9], "little")
            end = position + 9 + length
            if opcode == _DATA_END and length == 4:
                break
            if end > self.size or not 0 < opcode < 0x80 or (opcode == _CHUNK and not self._begins(position)):
                self.damaged += 1
                position = self._next_chunk(position + 1)
                continue
            if opcode == _CHUNK and (info := self._chunk_at(len(chunks), position, end)) is not None:
                chunks.append(info)
                end = info.index + info.index_length
            elif opcode == _METADATA:
                self._take_metadata(position + 9, end)
            position = end
        else:
            self.damaged += position < self.size  # a few bytes of a record
        return chunks

    def _begins(self, position: int) -> bool:
        """Return whether a chunk record may begin here."""
        if position + _BEFORE_NAME + 7 > self.size:
            return False
        length, start, end, size, _, name = struct.unpack_from("<QQQQII", self._data, position + 1)
        return length < _LARGEST_CHUNK and start <= end and size < _LARGEST_CHUNK and name in (0, 3, 4)

    def _next_chunk(self, position: int) -> int:
        """Return where the next chunk may begin, the end of the file if nowhere."""
        found = [self._data.find(name, position + _BEFORE_NAME) for name in _MAGICAL_NAMES]
        places = [place - _BEFORE_NAME for place in found if place >= 0]
        while places:
            place = min(places)
            if self._data[place] == _CHUNK and self._begins(place):
                return place
            found = [self._data.find(name, place + 1 + _BEFORE_NAME) for name in _MAGICAL_NAMES]
            places = [place - _BEFORE_NAME for place in found if place >= 0]
        return self.size

    def _chunk_at(self, number: int, position: int, end: int) -> ChunkInfo | None:
        """Return the chunk between two places, with the index behind it; None if it is damaged."""
        start, last = struct.unpack_from("<QQ", self._data, position + 9)
        index, channels = end, set()
        while index + 11 <= self.size and self._data[index] == _MESSAGE_INDEX:
            length = int.from_bytes(self._data[index + 1 : index + 9], "little")
            if length < 6 or index + 9 + length > self.size:
                index = self.size
                break
            channels.add(int.from_bytes(self._data[index + 9 : index + 11], "little"))
            index += 9 + length
        info = ChunkInfo(number, start, last, position, end - position, end, index - end, frozenset(channels) or None)
        # Where the file ends there, a part of the index may be missing.
        is_whole = index < self.size and self._data[index] != _MESSAGE_INDEX
        if is_whole and channels and channels <= self.channels.keys():
            return info
        # It brings new channels, or has no index: only the chunk itself can tell.
        content = self._unpacked(info)
        if content is None:
            self.damaged += 1
            return None
        found = frozenset(self._take_records(content))
        return replace(info, channels=found, index_length=0) if found != channels else info

    def _take_records(self, content: bytes) -> Index:
        """Take schemas and channels out of a chunk; return the index of its messages."""
        places: dict[int, list[tuple[int, int]]] = {}
        for opcode, start, end in _records(content):
            stream = ReadDataStream(io.BytesIO(content[start:end]))
            if opcode == _SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema
            elif opcode == _CHANNEL:
                channel = Channel.read(stream)
                self.channels[channel.id] = channel
            elif opcode == _MESSAGE:
                channel_id, _, log_time = struct.unpack_from("<HIQ", content, start)
                places.setdefault(channel_id, []).append((log_time, start - 9))
        return {
            channel: (np.array([time for time, _ in pairs], np.uint64), np.array([at for _, at in pairs], np.uint64))
            for channel, pairs in places.items()
        }

    def _take_metadata(self, start: int, end: int) -> None:
        try:
            record = Metadata.read(ReadDataStream(io.BytesIO(self._data[start:end])))
            if record.name == CHANNELS:
                self._take_channels(record.metadata)
            self.metadata.append(record)
        except (McapError, ValueError, KeyError, TypeError, struct.error, EOFError):
            self.damaged += 1

    def _take_channels(self, said: dict[str, str]) -> None:
        """Take channels from a list of them: the chunk that has them may be damaged."""
        text = said["channels"].encode()
        if zlib.crc32(text) != int(said["crc32"]):
            raise ValueError(text)
        for number, topic, encoding, name, metadata in orjson.loads(text):
            if number not in self.channels:
                schema = -number  # the real one is lost, but for its name
                self.schemas[schema] = Schema(id=schema, name=name, encoding="", data=b"")
                self.channels[number] = Channel(number, topic, encoding, metadata, schema)

    # Reading.

    def _unpacked(self, info: ChunkInfo) -> bytes | None:
        """Return the content of a chunk, None if it is damaged."""
        try:
            body = self._data[info.offset + 9 : info.offset + info.length]
            chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
            if chunk.uncompressed_size > _LARGEST_CHUNK or chunk.message_start_time != info.start:
                return None
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
            content = stream.read(length)
        except Exception:  # zstandard and lz4 have errors of their own for what is damaged
            return None
        return content if len(content) == chunk.uncompressed_size else None

    def content(self, info: ChunkInfo) -> bytes | None:
        """Return the content of a chunk; None, and the chunk is taken out and counted, if it is damaged."""
        with self._lock:
            if info.number in self._cache:
                self._cache.move_to_end(info.number)
                return self._cache[info.number]
            content = self._unpacked(info)
            if content is None:
                self.discard(info)
                return None
            self._cache[info.number] = content
            self._cached += len(content)
            while self._cached > _CACHED_BYTES and len(self._cache) > 1:
                self._cached -= len(self._cache.popitem(last=False)[1])
            return content

    def discard(self, info: ChunkInfo) -> None:
        """Take out a chunk that is damaged."""
        if info in self.chunks:
            self.damaged += 1
            self.chunks = [each for each in self.chunks if each is not info]

    def index(self, info: ChunkInfo) -> Index:
        """Return when the messages of a chunk were received and where they are in it, by channel."""
        with self._lock:
            if info.number in self._indexes:
                self._indexes.move_to_end(info.number)
                return self._indexes[info.number]
            index = self._read_index(info)
            if index is None:
                content = self.content(info)
                index = {} if content is None else self._take_records(content)
            self._indexes[info.number] = index
            if len(self._indexes) > _CACHED_INDEXES:
                self._indexes.popitem(last=False)
            return index

    def _read_index(self, info: ChunkInfo) -> Index | None:
        """Return the index as it is in the file, None if there is none or it is damaged."""
        text, position, index = self._data[info.index : info.index + info.index_length], 0, {}
        while position + 15 <= len(text):
            length, channel, size = struct.unpack_from("<QHI", text, position + 1)
            if text[position] != _MESSAGE_INDEX or length != size + 6 or size % 16 or position + 15 + size > len(text):
                return None
            pairs = np.frombuffer(text, "<u8", size // 8, position + 15).reshape(-1, 2)
            if not _is_sound(pairs[:, 0], info):
                return None
            index[channel] = pairs[:, 0], pairs[:, 1]
            position += 9 + length
        return index if info.channels == index.keys() else None

    def message(self, info: ChunkInfo, channel: int, offset: int, log_time: int) -> Message | None:
        """Return a message that the index of a chunk names.

        None if that was wrong: the chunk is damaged, and was taken out, or its index is, and was made anew.
        Look it up again then.
        """
        content = self.content(info)
        if content is None:
            return None
        if offset + 31 <= len(content) and content[offset] == _MESSAGE:
            (length,) = struct.unpack_from("<Q", content, offset + 1)
            found, sequence, time, published = struct.unpack_from("<HIQQ", content, offset + 9)
            if found == channel and time == log_time and offset + 9 + length <= len(content):
                return Message(found, time, published, sequence, content[offset + 31 : offset + 9 + length])
        with self._lock:
            self.damaged += 1
            if info.number in self._remade:
                self.discard(info)
            self._remade.add(info.number)
            self._indexes[info.number] = self._take_records(content)
        return None

    def tail(self, info: ChunkInfo, offset: int) -> int:
        """Return the bytes of the last message of a chunk, whose place is `offset`; 0 if it is damaged."""
        (size,) = struct.unpack_from("<Q", self._data, info.offset + 9 + 16)
        return max(int(size) - offset, 0)

    def verify(self) -> int:
        """Read every chunk; return how many records of the file are damaged."""
        for info in self.chunks:
            content = self.content(info)
            made = None if content is None or not info.index_length else self._take_records(content)
            with self._lock:
                if made is not None and not _same(self._read_index(info), made):
                    self.damaged += info.number not in self._remade
                    self._remade.add(info.number)
                    self._indexes[info.number] = made
        return self.damaged


def _same(one: Index | None, other: Index) -> bool:
    return one is not None and one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)


def _is_sound(times: np.ndarray[Any, Any], info: ChunkInfo) -> bool:
    """Return whether these can be the times of a channel's messages in a chunk."""
    within = len(times) == 0 or (info.start <= int(times[0]) and int(times[-1]) <= info.end)
    return within and bool((times[1:] >= times[:-1]).all())


def _records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the opcode of each record in a chunk, and where its body begins and ends."""
    read, position = partial(struct.unpack_from, "<BQ", content), 0
    while position + 9 <= len(content):
        opcode, length = read(position)
        if position + 9 + length > len(content):
            return
        yield opcode, position + 9, position + 9 + length
        position += 9 + length
