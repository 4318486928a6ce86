"""Local copies of documents: trees that are never changed, only replaced.

An update makes new containers along its path and shares the rest, so a reader that holds the old
tree keeps seeing the old instant. The rules are those of the server, so that a copy that follows
every update stays equal to the document.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any, Final

import numpy as np

from .paths import Path

__all__ = ["MISSING", "CannotApply", "copied", "get", "removed", "replaced"]


class _Missing:
    def __repr__(self) -> str:
        return "MISSING"


MISSING: Final = _Missing()
"""Stands for a tree or a value that is not there."""

_SHARED = frozenset({str, int, float, bool, type(None), bytes, np.ndarray})
"""Types of leaves that are never changed in place: arrays of a copy are read-only."""


class CannotApply(Exception):
    """The update does not fit the tree: its parent is not there or cannot hold it."""


def get(tree: Any, path: Path) -> Any:
    """Return what is at `path`, or MISSING."""
    for key in path:
        if isinstance(key, str):
            tree = tree.get(key, MISSING) if type(tree) is dict else MISSING
        else:
            tree = tree[key] if type(tree) is list and -len(tree) <= key < len(tree) else MISSING
    return tree


def replaced(tree: Any, path: Path, value: Any) -> Any:
    """Return `tree` with `value` at `path`; raise CannotApply where the server would refuse."""
    if not path:
        return value
    key, rest = path[0], path[1:]
    if isinstance(key, str) and type(tree) is dict:
        # JSON.SET makes the last element of a path only, never its parents.
        if rest and key not in tree:
            raise CannotApply
        return {**tree, key: replaced(tree.get(key), rest, value)}
    if isinstance(key, int) and type(tree) is list and -len(tree) <= key < len(tree):
        # Only the containers on the way are copied: whoever holds the old tree keeps the old instant.
        items = tree.copy()
        items[key] = replaced(items[key], rest, value)
        return items
    raise CannotApply


def removed(tree: Any, path: Path) -> Any:
    """Return `tree` without what is at `path`; unchanged if nothing is there."""
    if get(tree, path) is MISSING:
        return tree
    if not path:
        return MISSING
    parent = get(tree, path[:-1]).copy()
    del parent[path[-1]]
    return replaced(tree, path[:-1], parent)


def copied(tree: Any) -> Any:
    """Return `tree` with containers of its own, for a user to keep.

    Leaves that cannot be changed are shared, arrays too. Objects that a user's own ship has made are copied by
    `copy.deepcopy`; those that it cannot copy are shared.
    """
    kind = type(tree)
    if kind is dict:
        return {key: value if type(value) in _SHARED else copied(value) for key, value in tree.items()}
    if kind is list:
        return [item if type(item) in _SHARED else copied(item) for item in tree]
    if kind in _SHARED or isinstance(tree, np.ndarray | np.generic) or kind.__module__.startswith("reem_async."):
        return tree
    try:
        return deepcopy(tree)
    except Exception:
        return tree
