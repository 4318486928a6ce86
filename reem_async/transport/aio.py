"""The port on an event loop: a shared wire, a second one for large values, and spare ones for WATCH."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import partial
from typing import Any

from ..concurrency.locks import Locks
from ..concurrency.tasks import Tasks
from ..errors import ConnectionLost, InterfaceClosed, NotConnected, ReemError, WrongLoop
from ..plain.translation import finished, shortcut
from ..plan import Command, Reply
from ..plan.sizes import has_large
from . import Guard, Held, Transport, document_of
from .options import Options, server_run_id
from .protocol import error_of
from .state import States
from .text import HeldText, Text
from .wire import BUFFER, Wire, close_all, open_wire

# Connections for WATCH that are kept for the next caller; more at the same time are made and closed again.
_SPARE = 4
_LENT = 32
"""Connections for WATCH that are lent at a time. More callers wait for one: a server has 10,000 for all its clients."""
_PING: Command = ("PING",)
_COURTESIES = 3  # how often a large value waits for calls that are under way: there may always be some
_COMPANY, _PORTION = 0.1, 1 << 17
"""After a small call, for so many seconds, loopback TCP gets so many bytes of a large value at a time.

It would take megabytes at once, and the event loop stands still meanwhile."""


class AsyncTransport(Transport):
    def __init__(self, options: Options) -> None:
        super().__init__(options)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._pid = 0
        self._closed = False
        self._begin()
        self._failed_attempt: tuple[float, NotConnected] | None = None  # the last one for a lent connection, and when
        self.text = Text(options.timeout)
        # Not cancelled by `close`: callers share an attempt to connect, which ends by itself, within its time limit.
        self._tasks = Tasks()
        self.states = States()
        self.at_end: Callable[[], Awaitable[None]] = self.release
        self._farewell: AsyncGenerator[None, None] | None = None

    def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> Awaitable[list[Reply]]:
        large = has_large(commands)
        wire = self._lanes.get(bulk or large)
        # The hot path is one look at what can be wrong; everything else is decided in `_lane`.
        if wire is None or not wire.alive or self._loop is not asyncio.get_running_loop() or self._closed:
            return self._connected(commands, bulk or large)
        if wire.plain:
            return self._as_text(commands, bulk)
        return self.upload(wire, commands) if large else wire.roundtrip(commands)

    async def _connected(self, commands: Sequence[Command], bulk: bool) -> list[Reply]:
        wire = await self._lane(bulk)
        if not wire.alive:  # it was retired before its first call
            wire = await self._lane(bulk)
        if wire.plain:
            return await self._as_text(commands, bulk)
        return await (self.upload(wire, commands) if has_large(commands) else wire.roundtrip(commands))

    async def _as_text(self, commands: Sequence[Command], bulk: bool) -> list[Reply]:
        sent = shortcut(commands, self.text.known)
        if sent is not None:
            return finished(commands, await self._as_it_is(sent, bulk=bulk), self.text.known, error_of)
        return await self.text.roundtrip(self._as_it_is, self, commands, bulk)

    async def _as_it_is(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        large = has_large(commands)
        wire = self._lanes.get(bulk or large)
        if wire is None or not wire.alive:
            wire = await self._lane(bulk or large)
        return await (self.upload(wire, commands) if large else wire.roundtrip(commands))

    async def upload(self, wire: Wire, commands: Sequence[Command]) -> list[Reply]:
        """Send large values. A cancelled caller leaves them on their way, and notes that in `_left`."""
        shared = self._lanes.get(False)
        wire.limit_buffer(_PORTION if shared is not None and shared.idle < _COMPANY else BUFFER)
        # What was begun must be sent to its end: half a command would be read together with the next one.
        arrived: asyncio.Future[list[Reply] | Exception] = wire.begin(commands)
        try:
            outcome = await asyncio.shield(arrived)
        except asyncio.CancelledError:
            if not arrived.done():
                document = document_of(commands)
                self._left.setdefault(document, set()).add(arrived)
                arrived.add_done_callback(lambda done: self._has_arrived(document, done))
            raise
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def _has_arrived(self, document: str, arrived: asyncio.Future[Any]) -> None:
        left = self._left.get(document, set())
        left.discard(arrived)
        if not left:
            self._left.pop(document, None)

    async def _lane(self, bulk: bool) -> Wire:
        """Return the shared wire, connecting if need be. Concurrent callers share one attempt, and its failure."""
        self.check()
        opening = self._opening.get(bulk)
        if opening is None or opening.cancelled():  # cancelled before it began: an event loop ends
            opening = self._opening[bulk] = self._tasks.start(self._open_lane(bulk), "reem connect")
            opening.add_done_callback(lambda done: done.cancelled() or done.exception())  # all may have gone away
        # A cancelled caller does not take the connection from the others.
        return await asyncio.shield(opening)

    async def _open_lane(self, bulk: bool) -> Wire:
        task = asyncio.current_task()
        try:
            wire = self._lanes[bulk] = await self._opened(large=bulk)
            return wire
        finally:
            # Not if all was forgotten meanwhile, and another attempt has begun since.
            if self._opening.get(bulk) is task:
                del self._opening[bulk]

    async def _opened(
        self,
        on_push: Callable[[list[Any]], None] | None = None,
        on_lost: Callable[[Wire, Exception], None] | None = None,
        *,
        large: bool = False,
    ) -> Wire:
        """Return a new connection, unless the interface was closed while it was made."""

        def gone(wire: Wire, reason: Exception) -> None:
            self._open.discard(wire)
            if on_lost is not None:
                self.states.lost(reason)
                on_lost(wire, reason)
            elif not isinstance(reason, InterfaceClosed):
                self._missed(reason)

        nearby, connect = self._options.nearby, partial(open_wire, large=large)
        wire = await (connect(self._options) if nearby is None else nearby.connected(connect))
        # Closed while this was made: the connection has no other owner.
        if self._closed:
            await wire.discard()
            self.check()
        if wire.alive:
            self._open.add(wire)
        wire.on_push, wire.on_lost = on_push, gone
        self.states.opened(self._options.address, server_run_id(wire.introduction))
        return wire

    def _missed(self, reason: Exception) -> None:
        """Find out whether the server is gone when a connection for calls breaks: the next call may be long after.

        Then try to connect, once.
        """
        for other in list(self._open):  # one that does not answer in time breaks as well; the last one tells
            if not other.busy:  # else what it owes already tells, and sooner: the last question would be waited for
                other.send([_PING], lambda _: None)
        if not self._open and self.states.lost(reason):
            self._tasks.start(self._made_anew(), "reem connect")

    async def _made_anew(self) -> None:
        with contextlib.suppress(ReemError, OSError):  # the next call says what is the matter
            await self._lane(False)

    def check(self) -> None:
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")
        loop = asyncio.get_running_loop()
        if self._pid != os.getpid():
            # After a fork the sockets belong to the parent: forget them without closing.
            self._begin()
            self._pid, self._loop = os.getpid(), None
        if self._loop is not loop:
            if self._loop is not None and not self._loop.is_closed():
                raise WrongLoop(
                    "this RedisInterface is in use in another event loop; "
                    "make one interface per loop (or per asyncio.run)"
                )
            self._begin()
            self._loop = loop
            self._farewell = self._end_with_loop()
            with contextlib.suppress(StopIteration):
                # Stepped by hand up to its `yield`: the event loop knows it from then on, and ends it when it shuts
                # down.
                self._farewell.__anext__().__await__().send(None)

    async def _end_with_loop(self) -> AsyncGenerator[None, None]:
        """Close the connections that a program left open before its event loop ends: generators end last there."""
        try:
            yield
        finally:
            self._farewell = None
            if not self._closed:
                await self.at_end()

    def _begin(self) -> None:
        """Begin without connections and locks; those there are belong to another event loop, or are let go of."""
        # Two shared connections: False for small calls, True for large values, which no small call waits behind.
        self._lanes: dict[bool, Wire] = {}
        self._opening: dict[bool, asyncio.Task[Wire]] = {}
        self._spare: list[Wire] = []
        self._kept: set[Wire] = set()  # lent for long
        self._lendable = asyncio.Semaphore(_LENT)
        self._borrowers = 0  # callers that have a lent connection or wait for one
        self._open: set[Wire] = set()
        # Lent connections whose caller was cancelled while something large was on its way; closed once it has arrived.
        self._leaving: set[Wire] = set()
        self._orders = Locks(asyncio.Lock)
        # By document: what cancelled callers have left on its way. A later write to the same document waits for it.
        self._left: dict[str, set[asyncio.Future[Any]]] = {}

    def hold(self, guard: Guard | None = None) -> AbstractAsyncContextManager[Held]:
        """Lend a connection of its own. It is broken if the caller leaves with an error or is cancelled.

        A caller that finds 32 lent waits for one. It must not hold another one. If an attempt to connect fails
        meanwhile, that is its answer too: 1,500 callers would have to wait for 47 time limits of the same server.
        A caller with a guard may keep its connection for long, so it does not count.
        """
        return self._lend() if guard is None else _KeptConnection(self, guard)

    @asynccontextmanager
    async def _lend(self) -> AsyncIterator[Held]:
        self.check()
        lendable, asked = self._lendable, time.monotonic()
        self._borrowers += 1
        try:
            async with lendable, self._one_more(asked) as held:
                yield held
        finally:
            if self._lendable is lendable:
                self._borrowers -= 1

    @asynccontextmanager
    async def _one_more(self, asked: float) -> AsyncIterator[Held]:
        while self._spare and not self._spare[-1].alive:
            self._spare.pop()
        wire = self._spare.pop() if self._spare else await self._opened_to_lend(asked)
        lent = _Lent(self, wire)
        try:
            # It may have watched keys, and is not asked to forget them after an error: it is closed.
            yield HeldText(lent, self.text) if wire.plain else lent
        except BaseException:
            await self.take_broken(lent)
            raise
        is_awaited = self._borrowers > _LENT
        if wire.alive and (is_awaited or len(self._spare) < _SPARE) and not self._closed:
            self._spare.append(wire)
        else:
            await wire.discard()

    async def take_broken(self, lent: _Lent) -> None:
        self._kept.discard(lent.wire)
        if lent.is_uploading:  # its reply tells when what is on its way has arrived
            self._leaving.add(lent.wire)
            self._tasks.start(self._close_idle(lent.wire), "reem close")
        else:
            await lent.wire.discard()

    async def _opened_to_lend(self, asked: float) -> Wire:
        if self._failed_attempt is not None and self._failed_attempt[0] >= asked:
            error = self._failed_attempt[1]
            raise type(error)(*error.args) from error
        try:
            return await self._opened()
        except NotConnected as error:
            self._failed_attempt = time.monotonic(), error
            raise

    async def _close_idle(self, wire: Wire) -> None:
        with contextlib.suppress(ReemError):
            # Answered in order, so behind what is on its way.
            await wire.roundtrip([_PING])
        self._leaving.discard(wire)
        await wire.discard()

    async def pause(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def let_pass(self) -> bool:
        self.check()
        for _ in range(_COURTESIES):
            # Calls that were made in this turn of the loop are sent in the next.
            await asyncio.sleep(0)
            wire = self._lanes.get(False)
            if wire is None or not wire.busy:
                break
            try:
                await wire.roundtrip([_PING])  # answered after all the others
            except ConnectionLost:  # of their connection; the call has another one
                break
        return True

    def is_settled(self, document: str) -> bool:
        if self._left:
            self.check()  # what was left in another event loop, or by the parent process, is none of ours
        return document not in self._left

    async def settle(self, document: str) -> None:
        while left := self._left.get(document):
            await asyncio.wait(left)

    def ordered(self, key: str) -> AbstractAsyncContextManager[Any]:
        if self._loop is not asyncio.get_running_loop() or self._pid != os.getpid():
            self.check()  # a lock of another event loop, or of the parent process, is no lock here
        return self._orders.of(key)

    async def listen(self, on_push: Callable[[list[Any]], None], on_lost: Callable[[Wire, Exception], None]) -> Wire:
        self.check()
        return await self._opened(on_push, on_lost)

    async def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self.states.closed()
        farewell, self._farewell = self._farewell, None
        if self._loop is asyncio.get_running_loop():
            try:
                await self.release()
            finally:
                if farewell is not None:
                    await farewell.aclose()
        self._begin()

    def drop(self, reason: Exception) -> None:
        """Break all connections; new ones are made when needed. Any thread may call."""
        for wire in list(self._open):
            wire.abort_soon(reason)

    async def release(self) -> None:
        wires = [*self._lanes.values(), *self._spare, *self._leaving, *self._kept]
        self._begin()
        await close_all(wires)


class _Lent:
    def __init__(self, transport: AsyncTransport, wire: Wire) -> None:
        self._transport = transport
        self.wire = wire
        self.is_uploading = False  # something large was sent, and whether it has arrived is not known

    def fresh(self) -> bool:
        return self.wire.alive

    def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> Awaitable[list[Reply]]:
        return self._upload(commands) if has_large(commands) else self.wire.roundtrip(commands)

    async def _upload(self, commands: Sequence[Command]) -> list[Reply]:
        self.is_uploading = True
        replies = await self._transport.upload(self.wire, commands)
        self.is_uploading = False
        return replies


class _KeptConnection:
    """Lends a connection behind a guard for long.

    No generator: an event loop that ends would close it together with those that hold it, in any order.
    """

    def __init__(self, transport: AsyncTransport, guard: Guard) -> None:
        self._transport = transport
        self._guard = guard
        self._lent: _Lent | None = None

    async def __aenter__(self) -> Held:
        self._transport.check()
        wire = await self._transport._opened()
        self._transport._kept.add(wire)
        self._lent = _Lent(self._transport, wire)
        held = self._guard(self._lent)
        return HeldText(held, self._transport.text) if wire.plain else held

    async def __aexit__(self, *_: object) -> None:
        if self._lent is not None:
            await self._transport.take_broken(self._lent)
