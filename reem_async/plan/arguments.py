"""Refuse wrong arguments where they are given, and operations on a handle that are meant for its value."""

from __future__ import annotations

import math
import operator
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from ..errors import BadType, BadValue
from .paths import Path, shorten, show


def check_number(
    name: str, value: Any, cure: str, *, least: float = 0.0, above: float = -math.inf, most: float = math.inf
) -> None:
    """Raise BadType unless it is a number, and BadValue unless `above` < value and `least` <= value <= `most`."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise BadType(f"{name}={shorten(value)} is not a number; {cure}")
    if not (least <= value <= most and above < value):
        raise BadValue(f"{name}={shorten(value)} is out of range; {cure}")


def whole(name: str, value: Any, cure: str) -> int:
    """Return a whole number of at least 1 as an int; raise BadType or BadValue for anything else."""
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool | np.ndarray):
        raise BadType(f"{name}={shorten(value)} is not a whole number; {cure}")
    check_number(name, number, cure, least=1)
    return number


def check_instance(name: str, value: Any, kind: type[Any] | tuple[type[Any], ...], cure: str) -> None:
    if not isinstance(value, kind):
        raise BadType(f"{name}={shorten(value)} cannot be used; {cure}")


_VALUES = (
    *(str, bytes, bytearray, int, float, complex, list, tuple, dict, set, frozenset, type(None)),
    *(np.ndarray, np.generic),
)


class Handle:
    """A place in the dictionary, equal to other handles of the same place only.

    Python would use it like a value in `if`, `==`, arithmetic and so on: these raise a TypeError that says how to read.
    """

    __slots__ = ()
    _how_to_read = ".read()"

    @property
    def _place(self) -> tuple[object, Path]:
        """The owner, compared by identity, and the path."""
        raise NotImplementedError

    def _no_value(self, what: str) -> NoReturn:
        raise BadType(
            f"{show(self._place[1])}: a handle is a place in the dictionary, not the value there, and has no {what}; "
            f"read it first, with {self._how_to_read}"
        )

    if not TYPE_CHECKING:  # mypy would take every attribute to exist

        def __getattr__(self, name: str) -> NoReturn:
            if name.startswith("_"):  # libraries test whether such attributes exist
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
            raise AttributeError(
                f"{show(self._place[1])}: a handle is a place in the dictionary, not the value there, and has no "
                f"{name!r}; read it first, with {self._how_to_read}, or name a key in brackets, as in [{name!r}]",
                name=name,
                obj=self,
            )

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Handle):
            mine, theirs = self._place, other._place
            return type(self) is type(other) and mine[0] is theirs[0] and mine[1] == theirs[1]
        # `kvs["a"] == 3` is always a mistake. Other types decide themselves: mocks, sentinels, pytest's approx.
        if isinstance(other, _VALUES):
            self._no_value("value to compare")
        return NotImplemented

    def __hash__(self) -> int:
        owner, path = self._place
        return hash((id(owner), path))

    def __bool__(self) -> bool:
        self._no_value("truth")

    def _order(self, _: object) -> NoReturn:
        self._no_value("order")

    __lt__ = __le__ = __gt__ = __ge__ = _order

    def __array__(self, *_: object, **__: object) -> NoReturn:
        self._no_value("items for an array")

    def __format__(self, spec: str) -> str:
        return self._no_value(f"number to format with {spec!r}") if spec else str(self)

    def __iter__(self) -> Any:
        self._no_value("items to go through")

    def __contains__(self, _: object) -> bool:
        self._no_value("items to look among")

    __reversed__ = None  # or Python would make handles of indexes

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {show(self._place[1])}: read its value with {self._how_to_read}>"


def _number(self: Handle, *_: Any) -> Any:
    self._no_value("number")


_NUMBERS = (
    "int index float complex neg abs round add radd sub rsub mul rmul truediv rtruediv floordiv rfloordiv mod rmod "
    "pow rpow"
)
for _name in _NUMBERS.split():
    setattr(Handle, f"__{_name}__", _number)


def cannot_wait(syntax: str, call: str) -> Any:
    """Return a method for syntax that asyncio cannot await; it raises BadType, which names the call to use."""

    def refuse(self: object, *given: object) -> NoReturn:
        raise BadType(f"{syntax} cannot wait for the server; use: {call.format(*given)}")

    return refuse
