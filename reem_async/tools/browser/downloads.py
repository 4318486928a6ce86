"""Values as files: `/view/<path>?format=json`, `npy`, `csv`, `png` or `bin`."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from typing import Any
from urllib.parse import quote

import numpy as np

from ...errors import BadType, BadValue
from ...plan.paths import Path, show
from ..jsontext import json_text
from .addresses import address
from .pictures import LARGEST_SIDE, paint
from .slices import look_at, parse_slice, part
from .trees import Leaf, leaf_of

__all__ = ["FORMATS", "disposition", "file_of"]

_LONGEST_LIST = 1_000_000
"""Numbers of an array up to which it is written as a list."""
# All else is replaced in the plain name; the second one has all characters, percent-encoded (RFC 6266).
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


def file_of(value: Any, path: Path, kind: str, chosen: str | None) -> tuple[bytes, str]:
    """Return a value as a file, and its media type.

    Args:
        value: The value, arrays included.
        path: Where it is.
        kind: One of `FORMATS`.
        chosen: The part of an array that is wanted, such as "0,:,:"; None for what a view shows first.

    Raises:
        BadType: The value cannot be such a file.
        BadValue: There is no such format.
    """
    if kind not in FORMATS:
        raise BadValue(f"format={kind[:20]!r} is none of {', '.join(FORMATS)}")
    make, media_type = FORMATS[kind]
    return make(value, path, chosen), media_type


def disposition(path: Path, kind: str, chosen: str | None = None) -> str:
    """Return the header that gives a file its name; that of a part of an array says which."""
    whole = address(path)[:80] + (f"[{chosen[:40]}]" if chosen else "")
    name = _UNSAFE.sub("_", whole).strip("._") or "value"
    return f"attachment; filename=\"{name}.{kind}\"; filename*=UTF-8''{quote(f'{whole}.{kind}', '')}"


def _json(value: Any, path: Path, chosen: str | None) -> bytes:
    _check_json(value, path)
    try:
        return json_text(value, pretty=True).encode()
    except UnicodeEncodeError:
        raise _no_text(path) from None


def _check_json(value: Any, path: Path) -> None:
    """Raise BadType for what is not kept for this instant, and for arrays that are too long for a list."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            _check_json(item, (*path, key))
    elif not (value is None or isinstance(value, str | bool | int | float | bytes)):
        if isinstance(value, np.ndarray) and value.size <= _LONGEST_LIST:
            return
        leaf = leaf_of(value)
        raise BadType(f"{show(path)}, {leaf.label} {leaf.summary}, cannot be JSON; choose npy for it, or use Python")


def _bin(value: Any, path: Path, chosen: str | None) -> bytes:
    if not isinstance(value, bytes):
        raise BadType(f"{show(path)} is of type {type(value).__name__}, not bytes; use another format")
    return value


def _npy(value: Any, path: Path, chosen: str | None) -> bytes:
    array = _array(value, path)
    file = io.BytesIO()
    np.lib.format.write_array(file, _part(array, chosen, array.ndim), allow_pickle=False)
    return file.getvalue()


def _csv(value: Any, path: Path, chosen: str | None) -> bytes:
    array = _array(value, path)
    if chosen is None and array.ndim > 2:
        raise BadType(
            f"{show(path)} has {array.ndim} axes, CSV two: choose a slice, such as {'0,' * (array.ndim - 2)}:,:"
        )
    plane = _part(array, chosen, 2)
    file = io.StringIO()
    writer = csv.writer(file)
    # A structured array has a column for each field.
    names = plane.dtype.names
    if names:
        writer.writerow(names)
        rows = plane.reshape(-1).tolist()
    else:
        rows = plane.reshape(-1, 1).tolist() if plane.ndim < 2 else plane.tolist()
    writer.writerows([[_cell(item) for item in row] for row in rows])
    try:
        return file.getvalue().encode()
    except UnicodeEncodeError:
        raise _no_text(path) from None


def _no_text(path: Path) -> BadType:
    """Return what is raised for text of an array that no file of text can hold."""
    return BadType(f"{show(path)} has an array with half of a surrogate pair, which UTF-8 lacks; choose npy for it")


def _cell(item: Any) -> Any:
    """Return what goes into a cell: text that a spreadsheet would run as a formula is quoted."""
    return f"'{item}" if isinstance(item, str) and item[:1] in ("=", "+", "-", "@", "\t") else item


def _png(value: Any, path: Path, chosen: str | None) -> bytes:
    array = _array(value, path)
    if chosen is None:
        plane = look_at(array.dtype, array.shape).views.get("image")
        if plane is None:
            raise BadType(f"{show(path)}, an array of {array.dtype} {list(array.shape)}, is no picture")
        return paint(part(array, plane), side=LARGEST_SIDE).png
    return paint(_part(array, chosen, 3), side=LARGEST_SIDE).png


def _array(value: Any, path: Path) -> np.ndarray[Any, Any]:
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, list):
        try:
            array = np.array(value)
        except ValueError:
            array = np.array([], object)
        if array.dtype.kind in "biuf":
            return array
    what = "not kept for this instant" if isinstance(value, Leaf) else f"of type {type(value).__name__}"
    raise BadType(f"{show(path)} is {what}, not an array; use format=json")


def _part(array: np.ndarray[Any, Any], chosen: str | None, most_free: int) -> np.ndarray[Any, Any]:
    return array if chosen is None else part(array, parse_slice(chosen, array.shape, most_free))


FORMATS: dict[str, tuple[Callable[[Any, Path, str | None], bytes], str]] = {
    "json": (_json, "application/json"),
    "npy": (_npy, "application/octet-stream"),
    "csv": (_csv, "text/csv; charset=utf-8"),
    "png": (_png, "image/png"),
    "bin": (_bin, "application/octet-stream"),
}
"""What a value can be downloaded as."""
