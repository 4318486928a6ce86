"""Subscribers for plain scripts: the core's follow on the background loop, these wait for them."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable, Mapping
from typing import Any

from reem_async.concurrency.queues import Policy
from reem_async.concurrency.scheduling import take_short_turns
from reem_async.errors import BadType
from reem_async.pubsub import subscribers as core
from reem_async.pubsub.pattern_watch import PatternWatch as PatternWatchCore

from ._twin import documented_by, ends, makes, shares, waits
from .connection import RedisInterface
from .following import Following, Watch


@documented_by(PatternWatchCore)
class PatternWatch(Watch):
    """Follows all keys that some patterns name and yields their changes: an iterator.

    What is there when following begins comes first, an update for each key (`initial`). Then every change, published or
    only stored, by any client; new keys, and keys that go (`deleted`). A key that is only stored is found
    within a second of its making.

    Args:
        interface: The server.
        watch: The core's, which lives on the background loop.
    """

    def __init__(self, interface: RedisInterface, watch: PatternWatchCore) -> None:
        super().__init__(interface, watch)
        self.patterns = watch.patterns


@documented_by(core.SilentSubscriber)
class SilentSubscriber(Following):
    """A local variable that follows what is published at a path."""

    def __init__(
        self, channel: str, interface: Any = None, policy: Policy | None = None, *, stored: bool = False
    ) -> None:
        self.interface = interface if isinstance(interface, RedisInterface) else RedisInterface(interface)
        self._interface = self.interface
        self.channel = channel
        self.stored = stored
        self._core = core.SilentSubscriber(channel, self.interface._followers, policy, stored=stored)

    listen = waits(core.SilentSubscriber.listen)
    close = ends(core.SilentSubscriber.close)
    local_copy = shares(core.SilentSubscriber.local_copy)
    watch = makes(core.SilentSubscriber.watch, Watch)

    def value(self) -> Any:
        """Return a copy of the value as of now."""
        return self._core.value()

    def __getitem__(self, key: str | int) -> core.LocalAccessor:
        return self._core[key]

    def __iter__(self) -> Watch:
        return self.watch()

    def __setitem__(self, key: str | int, value: Any) -> None:
        self._core[key] = value

    def __delitem__(self, key: str | int) -> None:
        del self._core[key]

    def __reduce__(self) -> tuple[Any, ...]:
        _, (_, arguments, *more) = self._core.__reduce__()
        return core._rebuilt, (type(self), (self.channel, self.interface, *arguments[2:]), *more)

    def __repr__(self) -> str:
        return f"<reem.{type(self).__name__} {self.channel}>"


class CallbackSubscriber(SilentSubscriber):
    """Calls a function for each update of what is published at a path.

    Called as `callback(data, updated_path, **kwargs)`, the first two by name where it has these
    names, in any order, or takes `**kwargs` alone: the whole structure below the channel, and
    which path was updated, such as "callback_channel.number". Calls are made one after the other,
    in order, on a thread of the subscriber's own; they may use REEM. An exception in one is logged
    and does not end the subscription. So is SystemExit, since `sys.exit()` cannot end the program from a
    thread, and KeyboardInterrupt, which is also raised in the main thread. If calls are slower than
    updates, the oldest of over 1000 waiting ones are dropped; a warning says so. After a large update
    `data` may have later ones in it already, which are called for too.

    A callback with a parameter `update`, or that takes `**kwargs`, gets the `Update` by that name. It says how the call
    came about: after an outage the callback is called with what was found (`update.origin`), which may be old.

    Args:
        channel: The path to follow.
        interface: The server: a RedisInterface, or what it takes as host.
        callback_function: The function.
        kwargs: Keyword arguments for each call.
        policy: What to keep when calls are slower than updates.
        stored: Call for plain writes too, by any client.
        ttl: Seconds without a published update after which there is silence. The callback is only called for published
            updates that are not older than that when the call begins; `value()` is the last known one all the same. See
            `Accessor.watch`.
        on_silent: Called with `kwargs` once when silence begins, on the same thread.
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
        super().__init__(channel, interface, policy, stored=stored)
        options: dict[str, Any] = {"stored": stored, "ttl": ttl, "on_silent": on_silent}
        followers = self.interface._followers
        self._calls = core.CallbackSubscriber(channel, followers, callback_function, kwargs, policy, **options)
        # What answers `value()` is what calls are made of, so a callback never sees a copy older than its update.
        self._core = self._calls
        self._thread: threading.Thread | None = None
        self._starting = threading.RLock()
        for name, function in (("callback_function", callback_function), ("on_silent", on_silent)):
            if inspect.iscoroutinefunction(function):
                raise BadType(f"{name} is a coroutine function, which a thread cannot call; use reem_async")

    def listen(self) -> None:
        """Begin to follow and to call. When this returns, no later publish is missed. Idempotent."""
        self.interface._wait(self._calls._updates.listen())
        self._start()

    def _start(self) -> None:
        with self._starting:
            # Again after a fork, which leaves the child without it.
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._call_all, name=f"reem {self.channel}", daemon=True)
                self._thread.start()
                self.interface._background.callers.add(self._thread)

    def _call_all(self) -> None:
        caller, queue = self._calls._caller(), self._calls._updates.queue
        take_short_turns()  # the event loop's thread has had its wake-up before: waiting once in line is enough
        try:
            while True:
                caller.call_on_thread(queue.take_waiting(), queue.dropped)
        except Exception as reason:
            caller.ended(reason)

    def close(self) -> None:
        """Stop following and calling; waits for a call being made, in the blocking front up to 1 s. Idempotent."""
        super().close()
        # A callback may close its own subscriber. One that takes longer goes on: its thread is a daemon.
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)
