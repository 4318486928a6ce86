"""Trees as the browser keeps them: plain values, with arrays in their places or only what is known of them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any

import numpy as np
import orjson

from ...errors import BadData
from ...plan.paths import Path, show
from ...plan.placeholders import Unfetched, Unreadable, find, marked
from ...plan.trees import MISSING, get, mapped, walk
from ...ships.images import EncodedImage
from ...ships.numpy import NumpyShip
from .pictures import preview_of

_NUMPY = NumpyShip()
_SCALARS = (str, int, float, bool, type(None))
_OVERHEAD = 200  # bytes of memory that an array takes besides its items
CONTENTS = (np.ndarray, bytes, EncodedImage)
"""The types of what is kept as a `Frame`."""


class Frame:
    """An array or bytes of the past, in the place of a value in a tree: the content is let go of as room runs short."""

    # Not a dataclass: two frames are the same only if they are one, and there are thousands.
    __slots__ = ("described", "preview", "time", "whole")

    def __init__(self, whole: np.ndarray[Any, Any] | bytes | EncodedImage) -> None:
        self.described = described(whole)
        self.whole: np.ndarray[Any, Any] | bytes | EncodedImage | None = (
            whole  # the value, None once there is no room for it
        )
        # A small picture of it; None if there is none
        self.preview = preview_of(whole) if isinstance(whole, np.ndarray) else None
        self.time = 0.0  # since when it is known, in seconds since 1970

    def moved(self) -> Frame:
        it = copy.copy(self)
        it.time = 0.0
        return it

    @property
    def size(self) -> int:
        small = len(self.preview.file) + _OVERHEAD if self.preview else 0
        return small + (self.described.size + _OVERHEAD if self.whole is not None else 0)


def framed(tree: Any) -> Any:
    return mapped(tree, lambda it: Frame(it) if isinstance(it, CONTENTS) else it)


def thawed(tree: Any) -> Any:
    return mapped(tree, lambda it: (it.described if it.whole is None else it.whole) if isinstance(it, Frame) else it)


def described(value: Any) -> Unfetched:
    if isinstance(value, Unfetched):
        return value
    if isinstance(value, Frame):
        return value.described
    if isinstance(value, np.ndarray):
        return Unfetched("numpy", *_NUMPY.describe(value))
    if isinstance(value, bytes):
        return Unfetched("bytes", len(value), "bytes")
    if isinstance(value, EncodedImage):
        return Unfetched(value.label, len(value.data), value.summary)
    if isinstance(value, Unreadable):
        return Unfetched("unreadable", 0, value.reason)
    return Unfetched(type(value).__name__, 0, "")


def tree_of(text: bytes, name: str) -> Any:
    """Return the tree in a document's text, an `Unfetched` in the place of each placeholder. Raises BadData.

    In the place of something that looks like a placeholder and is none there is an `Unreadable`.
    """
    try:
        holder = [orjson.loads(text)]
    except orjson.JSONDecodeError as error:  # nested too deep, or not from RedisJSON
        raise BadData(f"{name}: what the server sent is not JSON: {error}") from None
    for slot in find(holder, name, []) if marked(text) else ():
        it = slot.placeholder
        slot.container[slot.key] = Unfetched(it.label, it.size, it.summary)
    return holder[0]


def same(one: Any, other: Any) -> bool:
    """Return whether two trees are equal, as far as is known: of arrays, that they are alike."""
    if one is other:
        return True
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(item, other[key]) for key, item in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    # Types too: 1, 1.0 and True are equal in Python, but not the same value for a reader.
    if isinstance(one, _SCALARS) or isinstance(other, _SCALARS):
        return type(one) is type(other) and bool(one == other)
    facts = [(it.label, it.size, it.summary) for it in (described(one), described(other))]
    return facts[0] == facts[1]


def is_kept(one: Any, other: Any) -> bool:
    """Return whether the contents of two arrays, or bytes, that were read are known to be equal, bit by bit."""
    one, other = (it.whole if isinstance(it, Frame) else it for it in (one, other))
    if one is other:  # not read twice: nothing newer is known
        return False
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return isinstance(one, bytes | EncodedImage) and type(one) is type(other) and bool(one == other)


def strip(tree: Any) -> Any:
    """Return `tree` with an `Unfetched` in the place of everything that a ship carries, but what a `Frame` holds."""
    kept = (Frame, Unreadable, *_SCALARS)
    return mapped(tree, lambda it: it if isinstance(it, kept) or it is MISSING else described(it))


def weight(tree: Any) -> int:
    """Return about how many bytes of memory a tree takes, without what is in its frames."""
    total = 0
    for _, it in walk(tree, ()):
        if isinstance(it, np.ndarray):
            total += it.nbytes + _OVERHEAD
        elif isinstance(it, EncodedImage):
            total += len(it.data) + _OVERHEAD
        elif isinstance(it, bytes | str):
            # What objects of Python take besides their content, about.
            total += len(it) + 80
        else:
            total += 100
    return total


_MOST_LEAVES = 5000  # of a tree of which the size is shown


def leaves_size(tree: Any) -> int | None:
    """Return the bytes of all values in a tree, as the rows of each show them; None if there are too many to count."""
    total = 0
    for number, (_, it) in enumerate(walk(tree, ())):
        if number >= _MOST_LEAVES:
            return None
        if isinstance(it, str):
            total += len(it.encode(errors="replace"))
        elif isinstance(it, _SCALARS):
            total += 8
        elif not isinstance(it, dict | list):
            total += described(it).size
    return total


_MOST_NAMED = 5  # types that change, in one message
_WHOLE = 1 << 63  # larger integers cannot be stored, and some are beyond any float


def fitted(old: Any, new: Any, path: Path) -> tuple[Any, list[str]]:
    """Return a new value with floats where there were floats, and what has another type than the old one, in words."""
    if type(old) is float and type(new) is int and abs(new) <= _WHOLE and float(new) == new:
        return float(new), []
    if type(old) is not type(new):
        return new, [f"{show(path)}: {type(old).__name__} becomes {type(new).__name__}"]
    retyped: list[str] = []
    if isinstance(new, dict | list):
        common = [key for key in new if key in old] if isinstance(new, dict) else range(min(len(old), len(new)))
        new = copy.copy(new)
        for key in common:
            new[key], found = fitted(old[key], new[key], (*path, key))
            retyped += found
    return new, retyped[:_MOST_NAMED]


# What has another value at one instant than at another.


def differing(paths: Iterable[Path], before: Callable[[str], Any], after: Callable[[str], Any], most: int) -> set[Path]:
    """Return which paths at and below those that were published have another value, at most so many.

    An array whose items are not known at both instants counts as changed, since it was published. `before` and `after`
    return the tree of a top-level key at one instant and at the other.
    """
    trees: dict[str, tuple[Any, Any]] = {}
    found: set[Path] = set()
    for path in paths:
        name = str(path[0])
        if name not in trees:
            trees[name] = before(name), after(name)
        old, new = (get(tree, path[1:]) for tree in trees[name])
        # No more than asked for: a list of a hundred thousand numbers may have changed as a whole.
        found.update(islice(_differing(old, new, path), most - len(found)))
    return found


def _differing(old: Any, new: Any, path: Path) -> Iterator[Path]:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in old.keys() | new.keys():
            yield from _differing(old.get(key, MISSING), new.get(key, MISSING), (*path, key))
    elif isinstance(old, list) and isinstance(new, list):
        items = [_at(old, index, new, (*path, index)) for index in range(max(len(old), len(new)))]
        inside = [each for item in items for each in item]
        if any(not isinstance(item, dict | list) for item in new) and inside:
            yield path  # its row shows its items
        yield from inside
    elif not _equal(old, new):
        yield from (where for where, _ in walk(new, path))


def _at(old: list[Any], index: int, new: list[Any], path: Path) -> list[Path]:
    one, other = (items[index] if index < len(items) else MISSING for items in (old, new))
    return list(_differing(one, other, path))


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, (Frame, *CONTENTS)):
        return is_kept(one, other)
    plain = all(isinstance(it, str | bool | int | float | None) for it in (one, other))
    return plain and same(one, other)
