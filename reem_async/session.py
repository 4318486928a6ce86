"""Session: what one interface shares among its stores and subscribers, on one transport."""

from __future__ import annotations

import asyncio
import os
import secrets
import time
from collections.abc import Coroutine, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from .errors import BadType, ClusterReply, NotAllowed, Refused, turned_down
from .plan import Plan
from .plan.keys import Keys, keys_of
from .plan.memory import Memory
from .plan.paths import check_top_key
from .ships.base import SpecialDatatypeShip
from .ships.registry import Ships, default_ships
from .transport import Transport, drive
from .transport.endpoints import NewTransport, way_to
from .transport.recorder import CommandRecorder

if TYPE_CHECKING:
    from .hub import Hub

__all__ = ["Session"]

_FRESH = 3.0
"""Seconds for which the first notices of a publisher about a key go to all nodes of a cluster."""


class Session:
    """One server as one interface sees it.

    Args:
        host: A host name, a URL, an `EmbeddedServer` or an `EmbeddedCluster`.
        ships: What carries values that are not JSON; None for the default list.
        namespace: Goes before every key and channel.
        timeout: Seconds without a byte moving after which a call is given up.
        options: redis-py's connection options.
        new_transport: Makes the transport to one server.
        replicas: What a user reads comes from replicas.

    Attributes:
        ships: Chooses ships.
        memory: What is known of the server.
        transport: The way to the server.
        readers: The way for what a user reads for its own sake, not to act on it; the same if it is not for replicas.
        interface: The interface this belongs to: what is pickled in its place.
    """

    def __init__(
        self,
        host: Any,
        ships: Sequence[SpecialDatatypeShip] | None,
        namespace: str,
        timeout: float,
        options: dict[str, Any],
        new_transport: NewTransport,
        *,
        replicas: bool = False,
    ) -> None:
        if not isinstance(namespace, str) or "{" in namespace or "}" in namespace:
            raise BadType(f"the namespace {namespace!r} is not a str without braces")
        self.namespace = namespace
        self.ships = Ships(default_ships() if ships is None else ships, CommandRecorder)
        self.memory = Memory()
        self.options, self.transport, self.readers = way_to(host, timeout, options, new_transport, replicas=replicas)
        self.interface: Any = None
        self._publisher = secrets.token_hex(6), os.getpid()
        self._sequences: dict[str, int] = {}
        self._fresh: dict[str, float] = {}
        self._hub: Hub | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return attrgetter("session"), (self.interface,)

    @property
    def hub(self) -> Hub:
        """The one subscription connection of the running event loop and all that follow updates through it."""
        self.transport.check()
        place = os.getpid(), asyncio.get_running_loop()
        if self._hub is None or self._hub.place != place:
            from .hub import Hub

            self._hub = Hub(self.transport, self.ships)
        return self._hub

    def keys(self, name: object) -> Keys:
        """Return the server-side names of the top-level key `name`; raises BadKey."""
        return keys_of(check_top_key(name), self.namespace, self.options.database, self.transport.sharded)

    def run(self, plan: Plan, at: Transport | None = None) -> Coroutine[Any, Any, Any]:
        """Send a plan's commands, and those that follow from the replies; awaited, it is the result.

        They go `at` one server, or where their keys are.
        """
        return drive(at or self.transport, plan)

    def stamp(self, keys: Keys) -> tuple[str, int]:
        """Return who publishes, and the number of this publisher's next update of a top-level key."""
        if self._publisher[1] != os.getpid():  # a forked child is another publisher
            self._publisher, self._sequences = (secrets.token_hex(6), os.getpid()), {}
        number = self._sequences[keys.channel] = self._sequences.get(keys.channel, 0) + 1
        if number == 1 and self.transport.sharded:
            self._fresh[keys.channel] = time.monotonic() + _FRESH
        return self._publisher[0], number

    def is_fresh(self, keys: Keys) -> bool:
        """Return whether this publisher has only begun with a top-level key of a cluster: others may not know it."""
        until = self._fresh.get(keys.channel)
        if until is None:
            return False
        if time.monotonic() < until:
            return True
        self._fresh.pop(keys.channel, None)
        return False

    async def initialize(self) -> None:
        """Connect and check that the server has RedisJSON."""
        await self.ships.ready()
        (reply,) = await self.transport.roundtrip([("JSON.TYPE", f"{self.namespace}reem")])
        # Not allowed to use JSON is told at once; that this one key is out of bounds means nothing.
        elsewhere = isinstance(reply, NotAllowed) and "run the" not in str(reply)
        if isinstance(reply, Refused | ClusterReply) and not elsewhere:
            raise turned_down(reply).at(self.options.address)

    async def release(self) -> None:
        """End all subscriptions and close all connections of this event loop; another one may go on."""
        hub, self._hub = self._hub, None
        if hub is not None:
            await hub.close()
        await self.readers.release()

    async def close(self) -> None:
        """End all subscriptions and close all connections."""
        if self._hub is not None:
            await self._hub.close()
        await self.readers.close()
