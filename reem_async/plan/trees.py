"""Immutable trees: local copies of documents, how updates change them, and which updates a read value contains.

An update makes new containers along its path and shares the rest, so a reader that holds the old tree keeps the old
instant. The rules are those of the server, so a copy that applies every update stays equal to the document.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from ..errors import BadKey
from .notices import ANNOUNCED, Notice
from .paths import Path, below, check_element
from .placeholders import Unreadable


class _Missing:
    def __repr__(self) -> str:
        return "MISSING"


MISSING: Final = _Missing()  # in the place of a tree or value that does not exist
_SHARED = frozenset({str, int, float, bool, type(None), bytes, np.ndarray})
"""Types of leaves that are never changed in place: arrays of a copy are read-only."""


class CannotApply(Exception):
    """The update does not fit the tree: its parent is missing or cannot hold it."""


def get(tree: Any, path: Path) -> Any:
    """Return the value at `path`, or MISSING; inside of an Unreadable, that."""
    for key in path:
        if isinstance(key, str):
            tree = tree.get(key, MISSING) if type(tree) is dict else _inside(tree)
        else:
            tree = tree[key] if type(tree) is list and -len(tree) <= key < len(tree) else _inside(tree)
    return tree


def _inside(tree: Any) -> Any:
    return tree if type(tree) is Unreadable else MISSING


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
        items = tree.copy()
        items[key] = replaced(items[key], rest, value)
        return items
    raise CannotApply


def removed(tree: Any, path: Path) -> Any:
    """Return `tree` without the value at `path`; the same tree if there is none."""
    if get(tree, path) is MISSING:
        return tree
    if not path:
        return MISSING
    parent = get(tree, path[:-1])
    if type(parent) is Unreadable:
        raise CannotApply
    parent = parent.copy()
    del parent[path[-1]]
    return replaced(tree, path[:-1], parent)


def changed(tree: Any, path: Path, value: Any) -> Any:
    """Return `tree` with `value` at `path` (MISSING removes what is there); unchanged where the server would refuse."""
    try:
        return removed(tree, path) if value is MISSING else replaced(tree, path, value)
    except CannotApply:
        return tree


def mapped(tree: Any, convert: Callable[[Any], Any]) -> Any:
    """Return a copy of `tree` with each leaf as `convert` returns it.

    An entry of a dict for which it returns MISSING is left out. An item of a list becomes None: the others keep their
    places.
    """
    kind = type(tree)
    if kind is dict:
        items = {key: mapped(item, convert) for key, item in tree.items()}
        return {key: item for key, item in items.items() if item is not MISSING}
    if kind is list:
        found = [mapped(item, convert) for item in tree]
        return [None if item is MISSING else item for item in found]
    return convert(tree)


def walk(tree: Any, path: Path) -> Iterator[tuple[Path, Any]]:
    """Yield every path in `tree`, which is at `path`, and what is there; parents first."""
    # No recursion: documents may be nested a hundred deep, and a generator for each level is slow.
    stack = [(path, tree)]
    while stack:
        where, it = stack.pop()
        yield where, it
        if type(it) is dict:
            stack.extend([((*where, key), item) for key, item in reversed(it.items())])
        elif type(it) is list:
            stack.extend([((*where, key), it[key]) for key in reversed(range(len(it)))])


def copied(tree: Any) -> Any:
    """Return `tree` with containers of its own, for a user to keep.

    Immutable leaves are shared, arrays too. Objects that a user's own ship has made are copied by `copy.deepcopy`, or
    shared if that fails.
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


def same(one: Any, other: Any) -> bool:
    """Return whether two trees are equal, type by type and bit by bit."""
    if one is other:
        return True
    kind = type(one)
    if kind is not type(other):
        return False
    if kind is dict:
        return one.keys() == other.keys() and all(same(item, other[key]) for key, item in one.items())
    if kind is list:
        return len(one) == len(other) and all(map(same, one, other))
    if kind is np.ndarray:
        return _same_arrays(one, other)
    try:
        return bool(one == other) and (kind is not float or one != 0 or str(one) == str(other))  # -0.0 == 0.0
    except Exception:  # types of a user's ship may raise anything
        return False


def _same_arrays(one: Any, other: Any) -> bool:
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    if not one.nbytes:
        return True
    # As bytes, since NaN is not equal to itself, and 0.0 is equal to -0.0.
    return np.array_equal(one.reshape(-1).view(np.uint8), other.reshape(-1).view(np.uint8))


def is_addressable(key: str | int) -> bool:
    try:
        check_element(key, ())
    except BadKey:
        return False
    return True


def difference(old: Any, new: Any, same: Callable[[Any, Any], bool] = same) -> Path | None:
    """Return the path of the deepest place that holds all differences between two trees; None if they are equal.

    It may be an entry of a dict that only one tree has. It is not inside of a list of another length, since the items
    that came or went are unknown, nor at an entry of a dict that no path can address.
    """
    path: list[str | int] = []
    while True:
        if type(old) is dict and type(new) is dict:
            differing = [key for key, item in new.items() if key not in old or not same(old[key], item)]
            differing += [key for key in old if key not in new]
        elif type(old) is list and type(new) is list and len(old) == len(new):
            differing = [place for place, item in enumerate(new) if not same(old[place], item)]
        else:
            return None if same(old, new) else tuple(path)
        if not differing:
            return None
        key = differing[0]
        # Several entries differ: this is the place. One differs: the place may be deeper inside.
        if len(differing) > 1 or not is_addressable(key):
            return tuple(path)
        path.append(key)
        if type(new) is dict and (key not in old or key not in new):
            return tuple(path)
        old, new = old[key], new[key]


class AnnouncedChange(Protocol):
    @property
    def path(self) -> Path: ...

    @property
    def deleted(self) -> bool: ...


def concerns(notice: AnnouncedChange, followed: Path) -> bool:
    """Return whether an update may change the value at the followed path."""
    for position, (theirs, ours) in enumerate(zip(notice.path, followed, strict=False)):
        if theirs == ours:
            continue
        if not isinstance(theirs, int) or not isinstance(ours, int):
            return False
        # Another item of the same list: it may be the same one if ours counts from the end, and a deletion moves ours.
        return ours < 0 or (notice.deleted and position == len(notice.path) - 1)
    return True


def is_whole(notice: Notice, followed: Path, tree: Any) -> bool:
    """Return whether the notice and the old `tree` suffice to know the new value at the followed path."""
    if notice.path[: len(followed)] != followed[: len(notice.path)]:
        return False
    if notice.deleted:  # deleting an item of a list moves the next one to its place
        return len(notice.path) > len(followed) or not (notice.path and isinstance(notice.path[-1], int))
    if notice.value is ANNOUNCED:
        return False
    # The server may have refused it because the parent is missing; where a value was, there is a parent.
    return not notice.path or len(notice.path) > len(followed) or tree is not MISSING


def applied(tree: Any, notice: Notice, followed: Path) -> Any:
    """Return the local copy after an update; raises CannotApply."""
    if len(notice.path) <= len(followed):
        return MISSING if notice.deleted else get(notice.value, followed[len(notice.path) :])
    inner = notice.path[len(followed) :]
    return removed(tree, inner) if notice.deleted else replaced(tree, inner, notice.value)


# A large update is only announced. A subscriber reads its value a little later, when newer updates may have changed it.
# The transaction that reads also reads `{foo}:last`: publisher and number of the last update that is in the value. All
# updates of a top-level key come in one order, so this note draws a line through them:
#
#       updates, in their order                      read: {image, n: 1, state: "done"}, and the note "p 2"
#     --------------------------------------------------------------------------------------------------------
#       p 1   cam = {image, n: 1, state: "raw"}      announced          |
#       p 2   cam.state = "done"                     with its value     |   all of these are in what was read,
#     . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . .  the line
#       p 3   cam.n = 5                              with its value         and none of these
#
# The value read is that of p 1 only if no update between p 1 and the line touched its place. Here p 2 did: the "raw"
# of p 1 is lost. So p 1 is skipped and counted; it is never delivered with a value that it did not have. What is left
# of p 1 depends on the place that the later update touched:
#
#     the same place, or one that holds it    nothing: the later update has replaced it
#     inside of it, through dicts only        all but that place: {image, n: 1}. With it, and then p 2, a copy equals
#                                             the server's document after p 2
#     inside of a list in it                  items may have moved, and deleting one twice deletes two. The list is
#                                             left out too; the list that was read is that of the last update inside it
#
# Updates behind the line are applied to the value read, as to any copy. If the note names an update that did not
# arrive although all from before the read have arrived, updates were lost: the others are skipped, and the key is read
# again.


class Rest(NamedTuple):
    value: Any  # its value without the places that were touched; MISSING if nothing is left
    # The lists (full paths) to take from the value read, and the position of the later update behind which.
    lists: dict[Path, int]


def is_own(path: Path, later: Iterable[AnnouncedChange]) -> bool:
    """Return whether the value read at `path` is still that of an update, though it has the `later` ones too."""
    return not any(concerns(each, path) for each in later)


def rest_of(value: Any, path: Path, later: Sequence[AnnouncedChange]) -> Rest:
    """Return what is left of an update of `path`, given the `value` read there, which has the `later` ones too."""
    lists: dict[Path, int] = {}
    for each in later:
        if not concerns(each, path):
            continue
        if below(path, each.path):
            value = MISSING
            continue
        # An item of a list on the way to `path` was deleted, if the other path is not inside of it.
        inside = below(each.path, path)
        start, touched = (len(path), each.path) if inside else (0, path)
        end = next((place for place in range(start, len(touched)) if isinstance(touched[place], int)), None)
        value = removed(value, touched[start:end]) if inside else MISSING
        if end is not None:
            lists[touched[:end]] = -1
    for touched in tuple(lists):
        place = max(place for place, each in enumerate(later) if concerns(each, touched))
        if below(touched, later[place].path):  # it was written as a whole
            del lists[touched]
        else:
            lists[touched] = place
    return Rest(value, lists)
