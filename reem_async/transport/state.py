"""The state of an interface's connection, and how long calls wait for a server that is not up yet."""

from __future__ import annotations

import collections
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from ..concurrency.locks import Inherited, WeakList
from ..concurrency.queues import BoundedQueue, Last, noop
from ..concurrency.streams import Stream
from ..errors import InterfaceClosed, NotConnected, ServerNotReady

logger = logging.getLogger("reem.connection")

_PAUSE = 0.1  # seconds between two attempts


class StartupWait:
    """How long the calls of one interface wait for a server that is not up yet.

    Nothing is asked or counted while calls succeed. The time begins with the first call that finds no server.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._deadline: float | None = None

    async def allows(self, transport: Any, error: Exception) -> bool:
        """Pause and return True if a call over a `Transport` that ended in `error`, unapplied, is to be tried again."""
        if not self._seconds or not isinstance(error, NotConnected | ServerNotReady):
            return False
        now, opened = time.monotonic(), transport.states.first_opened
        # A server that has been reached is lost, and not starting: but it may still load its data, and a cluster may
        # have nodes that start later than the first one.
        if opened is not None and not isinstance(error, ServerNotReady) and not transport.sharded:
            return False
        if self._deadline is None:
            self._deadline = (now if opened is None else opened) + self._seconds
            if now < self._deadline:
                logger.warning("waiting up to %g s for the server: %s", self._deadline - now, error)
        if now >= self._deadline:
            return False
        await transport.pause(min(_PAUSE, self._deadline - now))
        return True


State = Literal["idle", "connected", "lost", "reconnecting", "closed"]
"""idle: nothing was connected yet. lost: a connection broke and none is left that answers; the next call makes a
new one, and an event loop tries once at once. reconnecting: the same, and it is retried until it works, since a
subscriber follows updates."""

# Changes that wait for a slow reader of `states()`: of a server that comes and goes, the last ones tell.
_KEPT = 100


@dataclass(frozen=True, slots=True)
class StateChange:
    """One change of the state of an interface's connection.

    Attributes:
        state: The new state.
        reason: Why, for people; empty where there is nothing to say.
        time: When, in seconds since 1970 on this machine's clock.
        restarted: The server is another process than at the last connection: it was restarted (and may
            have lost what it had not saved), or another one took its place.
    """

    state: State
    reason: str
    time: float
    restarted: bool = False


class StateChanges(Stream[StateChange]):
    """Yields the state as it is, then each change: an async iterator; ends when the interface is closed."""

    @property
    def _following(self) -> bool:
        return True

    async def listen(self) -> None:
        """Nothing to wait for: it follows from the beginning."""


class States:
    """The state of one interface. Any thread may call; what is called back runs on the thread that noticed.

    Or on one that is calling back already, so that changes are reported in order. No lock is held meanwhile: what is
    called back may call REEM, and wait for what another thread has.
    """

    def __init__(self) -> None:
        self.startup = StartupWait(0.0)  # `RedisInterface(wait=)`
        self.first_opened: float | None = None  # when the first connection was made, on this machine's monotonic clock
        self.on_opened: Callable[[], None] = noop  # called after each new connection
        self.unreadable = 0  # how many messages on followed channels could not be read
        self.reported: set[str] = set()  # places that cannot be read, of which was warned
        self.last = StateChange("idle", "", time.time())
        self._lock = threading.RLock()
        self._queues: WeakList[BoundedQueue] = WeakList()
        self._callbacks: list[Callable[[StateChange], object]] = []
        self._untold: collections.deque[StateChange] = collections.deque()  # to the callbacks
        self._telling = threading.Lock()  # held by the thread that calls back
        self._servers: dict[str, str] = {}
        _all.add(self)

    def changes(self) -> StateChanges:
        changes = StateChanges(Last(_KEPT))
        with self._lock:
            changes.queue.put(self.last)
            if self.last.state == "closed":
                changes.queue.close()
            self._queues.add(changes.queue)
        return changes

    def call(self, callback: Callable[[StateChange], object]) -> None:
        """Call `callback` with each change from now on; it must not block. What it raises is logged."""
        self._callbacks.append(callback)

    # Callbacks are called without the lock.

    def opened(self, address: str, server: str | None) -> None:
        """Note a new connection to the server at `address`, whose process calls itself `server` (if it says so)."""
        with self._lock:
            if self.first_opened is None:
                self.first_opened = time.monotonic()
            # Per address: another node of a cluster is another process without anything having been restarted.
            before = self._servers.get(address, server)
            restarted = before != server and server is not None
            if server is not None:
                self._servers[address] = server
            if restarted or self.last.state not in ("connected", "closed"):
                self._change("connected", f"the server at {address} was restarted" if restarted else "", restarted)
        self.tell()
        self.on_opened()

    def lost(self, reason: Exception) -> bool:
        """Note that a connection broke, unless it was closed on purpose; return whether there is none now."""
        with self._lock:
            if self.last.state in ("connected", "idle") and not isinstance(reason, InterfaceClosed):
                self._change("lost", str(reason))
            is_lost = self.last.state == "lost"
        self.tell()
        return is_lost

    def answered(self) -> None:
        with self._lock:
            if self.last.state == "lost":
                self._change("connected", "")
        self.tell()

    def retrying(self) -> None:
        with self._lock:
            if self.last.state in ("connected", "lost"):
                self._change("reconnecting", self.last.reason)
        self.tell()

    def closed(self) -> None:
        """Note the end, which ends all iterators."""
        with self._lock:
            if self.last.state != "closed":
                self._change("closed", "")
            for queue in self._queues:
                queue.close()
        self.tell()

    def tell(self) -> None:
        """Call back with what was not told yet, unless another call, of this or of another thread, is at it."""
        while self._untold and self._telling.acquire(blocking=False):
            try:
                while self._untold:
                    change = self._untold.popleft()
                    for callback in tuple(self._callbacks):
                        try:
                            callback(change)
                        except Exception:
                            logger.exception("a callback for changes of the connection raised")
            finally:
                self._telling.release()

    def _change(self, state: State, reason: str, restarted: bool = False) -> None:
        self.last = StateChange(state, reason, time.time(), restarted)
        for queue in self._queues:
            queue.put(self.last)
        if self._callbacks:
            self._untold.append(self.last)

    def _forked(self) -> None:
        # A thread that the child does not have may hold them.
        self._lock, self._telling = threading.RLock(), threading.Lock()


_all = Inherited(States._forked)  # before that of `wire`, which notes a loss
