"""Accessor: one place in the dictionary, and what can be done there."""

from __future__ import annotations

import builtins
import operator
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar, overload

import numpy as np

from ..concurrency.queues import Newest, Policy, chosen
from ..connection import RedisInterface
from ..coordination.calls import call
from ..coordination.lease import Lease, OwnedPublisher
from ..coordination.parameter_objects import prepared
from ..coordination.parameters import Parameter, declared
from ..coordination.services import QUEUE, Arguments, Result, Service
from ..errors import BadKey, BadType, MissingDocument, MissingKey, Misuse, WrongType
from ..plan.arguments import Handle, cannot_wait
from ..plan.documents import number_text
from ..plan.paths import Path, check_element, check_name, parse, show
from ..plan.typed import check_annotation
from ..pubsub.mirror import Mirror
from ..pubsub.subscribers import Watch
from .catalog import Outline, outline
from .document import DocumentReader, DocumentWriter, opened, retried
from .view import View

if TYPE_CHECKING:
    from ..plan.reads import RawRead
    from ..session import Session

_NOTHING: Any = object()
T = TypeVar("T")


class Accessor(Handle):
    """One place in the dictionary: `kvs["foo"]["bar"]`, `kvs["foo"]["tiles"][0]`.

    It is only a path, immutable and cheap; nothing is sent before a method is called, or in plain programs it is
    assigned to, deleted from, or changed with `+=`, `-=`, `*=`, `/=`. Every call is atomic, may be cancelled at any
    time (it is then applied once or not at all) and raises `redis.exceptions.RedisError` if the server or the
    connection fails. It is not its value: comparing it with one, its truth, arithmetic and the like raise a TypeError
    that says how to read.
    """

    __slots__ = ("_path", "_reader", "_writer")
    _how_to_read = "await handle.read()"
    _reads: type[DocumentReader] = DocumentReader

    def __init__(self, reader: DocumentReader, writer: DocumentWriter, path: Path) -> None:
        self._reader = reader
        self._writer = writer
        self._path = path

    def __getitem__(self, key: str | int) -> Accessor:
        return type(self)(self._reader, self._writer, (*self._path, check_element(key, self.full_path)))

    __setitem__ = cannot_wait("assignment", "await accessor[{0!r}].write(value)")
    __delitem__ = cannot_wait("del", "await accessor[{0!r}].delete()")
    __iter__ = cannot_wait("iterating", "for key in await accessor.keys(), or await .read()")
    __contains__ = cannot_wait("`in`", "await accessor.contains({0!r}), or await .read()")
    __iadd__ = cannot_wait("`+=`", "await accessor.increment(number), or of a list await accessor.extend(items)")
    __isub__ = cannot_wait("`-=`", "await accessor.increment(-number)")
    __imul__ = cannot_wait("`*=`", "await accessor.multiply(number)")
    __itruediv__ = cannot_wait("`/=`", "await accessor.divide(number)")
    __len__ = cannot_wait("len()", "await accessor.length()")

    @property
    def _place(self) -> tuple[object, Path]:
        return self._reader.session, self.full_path

    @property
    def full_path(self) -> Path:
        """The keys and indexes that lead here, top-level key first."""
        return (self._reader.name, *self._path)

    @property
    def path(self) -> list[str | int]:
        """The keys and indexes that lead here from the top-level key."""
        return list(self._path)

    @property
    def reader(self) -> Reader:
        """The reader of the top-level key."""
        return Reader(self._reader.name, self._reader.session.interface)

    @property
    def writer(self) -> Writer:
        """The writer of the top-level key."""
        return Writer(self._reader.name, self._reader.session.interface)

    async def read(self, *, raw: bool = False) -> Any:
        """Return the value here. Arrays are read-only: they share memory with the reply.

        Pictures that were written as `Jpeg` or `Png` are decoded to arrays; with `raw` they stay as they are, and their
        `data` is the file.

        None if nothing is stored under the top-level key, as with redis-py's GET; the store's `contains` tells whether
        there is.

        One round trip; two or more the first time that arrays are met, or if they moved. Document and arrays are always
        of one instant.

        Raises:
            MissingKey: Nothing is stored here, though the top-level key is there.
            BadData: What is stored here was not written by REEM, or by a ship this interface lacks.
        """
        try:
            return await (self._reader.raw if raw else self._reader).read(self._path)
        except MissingDocument:
            return None
        except MissingKey as error:
            if not self._path or not isinstance(self._path[-1], int):
                raise error.with_traceback(None) from None
        raise await self._reader.no_item(self._path)

    async def get(self, *default: Any, default_value: Any = _NOTHING) -> Any:
        """Return the value here, or `default` (None if not given) if nothing is stored here.

        `get(key, default)`, with two arguments, does so for the element `key`, as in REEM 0.1, where the default may
        also be named: `get(key, default_value=0)`.
        """
        if default_value is not _NOTHING:
            default = (*default, default_value)
        place = self[default[0]] if len(default) > 1 else self
        try:
            return await place._reader.read(place._path)
        except MissingKey:
            return default[-1] if default else None

    async def write(self, value: Any) -> None:
        """Store `value` here, replacing the old value. One round trip.

        Two where this interface stores arrays for the first time (unless it is a whole top-level key), two or three if
        a list on the path holds arrays, and more if another client changed the shape in between.

        With an array of 64 KB or more, calls of this interface in progress in the same event loop are answered first,
        since encoding and sending the array block the loop; the array is stored as it is then. Publishing keeps the
        order of calls instead.

        Raises:
            BadValue, BadType, BadKey, TooDeep: It cannot be stored; nothing was sent.
            PathRefused: The parent is missing or cannot hold this element; nothing was stored. (A single array, or
                other value of a ship, just below a missing top-level key makes a dict for it.)
            Conflict: Other clients kept writing to the same top-level key until the call timed out; nothing was
                stored. Only where the old value must be read first: guarantee 6 in docs/guarantees.md says where.
        """
        await self._writer.set(self._path, value)

    async def delete(self) -> None:
        """Remove the value here. One round trip; more if there were arrays that this interface did not know.

        Raises:
            MissingKey: Nothing was here.
            Conflict: As `write`.
        """
        await self._writer.delete(self._path)

    async def length(self) -> int:
        """Return the number of entries, items, characters, bytes, or rows. One round trip for dicts and lists.

        Raises:
            MissingKey: Nothing is here.
            WrongType: It has no length.
        """
        return await self._reader.length_at(self._path)

    async def contains(self, key: str) -> bool:
        """Return whether the dict here has the key. One round trip; nothing of it is fetched.

        Raises:
            MissingKey: Nothing is here.
            WrongType: It is not a dict.
        """
        return await self._reader.contains_at(self._path, key)

    async def keys(self) -> list[str]:
        """Return the keys of the dict here, in its order. One round trip; the values are not fetched.

        Raises:
            MissingKey: Nothing is here.
            WrongType: It is not a dict.
        """
        return await self._reader.keys_at(self._path)

    async def outline(self) -> Outline:
        """Return the value here without fetching arrays: types, sizes, plain values. One round trip.

        Printed, or shown by a notebook, it is a line for each value; an array is its dtype, shape and bytes.

        Raises:
            MissingKey: Nothing is here.
            BadData: The value here was not written by REEM.
        """
        return await outline(self._reader.session.interface, self.full_path)

    async def pop(self, key: str | int = -1, *default: Any) -> Any:
        """Remove the element `key`, by default the last item of a list, and return what it was.

        Three round trips, again if another client writes to the same top-level key in between; one if there is nothing
        and a default is given, which is then returned.

        Raises:
            MissingKey: Nothing is there and no default was given.
            Conflict: Others changed it each of many times, or kept writing to the same top-level key.
        """
        return await self[key]._take(*default)

    async def _take(self, *default: Any) -> Any:
        """Do what `pop` does, with the value here."""
        if len(default) > 1:
            raise BadType(f"pop() takes one default, not {len(default)}")

        async def attempt() -> Any:
            before = await self._reader.raw_read(self._path)
            value = await opened(before)
            await self._writer.take(self._path, before)
            return value

        try:
            return await retried(attempt)
        except MissingKey as error:
            if not default:
                raise error.with_traceback(None) from None
            return default[0]

    async def update(self, values: Mapping[str, Any] | Iterable[tuple[str, Any]] = (), /, **more: Any) -> None:
        """Store each of `values`, and of the named ones, in the dict here, as `dict.update` does: all or none.

        One transaction, one round trip; two where this interface puts arrays for the first time. Each value
        is published by itself, in the same transaction. As with `write`, more if another client changed the
        shape of what is replaced.

        Raises:
            BadValue, BadType, BadKey, TooDeep: A value cannot be stored; nothing was sent.
            PathRefused: No dict is here; nothing was stored.
            Conflict: As `write`.
        """
        await self._writer.update(self._path, dict(values, **more))

    async def setdefault(self, key: str, default: Any = None) -> Any:
        """Return the value at `key` of the dict here; where there is none, store `default` first.

        One round trip if it is there (two or more for arrays, as `read`), else three, again if another client writes
        to the same top-level key in between.

        Raises:
            PathRefused: No dict is here.
            Conflict: Others changed it each of many times, or kept writing to the same top-level key.
        """
        return await self[check_name(key, self.full_path)]._read_or_put(default)

    async def _read_or_put(self, default: Any) -> Any:
        """Do what `setdefault` does, with the value here."""

        async def attempt() -> Any:
            try:
                return await self._reader.read(self._path)
            except MissingKey as error:
                missing = error
            await self._writer.put_absent(self._path, default, missing)
            return default

        return await retried(attempt)

    async def type(self) -> builtins.type:
        """Return the Python type of the value here: dict, list, int, float, bool, str, numpy.ndarray, ...

        One round trip, two for strings and arrays.

        Raises:
            MissingKey: Nothing is here.
        """
        return await self._reader.type_at(self._path)

    async def increment(self, number: float = 1) -> Any:
        """Add `number` to the number here; returns the result.

        One round trip; two the first time, after a write to the top-level key, and near the ends of 64 bits; more if
        another client writes to the same top-level key in between.

        Raises:
            MissingKey: Nothing is here.
            WrongType: It is not a number.
            Overflow: The result is out of range (of integers, -2^63 to 2^63-1: servers calculate with these); the old
                value is kept.
            Conflict: As `write`.
        """
        return await self._writer.calculate(self._path, "JSON.NUMINCRBY", operator.add, number)

    async def decrement(self, number: float = 1) -> Any:
        """Subtract `number` from the number here; returns the result. Raises and costs as `increment`."""
        plain = number.item() if isinstance(number, np.generic) else number  # unsigned ones have no negative
        number_text(plain, self.full_path)
        if plain == 0:  # the integer 0 has no negative either: -0.0 - 0 is -0.0, -0.0 + 0 is 0.0
            return await self._writer.compute(self._path, lambda value: value - plain)
        return await self.increment(-plain)

    async def multiply(self, number: float) -> Any:
        """Multiply the number here by `number`; returns the result. Raises and costs as `increment`."""
        return await self._writer.calculate(self._path, "JSON.NUMMULTBY", operator.mul, number)

    async def divide(self, number: float) -> Any:
        """Divide the number here by `number`, as Python's `/` does; returns the result.

        Two round trips, again if another client writes to the same top-level key in between. Raises
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
            WrongType: It is not a list.
            BadType: `value` cannot be stored.
            Conflict: As `write`.
        """
        await self._writer.extend(self._path, [value])

    async def extend(self, values: Iterable[Any]) -> None:
        """Append each of `values` to the list here, all or none. Raises and costs as `append`."""
        await self._writer.extend(self._path, list(values))

    async def expire(self, seconds: float) -> None:
        """Have this top-level key expire: document, arrays and what belongs to it go after `seconds`, at once.

        Subscribers see a deletion. A later write keeps the time that is left, but arrays that it stores do not expire:
        call this again after each write with arrays. A key that is deleted and written again does not expire.

        One transaction, two round trips, again if another client writes to the key in between. Needs the right
        +pexpire.

        Args:
            seconds: How long from now, to the millisecond, by the server's clock; an earlier expiry is replaced.

        Raises:
            BadKey: It is not a top-level key.
            BadType, BadValue: Not a number of seconds over 0, up to 1e10.
            MissingKey: Nothing is here.
            Conflict: As `write`.
        """
        await self._writer.expire(self._path, seconds)

    async def persist(self) -> None:
        """End the expiry of this top-level key, arrays included; nothing changes if it has none.

        Costs and raises as `expire`; the right is +persist.
        """
        await self._writer.expire(self._path, None)

    def edit(self) -> Edit:
        """Return a context manager that reads the value, lets you change it, and writes it back.

        Nothing is written if the block raises. Two round trips to write. Pictures are `Jpeg` and `Png` in it, and
        written back as they were; `decode()` returns their arrays.

        Raises:
            MissingKey: Nothing is here (on entering).
            WrongType: It is a number, text or None, which cannot be changed in place.
            Conflict: Another client changed it in between, or others kept writing to the same top-level key (on
                leaving); nothing was written.
        """
        return Edit(self._reader.raw, self._writer, self._path)

    def watch(self, policy: Policy | None = None, *, stored: bool = True, ttl: float | None = None) -> Watch:
        """Return an async iterator over the value here, first as it is, then each time any client changes it.

        Example:
            async for update in kvs["arm"].watch():
                print(update.path, update.value, update.data)

        An `Update` holds `path` (what changed, such as "arm.joint"), `value` (what was written there), `data` (all that
        is here now), and how it came about: `time`, `origin`, `late`, `deleted`, `initial`, `gap` and `missed`.

        Published updates arrive one by one. Plain writes (by a KeyValueStore, another language, redis-cli, an expiry,
        ...) arrive as the state they led to: several in a short time may be one update, and the last state always
        arrives.

        Args:
            policy: What to keep for a loop that is slower than the updates: `Newest()` (the
                default), `Last(n)` or `Every(bound)`, all from `reem_async`, such as `reem_async.Last(100)`.
            stored: Yield plain writes too. It needs the right to use CLIENT TRACKING; without, a warning is logged, and
                only published updates arrive.
            ttl: Seconds without a published update after which there is silence, by the clock of this program: one
                update with `silent=True` says so, within some milliseconds, also if the publisher, the server or the
                network is gone. Only published updates arrive then, and none that is older than `ttl`.

        Raises:
            BadType, BadValue: A policy or `ttl` that cannot be used; `ttl` with `Every`, or at an index from the end.
        """
        policy = chosen(policy, Newest())
        return Watch(self._reader.session, self._reader.keys, self._path, policy, stored=stored, ttl=ttl)

    def mirror(
        self,
        *,
        max_age: float | None = None,
        largest: int | None = None,
        stale: Literal["raise", "keep"] = "raise",
        ttl: float | None = None,
    ) -> Mirror:
        """Return a local copy of the value here that follows every change: `async with kvs["arm"].mirror() as arm:`.

        `arm.value()` and `arm["joint"].read()` answer from memory, `arm.age` says how old that may be, and
        `await arm.wait_until(predicate, timeout)` waits for a change.

        Args:
            max_age: Largest `age` of an answer in seconds, 0.005 at least; beyond it, and without a connection, answers
                raise Stale. It measures the link to the server, which is probed three times in that time, and does not
                notice a dead publisher.
            largest: Bytes of an array up to which it is fetched; an `Unfetched` is in the place of a larger one, with
                its `label`, `size` and `summary`. `kvs["arm"]["image"].read()` fetches it.
            stale: "keep" has answers return the last known value while the connection is down, instead of raising.
                `age` says how old that is.
            ttl: Seconds after the last published update in which answers count, on this program's clock; then they
                raise Silent, also if the publisher, the server or the network is gone, or return what is given:
                `cmd.value(default=STOP)`. What is found at the beginning or after a break does not count.

        Raises:
            BadType, BadValue: An argument that cannot be used, or `max_age` or `ttl` with `stale="keep"`.
        """
        return Mirror(
            self._reader.session,
            self._reader.keys,
            self._path,
            max_age=max_age,
            largest=largest,
            stale=stale,
            ttl=ttl,
        )

    async def parameter(
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
        """Declare a parameter in the dict here, and return it: `float(kp)` and `kp.value` are always current.

        Example:
            kp = await kvs["control"].parameter("kp", 2.0, low=0.0, high=10.0, unit="1/s")

        The value is stored at `control.kp`. A stored value wins over the default; where none is stored, the default is
        stored. A stored value of another type or out of range is ignored, logged once ("reem.parameters") and shown in
        `kp.invalid`. In an outage the last value stays. Two to six round trips, more for the first one of a server.

        Args:
            name: The key in the dict here, which is made if it is missing.
            default: A bool, int, float, str, or a list or array of up to 64 numbers. It decides the type: a parameter
                with the default 2 takes no 2.5. Or an object of a dataclass, `msgspec.Struct` or `pydantic.BaseModel`:
                each of its fields is a parameter, with the bounds that the class gives it, and `value` is an object.
            low: The least number; of a vector also a vector. None for no bound.
            high: The greatest number, likewise.
            unit: Such as "1/s"; for people.
            help: What it does; for people.
            choices: The values that it may have.
            on_change: A function, called with each new value (the newest only, if it is slow), also after this
                program's own writes, and not with the first value. In asyncio a plain or a coroutine function, on the
                event loop; in plain programs on a thread of its own.

        Raises:
            BadType, BadValue, BadKey: It cannot be declared so, or was declared differently in this program.
            PathRefused: The place here holds something that is not a dict.
            NotConnected: No server listens there.
            NotAllowed: The user may not read or follow the key. Without the right to write, the parameter can be read.
        """
        specification = {"low": low, "high": high, "unit": unit, "help": help, "choices": choices}
        declaration = prepared(self.full_path, name, default, on_change=on_change, **specification)
        return await declared(self._reader.session, declaration)

    async def call(self, /, *, timeout: float | None = None, **arguments: Any) -> Any:  # noqa: ASYNC109
        """Ask the service at this place, and return its answer: `actions = await kvs["policy"].call(image=image)`.

        One of the programs that `serve` here calls its function with these arguments, at most once. Arrays in an answer
        are read-only. A call that is left, by cancelling or by its timeout, cancels a coroutine function, and is not
        begun if it still waits.

        A message to the server and one back. The first call subscribes and looks for servers, two round trips more. A
        value over 64 KB that does not go through shared memory takes one more.

        Args:
            timeout: Seconds to wait for the answer; what `reem_async.timeout` says, or 10, if not given. A request
                that is not begun by then is never begun.
            arguments: The arguments of the function, by name. None can be called `timeout`.

        Raises:
            BadValue, BadType, BadKey, TooDeep: An argument cannot be stored, or not a timeout; nothing was sent.
            NoService: No program serves this; at once.
            Busy: Too many requests wait at every server; at once.
            CallTimeout: No answer in time. Also TimeoutError.
            RemoteError: The function raised an exception, or returned what cannot be stored.
            ServiceLost: The server ended or does not answer any more; within 0.3 s, or 1.2 s if it hangs.
            ConnectionLost: The connection broke before the answer came.
            BadData: The answer was written by a ship this interface lacks.
        """
        return await call(self._reader.session, self._reader.keys, self._path, arguments, timeout)

    @overload
    def serve(
        self, function: Callable[Arguments, Result], *, concurrency: int = 1, queue: int = QUEUE
    ) -> Service[Arguments, Result]: ...
    @overload
    def serve(
        self, function: None = None, *, concurrency: int = 1, queue: int = QUEUE
    ) -> Callable[[Callable[Arguments, Result]], Service[Arguments, Result]]: ...

    def serve(self, function: Callable[..., Any] | None = None, *, concurrency: int = 1, queue: int = QUEUE) -> Any:
        """Answer calls of the service at this place with a function: `@kvs["policy"].serve`, or with a `with` block.

        Example:
            async with kvs["policy"].serve(act, concurrency=2):
                ...

        A plain function runs on a thread of REEM's own, and may use REEM. In asyncio a coroutine function runs on the
        event loop and is cancelled when its caller leaves; it must not block. An exception reaches the caller as
        RemoteError. Functions that serve the same place share the calls.

        In plain programs it has begun when this returns. In asyncio it begins in the background; `async with` and
        `await service.listen()` return when it has begun. It ends with `close()`, the interface or the program.

        Args:
            function: What answers. It gets the arguments of a call by name; arrays are read-only.
            concurrency: How many calls are handled at a time.
            queue: How many more requests may wait. Beyond, callers try other servers, or get Busy.

        Raises:
            BadType, BadValue: `function` cannot be called, or the others are not whole numbers of at least 1.
            WrongLoop: In asyncio, no event loop is running.
            NotConnected, NotAllowed: In plain programs, no server, or a right is missing.
        """
        if function is None:
            return partial(self.serve, concurrency=concurrency, queue=queue)
        service = self._service(function, concurrency, queue)
        service.begin()
        return service

    def _service(
        self, function: Callable[Arguments, Result], concurrency: int, queue: int
    ) -> Service[Arguments, Result]:
        return Service(self._reader.session, self._reader.keys, self._path, function, concurrency, queue)

    def own(self, *, ttl: float = 0.2, name: str | None = None, take: bool = False) -> OwnedAccessor:
        """Return this top-level key for its one owner: `async with kvs["cmd"].own(name="joystick") as cmd:`.

        Inside, `cmd` is written like a place of a PublishSpace, and can be read. Each write notifies subscribers and
        renews the lease, in one transaction and one round trip (two in a cluster). The lease expires `ttl` seconds
        after the last write; `await cmd.renew()` renews it without one. Leaving the block releases it. Programs that
        do not call `own` are not kept from writing: readers with a `ttl` ignore them while there is an owner.

        Entering takes three round trips; it raises Owned if another program owns the key, NotAllowed if a right is
        missing. A write raises LeaseLost, with nothing written, if the lease has expired or another owner has it; then
        `cmd.lost` is true, and `await cmd.acquire()` owns the key again.

        Args:
            ttl: Seconds for which the lease lasts after each write, 0.001 to 3600. Write at least twice as often.
            name: How errors of others name the owner, 1 to 64 characters; the name of the program if not given.
            take: Take the key from another owner, whose next write raises LeaseLost.

        Raises:
            BadKey: It is not a top-level key.
            BadType, BadValue: An argument that cannot be used.
        """
        if self._path:
            raise BadKey(
                f"{show(self.full_path)}: only a whole top-level key can be owned; use kvs[{self._reader.name!r}].own()"
            )
        session = self._reader.session
        lease = Lease(session, self._reader.keys, ttl, name, take)
        return OwnedAccessor(self._reader, OwnedPublisher(lease, session), ())

    @overload
    def of(self, kind: builtins.type[T]) -> View[T]: ...
    @overload
    def of(self, kind: Any) -> View[Any]: ...

    def of(self, kind: Any) -> View[Any]:
        """Return this place as objects of a class: `arm = kvs["arm"].of(Arm)`, `await arm.read()`.

        Args:
            kind: A dataclass, `msgspec.Struct` or `pydantic.BaseModel`, or an annotation, such as `list[Arm]`. See
                docs/howto/typed.md for the types that fields may have.

        Raises:
            BadType: It is no class and no annotation.
        """
        check_annotation(kind, self.full_path)
        return View(self, kind)

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt, (type(self), self._writer.maker(), self._reader.session, self.full_path)


def rebuilt(kind: Any, writer: Any, session: Session, path: tuple[Any, ...]) -> Any:
    """Make an accessor from the parts of a pickled one."""
    return kind(kind._reads(session, path[0]), writer(session, path[0]), path[1:])


class OwnedAccessor(Accessor):
    """A top-level key that this program owns: what `Accessor.own` returns. See there."""

    __slots__ = ()
    _writer: OwnedPublisher

    def __getitem__(self, key: str | int) -> Accessor:
        # Only the top-level key is owned, acquired and released.
        return Accessor(self._reader, self._writer, (check_element(key, self.full_path),))

    @property
    def lost(self) -> bool:
        """Whether the next write raises LeaseLost, as far as is known without asking the server."""
        return self._writer.lease.lost

    @property
    def fence(self) -> int:
        """The fencing number of this acquisition, which its updates carry: higher than that of any owner before."""
        held = self._writer.lease.held
        return 0 if held is None else held.claim.number

    async def acquire(self) -> None:
        """Become the owner, as entering the block does; three round trips.

        Raises:
            Owned: Another program owns the key.
            NotAllowed: The user lacks a right.
        """
        await self._writer.lease.acquire()

    async def renew(self) -> None:
        """Renew the lease without a write. One round trip, two in a cluster.

        Raises:
            LeaseLost: It has expired, or another owner has it.
        """
        await self._writer.lease.renew()

    async def release(self) -> None:
        """Stop to be the owner: others need not wait until the lease expires. One round trip, two in a cluster.

        Nothing is done if this is not the owner, or if the server cannot be reached. Idempotent.
        """
        await self._writer.lease.release()

    async def __aenter__(self) -> Self:
        await self.acquire()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.release()

    def __reduce__(self) -> tuple[Any, ...]:
        raise Misuse(f"{show(self.full_path)}: a lease cannot be copied or sent to another process; call own() there")


class Edit:
    """What `Accessor.edit` returns."""

    def __init__(self, reader: DocumentReader, writer: DocumentWriter, path: Path) -> None:
        self._reader = reader
        self._writer = writer
        self._path = path
        self._before: RawRead | None = None
        self._value: Any = None

    async def __aenter__(self) -> Any:
        self._before = await self._reader.raw_read(self._path)
        await opened(self._before)
        for slot, _, _ in self._before.slots:
            value = slot.container[slot.key]
            # What was read shares its memory with the reply; the block may change arrays in place.
            if isinstance(value, np.ndarray) and not value.flags.writeable:
                slot.container[slot.key] = value.copy()
        self._value = self._before.holder[0]
        if not isinstance(self._value, dict | list | np.ndarray):
            where = show((self._reader.name, *self._path))
            raise WrongType(
                f"{where} is of type {type(self._value).__name__}, which cannot be changed in place; "
                "edit the dict or list that holds it, or use write()"
            )
        return self._value

    async def __aexit__(self, kind: object, *_: object) -> None:
        # Compared with what was read, byte by byte, under WATCH: a change by another client since then is a Conflict.
        if kind is None and self._before is not None:
            await self._writer.exchange(self._path, self._value, self._before)


class Reader:
    """Reads one top-level key."""

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.top_key_name = top_key_name
        self._document = DocumentReader(interface.session, top_key_name)

    async def read_from_redis(self, read_path: str) -> Any:
        """Return the value at a path like ".a.b" (or "." for all); see `Accessor.read`."""
        try:
            return await self._document.read(parse(read_path))
        # As the original did, and as GET does.
        except MissingDocument:
            return None


class Writer:
    """Writes one top-level key."""

    _kind: type[DocumentWriter] = DocumentWriter

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.top_key_name = top_key_name
        self._document = self._kind(interface.session, top_key_name)

    async def send_to_redis(self, set_path: str, set_value: Any) -> None:
        """Store a value at a path like ".a.b" (or "." for all); see `Accessor.write`."""
        await self._document.set(parse(set_path), set_value)
