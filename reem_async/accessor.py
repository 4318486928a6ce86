"""Accessor: one place in the dictionary, and what can be done there."""

from __future__ import annotations

import builtins
import operator
from collections.abc import Iterable
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from .document import DocumentReader, DocumentWriter, opened, resolved
from .errors import BadType, MissingKey
from .plan.documents import number_text
from .plan.paths import Path, check_element, counts_from_end, show

if TYPE_CHECKING:
    from .plan.reads import Sealed
    from .policy import Policy
    from .session import Session
    from .subscribe import Watch

__all__ = ["Accessor", "Edit"]

_NOTHING: Any = object()


class Accessor:
    """One place in the dictionary: `kvs["foo"]["bar"]`, `kvs["foo"]["tiles"][0]`.

    It is only a path, immutable and cheap; nothing is sent before a method is awaited. Every method
    is atomic, may be cancelled at any time (the call is then applied once or not at all) and raises
    `redis.exceptions.RedisError` if the server or the connection fails.
    """

    __slots__ = ("_path", "_reader", "_writer")

    def __init__(self, reader: DocumentReader, writer: DocumentWriter, path: Path) -> None:
        self._reader = reader
        self._writer = writer
        self._path = path

    def __getitem__(self, key: str | int) -> Accessor:
        return type(self)(self._reader, self._writer, (*self._path, check_element(key, self.full_path)))

    def __setitem__(self, key: str | int, value: Any) -> None:
        raise BadType(f"assignment cannot wait for the server; use: await accessor[{key!r}].write(value)")

    def __delitem__(self, key: str | int) -> None:
        raise BadType(f"del cannot wait for the server; use: await accessor[{key!r}].delete()")

    # Without these Python would try indexes 0, 1, 2, ... and never come to an end.
    __iter__ = None
    __contains__ = None

    @property
    def full_path(self) -> Path:
        """The keys and indexes that lead here, top-level key first."""
        return (self._reader.name, *self._path)

    async def read(self) -> Any:
        """Return the value here. Arrays are read-only: they share memory with the reply.

        One round trip; two or more the first time that arrays are met, or if they moved. Document
        and arrays are always of one instant.

        Raises:
            MissingKey: Nothing is stored here.
            BadData: What is stored here was not written by REEM, or by a ship this interface lacks.
        """
        return await self._reader.read(self._path)

    async def get(self, *default: Any) -> Any:
        """Return the value here, or `default` (None if not given) if nothing is stored here.

        `get(key, default)`, with two arguments, does so for the element `key`, as in REEM 0.1.
        """
        place = self[default[0]] if len(default) > 1 else self
        try:
            return await place.read()
        except MissingKey:
            return default[-1] if default else None

    async def write(self, value: Any) -> None:
        """Store `value` here, in place of what was here. One round trip.

        Two where this interface puts arrays for the first time (unless it is a whole top-level key), two or
        three where a list on the way holds arrays, and more if another client changed the shape meanwhile.

        An array of 64 KB or more lets calls of this interface that are under way in the same event loop be answered
        first, since encoding and sending it keep the loop; it is stored as it is then. (Publishing keeps the order of
        calls instead.)

        Raises:
            BadValue, BadType, BadKey, TooDeep: It cannot be stored; nothing was sent.
            PathRefused: The parent is missing or cannot hold this element; nothing was stored.
        """
        await self._writer.set(self._path, value)

    async def delete(self) -> None:
        """Remove what is here. One round trip; more if there were arrays that this interface did not know.

        Raises:
            MissingKey: Nothing was here.
        """
        await self._writer.delete(self._path)

    async def length(self) -> int:
        """Return the number of entries, items, characters, bytes, or rows. One round trip for dicts and lists.

        Raises:
            MissingKey: Nothing is here.
            BadType: It has no length.
        """
        return await self._reader.length_at(self._path)

    async def type(self) -> builtins.type:
        """Return the Python type of what is here: dict, list, int, float, bool, str, numpy.ndarray, ...

        One round trip, two for strings and arrays.

        Raises:
            MissingKey: Nothing is here.
        """
        return await self._reader.type_at(self._path)

    async def increment(self, number: float = 1) -> Any:
        """Add `number` to the number here; returns the result.

        One round trip; two the first time, after a write to the top-level key, and near the ends of 64 bits.

        Raises:
            MissingKey: Nothing is here.
            BadType: It is not a number.
            Overflow: The result is out of range; the old value is kept.
        """
        return await self._writer.calculate(self._path, "JSON.NUMINCRBY", operator.add, number)

    async def decrement(self, number: float = 1) -> Any:
        """Subtract `number` from the number here; returns the result. Raises and costs as `increment`."""
        plain = number.item() if isinstance(number, np.generic) else number  # unsigned ones have no negative
        number_text(plain, self.full_path)
        return await self.increment(-plain)

    async def multiply(self, number: float) -> Any:
        """Multiply the number here by `number`; returns the result. Raises and costs as `increment`."""
        return await self._writer.calculate(self._path, "JSON.NUMMULTBY", operator.mul, number)

    async def divide(self, number: float) -> Any:
        """Divide the number here by `number`, as Python's `/` does; returns the result.

        Two round trips, again if somebody else writes to the same top-level key in between. Raises
        as `increment`, and ZeroDivisionError.
        """
        number_text(number, self.full_path)
        if isinstance(number, np.generic):
            number = number.item()
        if number == 0:
            raise ZeroDivisionError(f"{show(self.full_path)}: division by zero")
        return await self._writer.compute(self._path, lambda value: value / number)

    async def add(self, value: Any) -> None:
        """Do what `+=` does: extend the list here by a list or tuple, or else `increment` the number here.

        One round trip. Raises as these two.
        """
        if isinstance(value, list | tuple):
            await self.extend(value)
        else:
            await self.increment(value)

    async def append(self, value: Any) -> None:
        """Append `value` to the list here. One round trip, two if it holds arrays.

        Raises:
            MissingKey: Nothing is here.
            BadType: It is not a list, or `value` cannot be stored.
        """
        await self._writer.extend(self._path, [value])

    async def extend(self, values: Iterable[Any]) -> None:
        """Append each of `values` to the list here, all or none. Raises and costs as `append`."""
        await self._writer.extend(self._path, list(values))

    def edit(self) -> Edit:
        """Return a context manager that reads the value, lets you change it, and writes it back.

        Nothing is written if the block raises. Two round trips to write.

        Raises:
            MissingKey: Nothing is here (on entering).
            BadType: It is a number, text or None, which cannot be changed in place.
            Conflict: Somebody else changed it meanwhile (on leaving); nothing was written.
        """
        return Edit(self._reader, self._writer, self._path)

    def watch(self, policy: Policy | None = None) -> Watch:
        """Return an async iterator over the value here, first as it is, then each time it is published.

        Args:
            policy: What to keep for a loop that is slower than the updates: `Newest()` (the
                default), `Last(n)` or `Every(bound)`.
        """
        from .policy import Newest
        from .subscribe import Watch

        return Watch(self._reader.session, self._reader.keys, self._path, policy or Newest())

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt, (type(self), type(self._writer), self._reader.session, self.full_path)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {show(self.full_path)}>"


def rebuilt(kind: Any, writer: Any, session: Session, path: tuple[Any, ...]) -> Any:
    """Make an accessor from the parts of a pickled one."""
    return kind(DocumentReader(session, path[0]), writer(session, path[0]), path[1:])


class Edit:
    """What `Accessor.edit` returns."""

    def __init__(self, reader: DocumentReader, writer: DocumentWriter, path: Path) -> None:
        self._reader = reader
        self._writer = writer
        self._path = path
        self._before: Sealed | None = None
        self._value: Any = None

    async def __aenter__(self) -> Any:
        if counts_from_end(self._path):
            self._path = await resolved(self._reader, self._path, MissingKey)
        self._before = await self._reader.sealed(self._path)
        await opened(self._before)
        for crate, _, _ in self._before.crates:
            value = crate.container[crate.key]
            if isinstance(value, np.ndarray) and not value.flags.writeable:
                crate.container[crate.key] = value.copy()
        self._value = self._before.holder[0]
        if not isinstance(self._value, dict | list | np.ndarray):
            where = show((self._reader.name, *self._path))
            raise BadType(
                f"{where} is of type {type(self._value).__name__}, which cannot be changed in place; "
                "edit the dict or list that holds it, or use write()"
            )
        return self._value

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None and self._before is not None:
            await self._writer.exchange(self._path, self._value, self._before)
