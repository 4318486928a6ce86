"""What a handle refuses: an accessor is a place, and Python would take it for its value without a word."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from ..errors import BadType
from .paths import Path, show

__all__ = ["Handle"]

_VALUES = (
    *(str, bytes, bytearray, int, float, complex, list, tuple, dict, set, frozenset, type(None)),
    *(np.ndarray, np.generic),
)


class Handle:
    """A place in the dictionary, which is equal to another handle of the same place and to nothing else.

    It has no truth, no order and no number: what would need them raises a TypeError that says how to read.
    """

    __slots__ = ()
    _how_to_read = ".read()"

    @property
    def _place(self) -> tuple[object, Path]:
        """What tells it from other handles: whose place it is, compared by identity, and the path."""
        raise NotImplementedError

    def _no_value(self, what: str) -> NoReturn:
        raise BadType(
            f"{show(self._place[1])}: a handle is a place in the dictionary, not the value there, and has no {what}; "
            f"read it first, with {self._how_to_read}"
        )

    if not TYPE_CHECKING:  # for which every attribute would be there

        def __getattr__(self, name: str) -> NoReturn:
            if name.startswith("_"):  # asked for by programs, which only want to know whether it is there
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
        # `kvs["a"] == 3` is always a mistake. Of other types `==` is left to decide: mocks, sentinels, pytest's approx.
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
        return f"<{type(self).__name__} {show(self._place[1])}: a place, whose value is read with {self._how_to_read}>"


def _number(self: Handle, *_: Any) -> Any:
    self._no_value("number")


_NUMBERS = (
    "int index float complex neg abs round add radd sub rsub mul rmul truediv rtruediv floordiv rfloordiv mod rmod "
    "pow rpow"
)
for _name in _NUMBERS.split():
    setattr(Handle, f"__{_name}__", _number)
