"""Accessor for plain scripts: the core's, with blocking calls and Python's own syntax."""

from __future__ import annotations

import builtins
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any, Literal, Self, overload

from reem_async.concurrency.queues import Policy
from reem_async.coordination.parameters import prepared
from reem_async.coordination.services import QUEUE
from reem_async.errors import BadType, RedisError, ReemError
from reem_async.plan.arguments import Handle
from reem_async.plan.paths import Path, show
from reem_async.store import accessor as core
from reem_async.store import space as core_space
from reem_async.store.catalog import Outline

from ._twin import documented_by
from .connection import RedisInterface
from .following import Watch
from .mirror import Mirror
from .parameters import Parameter, declared
from .service import Service


@documented_by(core.Reader)
class Reader:
    """Reads one top-level key."""

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.top_key_name = top_key_name
        self._core = core.Reader(top_key_name, interface._core)

    def read_from_redis(self, read_path: str) -> Any:
        """Return the value at a path like ".a.b"."""
        return self.interface._run(self._core.read_from_redis(read_path))


@documented_by(core.Writer)
class Writer:
    """Writes one top-level key."""

    _kind: type[core.Writer] = core.Writer

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.top_key_name = top_key_name
        self._core = self._kind(top_key_name, interface._core)

    def send_to_redis(self, set_path: str, set_value: Any) -> None:
        """Store a value at a path like ".a.b"."""
        self.interface._run(self._core.send_to_redis(set_path, set_value))


@documented_by(core_space.Publisher)
class Publisher(Writer):
    """Writes one top-level key and notifies its subscribers, in the same transaction."""

    _kind = core_space.Publisher


@documented_by(core.Accessor)
class Accessor(Handle):
    """One place in the dictionary: `kvs["foo"]["bar"]`, `kvs["foo"]["tiles"][0]`.

    It is only a path, immutable and cheap; nothing is sent before a method is called, or it is
    assigned to, deleted from, or changed with `+=`, `-=`, `*=`, `/=`. Every call is atomic and raises
    `redis.exceptions.RedisError` if the server or the connection fails. It is not its value: comparing it with one,
    its truth, arithmetic and the like raise a TypeError that says how to read.
    """

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

    # Not by way of the methods: an error that says it all shows one frame less.

    def __delitem__(self, key: str | int) -> None:
        self._interface._run(self._core[key].delete())

    def __len__(self) -> int:
        return self._interface._run(self._core.length())

    def __iter__(self) -> Iterator[str]:
        return iter(self._interface._run(self._core.keys()))

    def __contains__(self, key: object) -> bool:
        # Anything may stand before `in`; the core says what is wrong with what is no str.
        return self._interface._run(self._core.contains(key))  # type: ignore[arg-type]  # which refuses it

    def _ipython_key_completions_(self) -> list[str]:
        """Return the keys that IPython offers after `["`; none where they cannot be had."""
        try:
            return self.keys()
        except (ReemError, RedisError):
            return []

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

    @property
    def full_path(self) -> tuple[str | int, ...]:
        """The keys and indexes that lead here, top-level key first."""
        return self._core.full_path

    @property
    def path(self) -> list[str | int]:
        """The keys and indexes that lead here from the top-level key."""
        return self._core.path

    @property
    def reader(self) -> Reader:
        """The reader of the top-level key."""
        return Reader(str(self.full_path[0]), self._interface)

    @property
    def writer(self) -> Writer:
        """The writer of the top-level key."""
        return Writer(str(self.full_path[0]), self._interface)

    def read(self) -> Any:
        """Return the value here."""
        return self._interface._run(self._core.read())

    def get(self, *default: Any, default_value: Any = core._NOTHING) -> Any:
        """Return the value here, or a default."""
        return self._interface._run(self._core.get(*default, default_value=default_value))

    def write(self, value: Any) -> None:
        """Store `value` here."""
        self._interface._run(self._core.write(value))

    def delete(self) -> None:
        """Remove the value here."""
        self._interface._run(self._core.delete())

    def length(self) -> int:
        """Return the length of the value here."""
        return self._interface._run(self._core.length())

    def contains(self, key: str) -> bool:
        """Return whether the dict here has the key; also `key in accessor`."""
        return self._interface._run(self._core.contains(key))

    def keys(self) -> list[str]:
        """Return the keys of the dict here; also `for key in accessor`."""
        return self._interface._run(self._core.keys())

    def outline(self) -> Outline:
        """Return the value here without fetching arrays."""
        return self._interface._run(self._core.outline())

    def pop(self, key: str | int = -1, *default: Any) -> Any:
        """Remove an element and return what it was."""
        return self._interface._run(self._core.pop(key, *default))

    def update(self, values: Mapping[str, Any] | Iterable[tuple[str, Any]] = (), /, **more: Any) -> None:
        """Store several entries of the dict here."""
        self._interface._run(self._core.update(values, **more))

    def setdefault(self, key: str, default: Any = None) -> Any:
        """Return an element of the dict here, stored first where there was none."""
        return self._interface._run(self._core.setdefault(key, default))

    def type(self) -> builtins.type:
        """Return the Python type of the value here."""
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

    def expire(self, seconds: float) -> None:
        """Have this top-level key expire."""
        self._interface._run(self._core.expire(seconds))

    def persist(self) -> None:
        """End the expiry of this top-level key."""
        self._interface._run(self._core.persist())

    def edit(self) -> Edit:
        """Return a context manager that reads, lets you change, and writes back; also `with accessor:`."""
        return Edit(self._interface, self._core.edit())

    def watch(self, policy: Policy | None = None, *, stored: bool = True, ttl: float | None = None) -> Watch:
        """Return an iterator over the value here and its changes."""
        return Watch(self._interface, self._follower().watch(policy, stored=stored, ttl=ttl))

    def mirror(
        self,
        *,
        max_age: float | None = None,
        largest: int | None = None,
        stale: Literal["raise", "keep"] = "raise",
        ttl: float | None = None,
    ) -> Mirror:
        """Return a local copy of the value here that follows every change: `with kvs["arm"].mirror() as arm:`."""
        return Mirror(self._interface, self._core.full_path, max_age=max_age, largest=largest, stale=stale, ttl=ttl)

    def parameter(
        self,
        name: str,
        default: Any,
        *,
        low: Any = None,
        high: Any = None,
        unit: str = "",
        help: str = "",  # noqa: A002
        choices: Iterable[Any] | None = None,
        on_change: Callable[[Any], Any] | None = None,
    ) -> Parameter:
        """Declare a parameter in the dict here, and return it: `float(kp)` and `kp.value` are always current."""
        specification = {"low": low, "high": high, "unit": unit, "help": help, "choices": choices}
        declaration = prepared(self.full_path, name, default, on_change=on_change, **specification)
        return declared(self._interface, declaration)

    def _follower(self) -> core.Accessor:
        """Return the core's accessor on the background loop: connections of the caller's thread only ask and answer."""
        kind, writer = type(self._core), self._core._writer.maker()
        session = self._interface._followers.session
        return core.rebuilt(kind, writer, session, self._core.full_path)  # type: ignore[no-any-return]

    def call(self, *, timeout: float | None = None, **arguments: Any) -> Any:
        """Ask the service at this place, and return its answer."""
        return self._interface._wait(self._follower().call(timeout=timeout, **arguments))

    @overload
    def serve(self, function: Callable[..., Any], *, concurrency: int = 1, queue: int = QUEUE) -> Service: ...
    @overload
    def serve(
        self, function: None = None, *, concurrency: int = 1, queue: int = QUEUE
    ) -> Callable[[Callable[..., Any]], Service]: ...

    def serve(self, function: Callable[..., Any] | None = None, *, concurrency: int = 1, queue: int = QUEUE) -> Any:
        """Answer calls of the service at this place with a function: `@kvs["policy"].serve`, or with a `with` block."""
        if function is None:
            return partial(self.serve, concurrency=concurrency, queue=queue)
        return Service(self._interface, self._follower()._service(function, concurrency, queue))

    def own(self, *, ttl: float = 0.2, name: str | None = None, take: bool = False) -> OwnedAccessor:
        """Return this top-level key for its one owner: `with kvs["cmd"].own(name="joystick") as cmd:`."""
        return OwnedAccessor(self._interface, self._core.own(ttl=ttl, name=name, take=take))

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

    @property
    def lost(self) -> bool:
        """Whether the next write raises LeaseLost, as far as is known without asking the server."""
        return self._core.lost

    @property
    def fence(self) -> int:
        """The fencing number of this acquisition, which its updates carry: higher than that of any owner before."""
        return self._core.fence

    def acquire(self) -> None:
        """Become the owner, as entering the block does; three round trips."""
        self._interface._run(self._core.acquire())

    def renew(self) -> None:
        """Renew the lease without a write."""
        self._interface._run(self._core.renew())

    def release(self) -> None:
        """Stop to be the owner: others need not wait until the lease expires."""
        self._interface._run(self._core.release())

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

    @property
    def reader(self) -> Any:
        """Raise WriteOnly."""
        return self._core.reader

    @property
    def writer(self) -> Publisher:
        """The publisher of the top-level key."""
        return Publisher(str(self.full_path[0]), self._interface)

    def mirror(
        self,
        *,
        max_age: float | None = None,
        largest: int | None = None,
        stale: Literal["raise", "keep"] = "raise",
        ttl: float | None = None,
    ) -> Mirror:
        """Raise WriteOnly."""
        refused: Any = self._core.mirror(max_age=max_age, largest=largest, stale=stale, ttl=ttl)
        return refused  # type: ignore[no-any-return]

    def parameter(self, name: str, default: Any, **specification: Any) -> Parameter:
        """Raise WriteOnly."""
        return self._interface._run(self._core.parameter(name, default, **specification))  # type: ignore[return-value]

    def watch(self, policy: Policy | None = None, *, stored: bool = True, ttl: float | None = None) -> Watch:
        """Raise WriteOnly."""
        return self._core.watch(policy, stored=stored, ttl=ttl)  # type: ignore[return-value]


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

    def __exit__(self, *error: Any) -> None:
        self._interface._run(self._core.__aexit__(*error))
