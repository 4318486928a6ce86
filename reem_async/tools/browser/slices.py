"""Which part of an array a view shows: one index or a colon for each axis, and what is shown by itself."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import BadValue

__all__ = ["Look", "Slice", "look_at", "parse_slice", "part"]

Slice = tuple[int | None, ...]
"""For each axis an index, or None for all of it."""

_INDEX = re.compile(r"-?\d{1,12}")
# Rows and columns up to which an array is read as numbers.
_SMALL = 16
# Columns up to which an array is drawn as lines.
_MOST_CURVES = 16


@dataclass(frozen=True, slots=True)
class Look:
    """How an array can be shown.

    Attributes:
        view: What says most: "image", "line" or "table"; empty for an array without items.
        views: All that make sense, each with the part of the array it begins with.
    """

    view: str
    views: dict[str, Slice]


def look_at(dtype: np.dtype[Any], shape: tuple[int, ...]) -> Look:
    """Return how an array of this dtype and shape is best shown."""
    if 0 in shape:
        return Look("", {})
    if not shape:
        return Look("table", {"table": ()})
    numeric = dtype.kind in "biuf"
    views: dict[str, Slice] = {}
    # The order is that of the tabs of the page.
    if numeric and (plane := _image_slice(dtype, shape)) is not None:
        views["image"] = plane
    if numeric or dtype.kind == "c":
        views["line"] = _line_slice(shape)
    views["table"] = _leading(shape, 2) if not _has_channels(shape) else (None, None, 0)[-len(shape) :]
    if _has_channels(shape) and len(shape) > 3:
        views["table"] = (*[0] * (len(shape) - 3), None, None, 0)
    if numeric:
        views["histogram"] = (None,) * len(shape)
    return Look(_best(shape, views), views)


def _best(shape: tuple[int, ...], views: dict[str, Slice]) -> str:
    if "image" in views and min(_image_size(shape)) >= _SMALL:
        return "image"
    narrow = len(shape) == 1 or (len(shape) == 2 and shape[1] <= _MOST_CURVES)
    return "line" if "line" in views and narrow and shape[0] > _SMALL else "table"


def _has_channels(shape: tuple[int, ...]) -> bool:
    return len(shape) >= 3 and shape[-1] in (1, 3, 4) and min(shape[-3:-1]) > 1


def _image_size(shape: tuple[int, ...]) -> tuple[int, ...]:
    return shape[-3:-1] if _has_channels(shape) else shape[-2:]


def _image_slice(dtype: np.dtype[Any], shape: tuple[int, ...]) -> Slice | None:
    if len(shape) < 2:
        return None
    return _leading(shape, 3 if _has_channels(shape) else 2)


def _line_slice(shape: tuple[int, ...]) -> Slice:
    if _has_channels(shape):  # the channels along the row in the middle
        return (*[0] * (len(shape) - 3), shape[-3] // 2, None, None)
    if len(shape) >= 2 and shape[-1] <= _MOST_CURVES:
        return _leading(shape, 2)
    return (*[size // 2 for size in shape[:-2]], *([shape[-2] // 2] if len(shape) > 1 else []), None)


def _leading(shape: tuple[int, ...], free: int) -> Slice:
    fixed = max(len(shape) - free, 0)
    return (*[0] * fixed, *[None] * (len(shape) - fixed))


def parse_slice(text: str, shape: tuple[int, ...], most_free: int) -> Slice:
    """Return the part that `text` names, such as "0,:,:".

    Raises:
        BadValue: Not one colon or index within its axis for each of the axes, or too many colons.
    """
    words = [word.strip() for word in text.split(",")] if text.strip() else []
    if len(words) != len(shape):
        raise BadValue(f"the slice {text[:40]!r} has {len(words)} parts, the array has {len(shape)} axes")
    found: list[int | None] = []
    for word, size in zip(words, shape, strict=True):
        if word == ":":
            found.append(None)
        elif _INDEX.fullmatch(word) and -size <= int(word) < size:
            found.append(int(word))
        else:
            raise BadValue(f"the slice has {word[:20]!r} for an axis of {size} items; use : or a number below {size}")
    if found.count(None) > most_free:
        raise BadValue(f"the slice {text[:40]!r} leaves {found.count(None)} axes; this view shows {most_free} at most")
    return tuple(found)


def part(array: np.ndarray[Any, Any], chosen: Slice) -> np.ndarray[Any, Any]:
    """Return the part of an array, without copying it."""
    view: np.ndarray[Any, Any] = array[tuple([slice(None) if index is None else index for index in chosen])]
    return np.asarray(view)
