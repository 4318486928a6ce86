"""Several files read as one: the parts of a recording that was split, or recordings of several programs.

Channels are given new numbers, since each file has its own. Equal channels of two files get one number, so a path has
as many channels as in one file.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from mcap.records import Channel, Metadata, Schema

from ...errors import BadType, BadValue
from ...plan.paths import shorten
from .container import Container, Message, Progress, Ref
from .mcap_reader import ChunkInfo, Index, Numbers
from .sink import CONTINUED, SPLIT

_LEFT_OUT = (1 << 16) - 1
"""The number of all channels that are not read."""
_IN_USE = 3
"""Files of which chunks are kept in memory."""


class Joined:
    """Several files, with the methods of one `Container`. Any thread may use it."""

    def __init__(self, files: Sequence[Container]) -> None:
        self.files = sorted(files, key=lambda file: min((info.start for info in file.chunks), default=0))
        self.path = self.files[0].path
        self.indexed = all(file.indexed for file in files)
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.metadata: list[Metadata] = [record for file in self.files for record in file.metadata]
        self._numbers = [np.full(1 << 16, _LEFT_OUT, np.uint16) for _ in self.files]  # new ones by those of the file
        self._own = [np.zeros(1 << 16, np.uint16) for _ in self.files]  # the other way round
        self._give_numbers()
        chunks = [(info, place) for place, file in enumerate(self.files) for info in file.every_chunk]
        chunks.sort(key=lambda it: (it[0].start, it[1], it[0].offset))
        self._origins = [(place, info) for info, place in chunks]
        self.every_chunk = [
            replace(info, number=number, channels=self._numbers[place][info.channels])
            for number, (place, info) in enumerate(self._origins)
        ]
        self._in_use: list[Container] = []

    def _give_numbers(self) -> None:
        known: dict[Any, int] = {}
        schemas: dict[Any, int] = {}
        parts = {_part(file) for file in self.files}
        for place, file in enumerate(self.files):
            series, part = _part(file) or ("", 0)
            is_continued, seen = (series, part - 1) in parts, Counter[Any]()
            for number, channel in file.channels.items():
                # What a part begins with is what the part before it has ended with.
                if is_continued and CONTINUED in channel.metadata:
                    continue
                schema = file.schemas.get(channel.schema_id)
                form = None if schema is None else (schema.name, schema.encoding, schema.data)
                same = channel.topic, channel.message_encoding, tuple(sorted(channel.metadata.items())), form
                seen[same] += 1
                new = known.setdefault((same, seen[same]), len(known) + 1)
                if new == _LEFT_OUT:
                    raise BadValue(f"{len(self.files)} files have over {new} channels together; open fewer of them")
                about = 0 if form is None else schemas.setdefault(form, len(schemas) + 1)
                if schema is not None:
                    self.schemas[about] = replace(schema, id=about)
                self.channels[new] = replace(channel, id=new, schema_id=about)
                self._numbers[place][number], self._own[place][new] = new, number

    def parts(self) -> list[tuple[Container, dict[int, Channel]]]:
        """Return the files, and the channels of each by their new numbers."""
        found = []
        for file, numbers in zip(self.files, self._numbers, strict=True):
            new = [int(numbers[own]) for own in file.channels]
            found.append((file, {number: self.channels[number] for number in new if number != _LEFT_OUT}))
        return found

    @property
    def damaged(self) -> int:
        return sum(file.damaged for file in self.files)

    @property
    def lost(self) -> set[int]:
        if not any(file.lost for file in self.files):
            return set()
        origins = enumerate(self._origins)
        return {number for number, (place, info) in origins if info.number in self.files[place].lost}

    @property
    def chunks(self) -> list[ChunkInfo]:
        lost = self.lost
        return [info for info in self.every_chunk if info.number not in lost] if lost else self.every_chunk

    def _origin(self, info: ChunkInfo) -> tuple[int, Container, ChunkInfo]:
        place, own = self._origins[info.number]
        file = self.files[place]
        if file not in self._in_use[:1]:
            self._in_use = [file, *[each for each in self._in_use if each is not file]]
            for other in self._in_use[_IN_USE:]:
                other.forget()
            self._in_use = self._in_use[:_IN_USE]
        return place, file, own

    def content(self, info: ChunkInfo) -> bytes | None:
        _, file, own = self._origin(info)
        return file.content(own)

    def index(self, info: ChunkInfo) -> Index:
        place, file, own = self._origin(info)
        index = file.index(own)
        return index._replace(channels=self._numbers[place][index.channels])

    def part_of_index(self, info: ChunkInfo, channel: int) -> tuple[Numbers, Numbers] | None:
        place, file, own = self._origin(info)
        return file.part_of_index(own, int(self._own[place][channel]))

    def message(self, ref: Ref) -> Message | None:
        place, file, own = self._origin(ref.chunk)
        return file.message(Ref(ref.time, own, ref.offset, int(self._own[place][ref.channel])))

    def numbers_in(self, info: ChunkInfo, channels: Numbers) -> Numbers:
        return self._own[self._origins[info.number][0]][channels]

    def unpacked_size(self, info: ChunkInfo) -> int:
        _, file, own = self._origin(info)
        return file.unpacked_size(own)

    def header(self) -> dict[str, str]:
        others = [file for file in self.files if not any(record.name == "reem" for record in file.metadata)]
        return others[0].header() if others else {}

    def verify(self, progress: Progress | None = None) -> int:
        done, total = 0, len(self.every_chunk)
        for file in self.files:
            before = done
            file.verify(None if progress is None else lambda chunks, _: progress(before + chunks, total))  # noqa: B023
            file.forget()
            done += len(file.every_chunk)
        return self.damaged

    def close(self) -> None:
        for file in self.files:
            file.close()


Files = Container | Joined
"""What a recording is read from."""


def open_files(paths: Any, progress: Callable[[int, int], None] | None = None) -> Files:
    """Open one file, or several; raises DamagedRecording, OSError, and BadType or BadValue for other arguments."""
    if isinstance(paths, str | FilePath):
        return Container(FilePath(paths), progress)
    if not isinstance(paths, Sequence) or isinstance(paths, bytes) or not paths:
        raise BadType(f"{shorten(paths)} is neither the name of a file nor a list of some")
    files: list[Container] = []
    try:
        for path in map(FilePath, paths):
            files.append(Container(path, progress))
            twice = [file.path for file in files[:-1] if os.path.samefile(file.path, path)]
            if twice:
                raise BadValue(f"{path} and {twice[0]} are one file: its updates would be there twice; give it once")
        return files[0] if len(files) == 1 else Joined(files)
    except BaseException:
        for file in files:
            file.close()
        raise


def _part(file: Container) -> tuple[str, int] | None:
    """Return the series of files and the place in it that the recorder has noted; None if there is no series."""
    for record in file.metadata:
        series, found, part = record.metadata.get(SPLIT, "").rpartition(" ")
        if record.name == "reem" and found and part.isdecimal():
            return series, int(part[:9])
    return None
