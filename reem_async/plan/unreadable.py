"""What stands in the place of a value that cannot be read, so that all beside it can be."""

from __future__ import annotations

from typing import Any, NoReturn

from ..errors import BadData

__all__ = ["Unreadable"]


class _Used(BadData, AttributeError):
    """An attribute of a value that cannot be read was used; `hasattr` and `copy` take it for absent."""


class Unreadable:
    """Stands in the place of a value that cannot be read; any use of it raises BadData, which says why.

    The bytes of an array may be gone, damaged, or not this user's to read, or the interface may lack the ship that
    wrote it. Watches, subscribers and mirrors have it in their data, recordings and the page of `reem browse` in trees.
    `isinstance(value, reem.Unreadable)` tells it from a value; two are equal if their reasons are.

    Attributes:
        place: Where the value is, as far as that is known: "arm.image".
        reason: Why it cannot be read, and what to do.
    """

    __slots__ = ("place", "reason")

    def __init__(self, place: str, reason: str) -> None:
        self.place = place
        self.reason = reason.removeprefix(f"{place}: ")

    def __repr__(self) -> str:
        return f"<unreadable {self.place}: {self.reason}>"

    def __eq__(self, other: object) -> bool:
        return type(other) is Unreadable and other.reason == self.reason

    def __hash__(self) -> int:
        return hash(self.reason)

    def __reduce__(self) -> tuple[Any, ...]:
        return Unreadable, (self.place, self.reason)

    def __getattr__(self, name: str) -> NoReturn:
        raise _Used(f"{self.place}: {self.reason}")

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise BadData(f"{self.place}: {self.reason}")

    __getitem__ = __setitem__ = __delitem__ = __iter__ = __len__ = __contains__ = __bool__ = __call__ = _refuse
    __float__ = __int__ = __index__ = __complex__ = __bytes__ = __array__ = __lt__ = __le__ = __gt__ = __ge__ = _refuse
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __neg__ = _refuse
    __floordiv__ = __rfloordiv__ = __mod__ = __rmod__ = __pow__ = __rpow__ = __matmul__ = __rmatmul__ = _refuse
    __abs__ = __and__ = __rand__ = __or__ = __ror__ = __round__ = _refuse
