"""Values that have a message of their own: arrays, bytes, long lists of numbers, custom types.

In trees they are represented by `Stored`, which says what they are and where in the file to find them, so
that a tree can be looked at, kept and written again without touching a single array.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ...plan.paths import Path, show
from ...plan.trees import MISSING, get, replaced
from .contents import Content

__all__ = [
    "LONGEST_INLINE", "LOST", "New", "NotWritten", "Store", "Stored", "Unchanged", "carried", "extract", "is_inline",
    "opened", "resolve",
]  # fmt: skip

LONGEST_INLINE = 64
"""Numbers up to which an array or a list stays in the JSON: viewers draw a curve for each of them."""

LOST = "lost"
"""The label of what could not be recorded."""


@dataclass(frozen=True, slots=True)
class Stored:
    """A value in a message of its own.

    Attributes:
        label: "numpy", "bytes", "list" (a list of numbers, stored as an array), or a custom ship's label.
        path: The full path under which it was written.
        at: The log time of its message, in ns.
        size: Its bytes.
        summary: What it is, for people: "uint8[480,640,3]".
        dtype: The dtype of an array, for people.
        shape: The shape of an array, None for anything else.
        content: Its bytes, or a digest of them, to tell whether it has changed; not in the file.
        numbers: While it is recorded, the numbers of a list: one of them may be updated.
    """

    label: str
    path: Path
    at: int
    size: int
    summary: str = ""
    dtype: str = ""
    shape: tuple[int, ...] | None = None
    content: Content | None = field(default=None, compare=False, repr=False)
    numbers: np.ndarray[Any, Any] | None = field(default=None, compare=False, repr=False)

    @property
    def shown(self) -> str:
        """The path as people write it."""
        return show(self.path)


class Unchanged:
    """An attachment that was not read again, since the server says that it was not changed. Stands in what is read.

    Attributes:
        written: What stands for it in trees; None until the writing thread has met its value.
    """

    __slots__ = ("written",)

    def __init__(self) -> None:
        self.written: Any = None


class New(NamedTuple):
    """An attachment that was read. Stands in what is read, for the next reads to know what was written for it.

    Attributes:
        value: What the ship made of it.
        later: What stands in its place in later reads.
    """

    value: Any
    later: Unchanged


def carried(tree: Any, before: Any) -> Any:
    """Return what was read, with what an earlier read brought that `before` has and that will not be written itself."""
    news: dict[int, New] = {}
    _collect(before, news)
    return _with(tree, news) if news else tree


def _collect(tree: Any, news: dict[int, New]) -> None:
    if type(tree) is New:
        news[id(tree.later)] = tree
    for child in tree.values() if type(tree) is dict else tree if type(tree) is list else ():
        _collect(child, news)


def _with(tree: Any, news: dict[int, New]) -> Any:
    if type(tree) is dict:
        return {key: _with(child, news) for key, child in tree.items()}
    if type(tree) is list:
        return [_with(child, news) for child in tree]
    return news.get(id(tree), tree) if type(tree) is Unchanged else tree


class NotWritten(Exception):
    """What was read before of an attachment never reached the file: it has to be read again."""


Store = Callable[[str, Path, Any], Stored]
"""Writes a value (its label, its full path, itself) as a message and returns what stands for it."""


def is_inline(array: np.ndarray[Any, Any], longest: int = LONGEST_INLINE) -> bool:
    """Return whether an array is a few plain numbers, which viewers want to plot."""
    return array.size <= longest and array.dtype.kind in "biuf"


def extract(value: Any, path: Path, store: Store, longest: int = LONGEST_INLINE) -> Any:
    """Return `value`, at the full `path`, with everything that gets a message of its own replaced by `Stored`.

    Containers in which nothing was replaced are shared with `value`.

    Raises:
        NotWritten: There is an `Unchanged` of which nothing was written.
    """
    kind = type(value)
    if kind is New:
        value.later.written = extract(value.value, path, store, longest)
        return value.later.written
    if kind is Unchanged:
        if value.written is None:
            raise NotWritten
        return value.written
    if kind is dict:
        items = {key: extract(item, (*path, key), store, longest) for key, item in value.items()}
        return items if any(items[key] is not item for key, item in value.items()) else value
    if kind is list:
        # A list of numbers goes as an array: as JSON it would take several times the room, and a curve for each number.
        if len(value) > longest and (array := _numbers(value)) is not None:
            return store("list", path, array)
        found = [extract(item, (*path, index), store, longest) for index, item in enumerate(value)]
        return found if any(new is not old for new, old in zip(found, value, strict=True)) else value
    if kind in _PLAIN or (kind is np.ndarray and is_inline(value, longest)):
        return value
    label = "numpy" if kind is np.ndarray else "bytes" if kind is bytes else ""
    return store(label, path, value)


_PLAIN = frozenset({str, int, float, bool, type(None), Stored})


def _numbers(values: list[Any]) -> np.ndarray[Any, Any] | None:
    """Return an array that gives the very list back by `tolist()`, or None."""
    kinds = set(map(type, values))
    if kinds == {float}:
        return np.array(values)
    if kinds == {int} and min(values) >= -(2**63) and max(values) < 2**63:
        return np.array(values, np.int64)
    return None


def resolve(tree: Any, load: Callable[[Stored], Any]) -> Any:
    """Return a copy of `tree` with every `Stored` replaced by what `load` makes of it.

    What it makes MISSING of is left out; an item of a list is None then, and the others keep their places.
    """
    kind = type(tree)
    if kind is dict:
        items = {key: resolve(item, load) for key, item in tree.items()}
        return {key: item for key, item in items.items() if item is not MISSING}
    if kind is list:
        found = [resolve(item, load) for item in tree]
        return [None if item is MISSING else item for item in found]
    return load(tree) if kind is Stored else tree


def opened(tree: Any, path: Path, load: Callable[[Stored], Any]) -> Any:
    """Return `tree` with the long list on the way to `path`, if there is one, as the list that `load` makes of it."""
    it = tree
    for depth, key in enumerate(path):
        if type(it) is Stored:
            return replaced(tree, path[:depth], load(it)) if it.label == "list" else tree
        it = get(it, (key,))
    return tree
