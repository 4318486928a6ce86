"""Rebuilding what a key held at an instant from what was recorded of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ...plan.paths import Path, Pattern
from ...plan.trees import MISSING, CannotApply, difference, get, is_addressable, removed, replaced, same
from ...plan.unreadable import Unreadable
from .roles import Kind, Role
from .stored import LOST, Stored

__all__ = ["applied", "differing", "planted", "pruned", "without"]

# Items: an index that somebody made up must not make a list of millions.
_LONGEST_PADDING = 10_000


def planted(tree: Any, path: Path, value: Any) -> Any:
    """Return `tree` with `value` at `path`, making the parents that are not there.

    For what was sampled: only this path was looked at, so nobody knows what is around it. Missing items of
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
    if role == Role.DELETE:
        return without(tree, path, kind)
    if kind == Kind.READ:
        return planted(tree, path, value)
    try:
        return replaced(tree, path, value)
    except CannotApply:
        return tree


def without(tree: Any, path: Path, kind: Kind) -> Any:
    """Return `tree` after a recorded deletion of `path`; behind an item that a sample did not find, there is none."""
    if kind != Kind.READ or not path or isinstance(path[-1], str):
        return removed(tree, path)
    items = get(tree, path[:-1])
    return replaced(tree, path[:-1], items[: path[-1]]) if type(items) is list else tree


def differing(known: Any, tree: Any, whole: Any) -> list[Path]:
    """Return the deepest places that hold all that differs between what is known and a tree.

    One, unless `whole` has more there than is compared, as a dict has with samples in it that no pattern names. These
    are to stay, so it is a place for each entry that differs.
    """
    inner = difference(known, tree)
    if inner is None:
        return []
    here, now, all_of_it = get(known, inner), get(tree, inner), get(whole, inner)
    if type(here) is not dict or type(now) is not dict or type(all_of_it) is not dict or same(here, all_of_it):
        return [inner]
    names = {**here, **now}
    if not all(map(is_addressable, names)):
        return [inner]
    return [
        (*inner, key, *rest)
        for key in names
        for rest in differing(here.get(key, MISSING), now.get(key, MISSING), all_of_it.get(key, MISSING))
    ]


def pruned(tree: Any, path: Path, patterns: Iterable[Pattern]) -> Any:
    """Return what is at the full `path` without what none of the patterns name; MISSING if that is nothing at all.

    A dict on the way to what they name stays, though it be empty: an update inside of it needs it.
    """
    wanted = [pattern for pattern in patterns if pattern.concerns(path)]
    if any(len(pattern.rest) < len(path) for pattern in wanted):
        return tree
    # The items keep their places, also those of a long list that has a message of its own.
    if wanted and (type(tree) in (list, Unreadable) or (type(tree) is Stored and tree.label in ("list", LOST))):
        return tree
    if type(tree) is not dict or not wanted:
        return MISSING
    left = {key: pruned(item, (*path, key), wanted) for key, item in tree.items()}
    return {key: item for key, item in left.items() if item is not MISSING}
