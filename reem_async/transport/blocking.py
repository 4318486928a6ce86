"""The port for plain threads: the caller's own thread sends and receives, no event loop involved.

Its methods are `async def` only to fit the port: nothing in them ever suspends, so a coroutine of
the core over this transport is run to its end by a single step.
"""

from __future__ import annotations

import collections
import select
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from contextvars import ContextVar
from functools import partial
from typing import Any

import redis.exceptions

from ..concurrency.locks import Inherited, Locks, ThreadLock, WeakList
from ..concurrency.tasks import give_way
from ..concurrency.timeouts import LOOKS, moved_last, time_limit, unsent
from ..errors import ConnectionLost, InterfaceClosed
from ..plain.translation import finished, shortcut
from ..plan import Command, Reply
from . import Guard, Held, Transport
from .options import INFO_SERVER, Options, server_run_id
from .protocol import MORE, NOT_THE_PROTOCOL, SLOW, LargeReader, Piece, ReplyReader, SmallReader, error_of, pack
from .state import States
from .text import PROBE, HeldText, Text, is_plain, lists_json

_RECORD = 1 << 14  # bytes in one record of TLS, at most
_SLICE = 1 << 19  # bytes of a large value that are sent before giving way


class _Line:
    def __init__(self, options: Options, states: States) -> None:
        self._states = states
        self._is_kept = False
        self._connection = options.blocking_connection()
        try:
            self._connection.connect()
            self._socket: socket.socket = self._connection._sock
            self._tls = hasattr(self._socket, "context")
            # Python asks whether a socket with a time limit is ready before it sends, too. This one has none.
            self._out = self._socket if self._tls else self._socket.dup()
        except BaseException as error:  # redis-py lets pass what a peer's nonsense makes of its parser
            self._connection.disconnect()
            if not isinstance(error, Exception):  # Ctrl-C
                raise
            refused = options.refused(error)
            raise refused from (refused.__cause__ if refused is error else error)
        if not self._tls:
            self._out.settimeout(0.0)
        self._timeout = options.timeout
        self._limit = 0.0
        self._moved = 0.0  # when a byte of a large value, or of the reply to it, was last seen to move
        self._left = 0  # how many of its bytes were on their way up when last looked at
        self._set_limit(self._timeout)
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        self._small = SmallReader(options.largest)
        self._largest = options.largest
        self._large: LargeReader | None = None
        self.broken = False  # it is not to be used again; so it is while a call is under way
        self.retired = False  # it is closed when it is given back
        known = lists_json(self._connection.handshake_metadata)
        try:
            self.introduction, *probed = self.exchange([INFO_SERVER] if known else [INFO_SERVER, PROBE])
        except ConnectionLost as error:
            raise options.unanswered(error) from error
        self.plain = bool(probed) and is_plain(probed[0])
        self._states.opened(options.address, server_run_id(self.introduction))

    def _set_limit(self, limit: float) -> None:
        """Have Python watch the time: the kernel's own limits restart after each signal."""
        self._limit = limit
        self._socket.settimeout(limit)

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        return self.exchange(commands, bulk)

    def exchange(self, commands: Sequence[Command], bulk: bool = False) -> list[Reply]:
        pieces = pack(commands)
        self.broken = True  # until all is read: a Ctrl-C anywhere must not leave a reply for the next caller
        limit = time_limit(self._timeout)
        try:
            receive = self._socket.recv_into
            if len(pieces) == 1 and len(piece := pieces[0]) < SLOW:
                if limit != self._limit:
                    self._set_limit(limit)
                try:
                    sent = self._out.send(piece)
                except BlockingIOError:
                    sent = 0
                if sent < len(piece):
                    self._socket.sendall(memoryview(piece)[sent:])
            else:
                self._send_large(pieces, limit)
                receive = partial(self._receive_patiently, limit)
            if bulk and self._large is None:
                self._large = LargeReader(self._largest)
            replies = self._replies((bulk and self._large) or self._small, len(commands), receive)
            self.broken = False
            return replies
        except (BlockingIOError, TimeoutError):
            raise self.lost(
                f"the server moved no byte for {limit:g} s; the call was applied once or not at all"
            ) from None
        except OSError as error:
            raise self.lost(
                f"the connection broke before the reply came ({error}); the call was applied once or not at all"
            ) from error
        except NOT_THE_PROTOCOL as error:
            raise self.lost(f"the server sent something that is not its protocol: {error!s:.200}") from error
        except BaseException:  # Ctrl-C: the reply is still on its way and must not meet the next caller
            self.close()
            raise

    def _replies(self, reader: ReplyReader, count: int, receive: Callable[[memoryview], int]) -> list[Reply]:
        """Read `count` replies; raises InvalidResponse if there are more, since nothing else was asked."""
        replies: list[Reply] = []
        gets = reader.gets
        while True:
            received = receive(reader.target())
            if not received:
                raise ConnectionResetError("closed by the server")
            reader.received(received)
            before = len(replies)
            while (reply := gets()) is not MORE:
                replies.append(reply)
            if len(replies) > before:
                reader.fed = 0
            if len(replies) > count:
                raise redis.exceptions.InvalidResponse("more replies than were asked for")
            if len(replies) == count:
                return replies

    def _send_large(self, pieces: list[Piece], limit: float) -> None:
        """Send large values, giving way to other threads in between; bytes that move restart the limit."""
        if limit / LOOKS != self._limit:
            self._set_limit(limit / LOOKS)
        self._moved, self._left = time.monotonic(), 0
        step = _RECORD if self._tls else _SLICE  # over TLS, nothing is said of a part that was sent
        for piece in pieces:
            view, sent = memoryview(piece), 0
            while sent < len(view):
                try:
                    sent += self._socket.send(view[sent : sent + step])
                    self._moved = time.monotonic()
                except (BlockingIOError, TimeoutError):
                    self._check_moved(limit)
                give_way()

    def _receive_patiently(self, limit: float, target: memoryview) -> int:
        """Receive after a large value was sent: it may go on arriving long after the first replies are here."""
        while True:
            try:
                received = self._socket.recv_into(target)
                self._moved = time.monotonic()
                return received
            except (BlockingIOError, TimeoutError):
                self._check_moved(limit)

    def _check_moved(self, limit: float) -> None:
        """Raise TimeoutError if nothing has moved for the whole limit, neither here nor on its way up."""
        before, self._left, now = self._left, unsent(self._socket), time.monotonic()
        self._moved = moved_last(self._moved, now, before, self._left, limit)
        if now - self._moved >= limit:
            raise TimeoutError

    def fresh(self) -> bool:
        # Nothing is due: an event is a stray reply, or the server has closed.
        return not self.broken and not self.retired and not self._poll.poll(0)

    def lost(self, reason: str) -> ConnectionLost:
        self.close()
        error = ConnectionLost(reason)
        self._states.lost(error)
        return error

    async def discard(self) -> None:
        self.close()

    def close(self) -> None:
        self.broken = True
        self._connection.disconnect()
        self._out.close()

    def kept_open(self) -> tuple[Any, ...]:
        """Return what has to be kept for the connection to stay open, also when this object is finalized."""
        self._is_kept = True
        return self._connection, self._socket, self._out

    def __del__(self) -> None:  # an interrupted call may have kept it from being given back
        if hasattr(self, "_out") and not self._is_kept:
            self._out.close()


_open_at_exit: ContextVar[list[Any]] = ContextVar("_open_at_exit")


def keep_open_at_exit() -> None:
    """Keep the idle connections of this process open until it ends, for the calls of `__del__`.

    Python finalizes all modules and their objects as one heap of garbage, in any order: it would close a connection
    before it calls the `__del__` that sends the last command over it. The context of the main thread outlives that.
    """
    _open_at_exit.set([line.kept_open() for transport in _all for line in list(transport._idle)])


class BlockingTransport(Transport):
    def __init__(self, options: Options) -> None:
        super().__init__(options)
        self._closed = False
        self._text = Text(options.timeout)
        self._begin()
        _all.add(self)
        self.states = States()
        self.at_end: Callable[[], Awaitable[None]] = self.release

    def check(self) -> None:
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")

    def _begin(self) -> None:
        """Begin without connections and locks; in a forked child too, since those it has are its parent's."""
        self._idle: collections.deque[_Line] = collections.deque()
        self._lines: WeakList[_Line] = WeakList()  # all there are, also those in use
        self._kept: set[_Line] = set()  # lent for long
        self._orders = Locks(ThreadLock)

    def _take(self) -> _Line | None:
        if self._closed:
            self.check()
        stale: _Line | None = None
        while True:
            try:
                line = self._idle.pop()
            except IndexError:
                if stale is not None:  # there was none left
                    stale.lost("the server closed an idle connection")
                return None
            if line.fresh():
                return line
            line.close()
            stale = line

    async def _opened(self) -> _Line:
        nearby = self._options.nearby
        return await (self._connected(self._options) if nearby is None else nearby.connected(self._connected))

    async def _connected(self, options: Options) -> _Line:
        line = _Line(options, self.states)
        self._lines.add(line)
        return line

    def _give(self, line: _Line) -> None:
        if line.broken:
            line.close()
            self._close_idle()  # likely of the same fate; a new one says how things are
            return
        self._idle.append(line)
        if self._closed or line.retired:  # asked behind it: another thread closes what it finds
            self._close_idle()

    def _close_idle(self) -> None:
        with suppress(IndexError):  # other threads take, and close, too
            while True:
                self._idle.pop().close()

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        line = self._take() or await self._opened()
        try:
            if not line.plain:
                return line.exchange(commands, bulk)
            sent = shortcut(commands, self._text.known)
            if sent is not None:
                return finished(commands, line.exchange(sent, bulk), self._text.known, error_of)
        finally:
            self._give(line)
        return await self._text.roundtrip(self._as_it_is, self, commands, bulk)

    async def _as_it_is(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        line = self._take() or await self._opened()
        try:
            return line.exchange(commands, bulk)
        finally:
            self._give(line)

    @asynccontextmanager
    async def hold(self, guard: Guard | None = None) -> AsyncIterator[Held]:
        line = self._take() or await self._opened()
        held: Held = line
        if guard is not None:
            self._kept.add(line)
            held = guard(line)
        try:
            yield HeldText(held, self._text) if line.plain else held
        except BaseException:
            line.close()
            raise
        finally:
            self._kept.discard(line)
            self._give(line)

    async def pause(self, seconds: float) -> None:
        time.sleep(seconds)  # noqa: ASYNC251 - nothing else runs on this thread

    def ordered(self, key: str) -> AbstractAsyncContextManager[None]:
        return self._orders.of(key)

    def broken_off(self) -> None:
        for order in self._orders.all():
            order.let_go()

    async def close(self) -> None:
        self._closed = True
        self._close_idle()
        for line in [*self._kept]:
            if not line.broken:  # else a call is under way, and the next one finds the interface closed
                line.close()
        self.states.closed()

    def drop(self, reason: Exception) -> None:
        """Close all connections, those in use after their call; new ones are made when needed."""
        for line in self._lines:
            line.retired = True
        self._close_idle()

    async def release(self) -> None:
        self._close_idle()


# redis-py closes only the child's descriptors of the parent's connections, without a word to the server.
_all = Inherited(BlockingTransport._begin)
