"""RedisInterface: one server, the ships for it, and the lifetime of the connections."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from .errors import BadType, NoJsonSupport
from .plan import Plan
from .plan.keys import Keys, keys_of
from .plan.memory import Memory
from .plan.paths import check_top_key
from .plan.replies import no_json
from .ships.base import SpecialDatatypeShip
from .ships.registry import Ships, default_ships
from .transport import Transport, drive
from .transport.aio import AsyncTransport
from .transport.options import Options
from .transport.recorder import CommandRecorder

if TYPE_CHECKING:
    from .follow import Hub

__all__ = ["RedisInterface"]


class RedisInterface:
    """A connection to one server; everything else is made from it.

    Nothing is connected before the first call that needs it. One interface belongs to one event
    loop; any number of tasks may share it, and their calls are pipelined.

    Args:
        host: A host name, a URL (`redis://`, `rediss://`, `unix://`) or an `EmbeddedServer`.
        ships: What carries values that are not JSON, first fit first; replaces the default list of
            `NumpyShip` and `BytesShip`.
        namespace: Goes before every key and channel, so that several robots can share a server.
        timeout: Seconds without a byte received after which a call is given up.
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
        **options: Any,
    ) -> None:
        ships = options.pop("marshallers", ships)  # what REEM 0.1 called them
        self._given = (host, ships, {"namespace": namespace, "timeout": timeout, **options})
        if not isinstance(namespace, str) or "{" in namespace or "}" in namespace:
            raise BadType(f"the namespace {namespace!r} is not a str without braces")
        self.namespace = namespace
        self.options = Options(host, timeout, options)
        self.ships = Ships(default_ships() if ships is None else ships, CommandRecorder)
        self.memory = Memory()
        self.publisher_id = secrets.token_hex(6)
        self._sequences: dict[str, int] = {}
        self._hub: Hub | None = None
        self.transport: Transport = self._new_transport()

    def _new_transport(self) -> Transport:
        return AsyncTransport(self.options)

    @property
    def hostname(self) -> str:
        """Where the server is, without credentials."""
        return self.options.address

    @property
    def hub(self) -> Hub:
        """The interface's one subscription connection and all that follow updates through it."""
        if self._hub is None:
            from .follow import Hub

            assert isinstance(self.transport, AsyncTransport)
            self._hub = Hub(self.transport, self.ships, self.memory)
        return self._hub

    def keys(self, name: object) -> Keys:
        """Return the server-side names of the top-level key `name`; raises BadKey or BadType."""
        return keys_of(check_top_key(name), self.namespace, self.options.database)

    async def run(self, plan: Plan) -> Any:
        """Send a plan's commands, and those that follow from the replies; return the result."""
        return await drive(self.transport, plan)

    def next_sequence(self, keys: Keys) -> int:
        """Return the number of this publisher's next update of a top-level key."""
        number = self._sequences[keys.channel] = self._sequences.get(keys.channel, 0) + 1
        return number

    async def initialize(self) -> None:
        """Connect now, and check that the server has RedisJSON. Optional; one round trip, idempotent.

        Raises:
            NotConnected: Nobody listens there.
            NoJsonSupport: The server lacks RedisJSON.
            redis.exceptions.AuthenticationError: Wrong user or password.
        """
        await self.ships.ready()
        (reply,) = await self.transport.roundtrip([("JSON.TYPE", f"{self.namespace}reem")])
        if isinstance(reply, Exception) and "unknown command" in str(reply).lower():
            raise NoJsonSupport(f"{self.hostname}: {no_json()}")

    async def close(self) -> None:
        """End all subscriptions and close all connections. Idempotent."""
        if self._hub is not None:
            await self._hub.close()
        await self.transport.close()

    async def __aenter__(self) -> Self:
        await self.initialize()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def twin(self) -> RedisInterface:
        """Return a new asyncio interface of the same settings."""
        host, ships, options = self._given
        return RedisInterface(host, ships, **options)

    def __reduce__(self) -> tuple[Any, ...]:
        host, ships, options = self._given
        return _rebuilt, (type(self), getattr(host, "url", host), ships, options)

    def __repr__(self) -> str:
        return f"<{type(self).__module__.partition('.')[0]}.RedisInterface {self.hostname}>"


def _rebuilt(kind: type[RedisInterface], host: Any, ships: Any, options: dict[str, Any]) -> RedisInterface:
    return kind(host, ships, **options)
