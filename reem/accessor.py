"""Accessor for plain scripts: the core's, with blocking calls and Python's own syntax."""

from __future__ import annotations

import builtins
import threading
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, Self, TypeVar, overload

from reem_async.coordination.parameter_objects import prepared
from reem_async.coordination.services import QUEUE, Arguments, Result
from reem_async.errors import BadType, RedisError, ReemError
from reem_async.plan.arguments import Handle
from reem_async.plan.paths import Path, show
from reem_async.store import accessor as core
from reem_async.store import store as core_store

from ._twin import FOLLOWER, calls, documented_by, makes, runs, shares, waits
from .connection import RedisInterface
from .coordination import Parameter, Service, declared
from .following import Watch
from .mirror import Mirror
from .view import View

T = TypeVar("T")


class OneKey:
    """What reads or writes one top-level key."""

    _kind: Callable[[str, Any], Any]

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = self._interface = interface
        self.top_key_name = top_key_name
        self._core = self._kind(top_key_name, interface._core)


@documented_by(core.Reader)
class Reader(OneKey):
    """Reads one top-level key."""

    _kind = core.Reader
    read_from_redis = runs(core.Reader.read_from_redis)


@documented_by(core.Writer)
class Writer(OneKey):
    """Writes one top-level key."""

    _kind = core.Writer
    send_to_redis = runs(core.Writer.send_to_redis)


@documented_by(core_store.Publisher)
class Publisher(Writer):
    """Writes one top-level key and notifies its subscribers, in the same transaction."""

    _kind = core_store.Publisher


class Edit:
    """What `Accessor.edit` returns."""

    def __init__(self, interface: RedisInterface, inner: core.Edit) -> None:
        self._interface = interface
        self._core = inner

    __enter__ = runs(core.Edit.__aenter__)
    __exit__ = runs(core.Edit.__aexit__)


def known_keys(self: Any) -> list[str]:
    """Return the keys that IPython offers after `["`; none where they cannot be had."""
    try:
        return self.keys()  # type: ignore[no-any-return]
    except (ReemError, RedisError):
        return []


@documented_by(core.Accessor)
class Accessor(Handle):
    """One place in the dictionary: `kvs["foo"]["bar"]`, `kvs["foo"]["tiles"][0]`."""

    __slots__ = ("_core", "_edits", "_interface")

    def __init__(self, interface: RedisInterface, inner: core.Accessor) -> None:
        self._interface = interface
        self._core = inner
        # By thread: one accessor may be entered by several threads at once, and by one of them twice.
        self._edits: dict[int, list[Edit]] = {}

    def __getitem__(self, key: str | int) -> Self:
        return type(self)(self._interface, self._core[key])

    def __setitem__(self, key: str | int, value: Any) -> None:
        self[key]._assign(value)

    def _assign(self, value: Any) -> None:
        """Write, unless this is the end of `x[key] += n`: Python then assigns the accessor to itself."""
        if not isinstance(value, Accessor):
            self._interface._run(self._core.write(value))
        # Identity is not enough: Python evaluates `x[key]` twice for `x[key] += n`, which makes two accessors.
        elif (value._interface, type(value), value.full_path) != (self._interface, type(self), self.full_path):
            raise BadType(f"a handle cannot be stored ({show(value.full_path)}): assign its value, with .read()")

    full_path = shares(core.Accessor.full_path)
    path = shares(core.Accessor.path)

    @property
    def reader(self) -> Reader:
        """The reader of the top-level key."""
        return Reader(self._core._reader.name, self._interface)

    @property
    def writer(self) -> Writer:
        """The writer of the top-level key."""
        return Writer(self._core._reader.name, self._interface)

    read = runs(core.Accessor.read)
    get = runs(core.Accessor.get)
    write = runs(core.Accessor.write)
    delete = runs(core.Accessor.delete)
    length = __len__ = runs(core.Accessor.length)
    contains = runs(core.Accessor.contains)
    __contains__ = contains  # type: ignore[assignment]  # the core refuses what is no str
    keys = runs(core.Accessor.keys)
    outline = runs(core.Accessor.outline)
    pop = runs(core.Accessor.pop)
    update = runs(core.Accessor.update)
    setdefault = runs(core.Accessor.setdefault)
    type = runs(core.Accessor.type)
    increment = runs(core.Accessor.increment)
    decrement = runs(core.Accessor.decrement)
    multiply = runs(core.Accessor.multiply)
    divide = runs(core.Accessor.divide)
    add = runs(core.Accessor.add)
    append = runs(core.Accessor.append)
    extend = runs(core.Accessor.extend)
    expire = runs(core.Accessor.expire)
    persist = runs(core.Accessor.persist)
    edit = makes(core.Accessor.edit, Edit)
    watch = makes(core.Accessor.watch, Watch, FOLLOWER)
    mirror = makes(core.Accessor.mirror, Mirror, FOLLOWER)
    call = waits(core.Accessor.call, FOLLOWER)
    own = makes(core.Accessor.own, lambda interface, inner: OwnedAccessor(interface, inner))
    _ipython_key_completions_ = known_keys

    @overload
    def of(self, kind: builtins.type[T]) -> View[T]: ...
    @overload
    def of(self, kind: Any) -> View[Any]: ...

    def of(self, kind: Any) -> View[Any]:
        """Return this place as objects of a class."""
        return View(self, self._core.of(kind))

    def parameter(
        self,
        name: str,
        default: T,
        *,
        low: Any = None,
        high: Any = None,
        unit: str = "",
        help: str = "",  # noqa: A002
        choices: Iterable[Any] | None = None,
        on_change: Callable[[T], Any] | None = None,
    ) -> Parameter[T]:
        """Declare a parameter in the dict here, and return it: `float(kp)` and `kp.value` are always current."""
        # The arguments are checked here, and declared on the background loop.
        specification = {"low": low, "high": high, "unit": unit, "help": help, "choices": choices}
        return declared(self._interface, prepared(self.full_path, name, default, on_change=on_change, **specification))

    # Not by way of the methods: an error that says it all shows one frame less.

    def __delitem__(self, key: str | int) -> None:
        self._interface._run(self._core[key].delete())

    def __iter__(self) -> Iterator[str]:
        return iter(self._interface._run(self._core.keys()))

    def __iadd__(self, value: Any) -> Self:
        self._interface._run(self._core.add(value))
        return self

    def __isub__(self, value: Any) -> Self:
        self._interface._run(self._core.decrement(value))
        return self

    def __imul__(self, value: Any) -> Self:
        self._interface._run(self._core.multiply(value))
        return self

    def __itruediv__(self, value: Any) -> Self:
        self._interface._run(self._core.divide(value))
        return self

    @property
    def _place(self) -> tuple[object, Path]:
        return self._interface, self.full_path

    def _follower(self) -> core.Accessor:
        """Return the core's accessor on the background loop: connections of the caller's thread only ask and answer."""
        kind, writer = type(self._core), self._core._writer.maker()
        session = self._interface._followers.session
        return core.rebuilt(kind, writer, session, self._core.full_path)  # type: ignore[no-any-return]

    @overload
    def serve(
        self, function: Callable[Arguments, Result], *, concurrency: int = 1, queue: int = QUEUE
    ) -> Service[Arguments, Result]: ...
    @overload
    def serve(
        self, function: None = None, *, concurrency: int = 1, queue: int = QUEUE
    ) -> Callable[[Callable[Arguments, Result]], Service[Arguments, Result]]: ...

    def serve(self, function: Callable[..., Any] | None = None, *, concurrency: int = 1, queue: int = QUEUE) -> Any:
        """Answer calls of the service at this place with a function: `@kvs["policy"].serve`, or with a `with` block."""
        if function is None:
            return partial(self.serve, concurrency=concurrency, queue=queue)
        return Service(self._interface, self._follower()._service(function, concurrency, queue))

    def __enter__(self) -> Any:
        edit = self.edit()
        value = edit.__enter__()
        self._edits.setdefault(threading.get_ident(), []).append(edit)
        return value

    def __exit__(self, *error: Any) -> None:
        mine = self._edits[threading.get_ident()]
        # The innermost block of this thread.
        edit = mine.pop()
        if not mine:
            self._edits.pop(threading.get_ident(), None)
        edit.__exit__(*error)

    def __reduce__(self) -> tuple[Any, ...]:
        # The facade and the core's part of it, which says whether it publishes.
        kinds = type(self), type(self._core), self._core._writer.maker()
        return _rebuilt, (kinds, self._interface, self._core.full_path)


@documented_by(core.OwnedAccessor)
class OwnedAccessor(Accessor):
    """A top-level key that this program owns: what `Accessor.own` returns."""

    __slots__ = ()
    _core: core.OwnedAccessor

    def __getitem__(self, key: str | int) -> Accessor:  # type: ignore[override]  # only the whole key is owned
        return Accessor(self._interface, self._core[key])

    lost = shares(core.OwnedAccessor.lost)
    fence = shares(core.OwnedAccessor.fence)
    acquire = runs(core.OwnedAccessor.acquire)
    renew = runs(core.OwnedAccessor.renew)
    release = runs(core.OwnedAccessor.release)

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def __reduce__(self) -> tuple[Any, ...]:
        return self._core.__reduce__()


class PublishAccessor(Accessor):
    """One place of a PublishSpace: as `Accessor`, but what would read raises WriteOnly."""

    __slots__ = ()
    _how_to_read = "a KeyValueStore"
    _refuse: Any = calls(core_store.PublishAccessor._refuse)
    mirror = parameter = watch = _refuse
    reader = property(_refuse)

    @property
    def writer(self) -> Publisher:
        """The publisher of the top-level key."""
        return Publisher(self._core._reader.name, self._interface)


def _rebuilt(kinds: Any, interface: RedisInterface, path: tuple[Any, ...]) -> Accessor:
    facade, inner, writer = kinds
    made: Accessor = facade(interface, core.rebuilt(inner, writer, interface._core.session, path))
    return made
