"""RedisInterface: one server, the ships for it, and the lifetime of the connections."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any, Literal, Self

from .coordination.clock import ClockOffset, ServerClock
from .coordination.presence import NodeInfo, NodeWatch, Presence, in_order, listed
from .errors import SELF_EXPLANATORY
from .local import MEMORY, LocalPath
from .plan.arguments import check_number
from .session import Session
from .ships.base import SpecialDatatypeShip
from .transport import NewTransport
from .transport.aio import AsyncTransport
from .transport.client import asyncio_client
from .transport.state import State, StateChange, StateChanges

__all__ = ["RedisInterface"]


class RedisInterface:
    """A connection to one server; everything else is made from it.

    Nothing is connected before the first call that needs it. In asyncio an interface belongs to one event loop; any
    number of tasks may share it, and their calls are pipelined. In plain programs any number of threads may share it:
    reads and writes run on the caller's thread over a connection of their own. Subscriptions, and ships with coroutine
    functions, run on a background event loop, one daemon thread per interface, started when first needed and ended by
    `close()` or at exit. Calls work until the process ends, in functions of `atexit`, log handlers and `__del__` too.

    Args:
        host: A host name, `host:port`, a URL (`redis://`, `rediss://`, `unix://`) or an `EmbeddedServer`; if none is
            given, the URL in the environment variable REEM_URL, else `localhost`. `localhost` means the server's Unix
            socket where it has one (on Linux); `127.0.0.1` means TCP. Several servers, see docs/fleet.md:
            `redis+cluster://user:password@host:7000,host:7001` for some nodes of a cluster, or an `EmbeddedCluster`;
            `redis+sentinel://host:26379,host:26380/mymaster`. With TLS they begin with `rediss+`.
        ships: What carries values that are not JSON, first fit first; replaces the default list of
            `NumpyShip`, `BytesShip`, `JpegShip` and `PngShip`. A number in its place is the port.
        namespace: Goes before every key and channel, so that several robots can share a server. It ends with a
            separator, any character but a letter or digit: "robot1:", "robots/r1:".
        timeout: Seconds without a byte moving after which a call times out; `reem_async.timeout` sets
            another limit for some calls.
        local: How updates get to subscribers of the same host and user. "auto": those with arrays or bytes of 64 KB and
            more through shared memory, after the server has stored them. "off": always from the server. "early": all
            updates of this interface directly, before the server has stored them (`update.early`); promise 19 of
            docs/guarantees.md says what that weakens. Its calls of services reach programs on this host directly, too.
        local_memory: Bytes of shared memory that this interface's publishers may take, in all: six times the bytes
            of an update for each top-level key. Beyond that, values go through the server.
        wait: Seconds for which the first connection is tried again if the server is not up yet, for programs that start
            at boot, counted from the first call that found no server; then NotConnected is raised. A wrong password or
            certificate, a missing right and the like are raised at once, as is the loss of a server later.
        name: What other programs call this one: `nodes` lists it. It costs four small round trips a second, from the
            first connection on, until the interface is closed. Several programs may have one name.
        options: redis-py's connection options: `port`, `db`, `username`, `password`, `ssl`, ... Its `socket_timeout`
            is another name of `timeout`. Besides, `largest_value`: the bytes that a string in a reply may have, 512 MB
            if not given. What is larger, or over eight times that in one reply, closes the connection: ConnectionLost.

    Raises:
        BadType, BadValue: An option or URL that means nothing, a `wait` that is no number of seconds, or a `name` that
            cannot be used.
    """

    _new_transport: NewTransport = AsyncTransport

    def __init__(
        self,
        host: Any = None,
        ships: Sequence[SpecialDatatypeShip] | int | None = None,
        *,
        namespace: str = "",
        timeout: float = 1.0,
        local: Literal["auto", "off", "early"] = "auto",
        local_memory: int = MEMORY,
        wait: float = 0.0,
        name: str | None = None,
        **options: Any,
    ) -> None:
        ships = options.pop("marshallers", ships)  # what REEM 0.1 called them
        # RedisInterface("localhost", 6379): redis-py, and REEM 0.0, have the port there.
        if isinstance(ships, int):
            options["port"], ships = ships, None
        if host is None:
            host = os.environ.get("REEM_URL") or "localhost"
        settings = {"namespace": namespace, "timeout": timeout}
        settings |= {"local": local, "local_memory": local_memory, "wait": wait, "name": name}
        self._given = (getattr(host, "url", host), ships, {**settings, **options})
        shared = LocalPath(local, local_memory)
        self.session = Session(host, ships, namespace, timeout, options, self._new_transport, shared, wait)
        self.session.interface = self
        self._clock = ServerClock(self.session)
        self._presence = None if name is None else Presence(self.session, self._clock, name)
        self._client: Any = None
        # An event loop that ends without `close` (asyncio.run of a script) takes its connections and tasks with it.
        self.session.transport.at_end = self.session.release

    @property
    def hostname(self) -> str:
        """Where the server is, without credentials."""
        return self.session.options.address

    @property
    def namespace(self) -> str:
        """What goes before every key and channel."""
        return self.session.namespace

    @property
    def client(self) -> Any:
        """A plain client of redis-py for the same server, made when first asked for and closed with this interface.

        Replies are str. Its writes notify no subscriber, so do not write keys of REEM with it. On a server without JSON
        its JSON commands raise NoJsonSupport.

        Raises:
            Misuse: This is an interface to several servers.
            InterfaceClosed: It is closed.
        """
        self.session.transport.check()
        if self._client is None:
            self._client = self._new_client()
        return self._client

    def _new_client(self) -> Any:
        return asyncio_client(self.session.options)

    @property
    def state(self) -> State:
        """The state of the connection: "idle" before the first, "connected", "lost", "reconnecting" or "closed".

        Nothing is sent. After a connection was "lost" the next call reconnects. If there are subscribers, it reconnects
        by itself: "reconnecting", for ever, with growing pauses up to 1 s.
        """
        return self.session.transport.states.last.state

    def states(self) -> StateChanges:
        """Return an async iterator over the state as it is and each change; it ends when this is closed.

        A `StateChange` says why, when, and whether the server is another process than before (restarted).
        """
        return self.session.transport.states.changes()

    def on_state(self, callback: Callable[[StateChange], object]) -> None:
        """Call `callback` with each `StateChange` from now on.

        It runs where the change is noticed and must not block; what it raises is logged.
        """
        self.session.transport.states.call(callback)

    @property
    def unreadable(self) -> int:
        """How many messages and values could not be read by subscribers.

        A value that cannot be read, such as an array that was evicted, has an `Unreadable` in its place and is logged
        once. A message cannot be read if it is not an update of REEM, or of a later version: its key is read again,
        with `gap`, and the first of each channel is logged.
        """
        return self.session.transport.states.unreadable

    async def nodes(self) -> list[NodeInfo]:
        """Return the programs that are connected under a name, in the order of their names.

        A `NodeInfo` has name, host, process id, since when it is connected, and what it publishes, serves and owns. A
        program that was killed, stopped or cut off is missing within a second. Two round trips, or three.

        Raises:
            NotAllowed: The user lacks a right; says which.
        """
        return in_order((await listed(self.session)).values())

    def watch_nodes(self) -> NodeWatch:
        """Return an async iterator over the programs that join and leave, those that are there first.

        Each `NodeEvent` has `kind`, "joined" or "left", and `node`. Five times a second it makes two round trips.
        """
        return NodeWatch(self.session)

    async def clock(self, *, max_age: float = 60.0) -> ClockOffset:
        """Return by how much the server's clock is ahead of this computer's: `offset`, `bound`, `measured`.

        Add `offset` to `time.time()` for the server's time. Eight round trips, none if it was measured in the last
        `max_age` seconds and this computer's clock was not set since. Of a cluster it is the clock of one server.

        Raises:
            NotAllowed: The user lacks the right to TIME.
            BadValue: `max_age` is below 0.
        """
        check_number("max_age", max_age, "use seconds, 0 or more")
        return await self._clock.offset(max_age)

    async def initialize(self) -> None:
        """Connect now, and check that the server can be used. Optional; one round trip, idempotent.

        Raises:
            NotConnected: No server listens there, also after `wait` seconds.
            redis.exceptions.AuthenticationError: Wrong user or password.
        """
        try:
            await self.session.initialize()
        except SELF_EXPLANATORY as error:
            raise error.with_traceback(None) from None

    async def close(self) -> None:
        """End all subscriptions and close all connections. Idempotent."""
        try:
            if self._presence is not None:
                await self._presence.leave()
            await self.session.close()
        finally:
            if self._client is not None:
                await self._close_client()

    async def _close_client(self) -> None:
        await self._client.aclose()

    async def __aenter__(self) -> Self:
        try:
            await self.initialize()
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt, (type(self), *self._given)

    def __repr__(self) -> str:
        return f"<reem_async.RedisInterface {self.hostname}>"


def rebuilt(kind: Callable[..., Any], host: Any, ships: Any, options: dict[str, Any]) -> Any:
    return kind(host, ships, **options)
