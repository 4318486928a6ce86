"""The only place that talks to a server.

`Transport` is the narrow port: commands out, one reply per command back. `AsyncTransport` serves an
event loop, `BlockingTransport` a plain thread; both are handed the same plans by `drive`.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from typing import Any, NamedTuple, Protocol

from ..concurrency.timeouts import time_limit
from ..errors import SELF_EXPLANATORY, BadData, Contended, LeaseLost, NotConnected, ReemError, Refused, WrongKind
from ..plain.documents import is_document
from ..plan import Command, Plan, Reply, wire_commands
from ..plan.keys import count, first_page, page
from ..plan.replies import decoded
from .options import Options
from .state import States

_UNWATCH: Command = ("UNWATCH",)
_UNAPPLIED = (Contended, LeaseLost, NotConnected, Refused)  # errors of a plan that the server did nothing for


class Held(Protocol):
    """One connection for one caller: what WATCH needs."""

    def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> Awaitable[list[Reply]]:
        """Send `commands` in one go and return their replies; error replies are returned, not raised."""


async def give_back(lent: AbstractAsyncContextManager[Any] | None, error: BaseException | None = None) -> None:
    """Leave what lends a connection, if there is one; after an error the connection is closed."""
    if lent is not None:
        try:
            await lent.__aexit__(type(error) if error else None, error, None)
        except BaseException as again:
            if again is not error:
                raise


Guard = Callable[[Any], Held]
"""Wraps a connection before anything is sent over it. Except in a cluster, that has `fresh()`: whether it still stands
and leads to the right server, as far as one can see."""


class Transport(ABC):
    """A server, as far as plans can see it. What is not abstract is that of one server and of plain threads.

    Attributes:
        states: What the interface's user gets to know of the connections.
        sharded: It is a cluster: every key, and the notices about it, have a node.
        at_end: What ends subscriptions and connections when the event loop in use ends; unused where there is none.
    """

    states: States
    at_end: Callable[[], Awaitable[None]]
    sharded = False

    def __init__(self, options: Options) -> None:
        self._options = options

    @abstractmethod
    def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> Awaitable[list[Reply]]:
        """As `Held.roundtrip`."""

    @abstractmethod
    def hold(self, guard: Guard | None = None) -> AbstractAsyncContextManager[Held]:
        """Return a connection of the caller's own, given back on exit; with a guard, it may be kept for long."""

    @property
    def options(self) -> Options:
        """How the server is reached; in a cluster, one of its nodes."""
        return self._options

    @property
    def timeout(self) -> float:
        """Seconds without a byte moving after which a call made now is given up."""
        return time_limit(self.options.timeout)

    async def owner(self, key: bytes, *, refresh: bool = False) -> Transport:
        """Return the way to the server that has `key`; `refresh` if it was not where it was thought to be."""
        return self

    async def nodes(self) -> Sequence[Transport]:
        """Return the ways to the servers that have all keys together."""
        return (self,)

    @abstractmethod
    async def pause(self, seconds: float) -> None:
        """Wait."""

    async def let_pass(self) -> bool:
        """Wait, before something large is sent, until small calls of the same thread that are under way are answered.

        Returns whether anything else could happen meanwhile.
        """
        return False

    def is_settled(self, document: str) -> bool:
        """Return whether nothing large, sent by callers that were cancelled since, is on its way to `document`."""
        return True

    async def settle(self, document: str) -> None:  # noqa: B027 - only where something may be on its way
        """Wait until it has arrived: it must not come after what is written next."""

    @abstractmethod
    def ordered(self, key: str) -> AbstractAsyncContextManager[None]:
        """Return a lock: what is sent inside arrives in the order of entering, per `key`."""

    def broken_off(self) -> None:  # noqa: B027 - in an event loop calls are cancelled, which gives all back
        """Give back what a call of this thread holds that was broken off between two steps, by Ctrl-C for example."""

    @abstractmethod
    def check(self) -> None:
        """Raise if this cannot be used here: closed, or bound to another event loop."""

    @abstractmethod
    async def release(self) -> None:
        """Close the connections that are not in use; new ones are made when needed."""

    @abstractmethod
    async def close(self) -> None:
        """Close all connections. Idempotent."""


NewTransport = Callable[[Options], Any]
"""Makes the transport to one server: on an event loop, or for plain threads."""


class CompositeTransport(Transport):
    """A transport over others, one of which, the root, is there from beginning to end."""

    _root: Transport

    @abstractmethod
    def _all(self) -> Iterable[Transport]:
        """Return the transports there are, the root among them."""

    @property
    def options(self) -> Options:
        return self._root.options

    async def pause(self, seconds: float) -> None:
        await self._root.pause(seconds)

    def is_settled(self, document: str) -> bool:
        # A key may have moved since: what was sent to any node counts.
        return all(each.is_settled(document) for each in self._all())

    async def settle(self, document: str) -> None:
        for each in list(self._all()):
            await each.settle(document)

    def ordered(self, key: str) -> AbstractAsyncContextManager[None]:
        return self._root.ordered(key)

    def broken_off(self) -> None:
        self._root.broken_off()

    def check(self) -> None:
        self._root.check()

    @property
    def at_end(self) -> Callable[[], Awaitable[None]]:
        return self._root.at_end

    @at_end.setter
    def at_end(self, action: Callable[[], Awaitable[None]]) -> None:
        self._root.at_end = action

    async def release(self) -> None:
        async with AsyncExitStack() as steps:  # the last comes first, and each is taken, also if one is cancelled
            for each in reversed(list(self._all())):
                steps.push_async_callback(each.release)

    async def close(self) -> None:
        async with AsyncExitStack() as steps:  # as above
            for each in reversed(list(self._all())):
                steps.push_async_callback(each.close)


class Contention:
    """The attempts of one call that were given up, since others wrote to its key; it goes on for `limit` seconds."""

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._deadline = 0.0

    def given_up(self, commands: Sequence[Command]) -> None:
        """Note that an attempt to apply `commands` was given up; raises Contended after the limit from the first on.

        So there are two attempts at least, however long they take.
        """
        now = time.monotonic()
        if not self._deadline:
            self._deadline = now + self._limit
        elif now > self._deadline:
            raise Contended(
                f"{document_of(commands)}: others kept writing to this top-level key for {self._limit:g} s, each time "
                "between a look at it and the change; nothing was applied: write to it less often, give what is "
                "written often a top-level key of its own, or raise the timeout: "
                "timeout=, or ?socket_timeout=SECONDS in the URL"
            )

    def waited(self, seconds: float) -> None:
        """Leave out of the time for which it is tried again what it has waited for calls of its own interface."""
        self._deadline += seconds if self._deadline else 0.0

    def over(self) -> None:
        """Note that it was applied: what follows from it has a time of its own."""
        self._deadline = 0.0


def document_of(commands: Sequence[Command]) -> str:
    """Return the name on the server of the document that commands are about: all their keys carry it."""
    key = next(command for command in commands if len(command) > 1)[1]
    name: str = key.decode(errors="replace") if isinstance(key, bytes) else str(key)
    return name[1 : name.index("}")] if name.startswith("{") else name


async def drive(transport: Transport, plan: Plan) -> Any:
    """Run `plan` and what follows from it; return the result. Raises Contended, see `Contention`.

    Suspends only where `transport` does: over a blocking transport it runs through at the first step.
    """
    contention: Contention | None = None
    while True:
        try:
            # Everything up to the last held plan goes over one connection: WATCH lives on it. The lock on the
            # connection is given back before an error is raised, since it is no fault of the connection.
            if plan.held:
                contention = contention or Contention(transport.timeout)
                async with transport.hold() as held:
                    outcome = await _drive_held(held, plan, contention)
                if isinstance(outcome, _Raised):
                    raise outcome.error
            else:
                replies = await transport.roundtrip(wire_commands(plan), bulk=plan.bulk)
                outcome = decoded(plan, replies)
        except WrongKind as error:
            raise await _named(transport, error) from None
        except _UNAPPLIED as error:
            if await transport.states.startup.allows(transport, error):
                continue
            told = _told(plan, error)
            # These errors say all there is to know; our own frames and those of redis-py would only stand before them.
            raise told.with_traceback(None) from (None if told is error else error)
        except SELF_EXPLANATORY as error:
            raise error.with_traceback(None) from None
        # Results are values of users, or of REEM, and never plans.
        if type(outcome) is not Plan:
            return outcome
        plan = outcome


def _told(plan: Plan, error: Exception) -> Exception:
    """Return what to raise for an error that means that `plan` was not applied: others before it may have been."""
    return error if plan.unfinished is None else plan.unfinished(error)


async def _named(transport: Transport, error: WrongKind) -> WrongKind:
    (kind,) = await transport.roundtrip([("TYPE", error.key)])
    text = False
    if kind == b"string":  # of another program, or a document as servers without JSON keep it
        (begins,) = await transport.roundtrip([("GETRANGE", error.key, "0", "0")])
        text = isinstance(begins, bytes) and is_document(begins)
    return WrongKind(error.key, error.where, kind.decode() if isinstance(kind, bytes) else "?", text=text)


class _Raised(NamedTuple):
    """What a decode raised: no fault of the connection, which can be lent again."""

    error: Exception


async def _drive_held(held: Held, plan: Plan, contention: Contention) -> Any:
    outcome: Any = plan
    while type(outcome) is Plan and outcome.held:
        try:
            replies = await held.roundtrip(wire_commands(outcome))
        except (Contended, LeaseLost, NotConnected) as error:
            raise _told(outcome, error) from error
        sent = outcome
        try:
            outcome = decoded(sent, replies)
            if sent.atomic and replies[-1] is not None:
                contention.over()
            # Given up, and to be tried again: in which way, the plan knows. (Where the reason is that a slot moves, the
            # connection across the cluster has a limit of its own.)
            elif sent.atomic and type(outcome) is Plan and not isinstance(replies[0], Exception):
                contention.given_up(sent.commands)
        # The replies are not the protocol's: the connection is not to be used again, so it leaves with the error.
        except BadData:
            raise
        except ReemError as error:
            # The next borrower's transaction must not fail over keys that this one has watched.
            await held.roundtrip([_UNWATCH])
            return _Raised(_told(sent, error) if isinstance(error, _UNAPPLIED) else error)
    return outcome


async def scanned(transport: Transport, glob: str = "", kind: str = "") -> AsyncIterator[list[bytes]]:
    """Yield the names of all keys, about 1000 at a time; one round trip for each 1000, and a node at least one.

    A key that is there from the beginning to the end is among them, unless it moves from node to node
    meanwhile. Others may or may not be, and any may be twice. See `plan.keys.page` for `glob` and `kind`.

    Raises:
        ClusterNode: It is the way to one node of several.
        NotConnected: A part of the keys cannot be reached.
    """
    for node in await transport.nodes():
        plan = page(glob, kind) if transport.sharded else first_page(glob, kind)
        while True:
            cursor, names = await drive(node, plan)
            yield names
            # A cursor of 0 is the end; a page may be empty before that.
            if cursor in (b"0", 0):
                break
            plan = page(glob, kind, cursor)


async def counted(transport: Transport, database: int) -> int | None:
    """Return how many keys the servers count in a database; None if this user may not ask. A round trip for each."""
    total = 0
    for node in await transport.nodes():
        held: Any = await drive(node, count(database))
        if held is None:
            return None
        total += held
    return total
