"""The messages of an MCAP file, whichever of the format's optional parts its writer has left out.

With a complete summary only the end of the file is read. Otherwise the file is read from record to record once: its
recorder was killed, or another tool has written it without chunks, without indexes, or without a summary. What is
damaged is left out and counted: a whole chunk, or all that follows a damaged record outside of chunks.
"""

from __future__ import annotations

import io
import struct
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as FilePath
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

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
    read_part,
    read_summary,
    record_starts,
)  # fmt: skip

# Unpacked chunks that are kept: neighbours in time are asked for together.
_CACHED_BYTES = 96 << 20
_CACHED_ENTRIES = 4 << 20
"""Messages of which the places are kept, 16 bytes for each."""
_SMALLEST_CHUNK, _LARGEST_CHUNK = 40, 1 << 30
"""Bytes. REEM closes a chunk with the message that takes it over a megabyte. A message has up to 512 MB."""
_LFS = b"version https://git-lfs"
_BARE_BYTES = 1 << 20
"""Bytes of messages outside of chunks that are read as one chunk."""
_CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last log time, size and CRC-32 of the content, length of the name of the compression."""


class _Own(threading.local):
    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_OWN = _Own()  # a decompressor is for one thread at a time


def _unpack_zstd(data: memoryview, size: int) -> bytes:
    # A frame that names its size is unpacked to that size, whatever `max_output_size` is; -1: it names none.
    if zstandard.frame_content_size(data) not in (-1, size):
        return b""
    return _OWN.zstd.decompress(data, max_output_size=size)


# By the names that files have for them; with the size that the chunk names, so that a small one takes little memory.
_UNPACK: dict[bytes, Callable[[memoryview, int], bytes]] = {
    b"": lambda data, _: bytes(data),
    b"lz4": lambda data, size: bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)),
    b"zstd": _unpack_zstd,
}
# What other records of these kinds would hide: all that follows.
_END_LENGTHS = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}

Progress = Callable[[int, int], None]
"""Called with how much of something is done, and how much there is."""


class Message(NamedTuple):
    """One message: when it was published (ns), its number, its bytes."""

    publish_time: int
    sequence: int
    data: bytes


class Ref(NamedTuple):
    """Where a message is, and its log time in ns.

    The channel is last: of one instant, messages come in the order of the file, whatever numbers another tool has
    given to the channels.
    """

    time: int
    chunk: ChunkInfo
    offset: int
    channel: int


def _unpacked(source: Source, info: ChunkInfo) -> bytes | None:
    if info.bare:
        return source.read(info.offset, info.length)
    body = source.read(info.offset + HEAD.size, info.length - HEAD.size)
    try:
        start, _, size, checksum, length = _CHUNK_HEAD.unpack_from(body)
        data = _CHUNK_HEAD.size + length + 8
        (packed,) = struct.unpack_from("<Q", body, data - 8)
        if size > _LARGEST_CHUNK or start != info.start or data + packed > len(body):
            return None
        content = _UNPACK[body[_CHUNK_HEAD.size : data - 8]](memoryview(body)[data : data + packed], size)
    except Exception:  # zstandard and lz4 have errors of their own for what is damaged
        return None
    # The checksum is of the unpacked bytes, so damage in what unpacks well is found too; 0 if there is none.
    return content if len(content) == size and checksum in (0, zlib.crc32(content)) else None


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
            if end > len(content) or opcode == 0:
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
        start, last, _, _, name = _CHUNK_HEAD.unpack(self._source.peek(position + HEAD.size, _CHUNK_HEAD.size))
        data = position + HEAD.size + _CHUNK_HEAD.size + name + 8
        packed = int.from_bytes(self._source.peek(data - 8, 8), "little") if data <= end else 0
        self.damaged += data + packed != end  # one that is longer than its content may hide what follows
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
            stream = ReadDataStream(io.BytesIO(self._source.read(start, end - start)))
            self.contents.metadata[start] = Metadata.read(stream)
            self.damaged += stream.count != end - start
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
                is_pointer = self._source.peek(0, len(_LFS)) == _LFS
                what = "fetch it: it is a pointer of Git LFS" if is_pointer else "give one that a recorder has written"
                raise DamagedRecording(f"{path} is not an MCAP file; {what}")
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

    def parts(self) -> list[tuple[Container, dict[int, Channel]]]:
        """Return the files and the channels of each: this one."""
        return [(self, self.channels)]

    def numbers_in(self, info: ChunkInfo, channels: Numbers) -> Numbers:
        """Return the numbers that channels have in the content of a chunk."""
        return channels

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

    def forget(self) -> None:
        """Let go of the chunks and indexes in memory."""
        with self._lock:
            self._cache.clear()
            self._indexes.clear()
            self._cached = self._entries = 0

    def close(self) -> None:
        with self._lock:
            self.forget()
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

    def part_of_index(self, info: ChunkInfo, channel: int) -> tuple[Numbers, Numbers] | None:
        """Return the log times and places of a channel's messages in a chunk that has some; None if it is damaged.

        Only what is about the channel is read where the file allows it: there may be hundreds of others.
        """
        with self._lock:
            if info.map and info.number not in self._indexes:
                return read_part(self._source, info, channel)
            return self.index(info).of(channel)

    def _read_index(self, info: ChunkInfo) -> Index | None:
        """Return the index of a chunk, made of its content if the file has none; None if it is damaged."""
        if not info.index_length:
            content = self.content(info)
            index = None if content is None else _take_records(content, self._contents)
        else:
            text = self._source.read(info.index, info.index_length)
            starts = index_places(self._source, info) if info.map else record_starts(text)
            index = parse_index(text, starts, info.start, info.end)
        return index if index is not None and set(index.channels.tolist()) <= set(info.channels.tolist()) else None

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
        return int(min(size, _LARGEST_CHUNK))

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
