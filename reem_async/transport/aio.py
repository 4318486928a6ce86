"""The port on an event loop: a shared wire, a second one for large values, and spare ones for WATCH."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

import anyio

from ..background import in_background
from ..errors import InterfaceClosed, WrongLoop
from ..plan import Command, Reply
from ..state import States
from .identity import WHO, who
from .options import Options
from .packing import has_large
from .patience import patience
from .wire import Wire, open_wire

__all__ = ["AsyncTransport"]

_SPARE = 4


class AsyncTransport:
    """Connections of one interface in one event loop, made when first needed.

    Attributes:
        sharded: One server has all keys.
        states: What the interface's user gets to know of the connections.
        at_end: What closes all connections of an event loop; called if it ends before that was done.
    """

    sharded = False

    def __init__(self, options: Options) -> None:
        self._options = options
        self._loop: asyncio.AbstractEventLoop | None = None
        self._pid = 0
        self._closed = False
        self._lanes: dict[bool, Wire] = {}
        self._opening: dict[bool, asyncio.Task[Wire]] = {}
        self._spare: list[Wire] = []
        self._orders: dict[str, anyio.Lock] = {}
        self._left: dict[str, set[asyncio.Task[Any]]] = {}
        self.states = States()
        self.at_end: Callable[[], Awaitable[None]] = self.release
        self._farewell: AsyncGenerator[None, None] | None = None

    def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> Awaitable[list[Reply]]:
        """Send `commands` on the shared wire, or on the one for large values; awaited, it is the replies."""
        bulk = bulk or has_large(commands)
        wire = self._lanes.get(bulk)
        if wire is None or not wire.alive or self._loop is not asyncio.get_running_loop() or self._closed:
            return self._connected(commands, bulk)
        return wire.roundtrip(commands)

    async def _connected(self, commands: Sequence[Command], bulk: bool) -> list[Reply]:
        wire = await self._lane(bulk)
        return await wire.roundtrip(commands)

    async def _lane(self, bulk: bool) -> Wire:
        """Return the shared wire, connecting if need be: once for all who ask meanwhile, who share its failure too."""
        self.check()
        opening = self._opening.get(bulk)
        if opening is None:
            opening = self._opening[bulk] = in_background(self._open_lane(bulk), "reem connect")
            opening.add_done_callback(lambda done: done.cancelled() or done.exception())  # all may have gone away
        return await asyncio.shield(opening)

    async def _open_lane(self, bulk: bool) -> Wire:
        try:
            wire = self._lanes[bulk] = await self._opened(large=bulk)
            return wire
        finally:
            if self._opening.get(bulk) is asyncio.current_task():
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
            self.states.lost(reason)
            if on_lost is not None:
                on_lost(wire, reason)

        wire = await open_wire(self._options, on_push, gone, large=large)
        if self._closed:
            await wire.close()
            self.check()
        wire.send([WHO], lambda replies: self.states.opened(self._options.address, who(replies)))
        return wire

    def check(self) -> None:
        """Bind to the running loop at first use; raise if this is another one, or if it is closed."""
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")
        loop = asyncio.get_running_loop()
        if self._pid != os.getpid():
            # After a fork the sockets belong to the parent: forget them without closing.
            self._forget()
            self._pid, self._loop = os.getpid(), None
        if self._loop is not loop:
            if self._loop is not None and not self._loop.is_closed():
                raise WrongLoop(
                    "this RedisInterface is in use in another event loop; "
                    "make one interface per loop (or per asyncio.run)"
                )
            self._forget()
            self._loop = loop
            self._farewell = self._end_with_loop()
            with contextlib.suppress(StopIteration):
                self._farewell.__anext__().__await__().send(None)

    async def _end_with_loop(self) -> AsyncGenerator[None, None]:
        """Close the connections that a program left open before its event loop ends: generators end last there."""
        try:
            yield
        finally:
            self._farewell = None
            if not self._closed:
                await self.at_end()

    def _forget(self) -> None:
        self._lanes.clear()
        self._opening.clear()
        self._spare.clear()
        self._orders.clear()
        self._left.clear()

    @asynccontextmanager
    async def hold(self) -> AsyncIterator[Wire]:
        """Lend a connection of its own. It is broken if the caller leaves with an error or is cancelled."""
        self.check()
        while self._spare and not self._spare[-1].alive:
            self._spare.pop()
        wire = self._spare.pop() if self._spare else await self._opened()
        try:
            yield wire
        except BaseException:
            await wire.close()
            raise
        if wire.alive and len(self._spare) < _SPARE and not self._closed:
            self._spare.append(wire)
        else:
            await wire.close()

    @property
    def timeout(self) -> float:
        """Seconds without a byte moving after which a call made now is given up."""
        return patience(self._options.timeout)

    async def owner(self, key: bytes, *, anew: bool = False) -> AsyncTransport:
        """Return this: there is one server."""
        return self

    async def nodes(self) -> Sequence[AsyncTransport]:
        """Return this alone."""
        return (self,)

    async def pause(self, seconds: float) -> None:
        """Wait."""
        await asyncio.sleep(seconds)

    async def whole(self, key: str, call: Coroutine[Any, Any, Any]) -> Any:
        """Run `call` to its end even if the caller is cancelled: what comes after it must not overtake it.

        A large value goes over another connection than a small one.
        """
        task = asyncio.get_running_loop().create_task(call)
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            left = self._left.setdefault(key, set())
            left.add(task)
            task.add_done_callback(lambda done: self._end_of_left(key, done))
            raise

    def _end_of_left(self, key: str, done: asyncio.Task[Any]) -> None:
        if not done.cancelled():
            done.exception()  # nobody is left to hear of it
        left = self._left.get(key, set())
        left.discard(done)
        if not left:
            self._left.pop(key, None)

    def is_settled(self, key: str) -> bool:
        """Return whether cancelled callers have left nothing to run that writes to `key`."""
        return key not in self._left

    async def settle(self, key: str) -> None:
        """Wait for what cancelled callers have left to run."""
        await asyncio.wait(self._left[key])

    def ordered(self, key: str) -> AbstractAsyncContextManager[Any]:
        """Return the lock of `key`."""
        return self._orders.setdefault(key, anyio.Lock())

    async def listen(self, on_push: Callable[[list[Any]], None], on_lost: Callable[[Wire, Exception], None]) -> Wire:
        """Open a connection whose pushed messages go to `on_push`."""
        self.check()
        return await self._opened(on_push, on_lost)

    async def close(self) -> None:
        """Close all connections, for good."""
        if self._closed:
            return
        self._closed = True
        self.states.closed()
        farewell, self._farewell = self._farewell, None
        if self._loop is asyncio.get_running_loop():
            await self.release()
            if farewell is not None:
                await farewell.aclose()
        self._forget()

    async def release(self) -> None:
        """Close the connections of this event loop; another one may go on with this transport."""
        wires = [*self._lanes.values(), *self._spare]
        self._forget()
        for wire in wires:
            await wire.close()
