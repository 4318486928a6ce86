"""RedisInterface for plain scripts: the core's, with blocking calls."""

from __future__ import annotations

import contextlib
import os
import threading
import weakref
from collections.abc import Callable, Coroutine, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

import reem_async
from reem_async.connection import rebuilt
from reem_async.policy import Ended
from reem_async.ships.base import SpecialDatatypeShip
from reem_async.state import State, StateChange, StateChanges
from reem_async.transport.blocking import BlockingTransport
from reem_async.transport.endpoints import NewTransport

from ._portal import Portal, finish
from ._twin import documented_by

__all__ = ["RedisInterface"]

Result = TypeVar("Result")


class _OnThread(reem_async.RedisInterface):
    """The core's interface over connections that the caller's own thread drives."""

    _new_transport: NewTransport = BlockingTransport


class _Background:
    """The event loop of an interface and the core's interface on it, made when first needed."""

    def __init__(self, direct: reem_async.RedisInterface) -> None:
        self._direct = direct
        self._lock = threading.RLock()
        self._made: tuple[int, Portal, reem_async.RedisInterface] | None = None

    @property
    def inside(self) -> bool:
        """Whether the caller is on the loop's own thread."""
        made = self._made
        return made is not None and made[1].inside

    def started(self) -> tuple[Portal, reem_async.RedisInterface]:
        """Return both, starting them if need be; raises InterfaceClosed."""
        with self._lock:
            self._direct.session.transport.check()
            if self._made is None or self._made[0] != os.getpid():  # threads do not survive a fork
                host, ships, settings = self._direct._given
                interface = reem_async.RedisInterface(host, ships, **settings)
                interface.session.transport.states = self._direct.session.transport.states
                self._made = os.getpid(), Portal("reem-loop"), interface
            return self._made[1:]

    def close(self) -> None:
        """Close all connections and end the loop."""
        finish(self._direct.close())
        with self._lock:
            made, self._made = self._made, None
        if made is not None and made[0] == os.getpid():
            _, portal, interface = made
            if not portal.inside:
                with contextlib.suppress(TimeoutError):
                    portal.call(interface.close(), timeout=1.0)
            portal.stop()


class StateIterator:
    """Yields the state of an interface as it is, then each change; ends when the interface is closed."""

    def __init__(self, changes: StateChanges) -> None:
        self._core = changes

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> StateChange:
        try:
            return self._core.mailbox.take_waiting()  # type: ignore[no-any-return]
        except Ended:
            raise StopIteration from None


@documented_by(reem_async.RedisInterface)
class RedisInterface:
    """A connection to one server; everything else is made from it.

    Nothing is connected before the first call that needs it. Any number of threads may share it:
    reads and writes run on the caller's thread over a connection of their own. Subscriptions and
    ships with `async def` methods run on a background event loop, one daemon thread per interface,
    started when first needed and ended by `close()` or at exit.

    Args:
        host: A host name, a URL (`redis://`, `rediss://`, `unix://`) or an `EmbeddedServer`. Several servers:
            `redis+cluster://user:password@host:7000,host:7001` for some nodes of a cluster, or an
            `EmbeddedCluster`; `redis+sentinel://host:26379,host:26380/mymaster` for the primary that
            sentinels name. With TLS they begin with `rediss+`. See docs/fleet.md.
        ships: What carries values that are not JSON, first fit first; replaces the default list of
            `NumpyShip` and `BytesShip`.
        namespace: Goes before every key and channel, so that several robots can share a server.
        timeout: Seconds without a byte moving after which a call is given up; `reem.timeout` sets another
            limit for some calls.
        read_from_replicas: Have replicas answer `read`, `get`, `length` and `type`, to spare primaries; for a
            cluster or behind sentinels. What it gives up: replicas get updates some time later, usually
            milliseconds, but without any bound if one lags or has lost its primary. A read may bring what was
            there before this very program's last write, and, once another server had to be asked (one replica
            is kept to as long as it answers), even what was there before its last read. What stays: each read
            is of one instant, document and arrays together, and what a replica does not have is asked of the
            primary, so that MissingKey is as true as ever. Writes, `edit()`, arithmetic, subscribers, `watch()`
            and recordings stay with primaries, and `state` tells of them alone. See docs/fleet.md.
        options: redis-py's connection options: `port`, `db`, `username`, `password`, `ssl`, ...

    Raises:
        BadType, BadValue: An option or URL that means nothing.
    """

    def __init__(
        self,
        host: Any = "localhost",
        ships: Sequence[SpecialDatatypeShip] | None = None,
        *,
        namespace: str = "",
        timeout: float = 1.0,
        read_from_replicas: bool = False,
        **options: Any,
    ) -> None:
        settings = {"namespace": namespace, "timeout": timeout, "read_from_replicas": read_from_replicas, **options}
        self._direct = _OnThread(host, ships, **settings)
        self._background = _Background(self._direct)
        self._closing = weakref.finalize(self, self._background.close)  # when dropped, or at exit

    @property
    def hostname(self) -> str:
        """Where the server is, without credentials."""
        return self._direct.hostname

    @property
    def namespace(self) -> str:
        """What goes before every key and channel."""
        return self._direct.namespace

    @property
    def state(self) -> State:
        """What is known of the connection: "idle" before the first, "connected", "lost", "reconnecting" or "closed"."""
        return self._direct.state

    def states(self) -> StateIterator:
        """Return an iterator over the state and its changes."""
        return StateIterator(self._direct.states())

    def on_state(self, callback: Callable[[StateChange], object]) -> None:
        """Call `callback` with each change of the state."""
        self._direct.on_state(callback)

    @property
    def _core(self) -> reem_async.RedisInterface:
        """The core's interface that stores are made from."""
        return self._followers if self._direct.session.ships.asynchronous else self._direct

    @property
    def _followers(self) -> reem_async.RedisInterface:
        """The core's interface that subscribers are made from: it lives on the background loop."""
        return self._background.started()[1]

    def _run(self, coroutine: Coroutine[Any, Any, Result]) -> Result:
        """Run one of the core's coroutines on a store to its end and return the result."""
        if self._direct.session.ships.asynchronous or self._background.inside:
            return self._wait(coroutine)
        try:
            return finish(coroutine)
        except BaseException:
            self._direct.session.transport.broken_off()
            raise

    def _wait(self, coroutine: Coroutine[Any, Any, Result]) -> Result:
        """Run one of the core's coroutines on the background loop and return the result."""
        try:
            portal = self._background.started()[0]
        except BaseException:
            coroutine.close()
            raise
        return portal.call(coroutine)

    def initialize(self) -> None:
        """Connect now and check the server."""
        self._run(self._core.initialize())

    def close(self) -> None:
        """End all subscriptions and close all connections."""
        self._closing()

    def __enter__(self) -> Self:
        try:
            self.initialize()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt, (type(self), *self._direct._given)

    def __repr__(self) -> str:
        return f"<reem.RedisInterface {self.hostname}>"
