"""Subscribers for plain scripts: the core's follow on the background loop, these wait for them."""

from __future__ import annotations

import contextlib
import inspect
import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

import reem_async
from reem_async import subscribe as core
from reem_async.courtesy import take_short_turns
from reem_async.errors import BadType, InterfaceClosed, QueueFull
from reem_async.plan.paths import Path
from reem_async.policy import Ended, Newest, Policy

from ._twin import documented_by
from .connection import RedisInterface

__all__ = ["CallbackSubscriber", "SilentSubscriber", "Watch"]


@documented_by(core.Watch)
class Watch:
    """Follows one path and yields its updates, one by one: an (async) iterator.

    Follows from the first `for` or `with` on. The first update is the value that is already there,
    if any (`initial`). Leaving a loop with `break` keeps following until the watch is closed or
    dropped.

    Args:
        interface: The server.
        followers: The interface's side on the background loop.
        path: The path, top-level key first.
        policy: What to keep for a loop that is slower than the updates.
    """

    def __init__(
        self,
        interface: RedisInterface,
        followers: reem_async.RedisInterface,
        path: Path,
        policy: Policy | None,
    ) -> None:
        self._interface = interface
        session = followers.session
        self._core = core.Watch(session, session.keys(path[0]), path[1:], policy or Newest())

    @property
    def dropped(self) -> int:
        """How many updates were skipped since they were not taken in time."""
        return self._core.dropped

    def listen(self) -> None:
        """Begin to follow."""
        self._interface._wait(self._core.listen())

    def close(self) -> None:
        """Stop following and end the loop."""
        with contextlib.suppress(InterfaceClosed):  # whatever closed the interface has closed this too
            self._interface._wait(self._core.close())

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> core.Update:
        if not self._core._following:
            self.listen()
        try:
            return self._core.mailbox.take_waiting()  # type: ignore[no-any-return]
        except Ended:
            raise StopIteration from None

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@documented_by(core.SilentSubscriber)
class SilentSubscriber:
    """A local variable that follows what is published at a path.

    `value()` and `subscriber["number"].read()` answer from memory, without a trip to the server.
    It starts with the value that is already there. It can also be iterated: `for update in
    subscriber`.

    Args:
        channel: The path to follow, such as "foo" or "foo.bar".
        interface: The server: a RedisInterface, or what it takes as host.
        policy: What an iteration keeps for a loop that is slower than the updates.
    """

    def __init__(self, channel: str, interface: Any = "localhost", policy: Policy | None = None) -> None:
        self.interface = interface if isinstance(interface, RedisInterface) else RedisInterface(interface)
        self.channel = channel
        self._core = core.SilentSubscriber(channel, self.interface._followers, policy)

    def listen(self) -> None:
        """Begin to follow."""
        self.interface._wait(self._core.listen())

    def close(self) -> None:
        """Stop following."""
        with contextlib.suppress(InterfaceClosed):  # whatever closed the interface has closed this too
            self.interface._wait(self._core.close())

    def value(self) -> Any:
        """Return a copy of the value as of now."""
        return self._core.value()

    def __getitem__(self, key: str | int) -> core.LocalAccessor:
        return self._core[key]

    def watch(self, policy: Policy | None = None) -> Watch:
        """Return an iterator over the updates."""
        return Watch(self.interface, self._core.interface, self._core.full_path, policy or self._core.policy)

    def __iter__(self) -> Watch:
        return self.watch()

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __setitem__(self, key: str | int, value: Any) -> None:
        self._core[key] = value

    def __delitem__(self, key: str | int) -> None:
        del self._core[key]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.channel, self.interface, *self._core.__reduce__()[1][2:])

    def __repr__(self) -> str:
        return f"<reem.{type(self).__name__} {self.channel}>"


class CallbackSubscriber(SilentSubscriber):
    """Calls a function for each update of what is published at a path.

    Called as `callback(data, updated_path, **kwargs)`: the whole structure below the channel, and
    which path was updated, such as "callback_channel.number". Calls are made one after the other,
    in order, on a thread of the subscriber's own; they may use REEM. An exception in one is logged
    and does not end the subscription. If calls are slower than updates, the oldest of over 1000
    waiting ones are dropped; a warning says so.

    Args:
        channel: The path to follow.
        interface: The server: a RedisInterface, or what it takes as host.
        callback_function: The function.
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
        super().__init__(channel, interface, policy)
        self._calls = core.CallbackSubscriber(channel, self.interface._followers, callback_function, kwargs, policy)
        self._core = self._calls
        self._thread: threading.Thread | None = None
        if inspect.iscoroutinefunction(callback_function):
            raise BadType("callback_function is a coroutine function, which a thread cannot call; use reem_async")

    def listen(self) -> None:
        """Begin to follow and to call. When this returns, no later publish is missed. Idempotent."""
        self.interface._wait(self._calls._updates.listen())
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._call_all, name=f"reem {self.channel}", daemon=True)
            self._thread.start()

    def _call_all(self) -> None:
        caller, mailbox = self._calls._caller(), self._calls._updates.mailbox
        take_short_turns()  # the event loop's thread has had its wake-up before: waiting once in line is enough
        try:
            while True:
                caller.call(mailbox.take_waiting(), mailbox.dropped)
        except (Ended, QueueFull) as reason:
            caller.ended(reason)

    def close(self) -> None:
        """Stop following and calling; waits for a call being made, in the blocking front up to 1 s. Idempotent."""
        super().close()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)
