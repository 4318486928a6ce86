"""What changed between two instants: not all that was published, but what is another value since."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any

import numpy as np

from ...plan.paths import Path
from ...plan.trees import MISSING, get
from .trees import Frame, same, walk

__all__ = ["differing"]


def differing(paths: Iterable[Path], before: Callable[[str], Any], after: Callable[[str], Any], most: int) -> set[Path]:
    """Return which paths at and below those that were published have another value, at most so many.

    An array whose items are not known at both instants counts as changed, since it was published.

    Args:
        paths: What was published between two instants.
        before: Returns the tree of a top-level key at the first instant.
        after: The same for the second.
        most: How many paths are returned at most.
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
    items, others = (it.whole if isinstance(it, Frame) else it for it in (one, other))
    if isinstance(items, np.ndarray) and isinstance(others, np.ndarray):
        # The bytes, so that NaN is equal to itself.
        return items is not others and items.dtype == others.dtype and items.tobytes() == others.tobytes()
    if isinstance(items, bytes) and isinstance(others, bytes):
        return items is not others and items == others
    plain = all(isinstance(it, str | bool | int | float | None) for it in (one, other))
    return plain and same(one, other)
