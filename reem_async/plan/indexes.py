"""Indexes that count from the end: which items they name at the instant of their look."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ..errors import MissingKey
from . import Command, Reply
from .keys import Keys
from .paths import Path, show, to_jsonpath
from .replies import explained, full

__all__ = ["from_front", "lengths"]


def lengths(keys: Keys, path: Path) -> list[Command]:
    """Return the commands that `from_front` takes the replies of: how long lists are that are counted from the end."""
    return [("JSON.ARRLEN", keys.document, to_jsonpath(path[:position])) for position in _from_end(path)]


def from_front(replies: Sequence[Reply], keys: Keys, path: Path, absent: type[Exception]) -> Path:
    """Return `path` with every index counted from the front; raises `absent` if there is no such item."""
    # Which item -1 names is true for one instant only, so whoever uses the result watches the document, and starts
    # again if it was changed.
    front = list(path)
    for position, reply in zip(_from_end(path), replies, strict=True):
        index = path[position]
        count = _count(reply, keys, path, absent)
        where = show(full(keys, path))
        if count is None:
            raise absent(f"{where}: there is no list at {show(full(keys, path[:position]))}")
        if count + int(index) < 0:
            raise absent(f"{where}: the index {index} is out of range, the list has {count} items")
        front[position] = count + int(index)
    return tuple(front)


def _from_end(path: Path) -> Iterator[int]:
    return (position for position, key in enumerate(path) if isinstance(key, int) and key < 0)


def _count(reply: Reply, keys: Keys, path: Path, absent: type[Exception]) -> int | None:
    """Return the number in a reply to JSON.ARRLEN, None if there is no list."""
    if isinstance(reply, Exception):
        error = explained(reply, keys, path)
        raise absent(str(error)) if isinstance(error, MissingKey) else error
    count: int | None = reply[0] if reply else None
    return count
