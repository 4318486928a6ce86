"""The records of an MCAP file, taken apart: what is in a chunk, and what metadata records say of channels."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from functools import partial
from typing import Any

import orjson
from mcap.data_stream import ReadDataStream
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream

from .index import Index, index_of
from .source import Source
from .summary import ChunkInfo

__all__ = ["LARGEST_CHUNK", "MESSAGE", "checked", "records", "span", "take_records", "unpacked"]

# Opcodes of MCAP records. Each record is: opcode (1 byte), length of what follows (8 bytes, little-endian), content.
_SCHEMA, _CHANNEL, MESSAGE = 3, 4, 5
# Bytes. REEM closes a chunk with the message that takes it over a megabyte.
LARGEST_CHUNK = 1 << 31


def unpacked(source: Source, info: ChunkInfo) -> bytes | None:
    """Return the content of a chunk, None if it is damaged."""
    body = source.read(info.offset + 9, info.length - 9)
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
        if chunk.uncompressed_size > LARGEST_CHUNK or chunk.message_start_time != info.start:
            return None
        # The checksum is of the unpacked bytes, so damage in what unpacks well is found too.
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        content = stream.read(length)
    except Exception:  # zstandard and lz4 have errors of their own for what is damaged
        return None
    return content if len(content) == chunk.uncompressed_size else None


def take_records(content: bytes, schemas: dict[int, Schema], channels: dict[int, Channel]) -> Index:
    """Take the schemas and channels out of a chunk; return the index of its messages."""
    places: dict[int, list[tuple[int, int]]] = {}
    for opcode, start, end in records(content):
        stream = ReadDataStream(io.BytesIO(content[start:end]))
        if opcode == _SCHEMA:
            schema = Schema.read(stream)
            schemas[schema.id] = schema
        elif opcode == _CHANNEL:
            channel = Channel.read(stream)
            channels[channel.id] = channel
        elif opcode == MESSAGE:
            # A message begins with channel (2 bytes), sequence (4), log time (8); 9 bytes before it is its
            # record's head.
            channel_id, _, log_time = struct.unpack_from("<HIQ", content, start)
            places.setdefault(channel_id, []).append((log_time, start - 9))
    return index_of(places)


def span(index: Index) -> tuple[int, int]:
    """Return the first and the last log time of a chunk."""
    return (int(index.times.min()), int(index.times.max())) if len(index.times) else (0, 0)


def checked(said: dict[str, str]) -> list[list[Any]]:
    """Return the list that a metadata record about channels has; ValueError if it is damaged."""
    text = said["channels"].encode()
    if zlib.crc32(text) != int(said["crc32"]):
        raise ValueError(text[:100])
    found: list[list[Any]] = orjson.loads(text)
    return found


def records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the opcode of each record in a chunk, and where its body begins and ends."""
    read, position = partial(struct.unpack_from, "<BQ", content), 0
    while position + 9 <= len(content):
        opcode, length = read(position)
        if position + 9 + length > len(content):
            return
        yield opcode, position + 9, position + 9 + length
        position += 9 + length
