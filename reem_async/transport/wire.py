"""One asyncio connection: replies matched to requests in the order sent.

Callers share it: each appends its commands and waits for as many replies, so concurrent callers are
pipelined by themselves, and a caller that was cancelled leaves no trace: its replies still come,
in order, and are dropped.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import socket
import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import hiredis

from ..concurrency.locks import Inherited
from ..concurrency.tasks import give_way
from ..concurrency.timeouts import LOOKS, confirmed, moved_last, server_timeout, time_limit, unsent
from ..errors import ConnectionLost, InterfaceClosed
from ..plan import Command, Reply
from ..plan.sizes import LARGE
from .options import INFO_SERVER, Options, is_this_machine
from .protocol import MORE, NOT_THE_PROTOCOL, SLOW, LargeReader, Piece, ReplyReader, SmallReader, pack
from .text import PROBE, is_plain, lists_json, over_wire

_BUSY = 2.5  # the connection is busy if three reads come within so many times `pace`
_BATCHING = 0.005  # seconds of `pace` from which on updates may be read together: no listener needs them at once
BUFFER = 1 << 22  # bytes of a send buffer that Linux grants with its default limits (net.ipv4.tcp_wmem)
_FAREWELL = 1.0  # seconds for which what was to be sent is waited for when a connection is closed
_CONFIRMATIONS = (b"subscribe", b"unsubscribe", b"psubscribe", b"punsubscribe", b"ssubscribe")


_inherited: list[Any] = []
"""A parent's connections in a forked child, kept from being finalized: closing one would take it out of the parent's
event loop, since both share one epoll."""


@dataclass(slots=True, eq=False)
class _Due:
    count: int
    done: Callable[[list[Reply] | Exception], None]  # takes them, or an error
    limit: float  # seconds without a byte moving after which the call fails, and
    since: float  # the time from which this counts at the earliest: when they were asked for
    replies: list[Reply] = field(default_factory=list)
    late: bool = False  # the limit has passed: it is given up if the next look at the socket brings nothing
    over: bool = False  # the caller was told; what still comes is dropped
    lenient: bool = False  # errors are no reply


class Wire(asyncio.BufferedProtocol):
    def __init__(self, timeout: float, reader: ReplyReader) -> None:
        self.on_push: Callable[[list[Any]], None] | None = None  # called with each message the server sends unasked
        # Called once when the connection is gone, with the reason.
        self.on_lost: Callable[[Wire, Exception], None] | None = None
        # Seconds for which nothing more is read after something was, if much comes: it is taken together.
        self.pace = 0.0
        # The server tells of keys that were read here and then changed (CLIENT TRACKING); None if not asked.
        self.tracked: bool | None = None
        self.introduction: Reply = None  # the reply to INFO_SERVER
        self.plain = False  # the server has no JSON module; what reads documents is sent as what reads their text
        self._timeout = timeout
        self._reader = reader
        self._due: collections.deque[_Due] = collections.deque()
        self._outbox: list[Piece] = []
        self._unsent_calls: list[_Due] = []  # those whose commands are in the outbox
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._keep: Any = None
        self._socket: Any = None
        self._tls = self._loopback = False
        self._buffer = BUFFER
        self._goal = 0  # over TLS: how many bytes the other side has confirmed when it has all of what was written
        self._watch: asyncio.TimerHandle | None = None
        self._last_byte = self._read_before = 0.0
        self._doubted = 0.0
        self._unsent = 0  # bytes of large values that were on their way up when last looked at
        self._reason: Exception | None = None
        self._gone = self._loop.create_future()
        # What the socket does not take at once is copied by asyncio of Python 3.11; later versions and
        # uvloop keep a view of the array, which the caller may change meanwhile.
        self._keeps_views = sys.version_info >= (3, 12) or not isinstance(self._loop, asyncio.BaseEventLoop)

    def take_over(self, connection: Any) -> None:
        """Replace redis-py's stream on a connected `connection`."""
        writer = connection._writer
        self._keep = writer  # its finalizer would close the socket under us
        connection._reader = connection._writer = None
        transport: asyncio.Transport = writer.transport
        self._transport, self._socket = transport, transport.get_extra_info("socket")
        _open.add(self)
        self._tls = transport.get_extra_info("ssl_object") is not None
        self._loopback = _is_loopback(self._socket)
        transport.set_protocol(self)

    def limit_buffer(self, size: int) -> None:
        """Have loopback TCP take at most so many bytes at a time; to other machines, and on other sockets, nothing."""
        if self._loopback and size != self._buffer:
            self._buffer = size
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, size)

    def disown(self) -> None:
        """Give the connection up without touching it: it belongs to the parent process."""
        self._reason = self._reason or ConnectionLost("this connection belongs to the parent process")
        _inherited.append((self._transport, self._keep))
        self._transport = self._keep = self.on_lost = None
        waiting, self._due = self._due, collections.deque()
        for due in waiting:
            if not due.over:
                due.done(self._reason)

    @property
    def alive(self) -> bool:
        return self._reason is None and self._transport is not None and not self._transport.is_closing()

    @property
    def busy(self) -> bool:
        return bool(self._due) and self.alive

    @property
    def idle(self) -> float:
        return self._loop.time() - self._last_byte

    @property
    def batches_messages(self) -> bool:
        """Whether messages are batched, so that other threads are given way after each one."""
        return self.pace >= _BATCHING

    def send(self, commands: Sequence[Command], done: Callable[[list[Reply] | Exception], None]) -> None:
        """Send `commands`; `done` is called with their replies, in order with pushed messages, or with an error."""
        if not commands:
            done([])
            return
        if self.plain:
            commands, done = over_wire(commands, done)
        if self._transport is None or self._reason is not None:
            done(self._reason or ConnectionLost("the connection is closed"))
            return
        pieces, limit, now = pack(commands), time_limit(self._timeout), self._loop.time()
        idle = not self._due
        self._due.append(_Due(len(commands), done, limit, now))
        self._watch_until(now + limit)
        if idle and not self._outbox:
            self._write(pieces)
            if len(pieces) > 1 or len(pieces[0]) >= SLOW:
                self._watch_upload(limit)
            return
        # Others wait already: what is sent in the same turn of the loop goes out in one system call.
        if not self._outbox:
            self._loop.call_soon(self._flush)
        self._unsent_calls.append(self._due[-1])
        # A view of an array is copied: its owner may change it before this turn is over.
        self._outbox += [bytes(piece) if type(piece) is memoryview else piece for piece in pieces]

    def leave(self, channel: bytes) -> None:
        """Unsubscribe from a sharded channel.

        What confirms that looks like the word that the channel's slot has moved, and if it has, there is an
        error instead. So neither is waited for; the PONG behind it is.
        """
        if not self.alive:
            return
        limit, now = time_limit(self._timeout), self._loop.time()
        self._due.append(_Due(1, lambda _: None, limit, now, lenient=True))
        self._watch_until(now + limit)
        if not self._outbox:
            self._loop.call_soon(self._flush)
        self._outbox.extend(pack([("SUNSUBSCRIBE", channel), ("PING",)]))

    def _flush(self) -> None:
        pieces, self._outbox = self._outbox, []
        calls, self._unsent_calls = self._unsent_calls, []
        for due in calls:  # a turn with many calls may take longer than the limit
            due.since = self._loop.time()
        if self._reason is None:
            self._write(pieces)
            if sum(map(len, pieces)) >= SLOW:
                self._watch_upload(self._timeout)

    def _write(self, pieces: list[Piece]) -> None:
        assert self._transport is not None
        if self._tls:
            self._goal = max(self._goal, confirmed(self._socket)) + sum(map(len, pieces))
        start = 0
        for place, piece in enumerate(pieces):
            if type(piece) is memoryview or len(piece) >= LARGE:
                if place > start:
                    self._transport.write(b"".join(pieces[start:place]))
                start = place + 1
                self._transport.write(bytes(piece) if self._keeps_views and type(piece) is memoryview else piece)
        if start < len(pieces):
            self._transport.write(pieces[start] if len(pieces) - start == 1 else b"".join(pieces[start:]))

    def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> asyncio.Future[list[Reply]]:
        """Send `commands`; awaited, it is their replies. Cancelling leaves the connection usable."""
        answer: asyncio.Future[list[Reply]] = self._loop.create_future()

        def done(outcome: list[Reply] | Exception) -> None:
            try:
                if isinstance(outcome, Exception):
                    answer.set_exception(outcome)
                else:
                    answer.set_result(outcome)
            except asyncio.InvalidStateError:  # cancelled; asked before, Ctrl-C could still come between
                return

        self.send(commands, done)
        return answer

    def begin(self, commands: Sequence[Command]) -> asyncio.Future[list[Reply] | Exception]:
        """Send `commands`; the result tells what became of them, error or not, and is not to be cancelled."""
        arrived: asyncio.Future[list[Reply] | Exception] = self._loop.create_future()
        self.send(commands, arrived.set_result)
        return arrived

    def abort(self, reason: Exception) -> None:
        self._fail(reason)
        if self._transport is not None:
            self._transport.abort()

    def abort_soon(self, reason: Exception) -> None:
        with contextlib.suppress(RuntimeError):  # the event loop has ended, and the connection with it
            self._loop.call_soon_threadsafe(self.abort, reason)

    async def discard(self) -> None:
        await close_all([self])

    def hang_up(self) -> asyncio.Future[None]:
        """Begin to close the connection; the result is there when it is closed."""
        if self._transport is not None:
            self._fail(
                InterfaceClosed("this RedisInterface was closed during the call, which was applied once or not at all")
            )
            self._transport.close()
        elif not self._gone.done():  # it was given up
            self._gone.set_result(None)
        return self._gone

    def cut_off(self) -> None:
        if self._transport is not None and not self._gone.done():
            self._transport.abort()

    # What asyncio calls.

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._reader.target()

    def buffer_updated(self, nbytes: int) -> None:
        before, self._read_before, self._last_byte = self._read_before, self._last_byte, self._loop.time()
        try:
            self._reader.received(nbytes)
            batches_messages = self.batches_messages
            while (reply := self._reader.gets()) is not MORE:
                self._take(reply)
                if batches_messages:
                    give_way()
        except NOT_THE_PROTOCOL as error:
            self.abort(ConnectionLost(f"the server sent something that is not its protocol: {error!s:.200}"))
        if self._last_byte - before < _BUSY * self.pace and self.alive:
            assert self._transport is not None
            self._transport.pause_reading()
            self._loop.call_later(self.pace, self._read_on)

    def _read_on(self) -> None:
        if self.alive:
            assert self._transport is not None
            self._transport.resume_reading()

    def eof_received(self) -> None:
        """Close: the server will not answer any more."""

    def connection_lost(self, exc: Exception | None) -> None:
        self._fail(
            ConnectionLost(
                f"the connection broke before the reply came ({exc or 'closed by the server'}); "
                "the call was applied once or not at all"
            )
        )
        self._keep = None
        if not self._gone.done():
            self._gone.set_result(None)

    def _take(self, reply: Any) -> None:
        # The confirmation of a SUBSCRIBE is pushed too, but it is the only reply there is to the command.
        if type(reply) is hiredis.PushNotification and not (reply and reply[0] in _CONFIRMATIONS):
            if self.on_push is not None:
                self._reader.fed = 0
                self.on_push(reply)
            return
        if not self._due:
            self.abort(ConnectionLost("unexpected reply from the server"))
            return
        due = self._due[0]
        if due.lenient and isinstance(reply, Exception):
            return
        due.replies.append(reply)
        self._reader.fed = 0
        if len(due.replies) == due.count:
            self._due.popleft()
            if not due.over:
                due.done(due.replies)

    def _watch_upload(self, limit: float) -> None:
        """Look often from now on: the last progress of a large value on its way up begins the time limit."""
        self._unsent = self._bytes_unsent()
        self._watch_until(self._loop.time() + limit / LOOKS)

    def _watch_until(self, moment: float) -> None:
        if self._watch is not None:
            if self._watch.when() <= moment:
                return
            self._watch.cancel()
        self._watch = self._loop.call_at(moment, self._check_time)

    def _check_time(self) -> None:
        """Fail the calls whose limit has passed. Break the connection if no other call waits, or if it stays silent.

        Calls that were sent before the first one failed keep their own limits. Without an end to the silence, a program
        that goes on calling would keep a dead connection for ever.
        """
        self._watch = None
        now, left = self._loop.time(), self._bytes_unsent()
        waiting = [due for due in self._due if not due.over]
        if waiting:  # a large value on its way up is progress too
            self._last_byte = moved_last(self._last_byte, now, self._unsent, left, waiting[0].limit)
        self._unsent = left
        for due in waiting:
            if max(self._last_byte, due.since) + due.limit > now:
                due.late = False
            elif not due.late:  # the loop may have been busy while the reply came
                due.late = True
            else:
                due.over = True
                due.done(
                    ConnectionLost(
                        f"the server moved no byte for {due.limit:g} s; the call was applied once or not at all"
                    )
                )
        moments = [max(self._last_byte, due.since) + due.limit for due in self._due if not due.over]
        if moments and self._due[0].over:
            moments.append(self._end_of_silence())
        silent = bool(moments) and self._due[0].over and moments[-1] <= now
        if silent and self._doubted == self._last_byte:
            self.abort(ConnectionLost(f"the server moved no byte for {now - self._last_byte:.3g} s"))
        elif moments:
            self._doubted = self._last_byte if silent else 0.0  # look again: the loop may have been busy
            # While a large value is on its way up, look often: its last progress begins the limit.
            soon = now + min(due.limit for due in self._due if not due.over) / LOOKS if left else max(moments)
            self._watch_until(max(min(*moments, soon), now + 0.002))
        elif waiting:
            self.abort(ConnectionLost(f"the server moved no byte for {waiting[-1].limit:g} s"))

    def _end_of_silence(self) -> float:
        """Return when the connection is given up whatever was sent since: its oldest call has failed."""
        oldest, longest = self._due[0], max(due.limit for due in self._due if not due.over)
        return max(self._last_byte, oldest.since) + oldest.limit + longest

    def _bytes_unsent(self) -> int:
        if self._tls:
            return max(self._goal - confirmed(self._socket), 0)
        buffered = self._transport.get_write_buffer_size() if self._transport is not None else 0
        return buffered + unsent(self._socket)

    def _fail(self, reason: Exception) -> None:
        if self._reason is not None:
            return
        self._reason = reason
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None
        waiting, self._due = self._due, collections.deque()
        for due in waiting:
            if not due.over:
                due.done(reason)
        if self.on_lost is not None:
            self.on_lost(self, reason)


async def open_wire(options: Options, *, large: bool = False) -> Wire:
    """Connect, log in, and return the wire; `large` replies are received in place.

    Raises:
        NotConnected: No server listens there, or it does not answer.
        Refused: The server refused the login.
    """
    connection = options.asynchronous_connection()
    try:
        async with server_timeout(options.handshake_timeout):
            await connection.connect()
    except Exception as error:  # redis-py lets pass what a peer's nonsense makes of its parser
        await connection.disconnect(nowait=True)
        refused = options.refused(error)
        raise refused from (refused.__cause__ if refused is error else error)
    wire = Wire(options.timeout, (LargeReader if large else SmallReader)(options.largest))
    wire.take_over(connection)
    known = lists_json(connection.handshake_metadata)
    try:
        wire.introduction, *probed = await wire.roundtrip([INFO_SERVER] if known else [INFO_SERVER, PROBE])
    except BaseException as error:
        await wire.discard()
        if isinstance(error, ConnectionLost):
            raise options.unanswered(error) from error
        raise
    wire.plain = bool(probed) and is_plain(probed[0])
    return wire


async def close_all(wires: Collection[Wire]) -> None:
    """Close connections and wait until they are closed; a cancelled caller leaves none behind."""
    going = [wire.hang_up() for wire in wires]
    try:
        if going:
            await asyncio.wait(going, timeout=_FAREWELL)
    finally:
        for wire in wires:
            wire.cut_off()


def _is_loopback(sock: Any) -> bool:
    if sock.family not in (socket.AF_INET, socket.AF_INET6):
        return False
    try:
        return is_this_machine(sock.getpeername()[0])
    except OSError:  # gone meanwhile: the next send fails
        return False


_open = Inherited(Wire.disown)
