"""Where two trees differ."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import BadKey
from .paths import Path, check_element

__all__ = ["difference", "is_addressable", "same"]


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
    except Exception:  # a type that a ship of the user's carries may compare as it likes
        return False


def _same_arrays(one: Any, other: Any) -> bool:
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    if not one.nbytes:
        return True
    # As bytes, since NaN is not equal to itself, and 0.0 is equal to -0.0.
    return np.array_equal(one.reshape(-1).view(np.uint8), other.reshape(-1).view(np.uint8))


def is_addressable(key: str | int) -> bool:
    """Return whether a path can lead through a key."""
    try:
        check_element(key, ())
    except BadKey:
        return False
    return True


def difference(old: Any, new: Any) -> Path | None:
    """Return the path of the deepest place that holds all that differs between two trees; None if nothing does.

    An entry of a dict that is in one of them only is such a place. A list of another length is one as a whole: which of
    its items came or went cannot be seen. So is a dict of which an entry differs that no path can address.
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
        # Several entries differ: what holds all of them is here. One differs: it may be deeper inside.
        if len(differing) > 1 or not is_addressable(key):
            return tuple(path)
        path.append(key)
        if type(new) is dict and (key not in old or key not in new):
            return tuple(path)
        old, new = old[key], new[key]
