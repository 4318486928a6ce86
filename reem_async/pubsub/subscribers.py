"""Subscribers: a variable that follows, a function that is called, a loop."""

from __future__ import annotations

import asyncio
import weakref
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NoReturn

from ..concurrency.queues import BoundedQueue, Last, Newest, PlaceQueue, Policy, chosen
from ..concurrency.streams import Following, Stream
from ..connection import RedisInterface
from ..errors import BadType, InterfaceClosed, MissingKey, NotConnected, ReadOnly
from ..plan.arguments import Handle, check_instance
from ..plan.keys import Keys
from ..plan.paths import Path, check_element, parse, show
from ..plan.trees import MISSING, copied
from ..session import Session
from .callbacks import Caller, Calls, arranged, checked_on_silent
from .events import Update
from .follower import Follower, unnoticed
from .manager import SubscriptionManager, manager_of
from .silence import LivePlaceQueue, LiveQueue, checked_ttl

__all__ = ["CallbackSubscriber", "Link", "LocalAccessor", "SilentSubscriber", "Update", "Watch"]


class Link:
    """A follower and the manager it is at: made by the first `follow`, and again after a fork or in another loop."""

    def __init__(
        self, session: Session, make: Callable[[SubscriptionManager], Follower], queues: list[BoundedQueue]
    ) -> None:
        self._session = session
        self._make = make
        self._queues = queues
        self.on_state: Callable[[Any], None] = unnoticed  # called with each state of the copy; see `Follower`
        self._manager: SubscriptionManager | None = None
        self._following: asyncio.Lock | None = None
        self.closed = False  # it was closed, and does not begin again
        # The present one, or one of another process or loop; None before it has begun
        self.follower: Follower | None = None

    @property
    def follows(self) -> bool:
        """Whether it has begun, in this process and in an event loop that is not closed. Any thread may ask."""
        return self.follower is not None and self._manager is not None and self._manager.is_here

    @property
    def interface_closed(self) -> bool:
        """Whether the interface is closed, or is about to be. Any thread may ask."""
        return self._session.closed

    async def follow(self) -> None:
        """Begin to follow, if it has not begun; several callers wait for the same beginning."""
        if self.closed:
            raise InterfaceClosed("this subscription is closed; make a new one")
        manager = manager_of(self._session)
        if manager is not self._manager:
            # The manager of another loop, or of the process before a fork, has taken its followers with it.
            # The follower first: other threads ask for both.
            self.follower, self._manager, self._following = None, manager, asyncio.Lock()
        assert self._following is not None
        # Two callers that begin at once share one follower.
        async with self._following:
            if self.follower is None:
                self.follower = self._make(manager)
                self.follower.on_state = self.on_state
                self.follower.queues = self._queues
                try:
                    await manager.follow(self.follower)
                    if self.closed:  # meanwhile
                        await manager.unfollow(self.follower)
                        raise InterfaceClosed("this subscription was closed before it began")
                except BaseException as error:
                    self.follower = None
                    if isinstance(error, NotConnected):  # its message says it all
                        raise error.with_traceback(None) from None
                    raise

    async def unfollow(self) -> None:
        """Stop following, for good. Idempotent; also after the interface was closed."""
        self.closed = True
        if self._manager is not None and self._manager.is_here and self.follower is not None:
            await self._manager.unfollow(self.follower)


class Watch(Stream[Update]):
    """Follows one path and yields its updates, one by one: an async iterator.

    Follows from the first `async for` or `async with` on. The first update is the value that is
    already there, if any (`initial`). In asyncio, cancelling a waiting loop loses no update. Leaving a loop
    with `break` keeps following until the watch is closed or dropped. `watch` of an accessor makes one, and explains
    the arguments.
    """

    def __init__(
        self,
        session: Session,
        keys: Keys,
        path: Path,
        policy: Policy,
        queue: BoundedQueue | None = None,
        *,
        stored: bool = True,
        ttl: float | None = None,
    ) -> None:
        if ttl is not None and queue is None:
            full_path = keys.name, *path
            queue = LiveQueue(policy, checked_ttl(ttl, full_path), full_path)
        super().__init__(policy, queue)
        ttl = queue.ttl if isinstance(queue, LiveQueue) else None
        make = partial(Follower, keys, path, session.ships, session.cache, stored=stored, ttl=ttl)
        self._link = Link(session, make, [self.queue])

    @property
    def _following(self) -> bool:
        return self._link.follows or self._closed

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later update is missed. Idempotent; two or three round trips."""
        await self._link.follow()
        if isinstance(self.queue, LiveQueue):
            self.queue.start_clock()

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await super().close()
        await self._link.unfollow()


class SilentSubscriber(Following):
    """A local variable that follows what is published at a path.

    `value()` and `subscriber["number"].read()` answer from memory, without a trip to the server.
    It starts with the value that is already there. It can also be iterated: `async for update in
    subscriber`.

    Args:
        channel: The path to follow, such as "foo" or "foo.bar".
        interface: The server: a RedisInterface, or what it takes as host.
        policy: What an iteration keeps for a loop that is slower than the updates.
        stored: Follow plain writes too, by any client.
    """

    def __init__(
        self, channel: str, interface: Any = None, policy: Policy | None = None, *, stored: bool = False
    ) -> None:
        self.interface: RedisInterface = (
            interface if isinstance(interface, RedisInterface) else RedisInterface(interface)
        )
        # An empty path has no top-level key, which `keys` says better.
        key, *rest = parse(channel) or ("",)
        self.channel = channel
        self._keys, self._path = self.interface.session.keys(key), tuple(rest)
        self.full_path: Path = (self._keys.name, *rest)
        self.policy = chosen(policy, Newest())
        self.stored = stored
        session = self.interface.session
        make = partial(Follower, self._keys, self._path, session.ships, session.cache, stored=stored)
        self._link = Link(session, make, [])
        # By identity, held weakly: a loop that was left by `break` drops its own. Any thread may add one meanwhile.
        self._watches: weakref.WeakValueDictionary[int, Watch] = weakref.WeakValueDictionary()

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later publish is missed. Idempotent; two or three round trips.

        Raises:
            NotConnected: No server listens there.
            InterfaceClosed: It was closed before.
        """
        await self._link.follow()

    async def close(self) -> None:
        """Stop following; the value stays as it is. Idempotent."""
        for reference in self._watches.valuerefs():
            if (watch := reference()) is not None:
                await watch.close()
        await self._link.unfollow()

    def value(self) -> Any:
        """Return a copy of the value as of now, None if there is none. No round trip; any thread may call."""
        follower = self._link.follower
        return None if follower is None else follower.value()

    @property
    def local_copy(self) -> Any:
        """A copy of the value as of now, an empty dict if there is none."""
        value = self.value()
        return {} if value is None else value

    def __getitem__(self, key: str | int) -> LocalAccessor:
        return LocalAccessor(self, (check_element(key, (self.channel,)),))

    def watch(self, policy: Policy | None = None) -> Watch:
        """Return an async iterator over the updates, beginning with the value that is there."""
        watch = Watch(self.interface.session, self._keys, self._path, chosen(policy, self.policy), stored=self.stored)
        self._watches[id(watch)] = watch
        return watch

    def __aiter__(self) -> Watch:
        return self.watch()

    def __setitem__(self, key: str | int, value: Any) -> NoReturn:
        self[key].write(value)

    def __delitem__(self, key: str | int) -> NoReturn:
        self[key].write()

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (type(self), (self.channel, self.interface, self.policy), self.stored)

    def __repr__(self) -> str:
        return f"<reem_async.{type(self).__name__} {self.channel}>"


def _rebuilt(
    kind: type[SilentSubscriber], arguments: tuple[Any, ...], stored: bool, more: Mapping[str, Any] | None = None
) -> SilentSubscriber:
    return kind(*arguments, stored=stored, **(more or {}))


class LocalAccessor(Handle):
    """One place in a subscriber's local copy."""

    __slots__ = ("_path", "_subscriber")

    def __init__(self, subscriber: Any, path: Path) -> None:
        self._subscriber = subscriber
        self._path = path

    def __getitem__(self, key: str | int) -> LocalAccessor:
        return type(self)(self._subscriber, (*self._path, check_element(key, self._path)))

    def read(self) -> Any:
        """Return a copy of the value here as of now. No round trip.

        Raises:
            MissingKey: Nothing is here.
        """
        follower = self._subscriber._link.follower
        found = MISSING if follower is None else follower.at(self._path)
        if found is MISSING:
            what = show((self._subscriber.channel, *self._path))
            raise MissingKey(
                f"nothing has been published at {what} yet" + ("" if follower else "; call listen() first")
            )
        return copied(found)

    def get(self, default: Any = None) -> Any:
        """Return the value here, or `default`. No round trip."""
        try:
            return self.read()
        except MissingKey:
            return default

    def write(self, value: Any = None) -> NoReturn:
        """Raise ReadOnly."""
        where = show((self._subscriber.channel, *self._path))
        raise ReadOnly(f"{where}: a subscriber only follows the server; write with a KeyValueStore or a PublishSpace")

    def __setitem__(self, key: str | int, value: Any) -> NoReturn:
        self[key].write(value)

    def __delitem__(self, key: str | int) -> NoReturn:
        self[key].write()

    def __iadd__(self, value: Any) -> NoReturn:
        self.write(value)

    append = extend = increment = multiply = divide = delete = write
    __isub__ = __imul__ = __itruediv__ = __iadd__

    @property
    def _place(self) -> tuple[object, Path]:
        return self._subscriber, (self._subscriber.channel, *self._path)


class CallbackSubscriber(SilentSubscriber):
    """Calls a function for each update of what is published at a path.

    Called as `callback(data, updated_path, **kwargs)`, the first two by name where it has these
    names, in any order, or takes `**kwargs` alone: the whole structure below the channel, and
    which path was updated, such as "callback_channel.number". Calls are made one after the other, in order: in plain
    programs on a thread of the subscriber's own, where they may use REEM, in asyncio on the event loop. An exception in
    one is logged and does not end the subscription. So is SystemExit on a thread, since `sys.exit()` cannot end the
    program from there, and KeyboardInterrupt, which is also raised in the main thread; in asyncio both leave the event
    loop. If calls are slower than updates, the oldest of over 1000 waiting ones are dropped; a warning says so. After a
    large update `data` may have later ones in it already, which are called for too.

    A callback with a parameter `update`, or that takes `**kwargs`, gets the `Update` by that name. It says how the call
    came about: after an outage the callback is called with what was found (`update.origin`), which may be old.

    Args:
        channel: The path to follow.
        interface: The server: a RedisInterface, or what it takes as host.
        callback_function: The function; in asyncio it must not block, or is a coroutine function.
        kwargs: Keyword arguments for each call.
        policy: What to keep when calls are slower than updates.
        stored: Call for plain writes too, by any client.
        ttl: Seconds without a published update after which there is silence. The callback is only called for published
            updates that are not older than that when the call begins; `value()` is the last known one all the same. See
            `Accessor.watch`.
        on_silent: Called with `kwargs` once when silence begins, as `callback_function` and in turn with it.
    """

    def __init__(
        self,
        channel: str,
        interface: Any,
        callback_function: Callable[..., Any],
        kwargs: Mapping[str, Any] | None = None,
        policy: Policy | None = None,
        *,
        stored: bool = False,
        ttl: float | None = None,
        on_silent: Callable[..., Any] | None = None,
    ) -> None:
        super().__init__(channel, interface, chosen(policy, Last(1000)), stored=stored)
        if not callable(callback_function):
            raise BadType(f"callback_function is a function, not {type(callback_function).__name__}")
        self.callback_function = callback_function
        if kwargs is not None:
            check_instance("kwargs", kwargs, Mapping, "use a dict of keyword arguments, or None")
        self.kwargs = dict(kwargs or {})
        self._call = arranged(callback_function, self.kwargs)
        self._call_silent = checked_on_silent(on_silent, self.kwargs, ttl)
        self.ttl = None if ttl is None else checked_ttl(ttl, self.full_path)
        self.on_silent = on_silent
        self._begin()

    def _begin(self) -> None:
        session = self.interface.session
        queue: BoundedQueue = PlaceQueue(self.policy)
        if self.ttl is not None:
            queue = LivePlaceQueue(self.policy, self.ttl, self.full_path)
        self._updates = Watch(session, self._keys, self._path, self.policy, queue, stored=self.stored)
        self._watches[id(self._updates)] = self._updates
        self._link = self._updates._link  # one follower serves the calls and value()
        self._calls: Calls | None = None

    async def listen(self) -> None:
        """Begin to follow and to call. When this returns, no later publish is missed. Idempotent."""
        manager = manager_of(self.interface.session)  # raises, before anything is changed, where this cannot be used
        if self._calls is not None and self._calls.loop is not asyncio.get_running_loop() and not self._link.closed:
            self._watches.pop(id(self._updates), None)  # it ended with the other event loop
            self._begin()
        await self._updates.listen()
        if self._calls is None:
            # The manager keeps them: a subscriber that the program does not hold works until the interface is closed.
            self._calls = Calls(self._caller(), self._updates, manager.callers)

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = self.channel, self.interface, self.callback_function, self.kwargs, self.policy
        return _rebuilt, (type(self), arguments, self.stored, {"ttl": self.ttl, "on_silent": self.on_silent})

    def _caller(self) -> Caller:
        return Caller(self.channel, self._call, self._call_silent)

    async def close(self) -> None:
        """Stop following and calling; waits for a call being made, in the blocking front up to 1 s. Idempotent.

        Within a callback it does not wait, in asyncio also not for calls of other subscribers.
        """
        await super().close()
        if self._calls is not None:
            await self._calls.done()
