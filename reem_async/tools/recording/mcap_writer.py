"""Writes MCAP: chunks of messages, and at the end an index of all of them.

The records are the library's, and its readers read the file. What its own writer does not offer is done
here: a message is not copied on its way into a chunk, a chunk is compressed at level 1 of zstd (a fifth of
the time, hardly a byte more), and all of it in slices, giving way to the programs that are recorded.

Two chunks are open at a time, for small messages and for large ones, so that numbers are read without the pictures
between them. When small messages are written, the large ones so far are written first: a message refers to earlier
ones only.
"""

from __future__ import annotations

import struct
import tempfile
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from .mcap_reader import HEAD, MAGIC, MESSAGE
from .output import Output, slices

# Bytes after which a chunk is closed: large enough to compress well, small enough to be unpacked for one message.
_CHUNK_BYTES = 1 << 20
LARGE_BYTES = 1 << 13
"""Bytes from which a message goes to the chunks of large ones. A message of numbers has a few hundred."""
_INDEX_BYTES = 1 << 20
"""Bytes of the index of chunks that are kept in memory; the rest of it waits in a file without a name."""
_MESSAGE_FIELDS = MESSAGE.size - HEAD.size
# Opcode, length, first and last log time, size and CRC-32 of the content; compression and content follow.
_CHUNK = struct.Struct("<BQQQQI")
_CHUNK_FIELDS = _CHUNK.size - HEAD.size
_NEVER = 2**64 - 1
_PIECE = 1 << 18
"""Bytes of the index that are read back at once."""


_Stream = tuple[bytes, Callable[[Any], bytes], Callable[[], bytes]]
"""How a compressed stream begins, what compresses a part of it, and what ends it."""


def _zstd(size: int) -> _Stream:
    # The size comes first: readers then know how much memory they need.
    stream = zstandard.ZstdCompressor(level=1).compressobj(size=size)
    return b"", stream.compress, stream.flush


def _lz4(size: int) -> _Stream:
    stream = lz4.frame.LZ4FrameCompressor()
    return stream.begin(size), stream.compress, stream.flush


def _none(size: int) -> _Stream:
    return b"", bytes, bytes


COMPRESSIONS: dict[str, tuple[str, Callable[[int], _Stream]]] = {
    "zstd": ("zstd", _zstd),
    "lz4": ("lz4", _lz4),
    "none": ("", _none),
}
"""What users call a way to compress: its name in the file, and how it is done."""


class _Chunk:
    """The messages since the last chunk of its kind was closed, behind the schemas and channels that are new in those.

    Such records may be repeated, and must come before the first message that needs them. A chunk of the other kind may
    be written later, or be damaged.
    """

    def __init__(self, described: set[tuple[Opcode, int]]) -> None:
        self.described = described  # schemas and channels that are in earlier chunks of this kind, or in this one
        self.pieces: list[Any] = []
        self.size = 0
        self.index: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)  # log time and place of each message
        self.first = self.last = 0

    def put(self, *pieces: Any) -> None:
        for piece in pieces:
            self.pieces.append(piece)
            self.size += len(piece)

    def put_message(self, channel: int, log_time: int, *pieces: Any) -> None:
        # Messages of one channel come in order, those of different channels may overtake each other.
        self.first = min(self.first, log_time) if self.index else log_time
        self.last = max(self.last, log_time)
        self.index[channel].append((log_time, self.size))
        self.put(*pieces)


class McapWriter:
    """Writes one file, which is empty. Belongs to one thread."""

    def __init__(self, output: Output, compression: str, library: str) -> None:
        self._output = output
        self._name, self._compressor = COMPRESSIONS[compression]
        # Schemas and channels are written before their first use, and again in the summary.
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        # It grows with chunks times channels, 40 KB a second for a thousand keys: never in memory as a whole.
        self._index: IO[bytes] = tempfile.SpooledTemporaryFile(_INDEX_BYTES, dir=str(output.directory))  # noqa: SIM115 - closed by close()
        self._chunks = 0
        self._first, self._last = _NEVER, 0
        self._metadata: list[records.MetadataIndex] = []
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._small, self._large = _Chunk(set()), _Chunk(set())
        output.write(MAGIC + _record(records.Header("", library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        schema = records.Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
        self._schemas.append(schema)
        return schema.id

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        channel = records.Channel(
            id=len(self._channels) + 1, topic=topic, message_encoding=encoding, schema_id=schema, metadata=metadata
        )
        self._channels.append(channel)
        return channel.id

    def add_message(self, channel: int, log_time: int, pieces: list[Any], publish_time: int, number: int) -> int:
        """Put a message into a chunk, and write that if it is large enough; returns its bytes. Times are in ns.

        Pieces are bytes, or views of bytes that do not change.
        """
        size = sum(map(len, pieces))
        chunk = self._large if size >= LARGE_BYTES else self._small
        self._describe(channel, chunk)
        head = MESSAGE.pack(
            Opcode.MESSAGE, _MESSAGE_FIELDS + size, channel, number & 0xFFFFFFFF, log_time, publish_time
        )
        chunk.put_message(channel, log_time, head, *pieces)
        self._counts[channel] += 1
        # After the message and not before it: no message is split, however large.
        if chunk.size > _CHUNK_BYTES:
            self._close_chunks(with_small=chunk is self._small)
        return size

    def _describe(self, channel: int, chunk: _Chunk) -> None:
        """Put the records of a channel into a chunk, unless an earlier one of its kind has them."""
        record = self._channels[channel - 1]
        if (Opcode.CHANNEL, channel) in chunk.described:
            return
        if (Opcode.SCHEMA, record.schema_id) not in chunk.described:
            chunk.put(_record(self._schemas[record.schema_id - 1]))
        chunk.put(_record(record))
        chunk.described |= {(Opcode.CHANNEL, channel), (Opcode.SCHEMA, record.schema_id)}

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Write a metadata record, behind the chunks closed so far."""
        record = _record(records.Metadata(name=name, metadata=dict(metadata)))
        self._metadata.append(records.MetadataIndex(offset=self._output.tell(), length=len(record), name=name))
        self._output.write(record)

    def flush(self) -> None:
        """Close the chunks that have messages, and hand everything to the operating system."""
        self._close_chunks()
        self._output.flush()

    def finish(self) -> None:
        self._close_chunks()
        # 0: no checksum of the data section, which would be of hours of data; each chunk has its own.
        self._output.write(_record(records.DataEnd(0)))
        start = self._output.tell()
        offsets: list[records.SummaryOffset] = []
        checked = 0
        for opcode, pieces in self._summary():
            begin = self._output.tell()
            for piece in pieces:
                checked = zlib.crc32(piece, checked)
                self._output.write(piece)
                # A full piece of the index of chunks: of hours of recording it is not kept in memory as a whole.
                if len(piece) == _PIECE:
                    self._output.flush()
            offsets.append(records.SummaryOffset(opcode, begin, self._output.tell() - begin))
        offsets_start = self._output.tell()
        text = b"".join([_record(offset) for offset in offsets])
        self._output.write(text)
        footer = _record(records.Footer(start, offsets_start, 0))
        # The checksum covers the summary, and the footer up to the checksum itself.
        checked = zlib.crc32(footer[:-4], zlib.crc32(text, checked))
        self._output.write(footer[:-4] + struct.pack("<I", checked) + MAGIC)
        self._output.flush()

    def _summary(self) -> Iterator[tuple[Opcode, Iterable[bytes]]]:
        """Yield the groups of records at the end of the file, each in pieces."""
        yield Opcode.SCHEMA, map(_record, self._schemas)
        yield Opcode.CHANNEL, map(_record, self._channels)
        yield Opcode.STATISTICS, [_record(self._statistics())]
        self._index.seek(0)
        yield Opcode.CHUNK_INDEX, iter(partial(self._index.read, _PIECE), b"")
        yield Opcode.METADATA_INDEX, map(_record, self._metadata)

    def close(self) -> None:
        """Let go of the index, written or not. Idempotent."""
        self._index.close()

    def __del__(self) -> None:
        self.close()

    def _statistics(self) -> records.Statistics:
        return records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunks,
            message_count=sum(self._counts.values()),
            message_start_time=self._first if self._chunks else 0,
            message_end_time=self._last,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _close_chunks(self, *, with_small: bool = True) -> None:
        # The large ones first: small messages refer to them.
        self._close_chunk(self._large)
        self._large = _Chunk(self._large.described)
        if with_small:
            self._close_chunk(self._small)
            self._small = _Chunk(self._small.described)

    def _close_chunk(self, chunk: _Chunk) -> None:
        if not chunk.index:
            return
        # All sizes must be known before the head is written, so a chunk is compressed in memory first.
        checked, data = self._compressed(chunk)
        size, start, name = sum(map(len, data)), self._output.tell(), self._name.encode()
        length = _CHUNK_FIELDS + 4 + len(name) + 8 + size
        head = _CHUNK.pack(Opcode.CHUNK, length, chunk.first, chunk.last, chunk.size, checked)
        self._output.write(head + struct.pack("<I", len(name)) + name + struct.pack("<Q", size))
        for piece in data:
            self._output.write(piece)
        index_start, index, places = self._output.tell(), RecordBuilder(), {}
        for channel, entries in chunk.index.items():
            # Where each channel's index is: readers of one channel skip the others.
            places[channel] = index_start + index.count
            records.MessageIndex(channel, entries).write(index)
        text = _ended(index)
        self._output.write(text)
        entry = records.ChunkIndex(
            chunk_length=length + 9,
            chunk_start_offset=start,
            compression=self._name,
            compressed_size=size,
            message_end_time=chunk.last,
            message_index_length=len(text),
            message_index_offsets=places,
            message_start_time=chunk.first,
            uncompressed_size=chunk.size,
        )
        self._index.write(_record(entry))
        self._chunks += 1
        self._first, self._last = min(self._first, chunk.first), max(self._last, chunk.last)
        self._output.flush()

    def _compressed(self, chunk: _Chunk) -> tuple[int, list[bytes]]:
        """Return the checksum of a chunk's bytes, and these compressed, in pieces."""
        head, compress, end = self._compressor(chunk.size)
        checked, data = 0, [head]
        for part in slices(chunk.pieces):
            checked = zlib.crc32(part, checked)
            data.append(compress(part))
        return checked, [*data, end()]


def _record(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return _ended(builder)


def _ended(builder: RecordBuilder) -> bytes:
    text: bytes = builder.end()  # type: ignore[no-untyped-call]
    return text
