"""The port for what is only read: to replicas, and to the primary for what they cannot tell.

A read is harmless to repeat. So a replica that is gone, or has not got what is asked for, costs no
more than a second question, to the primary; and what is not there by a read's word is not there by
the primary's. That settles besides what replicas are not asked about: a key whose slot is moving has
left the replicas of its old node before those of the new one are known to have it.
"""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractAsyncContextManager, suppress
from typing import Any, Protocol

import redis.exceptions

from ..concurrency.timeouts import timeout
from ..errors import ConnectionLost, NotAllowed, NotConnected, ServerNotReady
from ..plan import Command, Reply
from . import Held, Transport
from .addresses import NewTransport
from .options import Address, NodeOptions, Options, connecting_by, question, question_here
from .redirects import Ask, Moved, refusal, slot_of
from .rooted import Standing

__all__ = ["Readers", "ReplicaOptions", "Replicated"]

logger = logging.getLogger("reem.connection")

_REST = 5.0
"""Seconds for which a replica that failed is left alone, and between questions for others if there is none."""
_READONLY: Command = ("READONLY",)
_STANDING: Command = ("INFO", "replication")
_NOTHING: tuple[Reply, ...] = (None, b"[]", [], [None], [[]])
"""How JSON.GET and JSON.TYPE say that there is nothing."""


class Replicated(Transport, Protocol):
    """The way to primaries that have replicas."""

    async def replicas(
        self, slot: int | None, *, anew: bool = False, suspects: Collection[Address] = ()
    ) -> Sequence[Address]:
        """Return where the replicas are that have `slot`; `anew` to ask for them, rather not the `suspects`."""
        ...


class ReplicaOptions(NodeOptions):
    """How to reach one replica; a connection is one only if it is a replica, and in touch with its primary.

    Args:
        of: How to reach the servers.
        address: Where it is.
        sharded: It is a node of a cluster.
    """

    def __init__(self, of: Options, address: Address, *, sharded: bool) -> None:
        self._questions = (_READONLY, _STANDING) if sharded else (_STANDING,)
        super().__init__(of, address)

    def asynchronous_connection(self) -> Any:
        """Return a fresh connection that asks for the replica's standing when it connects."""
        return connecting_by(super().asynchronous_connection(), self._connect_asynchronously)

    def blocking_connection(self) -> Any:
        """Return a fresh connection that asks for the replica's standing when it connects."""
        return connecting_by(super().blocking_connection(), self._connect)

    def refused(self, error: Exception) -> Exception:
        """Return the error to raise; one about rights says which it takes to read from replicas."""
        told = super().refused(error)
        if not isinstance(told, NotAllowed):
            return told
        return NotAllowed(f"{told}; to read from replicas a user of a cluster needs +readonly, see docs/fleet.md")

    async def _connect_asynchronously(self, connection: Any, connect: Callable[..., Any]) -> None:
        await connect()
        await question(connection, self._questions, _check_standing)

    def _connect(self, connection: Any, connect: Callable[..., Any]) -> None:
        connect()
        question_here(connection, self._questions, _check_standing)


def _check_standing(said: Any, connection: Any) -> None:
    words = (said.decode(errors="replace") if isinstance(said, bytes) else str(said)).split()
    # A replica without its primary answers for as long as it lives, with data that get older and older.
    if "role:slave" not in words or "master_link_status:up" not in words:
        where = f"{connection.host}:{connection.port}"
        raise redis.exceptions.ConnectionError(f"{where} is no replica, or not in touch with its primary")


class Readers(Standing):
    """Sends what only reads to replicas. It keeps to one replica of each primary as long as that one answers.

    Args:
        primaries: The way to the primaries.
        options: How to reach the servers.
        new_transport: Makes the transport to one of them.

    Attributes:
        sharded: It is a cluster.
    """

    def __init__(self, primaries: Replicated, options: Options, new_transport: NewTransport) -> None:
        self._root = self._primaries = primaries
        self._options = options
        self._new_transport = new_transport
        self.sharded = primaries.sharded
        self._ways: dict[Address, Transport] = {}
        # By slot, None where there is one primary: reads that follow each other see one replica, and so never go back
        # in time.
        self._chosen: dict[int | None, Address] = {}
        self._ranks: dict[Address, float] = {}
        # When a replica failed last, on the monotonic clock.
        self._left: dict[Address, float] = {}
        self._asked = -_REST

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        """Send `commands`, which only read, to a replica, and to the primary if that does not answer them.

        The replica has half of the call's time limit, and the primary what is left of it.
        """
        slot = slot_of(commands) if self.sharded else None
        address = self._chosen.get(slot) or await self._choice(slot)
        if address is None:
            return await self._root.roundtrip(commands, bulk=bulk)
        limit, began = self.timeout, time.monotonic()
        try:
            with timeout(limit / 2):
                replies = await self._ways[address].roundtrip(commands, bulk=bulk)
        except (NotConnected, ConnectionLost, ServerNotReady) as error:
            self._leave(address, error)
        else:
            problem = refusal(replies)
            if problem is None and _tells(commands, replies):
                return replies
            if problem is not None:
                await self._refused(slot, address, problem)
        with timeout(max(began + limit - time.monotonic(), limit / 2)):
            return await self._root.roundtrip(commands, bulk=bulk)

    async def _choice(self, slot: int | None) -> Address | None:
        """Choose the replica to read a slot from; None if there is none at the moment."""
        self._root.check()
        with suppress(NotConnected):  # the primaries' way tries longer, and says what is the matter
            address = self._fit(await self._primaries.replicas(slot))
            if address is None and time.monotonic() - self._asked >= _REST:
                self._asked = time.monotonic()
                address = self._fit(await self._primaries.replicas(slot, anew=True, suspects=self._left))
            if address is not None:
                self._root.check()  # it may have been closed meanwhile
                if address not in self._ways:
                    options = ReplicaOptions(self._options, address, sharded=self.sharded)
                    self._ways.setdefault(address, self._new_transport(options))
                self._chosen[slot] = address
            return address
        return None

    def _fit(self, addresses: Sequence[Address]) -> Address | None:
        """Return the replica to use: for all slots of a primary the same, but another one in another interface."""
        now = time.monotonic()
        fit = [each for each in addresses if now - self._left.get(each, -_REST) >= _REST]
        return min(fit, key=lambda each: (self._left.get(each, 0.0), self._rank(each)), default=None)

    def _rank(self, address: Address) -> float:
        return self._ranks.setdefault(address, random.random())  # noqa: S311

    def _leave(self, address: Address, reason: Exception) -> None:
        """Choose another replica from now on."""
        logger.info("the replica at %s:%s is not read from for %g s: %s", *address, _REST, reason)
        self._left[address] = time.monotonic()
        self._chosen = {slot: each for slot, each in list(self._chosen.items()) if each != address}

    async def _refused(self, slot: int | None, address: Address, problem: Exception) -> None:
        if isinstance(problem, Moved):  # of this slot; it may have others
            self._chosen.pop(slot, None)
            with suppress(NotConnected):
                await self._primaries.replicas(slot, anew=True, suspects=self._left)
        elif not isinstance(problem, Ask | redis.exceptions.TryAgainError):  # these mean this key, at this moment
            self._leave(address, problem)

    # What does not only read is the primaries'.

    def hold(self) -> AbstractAsyncContextManager[Held]:
        """Return a connection of the caller's own to a primary."""
        return self._root.hold()

    async def owner(self, key: bytes, *, anew: bool = False) -> Transport:
        """Return the way to the primary that has `key`."""
        return await self._root.owner(key, anew=anew)

    async def nodes(self) -> Sequence[Transport]:
        """Return the ways to the primaries."""
        return await self._root.nodes()

    def _all(self) -> list[Transport]:
        return [*self._ways.values(), self._root]


def _tells(commands: Sequence[Command], replies: Sequence[Reply]) -> bool:
    """Return whether a replica took the commands, and has the document, and the place in it, that they ask for."""
    if any(isinstance(each, redis.exceptions.ReadOnlyError) for each in replies):  # a ship that changes what it reads
        return False
    found = replies[-1] if commands[-1][0] == "EXEC" else replies
    return not isinstance(found, list) or not found or found[0] not in _NOTHING
