"""Recorded trees: values that have a message of their own, and what a key held after one update more.

In a tree, a `Reference` represents an array, bytes, a long list of numbers or a value of a custom type. It has the type
and the place in the file. So a tree can be looked at, kept and written again without touching a single array.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ...plan.paths import Path, Pattern, show
from ...plan.placeholders import Unreadable
from ...plan.trees import MISSING, changed, get, mapped, removed, replaced
from ...ships.images import EncodedImage
from ...ships.numpy import NumpyShip
from .format import Kind, Role
from .output import slices

_LONGEST_INLINE = 64
"""Numbers up to which an array or a list stays in the JSON: viewers draw a curve for each of them."""

LOST = "lost"
"""The label of what could not be recorded."""


class Content:
    """The bytes of one value, which must not change; later only a digest of them, to compare it when it is read again.

    Most values are never read again: a frame of a camera is replaced long before. So the bytes are kept until the next
    keyframe, which digests those that are still there.
    """

    __slots__ = ("_digest", "_pieces")

    def __init__(self, head: bytes, body: Any = b"") -> None:
        self._pieces: tuple[bytes, Any] | None = head, body
        self._digest = b""

    def digest(self) -> bytes:
        """Return 16 bytes that tell it from any other, and let go of its own."""
        if self._pieces is not None:
            head, body = self._pieces
            total = hashlib.blake2b(digest_size=16, salt=hashlib.blake2b(head, digest_size=16).digest())
            for part in slices([body]):
                total.update(part)
            # The digest takes the place of the bytes, which may be a frame of a camera.
            self._digest, self._pieces = total.digest(), None
        return self._digest


@dataclass(frozen=True, slots=True)
class Reference:
    """A value in a message of its own, at a full path and a log time in ns.

    While it is recorded, it also has what is not in the file: its content, to tell whether it has changed, and the
    numbers of a list, one of which may be updated.
    """

    label: str  # "numpy", "bytes", "list" (a list of numbers, stored as an array), or a custom ship's label
    path: Path
    at: int
    size: int
    summary: str = ""  # for people: "uint8[480,640,3]"
    dtype: str = ""
    shape: tuple[int, ...] | None = None  # of an array
    content: Content | None = field(default=None, compare=False, repr=False)
    numbers: np.ndarray[Any, Any] | None = field(default=None, compare=False, repr=False)
    where: Any = None  # the message that has it, in a file of another program

    @property
    def shown(self) -> str:
        return show(self.path)


_NUMPY = NumpyShip()


def reference_to(label: str, path: Path, at: int, value: Any, content: Content | None = None) -> Reference:
    """Return what stands for an array, bytes or a picture."""
    if isinstance(value, EncodedImage):
        return Reference(label, path, at, len(value.data), value.summary, value.dtype, value.shape, content)
    if isinstance(value, np.ndarray):
        size, summary = _NUMPY.describe(value)
        numbers = value if label == "list" else None
        return Reference(label, path, at, size, summary, summary.partition("[")[0], value.shape, content, numbers)
    return Reference(label, path, at, len(value), label, content=content)


class Unchanged:
    """An attachment that was not read again, since the server reported no change of it."""

    __slots__ = ("written",)

    def __init__(self) -> None:
        self.written: Any = None  # what is in trees for it, once the writing thread has written its value


class New(NamedTuple):
    """An attachment that was read, and what is in its place in later reads."""

    value: Any
    later: Unchanged


def carried(tree: Any, before: Any) -> Any:
    """Return what was read, with what an earlier read brought that `before` has and that will not be written itself."""
    news: dict[int, New] = {}
    _collect(before, news)
    if not news:
        return tree
    return mapped(tree, lambda it: news.get(id(it), it) if type(it) is Unchanged else it)


def _collect(tree: Any, news: dict[int, New]) -> None:
    if type(tree) is New:
        news[id(tree.later)] = tree
    for child in tree.values() if type(tree) is dict else tree if type(tree) is list else ():
        _collect(child, news)


class NotWritten(Exception):
    """What was read before of an attachment never reached the file: it has to be read again."""


Store = Callable[[str, Path, Any], Reference]
"""Writes a value (its label, its full path, itself) as a message and returns what stands for it."""


def is_inline(array: np.ndarray[Any, Any]) -> bool:
    """Return whether an array is a few plain numbers, which viewers want to plot."""
    return array.size <= _LONGEST_INLINE and array.dtype.kind in "biuf"


def extract(value: Any, path: Path, store: Store) -> Any:
    """Return `value`, at the full `path`, with everything that gets a message of its own replaced by `Reference`.

    Containers in which nothing was replaced are shared with `value`. Raises NotWritten.
    """
    kind = type(value)
    if kind is New:
        value.later.written = extract(value.value, path, store)
        return value.later.written
    if kind is Unchanged:
        if value.written is None:
            raise NotWritten
        return value.written
    if kind is dict:
        items = {key: extract(item, (*path, key), store) for key, item in value.items()}
        return items if any(items[key] is not item for key, item in value.items()) else value
    if kind is list:
        # A list of numbers goes as an array: as JSON it would take several times the room, and a curve for each number.
        if len(value) > _LONGEST_INLINE and (array := _numbers(value)) is not None:
            return store("list", path, array)
        found = [extract(item, (*path, index), store) for index, item in enumerate(value)]
        return found if any(new is not old for new, old in zip(found, value, strict=True)) else value
    if kind in _PLAIN or (kind is np.ndarray and is_inline(value)):
        return value
    if isinstance(value, EncodedImage):
        return store(value.label, path, value)
    label = "numpy" if kind is np.ndarray else "bytes" if kind is bytes else ""
    return store(label, path, value)


_PLAIN = frozenset({str, int, float, bool, type(None), Reference})


def _numbers(values: list[Any]) -> np.ndarray[Any, Any] | None:
    """Return an array that gives the very list back by `tolist()`, or None."""
    kinds = set(map(type, values))
    if kinds == {float}:
        return np.array(values)
    if kinds == {int} and min(values) >= -(2**63) and max(values) < 2**63:
        return np.array(values, np.int64)
    return None


def resolve(tree: Any, load: Callable[[Reference], Any]) -> Any:
    """Return a copy of `tree` with every `Reference` replaced by what `load` makes of it.

    What it makes MISSING of is left out, as in `mapped`.
    """
    return mapped(tree, lambda it: load(it) if type(it) is Reference else it)


def opened(tree: Any, path: Path, load: Callable[[Reference], Any]) -> Any:
    """Return `tree` with the long list on the way to `path`, if there is one, as the list that `load` makes of it."""
    it = tree
    for depth, key in enumerate(path):
        if type(it) is Reference:
            return replaced(tree, path[:depth], load(it)) if it.label == "list" else tree
        it = get(it, (key,))
    return tree


# Items: a made-up index must not make a list of millions.
_LONGEST_PADDING = 10_000


def planted(tree: Any, path: Path, value: Any) -> Any:
    """Return `tree` with `value` at `path`, making the parents that are not there.

    For what was sampled: only this path was looked at, so what is around it is unknown. Missing items of
    a list before it are None.
    """
    if not path:
        return value
    key, rest = path[0], path[1:]
    if isinstance(key, str):
        known = tree if type(tree) is dict else {}
        return {**known, key: planted(known.get(key, MISSING), rest, value)}
    items = list(tree) if type(tree) is list else []
    if not -len(items) <= key < _LONGEST_PADDING:
        return items
    items += [None] * (key + 1 - len(items))
    items[key] = planted(items[key], rest, value)
    return items


def applied(tree: Any, path: Path, role: Role, kind: Kind, value: Any) -> Any:
    """Return `tree` after one recorded update of `path`; unchanged where the server had refused it."""
    if kind != Kind.READ:
        return changed(tree, path, MISSING if role == Role.DELETE else value)
    return without(tree, path, kind) if role == Role.DELETE else planted(tree, path, value)


def without(tree: Any, path: Path, kind: Kind) -> Any:
    """Return `tree` after a recorded deletion of `path`; behind an item that a sample did not find, there is none."""
    if kind != Kind.READ or not path or isinstance(path[-1], str):
        return removed(tree, path)
    items = get(tree, path[:-1])
    return replaced(tree, path[:-1], items[: path[-1]]) if type(items) is list else tree


def pruned(tree: Any, path: Path, patterns: Iterable[Pattern]) -> Any:
    """Return what is at the full `path` without what none of the patterns name; MISSING if that is nothing at all.

    A dict on the way to what they name stays, though it be empty: an update inside of it needs it.
    """
    wanted = [pattern for pattern in patterns if pattern.concerns(path)]
    if any(len(pattern.rest) < len(path) for pattern in wanted):
        return tree
    # The items keep their places, also those of a long list that has a message of its own.
    if wanted and (type(tree) in (list, Unreadable) or (type(tree) is Reference and tree.label in ("list", LOST))):
        return tree
    if type(tree) is not dict or not wanted:
        return MISSING
    left = {key: pruned(item, (*path, key), wanted) for key, item in tree.items()}
    return {key: item for key, item in left.items() if item is not MISSING}
