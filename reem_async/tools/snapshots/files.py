"""Files of snapshots: their summary, and names by time."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from ...errors import BadData
from ..partfile import there_already

SUFFIXES = {"portable": ".zip", "rdb": ".rdb"}
"""The ends of names of both kinds of files. The content tells the kind, not the name."""

FIRST_MEMBER = b"reem-snapshot.json"
"""The name of the first member of a portable snapshot."""

# reem-20260801T120000Z.zip, reem-auto-20260801T120000Z-2.rdb: only "auto" ones, of --keep, are ever deleted.
_NAME = re.compile(r"reem-(?P<auto>auto-)?(?P<time>\d{8}T\d{6}Z)(?:-\d+)?\.(?:zip|rdb)")
_TIME = "%Y%m%dT%H%M%SZ"


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
        match: Which top-level keys were saved, of a portable one.
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
    match: str = "*"
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


def is_automatic(path: Path) -> bool:
    """Return whether a file has the name of one that may be deleted for newer ones."""
    named = _NAME.fullmatch(path.name)
    return named is not None and named["auto"] is not None and not path.is_symlink()


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
