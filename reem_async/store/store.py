"""KeyValueStore: the dictionary on the server; PublishSpace: a store that only writes, and notifies subscribers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NoReturn, TypeVar

from ..concurrency.queues import Policy
from ..connection import RedisInterface
from ..errors import BadType, MissingDocument, MissingKey, WriteOnly
from ..plan.arguments import cannot_wait
from ..plan.paths import Path, parse, show
from ..pubsub.join import Join
from ..pubsub.pattern_watch import PatternWatch
from ..session import Session
from .accessor import _NOTHING as _NOTHING
from .accessor import Accessor, Writer
from .catalog import names
from .document import DocumentReader, DocumentWriter
from .publish import DocumentPublisher
from .raw import RawKeys
from .send_queue import outages

_MOST_TOPS = 1000  # accessors of top-level keys that are cached

Interface = TypeVar("Interface")


def without_options(interface: Interface, options: Mapping[str, Any]) -> Interface:
    """Return an existing interface; raises BadType if options were given with it."""
    if options:
        raise BadType(f"{', '.join(options)}: options go to the RedisInterface when it is made, or with a host")
    return interface


class KeyValueStore:
    """The dictionary on the server.

    `kvs["foo"]["bar"]` is an `Accessor`: a path, nothing is sent yet. In plain programs `kvs["foo"] = value` and
    `kvs["foo"]["bar"] = value` write, and `read()` reads; in asyncio `await` its `read()`, `write(value)` and so on.

    Args:
        interface: The server: a RedisInterface, another store, or what RedisInterface takes as host.
        options: With a host, what else RedisInterface takes: `KeyValueStore("localhost", port=7400)`.
    """

    _accessor: type[Accessor] = Accessor
    _writer: Callable[[Session, object], DocumentWriter] = DocumentWriter

    def __init__(self, interface: Any = None, **options: Any) -> None:
        if isinstance(interface, KeyValueStore):
            interface = interface.interface
        self.interface: RedisInterface = (
            without_options(interface, options)
            if isinstance(interface, RedisInterface)
            else RedisInterface(interface, **options)
        )
        self._tops: dict[str, Accessor] = {}

    def __getitem__(self, key: str) -> Accessor:
        return self._top(key)

    def _top(self, key: object) -> Accessor:
        # The hot path: a key that was used before needs no check and no new objects.
        if type(key) is str and (known := self._tops.get(key)) is not None:
            return known
        session = self.interface.session
        name = session.keys(key).name
        writer = self._writer(session, name)
        if len(self._tops) >= _MOST_TOPS:
            self._tops.clear()
        # Another thread may have made one in between: all use the same.
        return self._tops.setdefault(name, self._accessor(self._accessor._reads(session, name), writer, ()))

    __setitem__ = cannot_wait("assignment", "await store[{0!r}].write(value)")
    __delitem__ = cannot_wait("del", "await store[{0!r}].delete()")
    __iter__ = cannot_wait("iterating", "for key in await store.keys()")
    __contains__ = cannot_wait("`in`", "await store.contains({0!r})")

    def at(self, path: str) -> Accessor:
        """Return the accessor of a dotted path such as "foo.bar" or "foo.tiles[2]"; sends nothing.

        `store["foo.bar"]` is another place, a top-level key with a dot; as a path it is quoted: `["foo.bar"]`.
        """
        key, *rest = parse(path) or ("",)
        top = self._top(key)
        return self._accessor(top._reader, top._writer, tuple(rest))

    async def get(self, path: str, default: Any = _NOTHING) -> Any:
        """Return the value at a dotted path, or `default` if given and nothing is there.

        Raises:
            MissingKey: Nothing is there and no default was given.
        """
        place = self.at(path)
        try:
            return await place._reader.read(place._path)
        except MissingKey as error:
            if default is not _NOTHING:
                return default
            if isinstance(error, MissingDocument) or not isinstance(place.full_path[-1], int):
                raise
        raise await place._reader.no_item(place._path)

    async def contains(self, key: str) -> bool:
        """Return whether a top-level key is there. One round trip.

        What a program without REEM stored under that name does not count.
        """
        return await self._top(key)._reader.exists()

    async def keys(self, pattern: str = "*") -> list[str]:
        """Return the top-level keys, sorted; with a pattern, those it names (`*` and `?` stand for others).

        One round trip for about 1000 keys of the server. Not atomic: a key that is written or deleted in between may or
        may not be among them.
        """
        return sorted([name async for name in names(self.interface, pattern)])

    async def pop(self, key: str, *default: Any) -> Any:
        """Remove a top-level key and return what it held, or `default` if given and it is not there.

        Raises and costs as `Accessor.pop`.
        """
        return await self._top(key)._take(*default)

    async def update(self, values: Mapping[str, Any] | Iterable[tuple[str, Any]] = (), /, **more: Any) -> None:
        """Store each of `values`, and of the named ones, under its top-level key.

        Each is a `write`, one after the other. Not atomic: each key is a document of its own, and if the connection
        fails, the first ones may have been stored. All keys and values are checked first.

        Raises:
            BadValue, BadType, BadKey, TooDeep: A value cannot be stored; nothing was sent.
        """
        every = dict(values, **more)
        for key, value in every.items():
            await self._top(key)._writer.check(value)
        for key, value in every.items():
            await self._top(key).write(value)

    def watch(self, *patterns: str, policy: Policy | None = None, largest: int | None = None) -> PatternWatch:
        """Return an async iterator over every change of all keys that some patterns name, those that come and go too.

        As `kvs["foo"].watch()` for each existing key (these come first, `initial`) and each new one: one that is only
        stored is found within a second. `update.path` names the place.

        Args:
            patterns: Globs of paths, such as "arm", "cam_*", "robot1.*" or "robot.*.battery"; all keys if none.
            policy: What to keep for a loop that is slower than the updates; `Last(1000)` if not given.
            largest: Bytes of an array up to which it is fetched; an `Unfetched` is in the place of a larger one,
                another object when it has changed.

        Raises:
            BadKey: Not a pattern.
        """
        return PatternWatch(self.interface.session, patterns, policy, largest=largest)

    def join(self, *paths: str, slop: float, policy: Policy | None = None) -> Join:
        """Return an async iterator over the updates of several paths that arrive together.

        Example:
            async for t, (image, q) in kvs.join("cam.rgb", "arm.q", slop=0.01):
                ...

        For each published update of the first path there is one, with the value of each other path whose update is
        nearest in time, before it or after it. `t` is when the update of the first path arrived. All times are those at
        which updates arrived at this program, on its `time.monotonic()`: clocks of publishers may differ. It is yielded
        as soon as no nearer update can arrive, after `slop` seconds at the latest. Plain writes are not joined.

        Name the path of the largest values first: on another host they are fetched, and those of the other paths that
        arrived meanwhile are kept for it. `skipped` says, by path, why there is none for an update of the first path.

        Args:
            paths: Two paths or more, such as "cam.rgb".
            slop: Seconds that updates may be apart.
            policy: What to keep for a loop that is slower: `Last(10)` if not given.

        Raises:
            BadKey, BadType, BadValue: A path or argument that means nothing.
        """
        places = [self.at(path) for path in paths]
        return Join(self.interface.session, [(it._reader.keys, it._path) for it in places], slop, policy)

    @property
    def raw(self) -> RawKeys:
        """Keys of programs without REEM, as these wrote them: `kvs.raw["sai::q"].read()`."""
        return RawKeys(self.interface.session)

    async def setdefault(self, key: str, default: Any = None) -> Any:
        """Return the value of a top-level key; where it is not there, store `default` first.

        Raises and costs as `Accessor.setdefault`.
        """
        return await self._top(key)._read_or_put(default)

    async def set(self, path: str, value: Any) -> None:
        """Store `value` at a dotted path; see `Accessor.write`."""
        await self.at(path).write(value)

    def track_schema_changes(
        self, set_value: bool | None = None, keys: Iterable[str] | None = None, *, track: bool | None = None
    ) -> None:
        """Do nothing: old programs set this switch of the first REEM to be quicker. Writes are quick without it."""
        if set_value is None and track is None:
            raise BadType("track_schema_changes() takes True or False")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface,)

    def __repr__(self) -> str:
        return f"<reem_async.{type(self).__name__} {self.interface.hostname}>"


def _cannot_read(path: Path) -> str:
    return (
        f"{show(path)}: a PublishSpace can only be written; read through KeyValueStore(interface), "
        "or follow it with a subscriber"
    )


class WriteOnlyReader(DocumentReader):
    """Reads nothing: each call raises WriteOnly."""

    def _refuse(self, path: Path, *_: Any) -> NoReturn:
        raise WriteOnly(_cannot_read((self.name, *path)))

    raw_read = contains_at = keys_at = type_at = length_at = _refuse  # type: ignore[assignment]


class PublishAccessor(Accessor):
    """One place of a PublishSpace: as `Accessor`, but reading raises WriteOnly."""

    __slots__ = ()
    _how_to_read = "a KeyValueStore"
    _reads = WriteOnlyReader

    @property
    def writer(self) -> Publisher:
        """The publisher of the top-level key."""
        return Publisher(self._reader.name, self._reader.session.interface)

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        """Raise WriteOnly."""
        raise WriteOnly(_cannot_read(self.full_path))

    reader = property(_refuse)
    edit = mirror = outline = parameter = watch = _refuse


class Publisher(Writer):
    """Writes one top-level key and notifies its subscribers, in the same transaction."""

    _kind = DocumentPublisher


class PublishSpace(KeyValueStore):
    """A store that can only be written, and that notifies subscribers of every change.

    Written like a `KeyValueStore`. A change and its notice are one transaction. The notice carries a small value; a
    large one is announced, and subscribers fetch the newest.

    `outage` is the policy for `write`, `update` and `delete` in an outage (NotConnected, ConnectionLost or
    ServerNotReady): they raise, drop their updates, or keep the newest of each place, up to 256 MB in all, and send
    these when the server is back. Nothing is applied twice. What is not published, or not for certain, is counted in
    `dropped`, and subscribers see it by `gap` and `missed`. `append`, `extend` and arithmetic always raise.

    With `wait=False`, `write`, `update` and `delete` encode and queue their updates and return. A background task sends
    them in the order of the calls. Bad input raises in the call. Errors of the server go to `on_error`, or the next
    call raises the first of them and queues nothing. If 32 calls of a key wait, a further one replaces those of the
    same place. A read may not see an update yet: `flush` waits until it is stored. Closing the interface, and the end
    of the program, send what is queued for up to a second. Promises 14 and 25 of docs/guarantees.md have the details.

    Args:
        interface: The server: a RedisInterface, a store, or what RedisInterface takes as host.
        outage: What to do in an outage: "raise", "drop" or "newest".
        wait: Whether a call waits until the server has stored the update.
        on_error: With `wait=False`, called with each error, in the background task; it must not block.
        options: With a host, what else RedisInterface takes.
    """

    _accessor = PublishAccessor

    def __init__(
        self,
        interface: Any = None,
        outage: str = "raise",
        wait: bool = True,
        on_error: Callable[[Exception], object] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(interface, **options)
        self.outage = outage
        self._chosen = outage, wait, on_error
        self._outages = outages(self.interface.session, *self._chosen)
        self._writer = partial(DocumentPublisher, outages=self._outages)

    async def flush(self, timeout: float | None = None) -> None:  # noqa: ASYNC109
        """Wait until the updates of all calls so far are stored or dropped.

        Args:
            timeout: Seconds to wait at most; as long as it takes if not given.

        Raises:
            TimeoutError: Some are not; they are still queued, or kept for the end of the outage.
            redis.exceptions.RedisError: With `wait=False` and without `on_error`: the first error of earlier updates.
        """
        if self._outages is not None:
            await self._outages.flush(timeout)

    @property
    def dropped(self) -> int:
        """How many updates this has not published, or not for certain: because of outages, or of `wait=False`."""
        return 0 if self._outages is None else self._outages.dropped

    @property
    def waiting(self) -> int:
        """How many updates are queued, or kept until the server is back, or on their way and not answered yet."""
        return 0 if self._outages is None else self._outages.waiting

    def watch(self, *patterns: str, policy: Any = None, largest: int | None = None) -> NoReturn:
        """Raise WriteOnly."""
        raise WriteOnly(_cannot_read(patterns or ("*",)))

    def join(self, *paths: str, slop: float, policy: Any = None) -> NoReturn:
        """Raise WriteOnly."""
        raise WriteOnly(_cannot_read(paths or ("*",)))

    @property
    def raw(self) -> NoReturn:
        """Raise WriteOnly: what other programs store has no subscribers of REEM. Use a KeyValueStore."""
        raise WriteOnly("a PublishSpace has no .raw: use that of KeyValueStore(interface)")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, *self._chosen)
