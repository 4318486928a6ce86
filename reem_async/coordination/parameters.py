"""Parameters: values that programs declare with type and bounds, and read without a round trip.

The value of a parameter is stored where its path says, like any other value. What programs declare is stored in the
document `_parameters`, so that tools know it. All parameters of a top-level key share one follower.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from typing import Any, Generic, NamedTuple, NoReturn, TypeVar

import numpy as np

from ..concurrency.queues import BoundedQueue, Newest
from ..concurrency.streams import Stream
from ..errors import (
    BadData,
    BadInput,
    BadKey,
    BadType,
    BadValue,
    MissingKey,
    NotAllowed,
    RedisError,
    ReemError,
    Stale,
)
from ..plan.arguments import Handle
from ..plan.keys import Keys
from ..plan.paths import Path, below, check_name, has_index, parse, shorten, show
from ..plan.trees import MISSING, get
from ..plan.writes import make_parents
from ..pubsub.callbacks import Caller, Calls
from ..pubsub.events import Update
from ..pubsub.follower import Follower
from ..pubsub.manager import manager_of
from ..pubsub.subscribers import Link
from ..session import Session
from ..store.document import DocumentReader, DocumentWriter, retried
from ..store.publish import publisher
from .specification import Specification, as_json, equal, from_stored, specified

logger = logging.getLogger("reem.parameters")

T = TypeVar("T")

SPECIFICATIONS = "_parameters"
"""The top-level key under which programs store what they declare, by the path of the parameter as text."""

_LARGEST = 4096  # bytes of an array that is fetched: a vector that another program has stored as an array is smaller
_ECHO = 0.5  # seconds to wait until a value that was written is in the copy; it is later only if the connection broke
_PAUSE = 1.0  # seconds between attempts to store defaults that are gone
_MOST_REPORTED = 20  # different warnings about one parameter


class Declaration(NamedTuple):
    path: Path
    specification: Specification
    is_array: bool  # values are given to the program as arrays
    on_change: Callable[[Any], Any] | None

    def given(self, value: Any) -> Any:
        """Return a value as the program gets it."""
        if not isinstance(value, tuple):
            return value
        if not self.is_array:
            return list(value)
        array = np.array(value)
        array.flags.writeable = False
        return array

    async def begin(self, group: ParameterGroup) -> LiveParameter:
        return await group.declare(self)


def prepared(
    parent: Path, name: Any, default: Any, *, on_change: Callable[[Any], Any] | None = None, **specification: Any
) -> Declaration:
    """Return a declaration; raises BadInput for what cannot be declared. Nothing is sent."""
    path = (*parent, check_name(name, parent))
    where = show(path)
    if has_index(path) or path[0] == SPECIFICATIONS:
        raise BadKey(f"{where}: a parameter cannot be in a list or in {SPECIFICATIONS}; use a dict of another key")
    if '"' in where and "'" in where:
        raise BadKey(f"{where}: a quote in the path of a parameter does not go with a dot or quote; use other names")
    check_on_change(where, on_change)
    found = specified(where, default, **specification)
    return Declaration(path, found, isinstance(default, np.ndarray), on_change)


def check_on_change(where: str, function: Any) -> None:
    if function is not None and not callable(function):
        raise BadType(f"{where}: on_change={shorten(function)} is not a function; use one that takes the value")


class ChangeQueue(BoundedQueue):
    """The value of one parameter that waits for a call of `on_change`: only the newest."""

    def __init__(self) -> None:
        super().__init__(Newest())

    def put(self, update: Any) -> None:
        """Ignore the updates of the top-level key: its follower closes this queue, the parameter fills it."""

    def put_value(self, path: str, value: Any) -> None:
        super().put(Update(path, value, value))

    def _skip(self) -> None:
        """Report no losses: only the newest value matters."""


class Live:
    """What a program follows of one declaration."""

    def __init__(self, group: ParameterGroup, path: Path, default: Any) -> None:
        self.group = group
        self.path = path
        self.name = show(path)
        self.default = default
        self.value = default  # the last good one
        self.invalid = ""  # why the stored value is not used; empty if it is
        self.begun = False  # changes are reported
        self.changes: list[tuple[ChangeQueue, Callable[[Any], Any]]] = []  # with what makes a value the program's
        self._waiting: list[tuple[Callable[[], bool], asyncio.Future[None]]] = []
        self._reported: set[str] = set()

    async def write(self, value: Any) -> None:
        """Check and publish a value; when this returns, it is the present one unless another was written since."""
        raise NotImplementedError

    def _set(self, value: Any) -> None:
        self.value = value
        if self.begun:
            for queue, given in self.changes:
                queue.put_value(self.name, given(value))

    def _wake(self) -> None:
        for condition, future in self._waiting:
            if condition() and not future.done():
                future.set_result(None)

    def report(self, text: str) -> None:
        if text not in self._reported and len(self._reported) < _MOST_REPORTED:
            self._reported.add(text)
            logger.warning("%s", text)

    @contextlib.contextmanager
    def awaited(self, condition: Callable[[], bool]) -> Iterator[asyncio.Future[None]]:
        """Yield a future that is done once a state of the copy fulfils a condition."""
        waiting = condition, asyncio.get_running_loop().create_future()
        if condition():
            waiting[1].set_result(None)
        self._waiting.append(waiting)
        try:
            yield waiting[1]
        finally:
            self._waiting.remove(waiting)

    async def _written(self, condition: Callable[[], bool], publishing: Awaitable[None]) -> None:
        """Publish, and wait until the copy has it."""
        with self.awaited(condition) as seen:
            await publishing
            await asyncio.wait([seen], timeout=_ECHO)


class LiveParameter(Live):
    def __init__(self, group: ParameterGroup, path: Path, specification: Specification) -> None:
        super().__init__(group, path, specification.default)
        self.specification = specification
        self.gone = True  # nothing is stored
        self._raw: Any = MISSING

    def take(self, raw: Any) -> None:
        if raw is self._raw:  # the copy shares what has not changed
            return
        self._raw = raw
        self.gone, self.invalid = raw is MISSING, ""
        if self.gone:
            self._set(self.specification.default)
            if self.begun:
                self.group.restore(self)
        else:
            try:
                self._set(self.specification.checked(self.name, raw))
            except BadInput as error:
                self.invalid = str(error)
                self.report(f"the stored value is ignored, and {shorten(as_json(self.value))} stays: {error}")
        self._wake()

    def _set(self, value: Any) -> None:
        if not equal(value, self.value):
            super()._set(value)

    async def write(self, value: Any) -> None:
        value = self.specification.checked(self.name, value)
        await self._written(
            lambda: not self.gone and not self.invalid and equal(value, self.value),
            publish(self.group.session, self.path, value),
        )


class ParameterGroup:
    """The parameters of one top-level key in one event loop, and the follower that they share."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self.session = session
        self._keys = keys
        self._parameters: dict[Path, LiveParameter] = {}
        self.objects: dict[tuple[Path, type], Any] = {}  # by path and class
        self.queues: list[BoundedQueue] = []  # closed when following ends
        make = partial(Follower, keys, (), session.ships, session.cache, stored=True, largest=_LARGEST)
        self._link = Link(session, make, self.queues)
        self._link.on_state = self._take
        self._lock = asyncio.Lock()  # one declaration at a time
        self._restoring: asyncio.Task[Any] | None = None
        self._may_be_lost = False  # there was an outage: the server may have forgotten what was declared

    async def declare(self, declaration: Declaration) -> LiveParameter:
        """Return the parameter, followed, and stored if it was not; raises BadValue if it was declared differently."""
        path, specification = declaration.path, declaration.specification
        async with self._lock:
            live = self._parameters.get(path)
            if live is None:
                live = self._parameters[path] = LiveParameter(self, path, specification)
                try:
                    await self._begin(live)
                except BaseException:
                    del self._parameters[path]
                    raise
            elif live.specification != specification:
                raise BadValue(
                    f"{live.name} is declared twice in this program and differently: {live.specification.stored()} "
                    f"and {specification.stored()}; declare it once, or with equal arguments"
                )
            return live

    async def _begin(self, live: LiveParameter) -> None:
        await self._link.follow()
        assert self._link.follower is not None
        live.take(self._link.follower.at(live.path[1:]))
        if live.gone:
            try:
                with live.awaited(lambda: not live.gone) as seen:
                    await self._store_default(live)
                    await asyncio.wait([seen], timeout=_ECHO)
            except NotAllowed as error:
                logger.warning("%s: its default is used and cannot be stored: %s", live.name, error)
        live.begun = True
        try:
            await self._describe(live)
        except NotAllowed as error:
            logger.warning("%s: tools will not know its type and bounds: %s", live.name, error)

    def _take(self, tree: Any) -> None:
        follower = self._link.follower
        if follower is None or follower.down:  # in an outage the values stay
            self._may_be_lost = any(live.begun for live in self._parameters.values())
            return
        for live in tuple(self._parameters.values()):
            live.take(get(tree, live.path[1:]))
        for each in tuple(self.objects.values()):
            each.take()
        if self._may_be_lost:
            self._restore_soon()

    @property
    def is_followed(self) -> bool:
        """Whether the values are kept current, or will be after an outage. Any thread may ask."""
        link = self._link
        return link.follows and not link.interface_closed and getattr(link.follower, "failure", None) is None

    def check(self, name: str) -> None:
        if self.is_followed:
            return
        if self._link.interface_closed:
            raise Stale(f"{name}: the RedisInterface of this parameter is closed; declare it with a new one")
        if self._link.follows and self._link.follower is not None:
            failure = self._link.follower.failure
            raise Stale(f"{name}: following has ended over an error: {failure!r}; restart the program")
        raise Stale(f"{name}: this parameter was declared in another process or event loop; declare it here")

    async def _store_default(self, live: LiveParameter) -> None:
        """Publish the default unless something is stored: of several programs, the first one does."""
        writer, inner = publisher(self.session, self._keys.name, "raise"), live.path[1:]
        reader = DocumentReader(self.session, self._keys.name)

        async def attempt() -> None:
            await self.session.run(make_parents(self._keys, inner))
            try:
                await reader.read(inner)
            except MissingKey as error:
                missing = error
            else:
                return
            await writer.put_absent(inner, as_json(live.specification.default), missing)

        await retried(attempt)

    async def _describe(self, live: LiveParameter, *, again: bool = False) -> None:
        """Store the specification for tools; `again`, only if there is none."""
        place, session = (live.name,), self.session
        try:
            found = await DocumentReader(session, SPECIFICATIONS).read(place)
        except MissingKey:
            await session.run(make_parents(session.keys(SPECIFICATIONS), place))
        else:
            if again:
                return
            with contextlib.suppress(BadData):
                if from_stored(live.name, found) == live.specification:
                    return
            logger.warning(
                "%s: another program has declared it differently: %s; this declaration replaces that",
                live.name,
                shorten(found, 200),
            )
        await DocumentWriter(session, SPECIFICATIONS).set(place, live.specification.stored())

    def restore(self, live: LiveParameter) -> None:
        default = shorten(as_json(live.specification.default))
        logger.warning(
            "%s is gone from the server (deleted, or lost in a restart): its default %s is used and stored again",
            live.name,
            default,
        )
        self._restore_soon()

    def _restore_soon(self) -> None:
        if self._restoring is None or self._restoring.done():
            self._restoring = manager_of(self.session).tasks.start(self._restore(), f"reem restore {self._keys.name}")

    async def _restore(self) -> None:
        """Store what is gone until nothing is, at most once a second: another program may delete it again and again."""
        while self._may_be_lost or any(live.gone and live.begun for live in self._parameters.values()):
            self._may_be_lost = False
            for live in [each for each in self._parameters.values() if each.begun]:
                try:
                    if live.gone:
                        await self._store_default(live)
                    await self._describe(live, again=True)
                except (ReemError, RedisError, OSError) as error:
                    live.report(f"{live.name}: its default cannot be stored: {error}")
            await asyncio.sleep(_PAUSE)


async def declare(session: Session, declaration: Any) -> Live:
    """Return the parameter of a declaration; see `Accessor.parameter`."""
    kept, keys = manager_of(session).kept, session.keys(declaration.path[0])
    place = ParameterGroup, keys.name
    group: ParameterGroup = kept.get(place) or kept.setdefault(place, ParameterGroup(session, keys))
    live: Live = await declaration.begin(group)
    return live


def changes_of(live: Live, declaration: Any) -> tuple[Caller, ChangeQueue]:
    """Return what calls the `on_change` of a declaration, and the queue of the values that it is called with."""
    on_change, queue = declaration.on_change, ChangeQueue()
    assert on_change is not None
    live.group.queues.append(queue)
    live.changes.append((queue, declaration.given))
    return Caller(live.name, lambda update: on_change(update.data)), queue


class Parameter(Handle, Generic[T]):
    """A value that is declared with type and bounds, kept current, and read without a round trip.

    `await kvs["control"].parameter("kp", 2.0, low=0.0, high=10.0)` returns one. `float(kp)`, `int(kp)`, `bool(kp)`,
    `str(kp)` and `kp.value` are the value as of now.
    """

    __slots__ = ("_declaration", "_live")
    _how_to_read = ".value, float() or int()"

    def __init__(self, live: Live, declaration: Any) -> None:
        self._live = live
        self._declaration = declaration

    @property
    def value(self) -> T:
        """The value as of now, without a round trip: the last good one that was stored, or the default.

        Any thread may ask. A vector is a new list, or a read-only array if the default is an array. An object is a new
        one, whose arrays are read-only: changing it changes nothing else. Raises Stale once the interface is closed,
        and in a forked child or another event loop until it is declared there.
        """
        self._check()
        value: T = self._declaration.given(self._live.value)
        return value

    @value.setter
    def value(self, value: T) -> None:
        self._assign(value)

    def _check(self) -> None:
        self._live.group.check(self._live.name)

    def _assign(self, value: Any) -> None:
        raise BadType(f"assignment cannot wait for the server; use: await parameter.write({shorten(value)})")

    async def write(self, value: T) -> None:
        """Publish a value. One round trip, three for an object; afterwards it is `value`, unless one was written since.

        Raises:
            BadType, BadValue: It is not of the type, out of range or not among the choices; nothing was sent.
            NotConnected, ConnectionLost: As any write.
        """
        await self._live.write(value)

    @property
    def invalid(self) -> str:
        """Why the stored value is not used, such as "control.kp: 99 is out of range; ..."; empty if it is used."""
        return self._live.invalid

    @property
    def name(self) -> str:
        """The path, such as "control.kp"."""
        return self._live.name

    @property
    def default(self) -> T:
        """The value where none is stored."""
        default: T = self._declaration.given(self._live.default)
        return default

    @property
    def _place(self) -> tuple[object, Path]:
        return self._live.group, self._live.path

    def __float__(self) -> float:
        value: Any = self.value
        return float(value)

    def __int__(self) -> int:
        value: Any = self.value
        return int(value)

    def __bool__(self) -> bool:
        return bool(self.value)

    def __str__(self) -> str:
        return str(self.value)

    def __format__(self, spec: str) -> str:
        return format(self.value, spec)

    def __repr__(self) -> str:
        return f"<{type(self).__module__.partition('.')[0]}.Parameter {self.name} {shorten(as_json(self._live.value))}>"

    def __reduce__(self) -> NoReturn:
        raise BadType(f"{self.name}: a parameter cannot be pickled; declare it in each program")


async def declared(session: Session, declaration: Any) -> Parameter[Any]:
    live = await declare(session, declaration)
    if declaration.on_change is not None:
        caller, queue = changes_of(live, declaration)
        Calls(caller, Stream(Newest(), queue), manager_of(session).callers)
    return Parameter(live, declaration)


class StoredParameter(NamedTuple):
    """A parameter as tools see it: what was declared, and what is stored."""

    path: Path
    specification: Specification
    value: Any  # what is stored, None if nothing is or it is not allowed; a vector is a tuple
    invalid: str = ""  # why what is stored is not allowed

    @property
    def name(self) -> str:
        """The path as text."""
        return show(self.path)

    @property
    def used(self) -> Any:
        """What a program uses that starts now."""
        return self.specification.default if self.value is None else self.value


async def stored_parameters(session: Session, under: Path = ()) -> tuple[dict[Path, StoredParameter], list[str]]:
    """Return what programs have declared at and below a path, by path and in its order, and why entries were left out.

    Any program may have written the entries. One round trip, and another one for all values together.
    """
    try:
        entries = await DocumentReader(session, SPECIFICATIONS).read(())
    except MissingKey:
        entries = {}
    if not isinstance(entries, dict):
        return {}, [f"{SPECIFICATIONS}: {shorten(entries)} is not a dict; remove it"]
    found: dict[Path, Specification] = {}
    refused = []
    for name, data in entries.items():
        try:
            path = parse(name)
            if len(path) < 2 or has_index(path):
                raise BadKey(f"{SPECIFICATIONS}: {shorten(name)} is not the path of a parameter; remove it")
            session.keys(path[0])
            found[path] = from_stored(show(path), data)
        except (BadInput, BadData) as error:
            refused.append(str(error))
    wanted = sorted(path for path in found if below(path, under))
    each = await asyncio.gather(*[_with_value(session, path, found[path]) for path in wanted])
    return {it.path: it for it in each}, refused


async def _with_value(session: Session, path: Path, specification: Specification) -> StoredParameter:
    try:
        stored = await DocumentReader(session, path[0]).read(path[1:])
        return StoredParameter(path, specification, specification.checked(show(path), stored))
    except MissingKey:
        return StoredParameter(path, specification, None)
    except (BadInput, BadData, NotAllowed) as error:
        return StoredParameter(path, specification, None, str(error))


async def publish(session: Session, path: Path, value: Any) -> None:
    """Publish a value that was checked; makes the dicts that hold it if they are gone."""
    await publisher(session, path[0], "raise").set_with_parents(path[1:], as_json(value))
