"""Going through an MCAP file that has no summary to trust, since its recorder was killed or it was damaged.

What can be read is found again: chunks by their records or, behind damage, by the names of their compressions.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Metadata, Schema

from .index import MESSAGE_INDEX, parse_index
from .records import LARGEST_CHUNK, checked, span, take_records, unpacked
from .sink import CHANNELS
from .source import Source
from .summary import MAGIC, ChunkInfo, Summary

__all__ = ["Scan", "Told"]

_CHUNK, _METADATA, _DATA_END = 6, 12, 15
# A chunk's compression as it stands in its record, length first: rare enough to search a damaged file for.
_MAGICAL_NAMES = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
_BEFORE_NAME = 1 + 8 + 8 + 8 + 8 + 4
"""Bytes of a chunk record before the name of its compression."""

Told = Callable[[int, int], None]
"""Is told how much of something is done, and how much there is."""


class Scan:
    """One way through a file, from its beginning to its end.

    Attributes:
        found: The chunks and metadata in the order of the file, channels and schemas by number.
        damaged: How many records were found to be damaged, or cut off.
    """

    def __init__(self, source: Source) -> None:
        self.found = Summary()
        self.damaged = 0
        self._source = source
        self._size = source.size
        # Of each compression: from where it was searched for, and where it was found next.
        self._names: dict[bytes, tuple[int, int]] = {}

    def run(self, progress: Told | None) -> Summary:
        """Return what is found."""
        position, source, chunks = len(MAGIC), self._source, self.found.chunks
        while position + 9 <= self._size:
            opcode, length = struct.unpack("<BQ", source.peek(position, 9))
            end = position + 9 + length
            # What follows is the summary, which was not to be trusted.
            if opcode == _DATA_END and length == 4:
                break
            # Not a record, or one that the file does not hold whole: go on at the next place where a chunk may begin.
            if end > self._size or not 0 < opcode < 0x80 or (opcode == _CHUNK and not self._begins(position)):
                self.damaged += 1
                position = self._next_chunk(position + 1)
                continue
            if opcode == _CHUNK and (info := self._chunk_at(len(chunks), position, end)) is not None:
                chunks.append(info)
                end = info.index + info.index_length
            elif opcode == _METADATA:
                self._take_metadata(position + 9, end)
            position = end
            if progress is not None:
                progress(position, self._size)
        else:
            self.damaged += position < self._size  # a few bytes of a record
        return self.found

    def _begins(self, position: int) -> bool:
        """Return whether a chunk record may begin here."""
        if position + _BEFORE_NAME + 7 > self._size:
            return False
        # The first fields of a chunk: what could not be of any chunk rules a place out before anything is unpacked.
        length, start, end, size, _, name = struct.unpack("<QQQQII", self._source.peek(position + 1, 40))
        return length < LARGEST_CHUNK and start <= end and size < LARGEST_CHUNK and name in (0, 3, 4)

    def _next_chunk(self, position: int) -> int:
        """Return where the next chunk may begin, the end of the file if nowhere."""
        while True:
            position = min(self._next_name(name, position + _BEFORE_NAME) for name in _MAGICAL_NAMES) - _BEFORE_NAME
            if position + _BEFORE_NAME >= self._size:
                return self._size
            if self._source.peek(position, 1)[0] == _CHUNK and self._begins(position):
                return position
            position += 1

    def _next_name(self, name: bytes, position: int) -> int:
        """Return where a name is from `position` on, the end of the file if nowhere; what was found is kept."""
        # Searching again for each place would read a large file once for each damaged record.
        since, place = self._names.get(name, (0, -1))
        if not since <= position <= place:
            found = self._source.find(name, position)
            place = self._size if found < 0 else found
            self._names[name] = position, place
        return place

    def _chunk_at(self, number: int, position: int, end: int) -> ChunkInfo | None:
        """Return the chunk between two places, with the index behind it; None if it is damaged."""
        start, last = struct.unpack("<QQ", self._source.peek(position + 9, 16))
        index, starts = end, []
        # The indexes of a chunk's channels stand right behind it, a record for each.
        while index + 11 <= self._size:
            opcode, length = struct.unpack("<BQ", self._source.peek(index, 9))
            if opcode != MESSAGE_INDEX:
                break
            if length < 6 or index + 9 + length > self._size:
                index = self._size
                break
            starts.append(index - end)
            index += 9 + length
        text = self._source.read(end, index - end)
        known = parse_index(text, np.array(starts, np.int64), start, last)
        place = number, start, last, position, end - position, end
        # Where the file ends there, a part of the index may be missing.
        is_whole = index < self._size and self._source.peek(index, 1)[0] != MESSAGE_INDEX
        trusted = known if is_whole and known is not None and span(known) == (start, last) else None
        if trusted is not None and self.found.channels.keys() >= set(trusted.channels.tolist()):
            return ChunkInfo(*place, index - end, trusted.channels)
        # It brings new channels, or has no index: only the chunk itself can tell.
        info = ChunkInfo(*place, 0, np.empty(0, np.uint16))
        content = unpacked(self._source, info)
        found = None if content is None else take_records(content, self.found.schemas, self.found.channels)
        if found is None or (len(found.times) and span(found) != (start, last)):
            self.damaged += 1
            return None
        # An index that says something else than the chunk is as good as none: it is made from the chunk whenever
        # needed.
        is_indexed = known is not None and known.same(found)
        return replace(info, channels=found.channels, index_length=index - end if is_indexed else 0)

    def _take_metadata(self, start: int, end: int) -> None:
        try:
            record = Metadata.read(ReadDataStream(io.BytesIO(self._source.read(start, end - start))))
            if record.name == CHANNELS:
                self._take_channels(record.metadata)
            self.found.metadata.append(record)
        except (McapError, ValueError, KeyError, TypeError, struct.error, EOFError):
            self.damaged += 1

    def _take_channels(self, said: dict[str, str]) -> None:
        """Take channels from a list of them: the chunk that has them may be damaged."""
        for number, topic, encoding, name, metadata in checked(said):
            if number not in self.found.channels:
                schema = -number  # the real one is lost, but for its name
                self.found.schemas[schema] = Schema(id=schema, name=name, encoding="", data=b"")
                self.found.channels[number] = Channel(number, topic, encoding, metadata, schema)
