"""Reading an MCAP file by its index, and without one: any file that was cut short or damaged opens too.

The library reads the summary and the records; what is done here is to find single messages without taking
whole chunks apart, to make the index of a file that has none, and to leave out what is damaged.
"""

from __future__ import annotations

import struct
import threading
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from .errors import DamagedRecording
from .index import Index, index_of, parse_index, record_starts
from .records import MESSAGE, checked, take_records, unpacked
from .scan import Scan, Told
from .sink import TOTALS
from .source import Source
from .summary import MAGIC, ChunkInfo, index_places, read_summary

__all__ = ["ChunkInfo", "Container", "Message", "Told"]

# Unpacked chunks that are kept: neighbours in time are asked for together.
_CACHED_BYTES = 96 << 20
_CACHED_ENTRIES = 4 << 20
"""Messages of which the places are kept, 16 bytes for each."""


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
        progress: Is told the bytes gone through and all of them, if there is no summary.

    Attributes:
        every_chunk: All chunks, in the order of the file, by number.
        lost: The numbers of those found to be damaged.
        channels: By number.
        schemas: By number.
        metadata: The metadata records, in the order of the file.
        indexed: The file has a summary: it was closed properly.
        damaged: How many records were found to be damaged, or cut off.

    Raises:
        DamagedRecording: Not an MCAP file.
        OSError: It cannot be read.
    """

    def __init__(self, path: FilePath, progress: Told | None = None) -> None:
        self.path = path
        self.damaged = 0
        self.lost: set[int] = set()
        self._lock = threading.RLock()
        self._cache: OrderedDict[int, bytes] = OrderedDict()
        self._cached = 0
        self._indexes: OrderedDict[int, Index] = OrderedDict()
        self._entries = 0
        self._remade: dict[int, Index] = {}
        self._source = Source(path)
        try:
            if self._source.peek(0, len(MAGIC)) != MAGIC:
                raise DamagedRecording(f"{path} is not an MCAP file; give one that `reem record` wrote")
            self.size = self._source.size
            # With a summary only the end of the file is read. Without one (the recorder was killed) the whole file is
            # gone through, which finds all but what was not yet written.
            summary = read_summary(self._source)
            self.indexed = summary is not None
            if summary is None:
                scan = Scan(self._source)
                summary = scan.run(progress)
                self.damaged = scan.damaged
            self.channels, self.schemas = summary.channels, summary.schemas
            self.every_chunk, self.metadata = summary.chunks, summary.metadata
        except BaseException:
            self._source.close()
            raise

    def close(self) -> None:
        """Close the file. Idempotent."""
        with self._lock:
            self._cache.clear()
            self._indexes.clear()
            self._source.close()

    @property
    def chunks(self) -> list[ChunkInfo]:
        """All chunks but those found to be damaged, in the order of the file."""
        return [info for info in self.every_chunk if info.number not in self.lost] if self.lost else self.every_chunk

    @property
    def left_out(self) -> int:
        """How many of the damaged records had to be left out; indexes are made anew."""
        return self.damaged - len(self._remade)

    def content(self, info: ChunkInfo) -> bytes | None:
        """Return the content of a chunk; None, and the chunk is taken out and counted, if it is damaged."""
        with self._lock:
            if info.number in self._cache:
                self._cache.move_to_end(info.number)
                return self._cache[info.number]
            content = unpacked(self._source, info)
            if content is None:
                self.discard(info)
                return None
            self._cache[info.number] = content
            self._cached += len(content)
            # At least one stays, however large: its caller is about to use it.
            while self._cached > _CACHED_BYTES and len(self._cache) > 1:
                self._cached -= len(self._cache.popitem(last=False)[1])
            return content

    def discard(self, info: ChunkInfo) -> None:
        """Take out a chunk that is damaged."""
        with self._lock:
            self.damaged += info.number not in self.lost
            self.lost.add(info.number)

    def index(self, info: ChunkInfo) -> Index:
        """Return when the messages of a chunk were received and where they are in it, by channel."""
        with self._lock:
            if info.number in self._remade:
                return self._remade[info.number]
            if info.number in self._indexes:
                self._indexes.move_to_end(info.number)
                return self._indexes[info.number]
            index = self._read_index(info)
            if index is None:
                content = self.content(info)
                index = index_of({}) if content is None else take_records(content, self.schemas, self.channels)
            self._indexes[info.number] = index
            self._entries += len(index.times)
            while self._entries > _CACHED_ENTRIES and len(self._indexes) > 1:
                self._entries -= len(self._indexes.popitem(last=False)[1].times)
            return index

    def _read_index(self, info: ChunkInfo) -> Index | None:
        """Return the index as it is in the file, None if there is none or it is damaged."""
        text = self._source.read(info.index, info.index_length)
        starts = index_places(self._source, info) if info.map else np.array(record_starts(text), np.int64)
        index = parse_index(text, starts, info.start, info.end)
        if index is None or np.array_equal(index.channels, info.channels):
            return index
        return index if np.array_equal(np.sort(index.channels), np.sort(info.channels)) else None

    def message(self, info: ChunkInfo, channel: int, offset: int, log_time: int) -> Message | None:
        """Return a message that the index of a chunk names.

        None if that was wrong: the chunk is damaged, and was taken out, or its index is, and was made anew.
        Look it up again then.
        """
        content = self.content(info)
        if content is None:
            return None
        # 31: head of the record (9), then channel, sequence, log time and publish time (2 + 4 + 8 + 8).
        if offset + 31 <= len(content) and content[offset] == MESSAGE:
            (length,) = struct.unpack_from("<Q", content, offset + 1)
            found, sequence, time, published = struct.unpack_from("<HIQQ", content, offset + 9)
            if found == channel and time == log_time and offset + 9 + length <= len(content):
                return Message(found, time, published, sequence, content[offset + 31 : offset + 9 + length])
        with self._lock:
            self.damaged += 1
            # An index that was made from the chunk itself cannot be wrong: the chunk must be.
            if info.number in self._remade:
                self.discard(info)
            self._remade[info.number] = take_records(content, self.schemas, self.channels)
        return None

    def unpacked_size(self, info: ChunkInfo) -> int:
        """Return the bytes of a chunk before compression; a wrong number if it is damaged."""
        # Behind the head and two times: the size of the content.
        (size,) = struct.unpack("<Q", self._source.read(info.offset + 9 + 16, 8))
        return int(size)

    def totals(self) -> dict[int, list[int]] | None:
        """Return how many messages each channel has, their bytes, and the first and last log time.

        That is what the recorder has written at the end; None if it has not, or if something is damaged.
        """
        said = [record.metadata for record in self.metadata if record.name == TOTALS]
        # With damage the recorder's own counts are more than can be read.
        if self.damaged or len(said) != 1:
            return None
        try:
            rows = checked(said[0])
            known = all(len(row) == 5 and all(type(each) is int and each >= 0 for each in row) for row in rows)
            return {row[0]: row[1:] for row in rows} if known else None
        except (ValueError, KeyError, TypeError):
            return None

    def verify(self, progress: Told | None = None) -> int:
        """Read every chunk; return how many records of the file are damaged."""
        for info in self.chunks:
            content = self.content(info)
            if content is not None and info.index_length:
                made = take_records(content, self.schemas, self.channels)
                with self._lock:
                    known = self._read_index(info)
                    if known is None or not known.same(made):
                        self.damaged += info.number not in self._remade
                        self._remade[info.number] = made
            if progress is not None:
                progress(info.number + 1, len(self.every_chunk))
        return self.damaged
