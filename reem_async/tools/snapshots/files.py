"""Files of snapshots: their summary, names by time, and writing that is all or nothing."""

from __future__ import annotations

import os
import re
import time
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import orjson

from ...errors import BadData
from ..partfile import PartFile, there_already

SUFFIXES = {"portable": ".zip", "rdb": ".rdb"}
"""The ends of names of both kinds of files. The content tells the kind, not the name."""

FIRST_MEMBER = b"reem-snapshot.json"
"""The name of the first member of a portable snapshot."""

# reem-20260801T120000Z.zip, reem-auto-20260801T120000Z-2.rdb: only "auto" ones, of --keep, are ever deleted.
_NAME = re.compile(r"reem-(?P<auto>auto-)?(?P<time>\d{8}T\d{6}Z)(?:-\d+)?\.(?:zip|rdb)")
_TIME = "%Y%m%dT%H%M%SZ"
# Bytes of the first member that are read; a made-up header may have any size.
_LONGEST_HEADER = 1 << 16


class SavedKey(NamedTuple):
    """One top-level key in a portable snapshot.

    Attributes:
        name: The key, without namespace.
        document: Bytes of the document's JSON.
        values: Of each value that a ship holds: the key's name after the tag, the Redis type, and bytes.
    """

    name: str
    document: int
    values: tuple[tuple[str, str, int], ...] = ()

    @property
    def size(self) -> int:
        return self.document + sum([size for _, _, size in self.values])


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The summary of a file.

    Attributes:
        path: The file.
        kind: "portable" or "rdb".
        time: Seconds since 1970 when it was taken; for an RDB file, when it was written.
        size: Bytes of the file.
        count: Top-level keys in a portable one; None for an RDB file.
        keys: The top-level keys of a portable one, in order of their names.
        server: Where it was taken; empty for an RDB file.
        namespace: The namespace it was taken of.
        unsaved: The top-level keys and arrays that could not be saved, and why.
        doubt: Of one that was just saved, why keys may be missing; empty if as many were found as the server counts.
    """

    path: Path
    kind: str
    time: float
    size: int
    count: int | None
    keys: tuple[SavedKey, ...] = field(default=(), repr=False)
    server: str = ""
    namespace: str = ""
    unsaved: Mapping[str, str] = field(default_factory=dict)
    doubt: str = ""


def sniff(path: Path) -> str:
    """Return "portable" or "rdb", by what the file begins with; raises BadData."""
    with path.open("rb") as file:
        head = file.read(64)
    # A zip file's first member: its name stands 30 bytes after the signature.
    if head.startswith(b"PK\3\4") and head[30:].startswith(FIRST_MEMBER):
        return "portable"
    if re.match(rb"REDIS\d{4}|VALKEY\d{3}", head):
        return "rdb"
    raise BadData(f"{path}: neither a snapshot of REEM nor an RDB file; it begins with {head[:16]!r}")


def new_name(directory: Path, kind: str, moment: float, *, auto: bool) -> Path:
    """Return a name that says when, in UTC, and that no file of the directory has."""
    stem = f"reem-{'auto-' if auto else ''}{time.strftime(_TIME, time.gmtime(moment))}"
    path, number = directory / f"{stem}{SUFFIXES[kind]}", 1
    while os.path.lexists(path):
        number += 1
        path = directory / f"{stem}-{number}{SUFFIXES[kind]}"
    return path


def is_dated(path: Path) -> bool:
    return _NAME.fullmatch(path.name) is not None


class Pruned(NamedTuple):
    deleted: list[Path]
    failed: list[OSError]


def prune(made: Sequence[Path], keep: int) -> Pruned:
    """Delete the oldest snapshots that were saved by period until `keep` (at least 1) are left.

    Deletes only files in the directory of the last one `made` by this run that have such a name and such content, and
    are of its kind, server, namespace and pattern; never that one itself. Those of earlier runs go first, whatever
    their times: a robot without a clock of its own begins each day in 1970.
    """
    done = Pruned([], [])
    try:
        old = _too_old(made, keep)
    except OSError as error:  # of the directory
        return Pruned([], [error])
    for path in old:
        try:
            path.unlink(missing_ok=True)
            done.deleted.append(path)
        except OSError as error:
            done.failed.append(error)
    return done


def _too_old(made: Sequence[Path], keep: int) -> list[Path]:
    # The clock may have been set back: files of this run are in the order in which they were made.
    newest, order = made[-1], {path: number for number, path in enumerate(made)}
    origin = _origin(newest)
    own = [
        path
        for path in newest.parent.iterdir()
        if path.suffix == newest.suffix and path != newest and _is_automatic(path) and _origin(path) == origin
    ]
    # -1 for files of earlier runs: they are older than all of this run.
    own.sort(key=lambda path: (order.get(path, -1), path.name))
    # The newest one, which is not in `own`, counts among those that are kept.
    return own[: max(0, len(own) + 1 - keep)]


def _is_automatic(path: Path) -> bool:
    found = _NAME.fullmatch(path.name)
    return found is not None and found["auto"] is not None and not path.is_symlink() and path.is_file()


def _origin(path: Path) -> tuple[object, ...]:
    """Return what of which server a snapshot holds, as far as it says that; an RDB file does not."""
    try:
        if sniff(path) == "rdb":
            return ("rdb",)
        with zipfile.ZipFile(path) as archive:
            said = orjson.loads(archive.open(FIRST_MEMBER.decode()).read(_LONGEST_HEADER))
        return said["server"], said["namespace"], said["match"]
    except (BadData, OSError, ValueError, LookupError, TypeError, zipfile.BadZipFile, zlib.error, RuntimeError):
        # Not readable: equal to no other file, so it is not deleted.
        return (path,)


def check_target(path: Path, *, overwrite: bool) -> None:
    """Raise errors before the work: FileExistsError, NotADirectoryError, IsADirectoryError."""
    if path.is_dir():
        raise IsADirectoryError(
            f"{path} is a directory; name a file in it, or use --directory, which names one by time"
        )
    if not path.parent.is_dir():
        raise NotADirectoryError(f"{path}: there is no directory {path.parent}; make it first")
    if path.exists() and not overwrite:
        raise there_already(path)


class NewFile:
    """A file that gets the name `path` when all of it is on the disk, or never; until then it is hidden beside it."""

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self._part = PartFile(path, replace=overwrite)
        self.file: BinaryIO = self._part.path.open("r+b")

    def commit(self) -> None:
        """Give the file its name; FileExistsError if another file has it by now and may not be replaced."""
        self.file.flush()
        # First the content, then the name: after a power failure there is never a name with half a file.
        os.fsync(self.file.fileno())
        self.file.close()
        self._part.finish()
        # Make the new name survive a power failure too, where directories can be opened.
        with suppress(OSError):
            descriptor = os.open(self._part.path.parent, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)

    def discard(self) -> None:
        """Remove the file. A thread that still writes to it gets an error."""
        with suppress(OSError):
            self.file.close()
        self._part.close()
