"""Typed views: a place in the dictionary whose values are objects of a class."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Generic, Literal, Self, TypeVar

from ..concurrency.queues import Policy
from ..concurrency.streams import Following
from ..errors import BadData, BadType, MissingKey
from ..plan import typed
from ..plan.arguments import Handle, cannot_wait
from ..plan.classes import fields_of
from ..plan.paths import Path, show
from ..plan.trees import MISSING
from ..pubsub.events import Update
from ..pubsub.mirror import Mirror
from ..pubsub.subscribers import Watch

T = TypeVar("T")
F = TypeVar("F")


def refuse_fields(view: Any, name: str, value: Any) -> None:
    """Refuse `arm.mode = ...`, which would write nothing."""
    if not name.startswith("_"):
        raise BadType(f"{show((*view._place[1], name))}: assignment does not write; use view[{name!r}].write(value)")
    object.__setattr__(view, name, value)


@dataclass(frozen=True, slots=True)
class TypedUpdate(Update, Generic[T]):
    """An update whose `data` is an object of the class of its view; None where nothing is there, or for silence."""

    data: T


class Selection:
    """What `View.at` hands to its function: notes which fields and items are asked for."""

    def __init__(self, path: Path = ()) -> None:
        self._path = path

    def __getattr__(self, name: str) -> Selection:
        return Selection((*self._path, name))

    def __getitem__(self, key: str | int) -> Selection:
        return Selection((*self._path, key))


def selected(select: Callable[[Any], Any], path: Path) -> Path:
    """Return the path that a function such as `lambda arm: arm.joints[0]` takes; raises BadType."""
    found = select(Selection())
    if not isinstance(found, Selection):
        raise BadType(f"{show(path)}: at() takes a function that returns a field, such as lambda arm: arm.joints")
    return found._path


class View(Handle, Generic[T]):
    """One place in the dictionary, read and written as objects of a class: `arm = kvs["arm"].of(Arm)`.

    Values are checked before they are sent and after they are read. Fields are views too: `arm.joints`, or
    `arm.at(lambda it: it.joints)`, which editors and type checkers follow; `arm["read"]` where a field has the name of
    a method. Costs, atomicity and errors are those of the accessor.
    """

    __slots__ = ("_accessor", "_annotation")
    __setitem__ = cannot_wait("assignment", "await view[{0!r}].write(value)")

    # The accessor is of `accessor.py`, which imports this module.
    def __init__(self, accessor: Any, annotation: Any) -> None:
        self._accessor = accessor
        self._annotation = annotation

    @property
    def _place(self) -> tuple[object, Path]:
        place: tuple[object, Path] = self._accessor._place
        return place

    if not TYPE_CHECKING:  # type checkers refuse it by themselves
        __setattr__ = refuse_fields

    def __getattr__(self, name: str) -> View[Any]:
        if name.startswith("_"):  # what Python looks for; arm["_name"] is a field
            raise AttributeError(name)
        try:
            return self[name]
        except BadType as error:
            raise AttributeError(str(error)) from None

    def __getitem__(self, key: str | int) -> View[Any]:
        return View(self._accessor[key], typed.element(self._annotation, key, self._accessor.full_path))

    def at(self, select: Callable[[T], F]) -> View[F]:
        """Return the view of a field or item: `arm.at(lambda it: it.joints)`."""
        view: View[Any] = self
        for key in selected(select, self._accessor.full_path):
            view = view[key]
        return view

    async def read(self) -> T:
        """Return the object here. Fields that are missing get their defaults, and such as the class lacks are left out.

        Raises:
            MissingKey: Nothing is stored here.
            BadData: What is stored is not what the class says; names path, expected and found.
        """
        value = await self._accessor.get(MISSING)
        if value is MISSING:
            raise MissingKey(f"{show(self._accessor.full_path)}: nothing is stored here")
        return self._made(value)

    async def write(self, value: T) -> None:
        """Store an object here, replacing the old one. As `Accessor.write`.

        What was stored beside the fields of an object that was read is written back with it, except with objects that
        have no `__dict__` (`slots=True`, `msgspec.Struct`): change these with `edit()`.

        Raises:
            BadValue: It is not what the class says; names path, expected and found. Nothing was sent.
        """
        await self._accessor.write(self._stored(value))

    def edit(self) -> ViewEdit[T]:
        """Return a context manager that reads the object, lets you change it, and writes it back. As `Accessor.edit`.

        What is stored beside the fields stays.
        """
        return ViewEdit(self._accessor.edit(), self)

    def watch(self, policy: Policy | None = None, *, stored: bool = True, ttl: float | None = None) -> ViewWatch[T]:
        """Return an async iterator over the updates here, whose `data` is an object of the class. As `Accessor.watch`.

        An update whose data is not what the class says raises BadData; the next call goes on behind it.
        """
        return ViewWatch(self._accessor.watch(policy, stored=stored, ttl=ttl), self)

    def mirror(
        self, *, max_age: float | None = None, stale: Literal["raise", "keep"] = "raise", ttl: float | None = None
    ) -> ViewMirror[T]:
        """Return a local copy of the object here that follows every change. As `Accessor.mirror`."""
        return ViewMirror(self._accessor.mirror(max_age=max_age, stale=stale, ttl=ttl), self)

    async def call(self, /, *, timeout: float | None = None, **arguments: Any) -> T:  # noqa: ASYNC109
        """Ask the service at this place, and return its answer as an object of the class. As `Accessor.call`.

        Raises:
            BadData: The answer is not what the class says; names path, expected and found.
        """
        return self._made(await self._accessor.call(timeout=timeout, **arguments))

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *(fields_of(self._annotation) or ())]

    def _made(self, value: Any) -> T:
        return typed.made(self._annotation, value, self._accessor.full_path)  # type: ignore[no-any-return]

    def _stored(self, value: T) -> Any:
        carries = self._accessor._place[0].ships.carries
        return typed.stored(self._annotation, value, self._accessor.full_path, carries)

    def _update(self, update: Update) -> TypedUpdate[T]:
        values = {field.name: getattr(update, field.name) for field in fields(update)}
        if not (update.silent or update.data is None):
            values["data"] = self._made(update.data)
        return TypedUpdate(**values)

    def __repr__(self) -> str:
        return f"<reem_async.View {show(self._accessor.full_path)}>"


class ViewWatch(Following, Generic[T]):
    """What `View.watch` returns."""

    def __init__(self, watch: Watch, view: View[T]) -> None:
        self._watch = watch
        self._view = view

    @property
    def dropped(self) -> int:
        """How many updates were skipped since they were not taken in time."""
        return self._watch.dropped

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later update is missed."""
        await self._watch.listen()

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await self._watch.close()

    async def next(self, timeout: float | None = None) -> TypedUpdate[T]:  # noqa: ASYNC109
        """Return the next update, with a time limit in seconds. As `Watch.next`."""
        return self._view._update(await self._watch.next(timeout))

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> TypedUpdate[T]:
        return self._view._update(await anext(self._watch))


class ViewMirror(Following, Generic[T]):
    """What `View.mirror` returns."""

    def __init__(self, mirror: Mirror, view: View[T]) -> None:
        self._mirror = mirror
        self._view = view

    @property
    def age(self) -> float:
        """For how many seconds the server may have had something else."""
        return self._mirror.age

    async def listen(self) -> None:
        """Begin to follow. When this returns, the copy is there."""
        await self._mirror.listen()

    async def close(self) -> None:
        """Stop following. Idempotent."""
        await self._mirror.close()

    def value(self, *default: T) -> T:
        """Return the object as of now, made anew by each call; `default` where `Mirror.value` returns its own.

        Raises:
            MissingKey: Nothing is stored here, and no default was given.
            BadData: What is stored is not what the class says.
            Stale, Silent: As `Mirror.value`.
        """
        return mirrored(self._mirror, self._view, default)

    async def wait_until(self, predicate: Callable[[T], Any], timeout: float | None = None) -> T:  # noqa: ASYNC109
        """Wait until the object is as wanted; returns it. As `Mirror.wait_until`.

        The predicate is not called while nothing is stored here. Raises BadData for what is not what the class says.
        """
        return self._view._made(await self._mirror.wait_until(wanted(self._view, predicate), timeout))


def wanted(view: View[T], predicate: Callable[[T], Any]) -> Callable[[Any], Any]:
    """Return a predicate for the mirror of a view."""
    if not callable(predicate):  # which the mirror refuses
        return predicate
    return lambda value: value is not None and predicate(view._made(value))


def mirrored(mirror: Any, view: View[T], default: tuple[T, ...]) -> T:
    """Return what a mirror has, as an object of the class of a view."""
    value = mirror.value(*default)
    if default and value is default[0]:
        return default[0]
    try:
        return view._made(value)
    except BadData:
        if value is not None:
            raise
    raise MissingKey(f"{mirror.channel}: nothing is stored here")


class ViewEdit(Generic[T]):
    """What `View.edit` returns."""

    def __init__(self, edit: Any, view: View[T]) -> None:
        self._edit = edit
        self._changes = Changes(view)

    async def __aenter__(self) -> T:
        return self._changes.begin(await self._edit.__aenter__())

    async def __aexit__(self, kind: object, *rest: object) -> None:
        if kind is None:
            self._changes.bring()
        await self._edit.__aexit__(kind, *rest)


class Changes(Generic[T]):
    """What a block that edits an object has changed."""

    def __init__(self, view: View[T]) -> None:
        self._view = view

    def begin(self, raw: Any) -> T:
        """Return the object of what is stored, to be changed."""
        self._raw, self._object = raw, self._view._made(raw)
        self._before = self._view._stored(self._object)
        return self._object

    def bring(self) -> None:
        """Change what was stored as the object was changed."""
        new = self._view._stored(self._object)
        if isinstance(self._raw, dict):
            _bring(self._raw, self._before, new)
        else:
            self._raw[slice(None) if isinstance(self._raw, list) else ...] = new


def _bring(raw: dict[str, Any], before: dict[str, Any], new: dict[str, Any]) -> None:
    """Change a stored dict where an object was changed; what is beside its fields stays."""
    for key in before.keys() - new.keys():
        raw.pop(key, None)
    for key, value in new.items():
        if all(isinstance(each, dict) for each in (value, raw.get(key), before.get(key))):
            _bring(raw[key], before[key], value)
        else:
            raw[key] = value
