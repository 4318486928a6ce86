"""Subscribers: a variable that follows, a function that is called, a loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, NoReturn, Self

from .callbacks import Caller, Calls
from .connection import RedisInterface
from .errors import BadType, InterfaceClosed, MissingKey, ReadOnly
from .follow import Follower, Update
from .hub import Hub
from .plan.keys import Keys
from .plan.paths import Path, check_element, parse, show
from .plan.trees import MISSING, copied
from .policy import Last, Mailbox, Newest, Policy
from .session import Session
from .stream import Stream

__all__ = ["CallbackSubscriber", "LocalAccessor", "SilentSubscriber", "Update", "Watch"]


class _Link:
    """A follower and the hub it is at: made by the first `follow`, anew after a fork or in another loop."""

    def __init__(self, session: Session, keys: Keys, path: Path, mailboxes: list[Mailbox]) -> None:
        self._session = session
        self._keys = keys
        self._path = path
        self._mailboxes = mailboxes
        self._hub: Hub | None = None
        self._following: asyncio.Lock | None = None
        self.closed = False
        self.follower: Follower | None = None

    async def follow(self) -> None:
        """Begin to follow, if it has not begun; several callers wait for the same beginning."""
        if self.closed:
            raise InterfaceClosed("this subscription is closed; make a new one")
        hub = self._session.hub
        if hub is not self._hub:
            self._hub, self.follower, self._following = hub, None, asyncio.Lock()
        assert self._following is not None
        async with self._following:
            if self.follower is None:
                session = self._session
                self.follower = Follower(self._keys, self._path, session.ships, session.memory, session.transport)
                self.follower.mailboxes = self._mailboxes
                try:
                    await hub.follow(self.follower)
                except BaseException:
                    self.follower = None
                    raise

    async def unfollow(self) -> None:
        """Stop following, for good. Idempotent; also after the interface was closed."""
        self.closed = True
        if self._hub is not None and self.follower is not None:
            await self._hub.unfollow(self.follower)


class Watch(Stream[Update]):
    """Follows one path and yields its updates, one by one: an (async) iterator.

    Follows from the first `async for` or `async with` on. The first update is the value that is
    already there, if any (`initial`). Cancelling a waiting loop loses no update. Leaving a loop
    with `break` keeps following until the watch is closed or dropped.

    Args:
        session: The server.
        keys: The top-level key's names.
        path: The path below it.
        policy: What to keep for a loop that is slower than the updates.
    """

    def __init__(self, session: Session, keys: Keys, path: Path, policy: Policy) -> None:
        super().__init__(policy)
        self._link = _Link(session, keys, path, [self.mailbox])

    @property
    def _following(self) -> bool:
        return self._link.follower is not None or self._closed

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later update is missed. Idempotent; two round trips."""
        await self._link.follow()

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await super().close()
        await self._link.unfollow()


class SilentSubscriber:
    """A local variable that follows what is published at a path.

    `value()` and `subscriber["number"].read()` answer from memory, without a trip to the server.
    It starts with the value that is already there. It can also be iterated: `async for update in
    subscriber`.

    Args:
        channel: The path to follow, such as "foo" or "foo.bar".
        interface: The server: a RedisInterface, or what it takes as host.
        policy: What an iteration keeps for a loop that is slower than the updates.
    """

    def __init__(self, channel: str, interface: Any = "localhost", policy: Policy | None = None) -> None:
        self.interface: RedisInterface = (
            interface if isinstance(interface, RedisInterface) else RedisInterface(interface)
        )
        key, *rest = parse(channel) or ("",)
        self.channel = channel
        self._keys, self._path = self.interface.session.keys(key), tuple(rest)
        self.full_path: Path = (self._keys.name, *rest)
        self.policy = policy or Newest()
        self._link = _Link(self.interface.session, self._keys, self._path, [])
        self._watches: list[Watch] = []
        self._closed = False

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later publish is missed. Idempotent; two round trips.

        Raises:
            NotConnected: Nobody listens there.
            InterfaceClosed: It was closed before.
        """
        await self._link.follow()

    async def close(self) -> None:
        """Stop following; the value stays as it is. Idempotent."""
        for watch in self._watches:
            await watch.close()
        await self._link.unfollow()

    def value(self) -> Any:
        """Return a copy of the value as of now, None if there is none. No round trip; any thread may call."""
        follower = self._link.follower
        return None if follower is None else follower.value()

    def __getitem__(self, key: str | int) -> LocalAccessor:
        return LocalAccessor(self, (check_element(key, (self.channel,)),))

    def watch(self, policy: Policy | None = None) -> Watch:
        """Return an async iterator over the updates, beginning with the value that is there."""
        watch = Watch(self.interface.session, self._keys, self._path, policy or self.policy)
        self._watches.append(watch)
        return watch

    def __aiter__(self) -> Watch:
        return self.watch()

    async def __aenter__(self) -> Self:
        await self.listen()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def __setitem__(self, key: str | int, value: Any) -> NoReturn:
        self[key].write(value)

    def __delitem__(self, key: str | int) -> NoReturn:
        self[key].write()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.channel, self.interface, self.policy)

    def __repr__(self) -> str:
        return f"<reem_async.{type(self).__name__} {self.channel}>"


class LocalAccessor:
    """One place in a subscriber's local copy."""

    __slots__ = ("_path", "_subscriber")

    def __init__(self, subscriber: SilentSubscriber, path: Path) -> None:
        self._subscriber = subscriber
        self._path = path

    def __getitem__(self, key: str | int) -> LocalAccessor:
        return LocalAccessor(self._subscriber, (*self._path, check_element(key, self._path)))

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
    __iter__ = None
    __contains__ = None

    def __repr__(self) -> str:
        return f"<LocalAccessor {show((self._subscriber.channel, *self._path))}>"


class CallbackSubscriber(SilentSubscriber):
    """Calls a function for each update of what is published at a path.

    Called as `callback(data, updated_path, **kwargs)`: the whole structure below the channel, and
    which path was updated, such as "callback_channel.number". Calls are made one after the other,
    in order. An exception in one is logged and does not end the subscription. If calls are slower
    than updates, the oldest of over 1000 waiting ones are dropped; a warning says so.

    Args:
        channel: The path to follow.
        interface: The server: a RedisInterface, or what it takes as host.
        callback_function: A plain function (then it must not block) or a coroutine function.
        kwargs: Keyword arguments for each call.
        policy: What to keep when calls are slower than updates.
    """

    def __init__(
        self,
        channel: str,
        interface: Any,
        callback_function: Callable[..., Any],
        kwargs: Mapping[str, Any] | None = None,
        policy: Policy | None = None,
    ) -> None:
        super().__init__(channel, interface, policy or Last(1000))
        if not callable(callback_function):
            raise BadType(f"callback_function is a function, not {type(callback_function).__name__}")
        self.callback_function = callback_function
        self.kwargs = dict(kwargs or {})
        self._begin()

    def _begin(self) -> None:
        self._updates = self.watch()
        self._link = self._updates._link  # one follower serves the calls and value()
        self._calls: Calls | None = None

    async def listen(self) -> None:
        """Begin to follow and to call. When this returns, no later publish is missed. Idempotent."""
        hub = self.interface.session.hub  # raises, before anything is changed, where this cannot be used
        if self._calls is not None and self._calls.loop is not asyncio.get_running_loop() and not self._link.closed:
            self._watches.remove(self._updates)  # it ended with the other event loop
            self._begin()
        await self._updates.listen()
        if self._calls is None:
            # The hub keeps them although nobody may hold on to the subscriber: it works until the interface is closed.
            self._calls = Calls(self._caller(), self._updates, hub.callers)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.channel, self.interface, self.callback_function, self.kwargs, self.policy)

    def _caller(self) -> Caller:
        """Return what makes the calls."""
        return Caller(self.channel, self.callback_function, self.kwargs)

    async def close(self) -> None:
        """Stop following and calling; waits for a call being made, in the blocking front up to 1 s. Idempotent."""
        await super().close()
        if self._calls is not None:
            await self._calls.done()
