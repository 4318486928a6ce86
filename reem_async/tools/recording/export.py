"""Recordings as CSV, npz or Parquet."""

from __future__ import annotations

import csv
import io
import itertools
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path as FilePath
from typing import IO, Any

import numpy as np

from ...errors import BadData, BadValue
from ...plan.paths import Path, suffix
from ...plan.trees import MISSING
from ..partfile import PartFile, there_already
from .align import EXACT, stacked
from .format import Kind
from .log import Log
from .stored import Reference, is_inline

# Rows of a group in a Parquet file, and those that are in memory at once.
_ROWS = 10_000
_DELETED, _STORED = "", "."
"""What stands for the columns of what was deleted and what was only stored until their names are known: no path has
these names."""


class Export:
    """What became of an export."""

    def __init__(self) -> None:
        self.rows = 0  # or instants of all paths together
        self.columns: list[str] = []
        self.left_out: dict[str, str] = {}  # what this format cannot hold, by path, and why
        self.time = "time"  # the names of special columns: another name if there is a path of this one
        self.deleted = ""
        self.stored = ""
        self.unreadable = 0  # updates that were left out, since they are damaged or of a type that was not recorded

    def begin(self, keys: Collection[str]) -> list[str]:
        """Name the columns, and return the keys of their cells; BadValue if only deleted or stored paths have any.

        These two come last, so that tables of recordings without them are as they always were.
        """
        special = [key for key in (_DELETED, _STORED) if key in keys]
        plain = [key for key in keys if key not in special]
        self.columns = plain.copy()
        if not plain:
            raise BadValue("nothing of this can be exported so: no number or text was recorded under these patterns")
        while self.time in self.columns:
            self.time = f"_{self.time}"
        if _DELETED in special:
            self.deleted = self._add("deleted")
        if _STORED in special:
            self.stored = self._add("stored")
        return [*plain, *special]

    def _add(self, name: str) -> str:
        while name in self.columns:
            name = f"_{name}"
        self.columns.append(name)
        return name


def export(
    log: Log, kind: str, target: str | FilePath, patterns: Sequence[str] = ("*",), *, overwrite: bool = False
) -> Export:
    """Write what was recorded into a file that other programs read.

    "csv" and "parquet" have a row for each update, and a column for each number or text, empty where it was not
    updated; an empty dict or list is the text "{}" or "[]". A deletion is in the column "deleted" of a row of its own.
    The column "stored" has the path where a row is of a plain write. Both are there only if something is in them.
    Arrays of more than 64 numbers are left out and named in the result; an update of nothing else has no row.

    "npz" has for each path an array of all its values, time first, and `path.time`. Deletions and empty dicts are left
    out and named. The file appears once it is complete.
    """
    check_format(kind)
    result = Export()
    with appearing(FilePath(target), log, overwrite=overwrite) as part:
        FORMATS[kind](log, part, patterns, result)
    return result


@contextmanager
def appearing(target: FilePath, log: Log, *, overwrite: bool) -> Iterator[FilePath]:
    """Give the hidden name of a file that gets its name when the block has ended, and is removed if the block fails.

    A program that waits for the file never sees a half one. Raises BadValue if it is there and may not be replaced.
    """
    if target.exists() and not overwrite:
        raise BadValue(str(there_already(target)))
    try:
        with PartFile(target, replace=overwrite) as part:
            yield part.path
    except FileExistsError as error:  # another program has created it in the meantime
        raise BadValue(str(error)) from None
    except OSError as error:
        file = str(log.path if error.filename == str(log.path) else target)
        raise OSError(error.errno, error.strerror or str(error), file) from error


def check_format(kind: str) -> None:
    if kind not in FORMATS:
        raise BadValue(f"{kind!r} is none of {', '.join(FORMATS)}")


def _rows(log: Log, patterns: Sequence[str], result: Export) -> Iterator[tuple[float, dict[str, Any]]]:
    """Yield the time of each update and its numbers and texts by name.

    Of a deletion the path is under _DELETED, of what was only stored under _STORED.
    """
    for time, path, value, kind in log.outlines_of(patterns):
        cells = {_DELETED: _name(path)} if value is MISSING else dict(_leaves(path, value, result))
        if cells:
            yield time, cells | ({_STORED: _name(path)} if kind == Kind.STORED else {})


def _leaves(path: Path, value: Any, result: Export) -> Iterator[tuple[str, Any]]:
    """Yield everything that fits into a cell, by the text of its path."""
    if isinstance(value, np.ndarray) and is_inline(value):
        value = value.tolist()
    if isinstance(value, dict | list):
        if not value:
            yield _name(path), str(value)
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves((*path, key), item, result)
    elif value is None or isinstance(value, bool | int | float | str):
        yield _name(path), value
    else:
        result.left_out.setdefault(_name(path), "an array, a long list, or bytes; npz has arrays")


def _name(path: Path) -> str:
    return suffix(path).removeprefix(".")


def _columns(log: Log, patterns: Sequence[str], result: Export) -> dict[str, set[type]]:
    """Name the columns of all rows, which must be known before the first row; return the types in each, by its key.

    The rows are read again to be written, with another `Export`: this pass has counted what is left out.
    """
    kinds: dict[str, set[type]] = {}
    for _, cells in _rows(log, patterns, result):
        for name, value in cells.items():
            kinds.setdefault(name, set()).add(_kind(value))
    result.unreadable = log.unreadable
    return {key: kinds[key] for key in result.begin(kinds)}


def _csv(log: Log, target: FilePath, patterns: Sequence[str], result: Export) -> None:
    keys = list(_columns(log, patterns, result))
    with target.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([result.time, *result.columns])
        for time, cells in _rows(log, patterns, Export()):
            result.rows += 1
            writer.writerow([f"{time:.6f}", *[cells.get(key) for key in keys]])


def _parquet(log: Log, target: FilePath, patterns: Sequence[str], result: Export) -> None:
    arrow, parquet = pyarrow()
    # None stands for an empty cell in every type.
    forms = {key: _form(found - {type(None)}) for key, found in _columns(log, patterns, result).items()}
    types = {bool: arrow.bool_(), int: arrow.int64(), float: arrow.float64(), str: arrow.string()}
    titles = dict(zip(forms, result.columns, strict=True))
    fields = [(result.time, arrow.timestamp("us", "UTC")), *[(titles[key], types[forms[key]]) for key in forms]]
    schema = arrow.schema(fields)
    rows = _rows(log, patterns, Export())
    with parquet.ParquetWriter(target, schema) as writer:
        while batch := list(itertools.islice(rows, _ROWS)):
            data: dict[str, list[Any]] = {result.time: [round(time * 1e6) for time, _ in batch]}
            for key, form in forms.items():
                data[titles[key]] = [_cell(cells.get(key), form) for _, cells in batch]
            writer.write_table(arrow.table(data, schema=schema))
            result.rows += len(batch)


def pyarrow() -> tuple[Any, Any]:
    """Return pyarrow and its part for Parquet; raises BadValue if it is not installed."""
    try:
        return import_module("pyarrow"), import_module("pyarrow.parquet")
    except ModuleNotFoundError:
        raise BadValue("Parquet needs pyarrow: pip install pyarrow") from None


class _Long(int):
    """The kind of ints that floats would round."""


def _kind(value: Any) -> type:
    """Return the type of a cell; ints that no column of integers holds are text."""
    if type(value) is not int or -EXACT <= value <= EXACT:
        return type(value)
    # Text for what no 64-bit integer holds.
    return _Long if -(2**63) <= value < 2**63 else str


def _form(kinds: set[type]) -> type:
    """Return the one type that holds values of all these exactly."""
    if kinds and kinds <= {int, _Long}:
        return int
    if len(kinds) == 1:
        return next(iter(kinds))
    return float if kinds == {int, float} else str


def _cell(value: Any, form: type) -> Any:
    if value is None:
        return None
    return value if type(value) is form else form(value)


def _npz(log: Log, target: FilePath, patterns: Sequence[str], result: Export) -> None:
    """Write each path as it is read, array by array: a recording may be larger than memory."""
    paths, lost = _array_paths(log, patterns, result), 0
    result.unreadable = log.unreadable
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for path in paths:
            before = log.unreadable
            # The header says how many values there are, so they wait in a file until they are counted.
            with tempfile.TemporaryFile(dir=target.parent) as values:
                try:
                    times, form = _spooled(log, path, values)
                except BadData as error:
                    result.left_out[_name(path)] = str(error)
                    continue
                finally:
                    lost += log.unreadable - before
                if form is None:
                    result.left_out[_name(path)] = "its type or shape changes, or no dtype holds it exactly"
                    continue
                result.rows += len(times)
                result.columns.append(_name(path))
                write_array(archive, f"{_name(path)}.time", times.dtype, times.shape, io.BytesIO(times.tobytes()))
                write_array(archive, _name(path), form[0], (len(times), *form[1]), values)
    # What each path lacks is in the updates, which were counted, but for arrays, which were not read then.
    result.unreadable = result.unreadable or lost
    result.begin(result.columns)


def write_array(
    archive: zipfile.ZipFile, name: str, dtype: np.dtype[Any], shape: tuple[int, ...], data: IO[bytes]
) -> None:
    """Write an array whose bytes are in a file into an npz archive."""
    data.seek(0)
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        np.lib.format.write_array_header_2_0(file, header)
        shutil.copyfileobj(data, file)


def _array_paths(log: Log, patterns: Sequence[str], result: Export) -> list[Path]:
    """Return the paths of everything in any update that may be stacked."""
    found: dict[Path, None] = {}
    for _, path, tree, _ in log.outlines_of(patterns):
        if tree is MISSING:
            result.left_out.setdefault(f"{_name(path)} (deleted)", "npz has values only; csv and parquet have a row")
        else:
            found.update(dict.fromkeys(_places(path, tree, result)))
    return sorted(found, key=_name)


def _places(path: Path, value: Any, result: Export) -> Iterator[Path]:
    if isinstance(value, dict):
        if not value:
            result.left_out.setdefault(_name(path), "an empty dict; csv and parquet have it")
        for key, item in value.items():
            yield from _places((*path, key), item, result)
    elif isinstance(value, list) and not all(isinstance(item, bool | int | float) for item in value):
        for index, item in enumerate(value):
            yield from _places((*path, index), item, result)
    elif isinstance(value, Reference) and value.label not in ("numpy", "list"):
        result.left_out[_name(path)] = f"{value.label}, not an array"
    elif value is not None:
        yield path


Form = tuple[np.dtype[Any], tuple[int, ...]]


def _spooled(log: Log, path: Path, file: IO[bytes]) -> tuple[np.ndarray[Any, Any], Form | None]:
    """Write a path's values into a file; return their times, and the dtype and shape of all, None if they differ."""
    times: list[float] = []
    forms: set[Form | None] = set()
    others: list[Any] = []
    for time, value in log[path].values():
        times.append(time)
        if isinstance(value, np.ndarray):
            forms.add((value.dtype, value.shape))
            file.write(value.tobytes())
        else:
            others.append(value)
    if others:
        is_text = all(isinstance(it, str) and not it.endswith("\0") for it in others)  # numpy takes that for padding
        array = np.array(others) if is_text else stacked(others)
        forms.add((array.dtype, array.shape[1:]) if isinstance(array, np.ndarray) else None)
        file.write(array.tobytes() if isinstance(array, np.ndarray) else b"")
    return np.array(times), forms.pop() if len(forms) == 1 else None


FORMATS: dict[str, Callable[[Log, FilePath, Sequence[str], Export], None]] = {
    "csv": _csv,
    "npz": _npz,
    "parquet": _parquet,
}
