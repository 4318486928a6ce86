"""Subscribers for plain scripts: the core's follow on the background loop, these wait for them."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable
from typing import Any

from reem_async.errors import BadType
from reem_async.pubsub import subscribers as core
from reem_async.pubsub.pattern_watch import PatternWatch as PatternWatchCore

from ._twin import documented_by, ends, makes, shares, takes, waits
from .connection import RedisInterface
from .following import Following, Watch


@documented_by(PatternWatchCore)
class PatternWatch(Watch):
    """Follows all keys that some patterns name and yields their changes: an iterator."""

    def __init__(self, interface: RedisInterface, watch: PatternWatchCore) -> None:
        super().__init__(interface, watch)
        self.patterns = watch.patterns


@documented_by(core.SilentSubscriber)
class SilentSubscriber(Following):
    """A local variable that follows what is published at a path."""

    _kind: Callable[..., Any] = core.SilentSubscriber
    _core: core.SilentSubscriber

    @takes(core.SilentSubscriber.__init__)
    def __init__(self, channel: str, interface: Any = None, *given: Any, **options: Any) -> None:
        self.interface = interface if isinstance(interface, RedisInterface) else RedisInterface(interface)
        self._interface = self.interface
        self._core = self._kind(channel, self.interface._followers, *given, **options)
        self.channel, self.stored = channel, self._core.stored

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


@documented_by(core.CallbackSubscriber)
class CallbackSubscriber(SilentSubscriber):
    """Calls a function for each update of what is published at a path."""

    _kind = core.CallbackSubscriber
    _core: core.CallbackSubscriber

    @takes(core.CallbackSubscriber.__init__)
    def __init__(self, channel: str, interface: Any, *given: Any, **options: Any) -> None:
        super().__init__(channel, interface, *given, **options)
        self._thread: threading.Thread | None = None
        self._starting = threading.RLock()
        for name in ("callback_function", "on_silent"):
            if inspect.iscoroutinefunction(getattr(self._core, name)):
                raise BadType(f"{name} is a coroutine function, which a thread cannot call; use reem_async")

    def listen(self) -> None:
        """Begin to follow and to call. When this returns, no later publish is missed. Idempotent."""
        self.interface._wait(self._core._updates.listen())
        with self._starting:
            # Again after a fork, which leaves the child without it.
            if self._thread is None or not self._thread.is_alive():
                self._thread = self.interface._calling(
                    self.channel, self._core._caller(), self._core._updates.queue, owner=self
                )

    def close(self) -> None:
        """Stop following and calling; waits for a call being made, in the blocking front up to 1 s. Idempotent."""
        super().close()
        # A callback may close its own subscriber. One that takes longer goes on: its thread is a daemon.
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)
