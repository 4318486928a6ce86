"""Ownership of a top-level key: one program at a time may write to it, and its lease shows that it is alive.

The server has a lease, a key with an expiry, and each write of the owner renews it in its own transaction. WATCH and
GET of the lease are sent behind each such transaction, ahead of the next one. So a write is one round trip, and the
server does not execute it if the lease was changed, or has expired, since the write before:

    MULTI; JSON.SET foo ...; SET {foo}:lease ... PX ttl; PUBLISH ...; EXEC; WATCH {foo}:lease; GET {foo}:lease

This needs a connection of the owner's own. On a new one, WATCH and GET are sent ahead of the first write. In a cluster
each write takes a connection to the node that has the key, and WATCH and GET ahead of it: two round trips, as for all
that is published there.
"""

from __future__ import annotations

import os
import secrets
import socket
import sys
import time
from collections.abc import AsyncIterator, Coroutine, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from typing import Any

from ..errors import ConnectionLost, LeaseLost, Misuse, NotConnected, RedisError, ReemError
from ..plan import Command, Plan, Reply
from ..plan.keys import Keys
from ..plan.leases import Claim, HeldLease, acquisition, check_name, check_ttl, claimed, permitted
from ..plan.replies import checked
from ..session import PublisherIdentity, Session
from ..store.publish import DocumentPublisher, PublishTurn
from ..transport import Contention, Held, give_back
from ..transport.route import keys_in
from ..transport.state import States


class Lease:
    """The ownership of one top-level key, as one program has it or not. Nothing is sent before `acquire`."""

    def __init__(self, session: Session, keys: Keys, ttl: Any, name: Any, take: bool) -> None:
        self._milliseconds = check_ttl(ttl)
        name = check_name(_program() if name is None else name)
        self._claim = Claim(0, name, socket.gethostname()[:255], os.getpid(), 0.0, "")
        self._take = take
        self._session = session
        self.keys = keys
        self.held: HeldLease | None = None
        self._pid = 0  # the process that acquired it
        self._renewed = 0.0  # when the server answered the last renewal, by this process's clock
        self._lost = "the lease was not acquired yet"
        self.connection = LeaseConnection(self, session)
        session.activities.leases.add(self)

    @property
    def lost(self) -> bool:
        """Whether the next write raises LeaseLost, as far as is known without asking the server."""
        return bool(self._reason())

    @property
    def is_held(self) -> bool:
        """Whether the program owns the key, as far as is known. Another thread may ask, so nothing is noted."""
        is_own = self._pid == os.getpid()
        return is_own and not self._lost and time.monotonic() - self._renewed <= self._milliseconds / 1000

    def _reason(self) -> str:
        if not self._lost and time.monotonic() - self._renewed > self._milliseconds / 1000:
            self._lost = f"the lease was not renewed for over {self._milliseconds / 1000:g} s, and has expired"
        return self._lost

    def check(self) -> HeldLease:
        """Return the lease if it may still be there; raises LeaseLost or Misuse."""
        self.check_process()
        if reason := self._reason():
            raise LeaseLost(
                f"{self.keys.name} is not owned by this program, so nothing was written: {reason}; to go on, "
                "acquire it again"
            )
        assert self.held is not None
        return self.held

    def check_process(self) -> None:
        if self._pid not in (0, os.getpid()):
            raise Misuse(
                f"{self.keys.name}: this lease belongs to the parent process, which goes on to own the key; a forked "
                "child acquires its own: kvs[...].own(...)"
            )

    def judge(self, found: Reply) -> bool:
        """Note what the server has in place of the lease; return whether it is this one."""
        if self.held is not None and found == self.held.text:
            return True
        if found is None:
            self._lost = f"the lease has expired ({self._milliseconds / 1000:g} s), or the server has lost its data"
        else:
            self._lost = f"{claimed(found)} has taken it over"
        return False

    def renewed(self) -> None:
        self._renewed = time.monotonic()

    async def acquire(self) -> None:
        self.check_process()
        claim = self._claim._replace(process=os.getpid(), token=secrets.token_hex(8))
        plan = acquisition(self.keys, claim, self._milliseconds, take=self._take)
        async with self._session.transport.ordered(self.keys.channel):
            await self.connection.leave(LeaseLost("acquired again"))  # it watches the lease that was
            self.held = await self._session.run(plan)
            self._pid, self._lost = os.getpid(), ""
            self.renewed()
            await self.connection.open()

    async def renew(self) -> None:
        async with self._session.transport.ordered(self.keys.channel):
            await self.confirm()

    async def confirm(self) -> None:
        """Do what `renew` does, for a caller that has the turn of the key."""
        await self.run(Plan([self.check().renewal], self._done, atomic=True))

    def _done(self, replies: Sequence[Reply]) -> None:
        checked(replies[0], self.keys, ())

    async def release(self) -> None:
        """Give the lease back, if it is still there; else, and without a connection, do nothing: it expires."""
        if self._pid != os.getpid():
            return
        async with self._session.transport.ordered(self.keys.channel):
            try:
                if not self.lost:
                    with suppress(ReemError, RedisError):
                        await self.run(Plan([self.check().removal], self._done, atomic=True))
            finally:
                self._lost = self._lost or "the lease was released"
                await self.connection.leave(LeaseLost("released"))

    def run(self, plan: Plan) -> Coroutine[Any, Any, Any]:
        return self._session.run(plan, self.connection)  # type: ignore[arg-type]  # as much of a transport as plans need


def _program() -> str:
    name = os.path.basename(sys.argv[0] if sys.argv else "")[:64]
    return name if name and name.isprintable() else "python"


class LeaseConnection:
    """The owner's connection: it reconnects, and is then used only if the server still has the lease."""

    def __init__(self, lease: Lease, session: Session) -> None:
        self._lease = lease
        self._transport = session.transport
        self.pause, self.sharded = session.transport.pause, session.transport.sharded
        self._exit: AsyncExitStack | None = None
        self._held: Any = None
        self._guard: LeaseGuard | None = None

    @property
    def timeout(self) -> float:
        return self._transport.timeout

    @property
    def states(self) -> States:
        return self._transport.states

    async def open(self) -> None:
        """Connect ahead of the first write; in a cluster a connection is taken for each write."""
        if not self.sharded:
            async with self.hold():
                assert self._guard is not None
                await self._guard.arm(())

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        """Send `commands`; a transaction that was not executed, though the lease is there, is sent again.

        Another program wrote to the same top-level key in between, or a write of this owner arrived late over a
        connection that it had before.
        """
        contention: Contention | None = None
        while True:
            async with self.hold() as held:
                replies = await held.roundtrip(commands, bulk=bulk)
            if replies[-1] is not None or commands[-1][0] != "EXEC":
                return replies
            contention = contention or Contention(self.timeout)
            contention.given_up(commands)

    @asynccontextmanager
    async def hold(self) -> AsyncIterator[Held]:
        """Lend the connection; it is closed if the caller leaves with an error or is cancelled.

        What is still on its way over it is then executed before the next write or not at all: WATCH sees to that.
        """
        held = await self._opened()
        try:
            yield held
        except BaseException as error:
            await self.leave(error)
            raise
        if self.sharded:
            await self.leave()

    async def _opened(self) -> Any:
        self._lease.check_process()
        if self._guard is not None:
            if self._guard.fresh():
                return self._held
            await self.leave(ConnectionLost("the owner's connection broke"))
        async with AsyncExitStack() as stack:
            self._held = await stack.enter_async_context(self._transport.hold(self._guarded))
            self._exit = stack.pop_all()
        return self._held

    def _guarded(self, connection: Any) -> Held:
        self._guard = LeaseGuard(self._lease, connection, self.sharded)
        return self._guard

    async def leave(self, error: BaseException | None = None) -> None:
        leaving, self._exit, self._held, self._guard = self._exit, None, None, None
        await give_back(leaving, error)


class LeaseGuard:
    """One connection. What is sent over it with a renewal of the lease is executed only if the lease is still there."""

    def __init__(self, lease: Lease, held: Any, sharded: bool) -> None:
        self._lease = lease
        self._held = held
        self._sharded = sharded
        self._is_armed = False  # the lease is watched, and was there after that
        self._is_sound = True

    def fresh(self) -> bool:
        return self._is_sound and bool(self._held.fresh())

    async def arm(self, commands: Sequence[Command]) -> None:
        """Watch the lease ahead of a transaction of `commands`; raises LeaseLost if it is not there.

        In a cluster, with all keys of the transaction: see `transport.route`.
        """
        lease = self._lease.check()
        watch = lease.watch
        if self._sharded:
            watch = ("WATCH", *dict.fromkeys([self._lease.keys.document.encode(), *keys_in(commands)]))
        try:
            replies = await self._held.roundtrip([watch, lease.look])
        except ConnectionLost as error:
            raise NotConnected(f"{error}; nothing was sent but a look at the lease, so nothing was applied") from error
        self._look(replies[0], replies[1])
        self._lease.check()

    def _look(self, watching: Reply, found: Reply) -> None:
        lease = self._lease.check()
        for reply, command in ((watching, lease.watch), (found, lease.look)):
            permitted(self._lease.keys, reply, command)
        self._is_armed = self._lease.judge(found)

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        lease = self._lease.held
        assert lease is not None
        last = commands[-1][0]
        if last == "EXEC" and (lease.renewal in commands or lease.removal in commands):
            self._lease.check()
            if not self._is_armed:
                await self.arm(commands)
            replies = await self._sent(commands, lease, bulk)
            if type(replies[-1]) is list:
                self._lease.renewed()
            # Not executed: the server has said what it has in place of the lease.
            elif replies[-1] is None and not self._sharded:
                self._lease.check()
            return replies
        # A look of a plan that watches more: the lease is watched with it.
        if commands[0][0] == "WATCH" and not self._is_armed and not self._lease.lost:
            watch = (*commands[0], lease.watch[1])
            seen: list[Reply] = await self._held.roundtrip([watch, *commands[1:], lease.look], bulk=bulk)
            self._look(seen[0], seen.pop())
            return seen
        if last == "EXEC" or commands[0][0] == "UNWATCH":
            return await self._sent(commands, lease, bulk)
        return list(await self._held.roundtrip(commands, bulk=bulk))

    async def _sent(self, commands: Sequence[Command], lease: HeldLease, bulk: bool) -> list[Reply]:
        """Send what ends all watching; on one server, the lease is watched again behind it."""
        self._is_armed = False
        if self._sharded:
            return list(await self._held.roundtrip(commands, bulk=bulk))
        replies: list[Reply] = await self._held.roundtrip([*commands, lease.watch, lease.look], bulk=bulk)
        found, watching = replies.pop(), replies.pop()
        if isinstance(found, Exception) or isinstance(watching, Exception):
            self._is_sound = False  # what is watched is not known: a new connection is made
        else:
            self._is_armed = self._lease.judge(found)
        return replies


class OwnedPublisher(DocumentPublisher):
    def __init__(self, lease: Lease, session: Session) -> None:
        super().__init__(session, lease.keys.name)
        self.lease = lease
        self._run = lease.run  # over the owner's connection

    def turn(self, identity: PublisherIdentity | None = None) -> PublishTurn:
        return PublishTurn(self.session, self.keys, identity, self.lease.check)

    async def _expire(self, turn: Any, milliseconds: int | None) -> None:
        await self.lease.confirm()
        await super()._expire(turn, milliseconds)
