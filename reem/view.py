"""Typed views for plain scripts: a place in the dictionary whose values are objects of a class."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, Literal, Self, TypeVar

from reem_async.concurrency.queues import Policy
from reem_async.plan.arguments import Handle
from reem_async.plan.paths import Path
from reem_async.store import view as core
from reem_async.store.view import TypedUpdate

from ._twin import documented_by
from .following import Following, Watch
from .mirror import Mirror

T = TypeVar("T")
F = TypeVar("F")


@documented_by(core.View)
class View(Handle, Generic[T]):
    """One place in the dictionary, read and written as objects of a class: `arm = kvs["arm"].of(Arm)`."""

    __slots__ = ("_accessor", "_core")

    # The accessor is of `accessor.py`, which imports this module.
    def __init__(self, accessor: Any, inner: core.View[T]) -> None:
        self._accessor = accessor
        self._core = inner

    @property
    def _interface(self) -> Any:
        return self._accessor._interface

    @property
    def _place(self) -> tuple[object, Path]:
        return self._core._place

    if not TYPE_CHECKING:  # type checkers refuse it by themselves
        __setattr__ = core.refuse_fields

    def __setitem__(self, key: str | int, value: Any) -> None:
        self[key].write(value)

    def __getattr__(self, name: str) -> View[Any]:
        if name.startswith("_"):  # of an object that is being unpickled, for example
            raise AttributeError(name)
        return self._below(getattr(self._core, name))

    def __getitem__(self, key: str | int) -> View[Any]:
        return self._below(self._core[key])

    def at(self, select: Callable[[T], F]) -> View[F]:
        """Return the view of a field or item: `arm.at(lambda it: it.joints)`."""
        return self._below(self._core.at(select))

    def _below(self, inner: core.View[F]) -> View[F]:
        return View(type(self._accessor)(self._interface, inner._accessor), inner)

    def read(self) -> T:
        """Return the object here."""
        value: T = self._interface._run(self._core.read())
        return value

    def write(self, value: T) -> None:
        """Store an object here."""
        self._interface._run(self._core.write(value))

    def edit(self) -> ViewEdit[T]:
        """Return a block that changes the object here."""
        return ViewEdit(self._accessor.edit(), self._core)

    def watch(self, policy: Policy | None = None, *, stored: bool = True, ttl: float | None = None) -> ViewWatch[T]:
        """Return an iterator over the updates here."""
        return ViewWatch(self._accessor.watch(policy, stored=stored, ttl=ttl), self._core)

    def mirror(
        self, *, max_age: float | None = None, stale: Literal["raise", "keep"] = "raise", ttl: float | None = None
    ) -> ViewMirror[T]:
        """Return a local copy that follows."""
        return ViewMirror(self._accessor.mirror(max_age=max_age, stale=stale, ttl=ttl), self._core)

    def call(self, /, *, timeout: float | None = None, **arguments: Any) -> T:
        """Ask the service at this place."""
        return self._core._made(self._accessor.call(timeout=timeout, **arguments))

    def __dir__(self) -> list[str]:
        return dir(self._core)

    def __repr__(self) -> str:
        return repr(self._core).replace("reem_async", "reem")


@documented_by(core.ViewWatch)
class ViewWatch(Following, Generic[T]):
    """What `View.watch` returns."""

    def __init__(self, watch: Watch, view: core.View[T]) -> None:
        self._watch = watch
        self._view = view

    def listen(self) -> None:
        """Begin to follow."""
        self._watch.listen()

    def close(self) -> None:
        """Stop following."""
        self._watch.close()

    @property
    def dropped(self) -> int:
        """How many updates were skipped since they were not taken in time."""
        return self._watch.dropped

    def next(self, timeout: float | None = None) -> TypedUpdate[T]:
        """Return the next update, with a time limit."""
        return self._view._update(self._watch.next(timeout))

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> TypedUpdate[T]:
        return self._view._update(next(self._watch))


@documented_by(core.ViewMirror)
class ViewMirror(Following, Generic[T]):
    """What `View.mirror` returns."""

    def __init__(self, mirror: Mirror, view: core.View[T]) -> None:
        self._mirror = mirror
        self._view = view

    def listen(self) -> None:
        """Begin to follow."""
        self._mirror.listen()

    def close(self) -> None:
        """Stop following."""
        self._mirror.close()

    @property
    def age(self) -> float:
        """For how many seconds the server may have had something else."""
        return self._mirror.age

    def value(self, *default: T) -> T:
        """Return the object as of now."""
        return core.mirrored(self._mirror, self._view, default)

    def wait_until(self, predicate: Callable[[T], Any], timeout: float | None = None) -> T:
        """Wait until the object is as wanted."""
        return self._view._made(self._mirror.wait_until(core.wanted(self._view, predicate), timeout))


class ViewEdit(Generic[T]):
    """What `View.edit` returns."""

    def __init__(self, edit: Any, view: core.View[T]) -> None:
        self._edit = edit
        self._changes = core.Changes(view)

    def __enter__(self) -> T:
        return self._changes.begin(self._edit.__enter__())

    def __exit__(self, kind: object, *rest: object) -> None:
        if kind is None:
            self._changes.bring()
        self._edit.__exit__(kind, *rest)
