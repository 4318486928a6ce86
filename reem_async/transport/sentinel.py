"""The port over a primary that sentinels watch: each new connection asks them where it is.

After a failover the connections to the old primary break, or its replies say that it takes no writes
any more. The next connection goes where the sentinels say then, and only a server that calls itself
a primary is taken. An old primary that is not dead hears of its successor some ten seconds later, and
what it takes until then is lost: so the sentinels are asked every second, on a thread.
"""

from __future__ import annotations

import asyncio
import os
import threading
import time
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

import redis.exceptions

from ..errors import BadValue, ConnectionLost, NotConnected, ReemError, Refused, TlsRefused
from ..plan import Command, Reply
from . import CompositeTransport, Guard, Held, NewTransport, Transport
from .options import Address, NodeOptions, Options, address_of, listed
from .state import States

if TYPE_CHECKING:
    from .wire import Wire

_LOOK_PAUSE = 1.0  # seconds between questions to the sentinels
_MASTERS: Command = ("SENTINEL", "MASTERS")
_UNFIT = (b"down", b"disconnected")
"""What the sentinels' flags of a server hold if it cannot be used: s_down, o_down, disconnected."""

_EXAMPLE = "redis+sentinel://user:password@host:26379,host2:26379/mymaster"


class SentinelOptions(Options):
    """How to reach the primary that sentinels watch.

    Args:
        url: `redis+sentinel://user:password@host:port,host:port/service`; user and password are the servers'.
        timeout: As for `Options`.
        options: Those of the servers; besides, `sentinel_username` and `sentinel_password` for the sentinels.

    Raises:
        BadValue: The URL names no service.
    """

    def __init__(self, url: str, timeout: float, options: dict[str, Any]) -> None:
        options = dict(options)
        login = {name: options.pop(f"sentinel_{name}", None) for name in ("username", "password")}
        urls = [each.partition("?") for each in listed(url, _EXAMPLE)]
        heads = [head.split("/") for head, _, _ in urls]  # scheme:, nothing, host, service, database
        self.service = heads[0][3] if len(heads[0]) > 3 else ""  # what the sentinels call the primary
        if not self.service:
            raise BadValue(f"the URL names no service; write it like {_EXAMPLE}")
        plain = [
            f"{'/'.join([*parts[:3], *parts[4:]])}{mark}{query}"
            for parts, (_, mark, query) in zip(heads, urls, strict=True)
        ]
        self.found: Address | None = None  # where it was when a connection was made last
        # Called when a connection is made elsewhere than the last one; may be called on any thread.
        self.changed: Callable[[], None] = lambda: None
        self._sentinels = [address_of(one, 26379) for one in plain]
        # When they were asked last, of those that have not answered since: they are asked behind all others.
        self._silent: dict[Address, float] = {}
        super().__init__(plain[0], timeout, options)
        tls = {"ssl": True, **{name: value for name, value in self.settings.items() if name.startswith("ssl_")}}
        self._asking = {
            "socket_connect_timeout": self.handshake_timeout / 2,
            **{name: value for name, value in login.items() if value is not None},
            **(tls if self.tls else {}),
        }

    @property
    def _hosts(self) -> str:
        return ",".join(f"{host}:{port}" for host, port in self._sentinels)

    @property
    def address(self) -> str:
        return f"{self.service} (sentinels {self._hosts})"

    @property
    def url(self) -> str:
        database = f"/{self.database}" if self.database else ""
        return f"{'rediss' if self.tls else 'redis'}+sentinel://{self._hosts}/{self.service}{database}"

    def asynchronous_connection(self) -> Any:
        connection = super().asynchronous_connection()
        connect = connection.connect

        async def connect_to_primary() -> None:
            self._go_to(connection, await self.find_primary(_ask))
            await connect()
            _check_role(connection)

        connection.connect = connect_to_primary
        return connection

    def blocking_connection(self) -> Any:
        connection = super().blocking_connection()
        connect = connection.connect

        def connect_to_primary() -> None:
            self._go_to(connection, self.primary())
            connect()
            _check_role(connection)

        connection.connect = connect_to_primary
        return connection

    def _go_to(self, connection: Any, address: Address) -> None:
        connection.host, connection.port = address
        before, self.found = self.found, address
        if before not in (None, address):
            self.changed()

    def sentinels(self) -> Iterator[Options]:
        """Yield how to reach each of the sentinels: those that did not answer when they were asked last come last."""
        for address in sorted(self._sentinels, key=lambda each: self._silent.get(each, 0.0)):
            yield NodeOptions(self, address, self._asking)

    def primary(self) -> Address:
        """Ask the sentinels where the primary is, on this thread; raises what `find_primary` raises."""
        try:
            self.find_primary(_ask_blocking).send(None)
        except StopIteration as end:
            address: Address = end.value
            return address
        raise AssertionError("a blocking question cannot wait")

    async def find_primary(self, ask: Callable[[Options, float], Awaitable[Any]]) -> Address:
        """Ask the sentinels, one after the other by `ask`, where the primary is, within the limit for connecting.

        The first one has half of that limit, since it may only be slow, and each of the others a share of the rest, so
        that there is time for the last one, and for the primary.

        Raises:
            TlsRefused, LoginRefused, NotAllowed: No sentinel names it, and one of them gave this reason.
            NotConnected: No sentinel names it.
        """
        problems: list[Exception] = []
        deadline, parts = time.monotonic() + self.handshake_timeout, len(self._sentinels)
        for place, sentinel in enumerate(self.sentinels()):
            address: Address = (sentinel.settings["host"], sentinel.settings["port"])
            now = time.monotonic()
            if now >= deadline:
                break
            self._silent[address] = now  # until it has answered, however the asking ends
            limit = (deadline - now) / (parts - place + 1 if place else 2)
            try:
                return self._named(await ask(sentinel, limit), address)
            except Exception as error:  # redis-py lets pass what a peer's nonsense makes of its parser
                problem = sentinel.refused(error)
                if problem is not error:
                    problem.__cause__ = error
                problems.append(problem)
        raise self._nowhere(problems)

    def _named(self, masters: Any, sentinel: Address) -> Address:
        """Return where a sentinel says that the primary is; raises NotConnected if it knows of none that is up."""
        for row in masters:
            if row[b"name"] == self.service.encode():
                if any(word in row[b"flags"] for word in _UNFIT):
                    raise NotConnected(f"a sentinel says that the primary of {self.service!r} is down")
                primary = row[b"ip"].decode(), int(row[b"port"])
                self._silent.pop(sentinel, None)
                return primary
        raise NotConnected(f"a sentinel knows no {self.service!r}; the URL ends with the name that it was given there")

    def _nowhere(self, problems: Sequence[Exception]) -> Exception:
        """Return the error to raise: the reason that a person has to act on, or all of them."""
        for kind in (TlsRefused, Refused):
            if found := [problem for problem in problems if isinstance(problem, kind)]:
                return found[-1]
        said = "; ".join(dict.fromkeys(str(problem).partition("; start one")[0] for problem in problems))
        error = NotConnected(f"no sentinel of {self.address} names a primary: {said}")
        error.__cause__ = problems[-1] if problems else None
        return error


async def _ask(sentinel: Options, limit: float) -> Any:
    connection = sentinel.asynchronous_connection()
    try:
        async with asyncio.timeout(limit):
            await connection.connect()
            await connection.send_command(*_MASTERS)
            return await connection.read_response()
    finally:
        await connection.disconnect(nowait=True)


async def _ask_blocking(sentinel: Options, limit: float) -> Any:
    connection = sentinel.blocking_connection()
    connection.socket_timeout = connection.socket_connect_timeout = limit
    try:
        connection.connect()
        connection.send_command(*_MASTERS)
        return connection.read_response()
    finally:
        connection.disconnect()


def _check_role(connection: Any) -> None:
    greeting = connection.handshake_metadata
    if (greeting.get(b"role") or greeting.get("role")) not in (b"master", "master"):
        raise redis.exceptions.ConnectionError(f"{connection.host}:{connection.port} is not the primary any more")


class SentinelTransport(CompositeTransport):
    _options: SentinelOptions

    def __init__(self, options: SentinelOptions, new_transport: NewTransport) -> None:
        self._options = options
        self._root: Any = new_transport(options)
        self._lookout: _Lookout | None = None

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        """Send `commands` to the primary; raises NotConnected, with nothing applied, if it is none any more."""
        self._look_out()
        return self.checked(await self._root.roundtrip(commands, bulk=bulk))

    def _look_out(self) -> None:
        if self._lookout is None or self._lookout.pid != os.getpid():
            self._lookout = _Lookout(self._options, self)
            self._options.changed = self._lookout.tell

    def on_moved(self) -> None:
        """Break the connections to the primary of before: the next ones ask the sentinels. Any thread may call."""
        self._root.drop(ConnectionLost(f"the sentinels name another primary for {self._options.service!r}"))

    async def listen(self, on_push: Callable[[list[Any]], None], on_lost: Callable[[Wire, Exception], None]) -> Wire:
        self._look_out()
        wire: Wire = await self._root.listen(on_push, on_lost)
        return wire

    def checked(self, replies: list[Reply]) -> list[Reply]:
        for reply in replies:
            # The only sign, before the connection breaks, that the server was demoted. A primary that cannot save, or
            # that lacks replicas, refuses writes with another code.
            if isinstance(reply, redis.exceptions.ReadOnlyError) and "READONLY" in str(reply):
                reason = ConnectionLost(f"a primary of {self._options.address} became a replica")
                self.states.lost(reason)
                self._root.drop(reason)
                raise NotConnected(
                    f"the server that was the primary of {self._options.address} is a replica now ({reply}); "
                    "nothing was applied: call again, the next connection asks the sentinels"
                )
        return replies

    @property
    def states(self) -> States:
        states: States = self._root.states
        return states

    @states.setter
    def states(self, states: States) -> None:
        self._root.states = states

    def hold(self, guard: Guard | None = None) -> AbstractAsyncContextManager[Held]:
        self._look_out()
        if guard is None:
            return self._lend()
        # The guard is on the inside, where a server without JSON is sent text.
        return self._root.hold(lambda kept: guard(_CheckedConnection(self, kept)))  # type: ignore[no-any-return]

    @asynccontextmanager
    async def _lend(self) -> AsyncIterator[Held]:
        async with self._root.hold() as held:
            yield _CheckedConnection(self, held)

    async def close(self) -> None:
        if self._lookout is not None:
            self._lookout.stop()
        await super().close()

    def _all(self) -> list[Transport]:
        return [self._root]


class _Lookout:
    """A thread that asks the sentinels whether the primary is another one than that of the connections."""

    def __init__(self, options: SentinelOptions, owner: SentinelTransport) -> None:
        self.pid = os.getpid()  # the process it runs in
        self._options = options
        self._owner = weakref.ref(owner)
        self._stopped = threading.Event()
        threading.Thread(target=self._run, name="reem-sentinel", daemon=True).start()

    def _run(self) -> None:
        while not self._stopped.wait(_LOOK_PAUSE):
            if self._owner() is None:  # the transport was dropped
                return
            with suppress(ReemError):
                if self._options.found not in (None, self._options.primary()):
                    self.tell()

    def tell(self) -> None:
        if (owner := self._owner()) is not None:
            owner.on_moved()

    def stop(self) -> None:
        """End the thread, within a second or so."""
        self._stopped.set()


class _CheckedConnection:
    def __init__(self, transport: SentinelTransport, held: Any) -> None:
        self._transport = transport
        self._held = held

    def fresh(self) -> bool:
        return bool(self._held.fresh())

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        return self._transport.checked(await self._held.roundtrip(commands, bulk=bulk))
