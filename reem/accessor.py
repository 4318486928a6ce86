"""Accessor for plain scripts: the core's, with blocking calls and Python's own syntax."""

from __future__ import annotations

import builtins
import threading
from collections.abc import Iterable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from reem_async import accessor as core
from reem_async.errors import BadType

from ._twin import documented_by
from .connection import RedisInterface

if TYPE_CHECKING:
    from reem_async.policy import Policy

    from .subscribe import Watch

__all__ = ["Accessor", "Edit", "PublishAccessor"]


@documented_by(core.Accessor)
class Accessor:
    """One place in the dictionary: `kvs["foo"]["bar"]`, `kvs["foo"]["tiles"][0]`.

    It is only a path, immutable and cheap; nothing is sent before a method is called, or it is
    assigned to, deleted from, or changed with `+=`, `-=`, `*=`, `/=`. Every call is atomic and raises
    `redis.exceptions.RedisError` if the server or the connection fails.
    """

    __slots__ = ("_core", "_edits", "_interface")

    def __init__(self, interface: RedisInterface, inner: core.Accessor) -> None:
        self._interface = interface
        self._core = inner
        self._edits: dict[int, list[Edit]] = {}

    def __getitem__(self, key: str | int) -> Self:
        return type(self)(self._interface, self._core[key])

    def __setitem__(self, key: str | int, value: Any) -> None:
        self[key]._assign(value)

    def _assign(self, value: Any) -> None:
        """Write, unless this is the end of `x[key] += n`: Python then assigns the accessor to itself."""
        if not isinstance(value, Accessor):
            self._interface._run(self._core.write(value))
        elif (value._interface, type(value), value.full_path) != (self._interface, type(self), self.full_path):
            raise BadType(f"an accessor cannot be stored: assign {value!r}.read(), its value")

    def __delitem__(self, key: str | int) -> None:
        self[key].delete()

    def __len__(self) -> int:
        return self.length()

    __iter__ = None
    __contains__ = None

    def __iadd__(self, value: Any) -> Self:
        self.add(value)
        return self

    def __isub__(self, value: Any) -> Self:
        self.decrement(value)
        return self

    def __imul__(self, value: Any) -> Self:
        self.multiply(value)
        return self

    def __itruediv__(self, value: Any) -> Self:
        self.divide(value)
        return self

    @property
    def full_path(self) -> tuple[str | int, ...]:
        """The keys and indexes that lead here, top-level key first."""
        return self._core.full_path

    def read(self) -> Any:
        """Return the value here."""
        return self._interface._run(self._core.read())

    def get(self, *default: Any) -> Any:
        """Return the value here, or a default."""
        return self._interface._run(self._core.get(*default))

    def write(self, value: Any) -> None:
        """Store `value` here."""
        self._interface._run(self._core.write(value))

    def delete(self) -> None:
        """Remove what is here."""
        self._interface._run(self._core.delete())

    def length(self) -> int:
        """Return the length of what is here."""
        return self._interface._run(self._core.length())

    def type(self) -> builtins.type:
        """Return the Python type of what is here."""
        return self._interface._run(self._core.type())

    def increment(self, number: float = 1) -> Any:
        """Add to the number here."""
        return self._interface._run(self._core.increment(number))

    def decrement(self, number: float = 1) -> Any:
        """Subtract from the number here."""
        return self._interface._run(self._core.decrement(number))

    def multiply(self, number: float) -> Any:
        """Multiply the number here."""
        return self._interface._run(self._core.multiply(number))

    def divide(self, number: float) -> Any:
        """Divide the number here."""
        return self._interface._run(self._core.divide(number))

    def add(self, value: Any) -> None:
        """Add to the number, or to the list, here."""
        self._interface._run(self._core.add(value))

    def append(self, value: Any) -> None:
        """Append to the list here."""
        self._interface._run(self._core.append(value))

    def extend(self, values: Iterable[Any]) -> None:
        """Append several to the list here."""
        self._interface._run(self._core.extend(values))

    def edit(self) -> Edit:
        """Return a context manager that reads, lets you change, and writes back; also `with accessor:`."""
        return Edit(self._interface, self._core.edit())

    def watch(self, policy: Policy | None = None) -> Watch:
        """Return an iterator over the value here and its updates."""
        from .subscribe import Watch

        return Watch(self._interface, self._interface._followers, self._core.full_path, policy)

    def __enter__(self) -> Any:
        edit = self.edit()
        value = edit.__enter__()
        self._edits.setdefault(threading.get_ident(), []).append(edit)
        return value

    def __exit__(
        self, kind: builtins.type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._edits[threading.get_ident()].pop().__exit__(kind, error, trace)

    def __reduce__(self) -> tuple[Any, ...]:
        kinds = type(self), type(self._core), type(self._core._writer)
        return _rebuilt, (kinds, self._interface, self._core.full_path)

    def __repr__(self) -> str:
        return repr(self._core)


class PublishAccessor(Accessor):
    """One place of a PublishSpace: as `Accessor`, but what would read raises WriteOnly."""

    __slots__ = ()

    def watch(self, policy: Policy | None = None) -> Watch:
        """Raise WriteOnly."""
        return self._core.watch(policy)  # type: ignore[return-value]


def _rebuilt(kinds: Any, interface: RedisInterface, path: tuple[Any, ...]) -> Accessor:
    facade, inner, writer = kinds
    made: Accessor = facade(interface, core.rebuilt(inner, writer, interface._core.session, path))
    return made


class Edit:
    """What `Accessor.edit` returns."""

    def __init__(self, interface: RedisInterface, inner: core.Edit) -> None:
        self._interface = interface
        self._core = inner

    def __enter__(self) -> Any:
        return self._interface._run(self._core.__aenter__())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._interface._run(self._core.__aexit__(kind, error, trace))
