"""RedisInterface: one server, the ships for it, and the lifetime of the connections."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Literal, Self

from .local.path import MEMORY, LocalPath
from .session import Session
from .ships.base import SpecialDatatypeShip
from .transport.aio import AsyncTransport
from .transport.composite import NewTransport, ToOneServer
from .transport.options import Options
from .transport.state import State, StateChange, StateChanges

__all__ = ["RedisInterface"]


def _on_event_loop(options: Options) -> ToOneServer:
    """Return a transport for event loops."""
    return AsyncTransport(options)


class RedisInterface:
    """A connection to one server; everything else is made from it.

    Nothing is connected before the first call that needs it. One interface belongs to one event
    loop; any number of tasks may share it, and their calls are pipelined.

    Args:
        host: A host name, `host:port`, a URL (`redis://`, `rediss://`, `unix://`) or an `EmbeddedServer`; if none is
            given, the URL in the environment variable REEM_URL, else `localhost`. `localhost` means the
            server's Unix socket where it has one (on Linux), which is quicker; `127.0.0.1` means TCP. Several servers:
            `redis+cluster://user:password@host:7000,host:7001` for some nodes of a cluster, or an
            `EmbeddedCluster`; `redis+sentinel://host:26379,host:26380/mymaster` for the primary that
            sentinels name. With TLS they begin with `rediss+`. See docs/fleet.md.
        ships: What carries values that are not JSON, first fit first; replaces the default list of
            `NumpyShip` and `BytesShip`. A number in its place is the port.
        namespace: Goes before every key and channel, so that several robots can share a server. It ends with a
            separator, any character but a letter or digit: "robot1:", "robots/r1:".
        timeout: Seconds without a byte moving after which a call is given up; `reem_async.timeout` sets
            another limit for some calls.
        local: How updates with arrays or bytes of 64 KB and more get to subscribers of the same host and user. "auto":
            through shared memory, where that can be had; the server has every update all the same, and whatever goes
            wrong on the way, the subscriber fetches it there. "off": always from the server. "early": what this
            interface publishes is delivered on this host before the server has it (`update.early`); if the
            server never gets it, subscribers get what is there, with `gap`. See docs/guarantees.md.
        local_memory: Bytes of shared memory that this interface's publishers may take, in all: six times the bytes
            of an update for each top-level key. Beyond that, values go through the server.
        options: redis-py's connection options: `port`, `db`, `username`, `password`, `ssl`, ... Its `socket_timeout`
            is another name of `timeout`. Besides, `largest_value`: the bytes that a string in a reply may have
            (an array, or the text of a document); 512 MB if not given, as a server's own `proto-max-bulk-len`. What is
            larger, or over eight times that in one reply, closes the connection: ConnectionLost.

    Raises:
        BadType, BadValue: An option or URL that means nothing.
    """

    _new_transport: NewTransport = staticmethod(_on_event_loop)

    def __init__(
        self,
        host: Any = None,
        ships: Sequence[SpecialDatatypeShip] | int | None = None,
        *,
        namespace: str = "",
        timeout: float = 1.0,
        local: Literal["auto", "off", "early"] = "auto",
        local_memory: int = MEMORY,
        **options: Any,
    ) -> None:
        ships = options.pop("marshallers", ships)  # what REEM 0.1 called them
        # RedisInterface("localhost", 6379): redis-py, and REEM 0.0, have the port there.
        if isinstance(ships, int):
            options["port"], ships = ships, None
        if host is None:
            host = os.environ.get("REEM_URL") or "localhost"
        settings = {"namespace": namespace, "timeout": timeout}
        settings |= {"local": local, "local_memory": local_memory}
        self._given = (getattr(host, "url", host), ships, {**settings, **options})
        self.session = Session(
            host,
            ships,
            namespace,
            timeout,
            options,
            self._new_transport,
            local=LocalPath(local, local_memory),
        )
        self.session.interface = self
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

        Replies are str. What it writes no subscriber is told of, and keys of REEM are best left to REEM. On a server
        without JSON its JSON commands raise NoJsonSupport, which says what to use.

        Raises:
            Misuse: This is an interface to several servers.
            InterfaceClosed: It is closed.
        """
        self.session.transport.check()
        if self._client is None:
            self._client = self._new_client()
        return self._client

    def _new_client(self) -> Any:
        from .transport.client import asyncio_client

        return asyncio_client(self.session.options)

    @property
    def state(self) -> State:
        """What is known of the connection: "idle" before the first, "connected", "lost", "reconnecting" or "closed".

        Nothing is sent. A connection that broke is made again by the next call ("lost"),
        or by itself where somebody follows updates ("reconnecting", for ever, with growing pauses up to 1 s).
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
        """How many messages on the channels that are followed, and values in what is followed, could not be read.

        A value that cannot be read, such as an array that was evicted, has an `Unreadable` in its place and is logged
        once. Any client may publish what is no update of REEM, and a later version may send what this one does
        not know. Such a message costs itself alone: what follows its key is read anew, with `gap`, and the
        first of each channel is logged.
        """
        return self.session.transport.states.unreadable

    async def initialize(self) -> None:
        """Connect now, and check that the server can be used. Optional; one round trip, idempotent.

        Raises:
            NotConnected: Nobody listens there.
            redis.exceptions.AuthenticationError: Wrong user or password.
        """
        await self.session.initialize()

    async def close(self) -> None:
        """End all subscriptions and close all connections. Idempotent."""
        try:
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

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt, (type(self), *self._given)

    def __repr__(self) -> str:
        return f"<reem_async.RedisInterface {self.hostname}>"


def rebuilt(kind: Callable[..., Any], host: Any, ships: Any, options: dict[str, Any]) -> Any:
    """Make an interface from the parts of a pickled one."""
    return kind(host, ships, **options)
