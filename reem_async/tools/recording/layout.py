"""Trees as JSON messages that viewers can plot, and back, exactly.

What JSON or a viewer in JavaScript cannot hold exactly is shown as well as it can be in its place, and the
exact truth stands beside it, in a text under "$ship" at the root: a JSON list of notes. A viewer shows this
text as text. A root that is not a dict (or that has a "$ship" of its own) is wrapped as {"value": ...}.

    {"joint": [0.1, 0.2], "image": {"$ship": "numpy", "topic": "/arm/image", ...}, "$ship": "[[...], [...]]"}

A note begins with the path below the root, then says what is there:

    [path, "int"]                                                   an int over 2**53, shown as text
    [path, "array", dtype, shape, null or base64]                   a short array, shown as a list
    [path, "stored", label, path, time, size, summary, dtype, shape]    has a message of its own
"""

from __future__ import annotations

import base64
import re
from typing import Any, NamedTuple

import numpy as np
import orjson

from ...plan.documents import nested_over
from ...plan.paths import Path, shorten
from .errors import DamagedRecording
from .stored import Stored

__all__ = ["NOTES", "WRAPPER", "Document", "from_json", "to_json", "topic_of"]

NOTES = "$ship"
WRAPPER = "value"
_DEEPEST = 128
"""Levels of a value. What is written has at most 100."""
# Larger integers are not exact in JavaScript, in which most viewers are written.
_LARGEST_EXACT = 2**53
# Plain numbers and bools: what a short array in a message may be.
_DTYPE = re.compile(r"[<>|=][biuf]\d{1,2}")


class Document(NamedTuple):
    """A tree ready to be written.

    Attributes:
        tree: What is written, notes included: plain JSON values.
        wrapped: The tree proper is under "value".
    """

    tree: dict[str, Any]
    wrapped: bool

    @property
    def text(self) -> bytes:
        """The JSON text."""
        return orjson.dumps(self.tree)


def topic_of(path: Path) -> str:
    """Return the topic of a path: `/arm/q`."""
    return "/" + "/".join([str(key) for key in path])


def to_json(tree: Any) -> Document:
    """Return a tree, arrays already replaced by `Stored` where they are long, as a JSON object with its notes."""
    notes: list[Any] = []
    shown = _shown(tree, None, notes)
    # A root with a "$ship" of its own would be taken for one with notes.
    wrapped = type(shown) is not dict or type(tree) is not dict or NOTES in tree
    root: dict[str, Any] = {WRAPPER: shown} if wrapped else shown
    if notes:
        root[NOTES] = orjson.dumps(notes).decode()
    return Document(root, wrapped)


_Place = Any
"""A path as nested pairs (parent, key), None for the root: cheaper to extend than a tuple."""


def _shown(value: Any, place: _Place, notes: list[Any]) -> Any:
    kind = type(value)
    if kind is float or kind is str or kind is bool or value is None:
        return value
    if kind is int:
        if -_LARGEST_EXACT <= value <= _LARGEST_EXACT:
            return value
        # As text in its place: a viewer that reads it as a number would show another one.
        notes.append([_flat(place), "int"])
        return str(value)
    if kind is dict:
        return {key: _shown(item, (place, key), notes) for key, item in value.items()}
    if kind is list:
        return [_shown(item, (place, index), notes) for index, item in enumerate(value)]
    if kind is Stored:
        return _shown_stored(value, place, notes)
    return _shown_array(value, place, notes)


def _shown_stored(it: Stored, place: _Place, notes: list[Any]) -> dict[str, Any]:
    note = [_flat(place), "stored", it.label, it.path, it.at, it.size, it.summary, it.dtype, it.shape]
    notes.append(note)
    shape = {} if it.shape is None else {"dtype": it.dtype, "shape": it.shape}
    return {NOTES: it.label, "topic": topic_of(it.path), "size": it.size, **shape}


def _shown_array(array: np.ndarray[Any, Any], place: _Place, notes: list[Any]) -> Any:
    exact = array.tolist()
    data = None
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        # JSON has no NaN: null in its place, and the exact bytes in the note.
        objects = array.astype(object)
        objects[~np.isfinite(array)] = None
        shown = objects.tolist()
        data = base64.b64encode(array.tobytes()).decode()
    elif array.dtype.kind in "iu" and array.itemsize == 8 and _is_large(array):
        # Rounded for viewers; the exact bytes are in the note.
        shown = array.astype(float).tolist()
        data = base64.b64encode(array.tobytes()).decode()
    else:
        shown = exact
    notes.append([_flat(place), "array", array.dtype.str, array.shape, data])
    return shown


def _is_large(array: np.ndarray[Any, Any]) -> bool:
    return bool(array.size) and (int(array.max()) > _LARGEST_EXACT or int(array.min()) < -_LARGEST_EXACT)


def _flat(place: _Place) -> list[str | int]:
    path = []
    while place is not None:
        place, key = place
        path.append(key)
    return path[::-1]


def from_json(text: bytes, *, wrapped: bool) -> Any:
    """Return the tree of a message, long arrays as `Stored`.

    Raises:
        DamagedRecording: Not what `to_json` writes.
    """
    try:
        root = orjson.loads(text)
        if type(root) is not dict:
            raise TypeError("not an object")
        notes = orjson.loads(root.pop(NOTES)) if NOTES in root else []
        holder = [root[WRAPPER] if wrapped else root]
        # Everything here may be made up: each wrong step ends as DamagedRecording, below.
        for path, *note in notes:
            container: Any = holder
            keys: list[Any] = [0, *path]
            for key in keys[:-1]:
                container = container[key]
            container[keys[-1]] = _exact(container[keys[-1]], *note)
        if nested_over(text, holder[0], _DEEPEST):
            raise ValueError(f"nested over {_DEEPEST} levels")
    except (AttributeError, IndexError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise DamagedRecording(f"the message {shorten(text)} was not written by REEM: {error!r}") from None
    return holder[0]


def _exact(shown: Any, kind: str, *note: Any) -> Any:
    if kind == "int":
        return int(shown)
    if kind == "array":
        return _array(shown, *note)
    if kind == "stored":
        label, path, at, size, summary, dtype, shape = note
        is_sound = path and all(type(key) in (str, int) for key in path) and type(path[0]) is str
        if not is_sound or {type(it) for it in (label, summary, dtype)} != {str} or not _are_sizes([at, size]):
            raise ValueError(note)
        if shape is not None and not _are_sizes(shape):
            raise ValueError(shape)
        return Stored(label, tuple(path), at, size, summary, dtype, None if shape is None else tuple(shape))
    raise ValueError(kind)


def _are_sizes(numbers: list[Any]) -> bool:
    return all(type(number) is int and 0 <= number < 2**63 for number in numbers)


def _array(shown: Any, dtype: str, shape: list[int], data: str | None) -> np.ndarray[Any, Any]:
    if not _DTYPE.fullmatch(dtype) or min(shape, default=0) < 0:
        raise ValueError(dtype, shape)
    flat = (
        np.array(shown, np.dtype(dtype))
        if data is None
        else np.frombuffer(base64.b64decode(data, validate=True), np.dtype(dtype))
    )
    array = flat.reshape(shape)
    array.flags.writeable = False
    return array
