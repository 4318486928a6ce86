"""What the documented calls do, told with a plain dict. Knows nothing of Redis."""

from __future__ import annotations

import copy
import math
import numbers
from typing import Any, NamedTuple

import numpy as np

from reem_async.errors import (
    BadInput,
    BadKey,
    BadType,
    MissingKey,
    Overflow,
    PathRefused,
    WriteOnly,
    WrongType,
)


class _Absent:
    def __repr__(self) -> str:
        return "ABSENT"

    def __deepcopy__(self, memo: Any) -> _Absent:
        return self


ABSENT: Any = _Absent()
"""Nothing is stored there."""


class Op(NamedTuple):
    """One call: what, where (the top-level key first), and with what."""

    name: str
    path: tuple[Any, ...]
    value: Any = None
    refused: type[Exception] | None = None  # what is wrong with the value

    def __repr__(self) -> str:
        value = "a bad value, " + type(self.value).__name__ if self.refused else repr(self.value)
        text = f"{self.name} {self.path!r} {value}"
        return text if len(text) < 240 else text[:237] + "..."


class Expected(NamedTuple):
    """What has to come of a call: the document after it, what it returns or raises."""

    after: Any
    result: Any = None
    error: type[Exception] | tuple[type[Exception], ...] | None = None


READS = ("read", "get", "length", "type", "get_dotted", "contains", "entries", "has")
CHANGES = (
    "write", "delete", "increment", "decrement", "multiply", "divide", "append", "extend", "edit", "set_dotted",
    "pop", "setdefault", "update",
)  # fmt: skip
CALCULATIONS = ("increment", "decrement", "multiply", "divide")
ANSWERING = (*READS, *CALCULATIONS, "pop", "setdefault")
"""Calls that return something."""
READING = ("read", "get", "length", "type", "get_dotted", "entries", "has", "edit", "pop", "setdefault")
"""Calls that a PublishSpace refuses."""


def refused_as_top(top: Any, namespace: str) -> bool:
    """Return whether it cannot name a top-level key."""
    if not isinstance(top, str) or not top or "{" in top or "}" in top:
        return True
    try:
        return len((namespace + top).encode()) > 512
    except UnicodeEncodeError:
        return True


def refused_in_path(key: Any) -> bool:
    """Return whether it cannot be an element of a path."""
    if isinstance(key, str):
        try:
            key.encode()
        except UnicodeEncodeError:
            return True
        return key.startswith(" ") or "\\" in key or ("'" in key and '"' in key)
    if isinstance(key, bool) or not isinstance(key, numbers.Integral):
        return True
    return not -(2**63) <= key < 2**63


def as_read(value: Any) -> Any:
    """Return a value as it comes back, in containers of its own."""
    if isinstance(value, np.generic) and not isinstance(value, np.void):
        return value.item()
    if isinstance(value, dict):
        return {key: as_read(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_read(item) for item in value]
    if isinstance(value, bytearray | memoryview):
        return bytes(value)
    return copy.deepcopy(value)


def found(tree: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        named = isinstance(tree, dict) and isinstance(key, str) and key in tree
        counted = isinstance(tree, list) and not isinstance(key, str) and -len(tree) <= key < len(tree)
        if not named and not counted:
            return ABSENT
        tree = tree[key]
    return tree


def edited(value: Any, new: Any) -> None:
    """Change what `edit` brought, the same way for the model as for REEM."""
    if isinstance(value, dict):
        value[str(new[0])] = new[1]
    elif isinstance(value, list):
        value.append(new[1])
    elif value.size:
        value.reshape(-1)[0] = value.reshape(-1)[-1]


class Place:
    """What the calls do to one place of a document."""

    def __init__(self, document: Any, path: tuple[Any, ...]) -> None:
        self.root = [] if document is ABSENT else [copy.deepcopy(document)]
        self.path = (0, *path)
        self.parent = found(self.root, self.path[:-1])
        self.here = found(self.root, self.path)

    def _now(self, result: Any = None) -> Expected:
        return Expected(self.root[0] if self.root else ABSENT, result)

    def _raised(self, error: type[Exception]) -> Expected:
        return self._now()._replace(error=error)

    def read(self, _: Any = None) -> Expected:
        if self.here is ABSENT and self.root:
            return self._raised(MissingKey)
        return self._now(None if self.here is ABSENT else self.here)

    def get(self, default: Any) -> Expected:
        return self._now(default if self.here is ABSENT else self.here)

    def get_dotted(self, _: Any) -> Expected:
        return self._raised(MissingKey) if self.here is ABSENT else self._now(self.here)

    def contains(self, _: Any) -> Expected:
        return self._now(bool(self.root))

    def length(self, _: Any) -> Expected:
        if self.here is ABSENT:
            return self._raised(MissingKey)
        try:
            return self._now(len(self.here))
        except TypeError:
            return self._raised(WrongType)

    def type(self, _: Any) -> Expected:
        return self._raised(MissingKey) if self.here is ABSENT else self._now(type(self.here))

    def write(self, value: Any) -> Expected:
        value = as_read(value)
        if len(self.path) == 1:
            return Expected(value)
        key, parent = self.path[-1], self.parent
        if not self.root and len(self.path) == 2 and isinstance(key, str) and isinstance(value, bytes | np.ndarray):
            return Expected({key: value})  # what goes by ship makes the dict it is in
        if self.here is ABSENT and not (isinstance(parent, dict) and isinstance(key, str)):
            return self._raised(PathRefused)
        parent[key] = value
        return self._now()

    set_dotted = write

    def delete(self, _: Any = None) -> Expected:
        if self.here is ABSENT:
            return self._raised(MissingKey)
        del self.parent[self.path[-1]]
        return self._now()

    def entries(self, _: Any) -> Expected:
        if not isinstance(self.here, dict):
            return self._raised(MissingKey if self.here is ABSENT else WrongType)
        return self._now(sorted(self.here))

    def has(self, _: Any) -> Expected:
        if not isinstance(self.parent, dict) or not self.root:
            return self._raised(MissingKey if self.parent is ABSENT or not self.root else WrongType)
        return self._now(self.here is not ABSENT)

    def pop(self, _: Any) -> Expected:
        if self.here is ABSENT:
            return self._raised(MissingKey)
        return self.delete()._replace(result=self.here)

    def setdefault(self, default: Any) -> Expected:
        if self.here is not ABSENT:
            return self._now(self.here)
        if not isinstance(self.parent, dict):
            return self._raised(PathRefused)
        return self.write(default)._replace(result=as_read(default))

    def update(self, values: Any) -> Expected:
        if not values:
            return self._now()
        if not isinstance(self.here, dict):
            return self._raised(PathRefused)
        self.here.update(as_read(values))
        return self._now()

    def append(self, value: Any) -> Expected:
        return self.extend([value])

    def extend(self, values: Any) -> Expected:
        if not values:
            return self._now()
        if not isinstance(self.here, list):
            return self._raised(MissingKey if self.here is ABSENT else WrongType)
        self.here.extend(as_read(values))
        return self._now()

    def edit(self, new: Any) -> Expected:
        if self.here is ABSENT:
            return self._raised(MissingKey)
        if not isinstance(self.here, dict | list | np.ndarray):
            return self._raised(WrongType)
        edited(self.here, as_read(new))
        return self._now()

    def increment(self, number: Any) -> Expected:
        return self._calculated(lambda old: old + number)

    def decrement(self, number: Any) -> Expected:
        return self._calculated(lambda old: old - number)

    def multiply(self, number: Any) -> Expected:
        return self._calculated(lambda old: old * number)

    def divide(self, number: Any) -> Expected:
        if number == 0:
            return self._raised(ZeroDivisionError)
        return self._calculated(lambda old: old / number)

    def _calculated(self, function: Any) -> Expected:
        if type(self.here) not in (int, float):
            return self._raised(MissingKey if self.here is ABSENT else WrongType)
        new = function(self.here)
        if not (math.isfinite(new) if isinstance(new, float) else -(2**63) <= new < 2**63):
            return self._raised(Overflow)
        self.parent[self.path[-1]] = new
        return self._now(new)


def expected(document: Any, op: Op, namespace: str, *, write_only: bool) -> Expected:
    if refused_as_top(op.path[0], namespace):
        return Expected(document, error=BadKey)
    unreadable = write_only and op.name in READING
    if any(map(refused_in_path, op.path[1:])):
        return Expected(document, error=(BadInput, WriteOnly) if unreadable else BadInput)
    if unreadable:
        return Expected(document, error=WriteOnly)
    if op.name in CALCULATIONS and (isinstance(op.value, bool) or not isinstance(op.value, int | float)):
        return Expected(document, error=BadType)
    if op.refused is not None and op.name not in ("edit", "setdefault"):
        return Expected(document, error=op.refused)
    place = Place(document, op.path[1:])
    if op.refused is not None and op.name == "setdefault":
        return Expected(document, place.here) if place.here is not ABSENT else Expected(document, error=op.refused)
    if op.refused is not None:
        there = place.edit((0, None))
        refused = there.error or (op.refused if isinstance(place.here, dict | list) else None)
        return Expected(document, error=refused) if refused else there
    outcome: Expected = getattr(place, op.name)(op.value)
    return outcome if outcome.error is None else outcome._replace(after=document)
