"""Make the value of an old key from its parts. Pure; nothing is evaluated."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..errors import BadData
from ..plan.paths import Path, shorten
from ..ships.numpy import NumpyShip
from .olddata import ROOT, candidates

ARRAY_LABEL = "default_numpy_handler"  # the label of the ship for arrays

ARRAY_FIELDS = frozenset({b"arr", b"dtype", b"shape"})
_MORE_FIELDS = frozenset({b"strides"})

_NAMED = re.compile(r"bool|u?int(?:8|16|32|64)|float(?:16|32|64)|complex(?:64|128)")
_TIME = re.compile(r"(datetime64|timedelta64)(\[\d{0,9}[a-zA-Zμ]{1,2}\])?")
_SHAPE = re.compile(r"\((?:\d{1,15}L?(?:, ?\d{1,15}L?)*,?)?\)")
# Bytes of the text of a dtype or a shape; longer ones are not valid.
_LONGEST = 1 << 15


def is_array(fields: frozenset[bytes]) -> bool:
    return fields >= ARRAY_FIELDS and fields <= ARRAY_FIELDS | _MORE_FIELDS


def array_of(fields: Any) -> np.ndarray[Any, Any]:
    """Return the array in an old hash; raises BadData.

    The bytes are in C order. The strides are those in the memory of the writer, and mean nothing.
    """
    if not isinstance(fields, Mapping) or not fields.keys() >= ARRAY_FIELDS:
        raise BadData("the array is gone from the server, or something else is in its place")
    # Old programs stored repr() of both: these are matched, never evaluated.
    dtype, shape = _text(fields[b"dtype"]), _text(fields[b"shape"])
    if not _SHAPE.fullmatch(shape):
        raise BadData(f"an array has the shape {shorten(shape)}, which is none")
    header = f"{{'descr': {_description(dtype)}, 'fortran_order': False, 'shape': {shape.replace('L', '')}, }}".encode()
    # Read as an .npy file, by the ship that checks everything.
    start = b"\x93NUMPY\x03\x00" + len(header).to_bytes(4, "little")
    try:
        return NumpyShip().unpack(start + header + bytes(fields[b"arr"]))
    except BadData as error:
        raise BadData(f"the array of dtype {shorten(dtype)} and shape {shape} cannot be converted: {error}") from None


def _text(value: Any) -> str:
    try:
        return bytes(value[:_LONGEST]).decode()
    except UnicodeDecodeError:
        return repr(value[:20])


def _description(dtype: str) -> str:
    if _NAMED.fullmatch(dtype):
        return repr(np.dtype(dtype).str)
    if found := _TIME.fullmatch(dtype):
        return repr(f"<{'M' if found[1] == 'datetime64' else 'm'}8{found[2] or ''}")
    return dtype if dtype.startswith("[") else repr(dtype)


class Tree:
    """A document into which the values of old ships are put.

    The holder is a list of the document, empty if there is none. The values of new ships in `kept` stay.
    """

    def __init__(self, holder: list[Any], kept: list[tuple[Any, Any]]) -> None:
        self._holder = holder
        # By id: equal containers may be in several places.
        self._kept = {(id(container), key) for container, key in kept}

    def put(self, place: str, value: Any) -> bool:
        """Put a ship's value at an old place, unless a value of a new ship is there; return whether it was put.

        Raises BadData if the place is inside of a value without entries.
        """
        found = self._slot(place)
        if (id(found[0]), found[1]) in self._kept:
            return False
        container, key = found
        if key == len(container) and isinstance(container, list):
            container.append(value)
        else:
            container[key] = value
        return True

    def holds(self, place: str) -> bool:
        for path in candidates(place):
            found = self._find(path)
            if found is not None and (id(found[0]), found[1]) in self._kept:
                return True
        return False

    def root(self, deletion: Callable[[str], str]) -> list[Any]:
        """Return the whole value in a list of one, empty if there is none, taken out of the dict made for it.

        Raises BadData if the dict has other entries, which old programs read by path only; `deletion` returns the shell
        command that deletes an entry.
        """
        if not self._holder or not isinstance(self._holder[0], dict) or ROOT not in self._holder[0]:
            return self._holder
        others = sorted(self._holder[0].keys() - {ROOT})
        if others:
            raise BadData(
                f"it holds both a value and, beside it, {', '.join(map(shorten, others[:3]))}, which no key can any "
                f"more; delete the value with `{deletion(ROOT)}`, or {shorten(others[0])} with `{deletion(others[0])}`"
            )
        return [self._holder[0][ROOT]]

    def _find(self, path: Path) -> tuple[Any, Any] | None:
        if path and path[0] == ROOT and self._holder and not isinstance(self._holder[0], dict):
            path = path[1:]  # it was taken out of its dict already
        container: Any = self._holder
        key: Any = 0
        for step in path:
            if not _has(container, key):
                return None
            container, key = container[key], step
        if not _has(container, key):
            return None
        return container, key + len(container) if isinstance(key, int) and key < 0 else key

    def _slot(self, place: str) -> tuple[Any, Any]:
        """Return the container and the key to set; makes missing dicts on the path, as old programs did."""
        found = candidates(place)
        for path in found:
            slot = self._find(path)
            if slot is not None:
                return slot
        container: Any = self._holder
        key: Any = 0
        for step in found[-1]:
            if not _has(container, key):
                if isinstance(container, list):
                    container.append({})
                else:
                    container[key] = {}
            container, key = container[key], step
            if not isinstance(container, dict):
                raise BadData(f"{place} is inside of a value of type {type(container).__name__}, which has no entries")
        return container, key


def _has(container: Any, key: Any) -> bool:
    if isinstance(container, dict):
        return key in container
    if isinstance(container, list) and isinstance(key, int):
        return -len(container) <= key < len(container)
    return False
