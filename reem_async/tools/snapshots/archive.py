"""The portable snapshot: a zip file that any unzip opens, with a digest at its end.

    reem-snapshot.json        format, version, and when and where it was taken
    keys/1/document.json      a document, as the server sent it
    keys/1/values/1.npy       a ship's value: an array, for numpy.load
    keys/1/values/2.bin       other bytes
    keys/1/values/3.hash      the parts of another Redis type, each after its length and a colon
    keys/2/...
    index.json                the names that belong to these

The comment of the zip file ends in the SHA-256 of the whole file (with zeros in the place of that digest), so a file
that was cut or changed is refused. It is written and read one top-level key at a time. No I/O with a server.
"""

from __future__ import annotations

import hashlib
import time
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Self

import orjson

from ...errors import BadData
from ...plan.keys import DOCUMENT
from ...plan.paths import check_top_key, parse_suffix
from ..partfile import PartFile
from .files import FIRST_MEMBER, SavedKey, Snapshot
from .plans import REDIS_TYPES, KeyContent, Value, joined, split

# Of the format: it grows when older programs would misread a file, not when something is added that they may ignore.
VERSION = 1
_HEADER = FIRST_MEMBER.decode()
_INDEX = "index.json"
_COMMENT = b"reem-snapshot sha256 "
# As long as a SHA-256 in hexadecimal digits.
_ZEROS = b"0" * 64
# Bytes read at a time.
_BLOCK = 1 << 20
_NUMPY = b"\x93NUMPY"


class _Hashed:
    """A file for zipfile that cannot seek: every byte passes once, and is counted in the digest."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.digest = hashlib.sha256()

    def write(self, data: Any) -> int:
        self.digest.update(data)
        return self._file.write(data)

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        pass  # the owner closes the file


# Bytes of an index after decompression; a small file may claim to unpack to any size.
_LARGEST_INDEX = 1 << 29
_LATEST = 1 << 37
"""A time in seconds since 1970 that no snapshot has been taken at."""
_LONGEST_EXPIRY = 1 << 53
"""Milliseconds until a key expires that no server takes."""


class ArchiveWriter:
    """Makes one portable snapshot, which has its name when `finish` has returned, or never."""

    def __init__(self, path: Path, header: dict[str, Any], *, overwrite: bool = False) -> None:
        self._part = PartFile(path, replace=overwrite)
        self._file: BinaryIO = self._part.path.open("r+b")
        # A file that cannot seek makes zipfile write sizes behind each member rather than going back to its head, which
        # would change bytes that are in the digest already.
        self._hashed = _Hashed(self._file)
        self._zip = zipfile.ZipFile(self._hashed, "w")
        self._keys: list[dict[str, Any]] = []
        try:
            self._put(_HEADER, orjson.dumps({"format": "reem-snapshot", "version": VERSION, **header}))
        except BaseException:
            self.abandon()
            raise

    def add(self, content: KeyContent) -> None:
        folder = f"keys/{len(self._keys) + 1}"
        # Text is compressed at the fastest level; arrays are not: they hardly shrink, and this is about as fast as
        # the disk.
        self._put(f"{folder}/document.json", content.text, zipfile.ZIP_DEFLATED)
        values = []
        for number, value in enumerate(content.values, 1):
            if value.kind == "string":
                blob = value.pieces[0]
                ending = "npy" if blob[:6] == _NUMPY else "bin"
            else:
                blob, ending = joined(value.pieces), "json" if value.kind == DOCUMENT else value.kind
            member = f"{folder}/values/{number}.{ending}"
            self._put(member, blob)
            values.append({"suffix": value.suffix, "type": value.kind, "size": value.size, "file": member})
        row = {"name": content.name, "size": len(content.text), "file": f"{folder}/document.json"}
        row |= {} if content.expires is None else {"expires": content.expires}
        self._keys.append({**row, "registry": content.registry, "values": values})

    def finish(self, unsaved: Mapping[str, str]) -> None:
        """Write the index and the digest, sync the file to the disk, and give it its name."""
        # Earlier versions of REEM demand the number and the names of the keys that are not REEM's.
        index = {"keys": self._keys, "foreign": 0, "foreign_names": [], "unsaved": dict(unsaved)}
        self._put(_INDEX, orjson.dumps(index), zipfile.ZIP_DEFLATED)
        # The comment is the end of the file. It is written with zeros, which the digest covers, and then the digest
        # takes their place, so a reader can compute the same digest from the file alone.
        self._zip.comment = _COMMENT + _ZEROS
        self._zip.close()
        # Not through `_hashed`, which would count these bytes again.
        self._file.seek(-len(_ZEROS), 2)
        self._file.write(self._hashed.digest.hexdigest().encode())
        self._file.close()
        self._part.finish()

    def abandon(self) -> None:
        """Remove the file; a thread that is still writing to it gets an error."""
        self._zip.fp = None  # else its finalizer would write an index at some later time
        with suppress(OSError):
            self._file.close()
        self._part.close()

    def _put(self, name: str, data: Any, method: int = zipfile.ZIP_STORED) -> None:
        # A zip file's own times are local and begin in 1980: every member has the same, the header has the real one.
        self._zip.writestr(zipfile.ZipInfo(name), data, method, 1)


def verify(path: Path) -> None:
    """Read the whole file and compare its digest; raises BadData if it was cut or changed."""
    total = path.stat().st_size
    # All but the digest itself, then zeros in its place: what the writer has counted.
    digest, left = hashlib.sha256(), total - len(_ZEROS)
    with path.open("rb") as file:
        while left > 0 and (block := file.read(min(_BLOCK, left))):
            digest.update(block)
            left -= len(block)
        end = file.read()
    digest.update(_ZEROS)
    if digest.hexdigest().encode() != end:
        raise BadData(
            f"{path}: the snapshot is damaged or not complete (its {total} bytes do not have the digest at their end); "
            "nothing was done with it: use another one"
        )


class Archive:
    """A portable snapshot open for reading. Raises BadData if its index is damaged; `verify` checks the rest."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with _believed(path):
            self._zip = zipfile.ZipFile(path)
        try:
            with _believed(path):
                self.summary = self._summed_up()
        except BaseException:
            self._zip.close()
            raise

    def read(self, name: str) -> KeyContent:
        with _believed(self._path):
            row = self._rows[name]
            values = tuple([self._value(each) for each in row["values"]])
            text = self._member(row["file"], row["size"])
            return KeyContent(name, text, tuple(row["registry"]), values, row.get("expires"))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def _summed_up(self) -> Snapshot:
        header = self._json(_HEADER)
        if header["format"] != "reem-snapshot":
            raise BadData(f"{self._path}: not a snapshot of REEM")
        if header["version"] > VERSION:
            raise BadData(
                f"{self._path}: version {header['version']} of the format; this program knows {VERSION}: update reem"
            )
        # The rows are trusted only as far as `_saved_key` has checked them: they become names of keys on a server.
        index = self._json(_INDEX)
        self._rows: dict[str, dict[str, Any]] = {row["name"]: row for row in index["keys"]}
        keys = tuple([_saved_key(row) for row in self._rows.values()])
        return Snapshot(
            path=self._path,
            kind="portable",
            time=_within(float(header["time"]), _LATEST),
            size=self._path.stat().st_size,
            count=len(keys),
            keys=keys,
            server=str(header["server"]),
            namespace=str(header["namespace"]),
            match=str(header.get("match", "*")),
            unsaved={str(place): str(why) for place, why in index.get("unsaved", {}).items()},
        )

    def _json(self, member: str) -> dict[str, Any]:
        if self._zip.getinfo(member).file_size > _LARGEST_INDEX:
            raise ValueError(f"{member} is larger than any index")
        content: dict[str, Any] = orjson.loads(self._zip.read(member))
        return content

    def _member(self, name: str, size: int | None) -> bytes:
        """Return the content of a member that has the size which the index says; None for one that is not compressed.

        It is compared before anything is unpacked: a few bytes may claim to unpack to any size.
        """
        info = self._zip.getinfo(name)
        if info.file_size != (info.compress_size if size is None else size):
            raise ValueError(f"{name} would unpack to {info.file_size} bytes")
        return self._zip.read(info)

    def _value(self, row: dict[str, Any]) -> Value:
        # Of what has parts, the index says the size without what is between them.
        blob = self._member(row["file"], row["size"] if row["type"] == "string" else None)
        # Hashes hold pairs, sorted sets members and scores, JSON is one text.
        pieces = (blob,) if row["type"] == "string" else tuple(split(blob))
        if (row["type"] in ("hash", "zset") and len(pieces) % 2) or (row["type"] == DOCUMENT and len(pieces) != 1):
            raise ValueError(f"a {row['type']} of {len(pieces)} pieces")
        return Value(row["suffix"], row["type"], pieces)


def _saved_key(row: dict[str, Any]) -> SavedKey:
    # Nothing in the index is trusted: these become names on a server.
    name = check_top_key(row["name"])
    for suffix in [*row["registry"], *[value["suffix"] for value in row["values"]]]:
        if suffix and suffix[0] not in ".[~":
            raise ValueError(f"{suffix!r} is not the place of a value")
        parse_suffix(suffix)
    unknown = [value["type"] for value in row["values"] if value["type"] not in REDIS_TYPES]
    if unknown:
        raise ValueError(f"a value of {name} has the unknown type {unknown[0]!r}")
    expires = row.get("expires")
    if expires is not None and (type(expires) is not int or not 0 < expires < _LONGEST_EXPIRY):
        raise ValueError(f"{name} cannot expire in {expires!r} ms")
    values = tuple([(it["suffix"], it["type"], int(_within(it["size"], 2**63))) for it in row["values"]])
    return SavedKey(name, int(_within(row["size"], 2**63)), values)


def _within(number: float, limit: float) -> float:
    if not 0 <= number < limit:
        raise ValueError(f"{number!r} cannot be")
    return number


@contextmanager
def _believed(path: Path) -> Iterator[None]:
    try:
        yield
    except BadData:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise BadData(f"{path}: the snapshot is damaged or not complete: {error}") from None
    # A file that was made up may hold any types and names.
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError, ArithmeticError, MemoryError) as error:
        raise BadData(f"{path}: the snapshot is damaged, its index does not fit its content: {error}") from None


def header(server: str, namespace: str, match: str, version: str) -> dict[str, Any]:
    now = time.time()
    utc = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(now))
    return {"time": now, "utc": utc, "server": server, "namespace": namespace, "match": match, "reem": version}
