"""Making connections: the transport that an address asks for, the socket nearby, and the first questions."""

from __future__ import annotations

import os
import re
import socket
import struct
from typing import Any

import redis.exceptions

from ..concurrency.timeouts import server_timeout
from ..errors import ConnectionLost, NotConnected
from ..plan import Command, Reply
from . import Transport
from .composite import NewTransport
from .options import Options, connecting_by, is_this_machine, question, question_here
from .parsing import LargeReader, SmallReader
from .text import PROBE, is_plain, lists_json
from .wire import Wire

__all__ = [
    "WHO", "ServerSocket", "first_answer", "look_nearby", "make_transport", "open_wire", "unanswered", "who",
]  # fmt: skip

_CLUSTER = ("redis+cluster://", "rediss+cluster://")
_SENTINEL = ("redis+sentinel://", "rediss+sentinel://")
WHO: Command = ("INFO", "server")
"""Asked once per connection; whoever may not ask does not get to know of restarts."""

_RUN = re.compile(rb"run_id:([0-9a-f]{8,64})")
_PORT = re.compile(rb"^tcp_port:(\d+)\r?$", re.MULTILINE)
_PID = re.compile(rb"^process_id:(\d+)\r?$", re.MULTILINE)
_SOCKET = re.compile(rb"^listener\d+:name=unix,bind=(/[^,\r\n]+)", re.MULTILINE)
_CREDENTIALS = struct.Struct("3i")  # process, user and group of whoever listens


def make_transport(
    host: Any, timeout: float, options: dict[str, Any], new_transport: NewTransport
) -> tuple[Options, Transport]:
    """Return how to reach what `host` names, and the transport to it. Nothing is connected yet.

    Raises:
        BadType, BadValue: An address or an option that means nothing.
    """
    url = host if isinstance(host, str) else getattr(host, "url", "")
    if url.startswith(_CLUSTER):
        # Imported only where an address asks for it: a program for one server starts without it.
        from .cluster import ClusterOptions, ClusterTransport

        cluster = ClusterOptions(url, timeout, options)
        nodes = ClusterTransport(cluster, new_transport)
        return cluster, nodes
    if url.startswith(_SENTINEL):
        from .sentinel import SentinelOptions, SentinelTransport

        watched = SentinelOptions(url, timeout, options)
        primary = SentinelTransport(watched, new_transport)
        return watched, primary
    one = Options(host, timeout, options)
    if one.settings.get("host", "localhost") == "localhost":  # a number means TCP
        look_nearby(one)
    server = new_transport(one)
    return one, server


async def first_answer(wire: Wire, question: Command, address: str) -> list[Reply]:
    """Ask something over a new connection; if that does not go well, close it.

    Raises:
        NotConnected: It broke.
    """
    try:
        return await wire.roundtrip([question])
    except BaseException as error:
        await wire.close()
        if isinstance(error, ConnectionLost):
            raise unanswered(address, error) from error
        raise


async def open_wire(options: Options, *, large: bool = False) -> Wire:
    """Connect, log in, and return the wire; `large` replies are received in place.

    Raises:
        NotConnected: Nobody listens there.
        Refused: The server refused the login.
    """
    connection = options.asynchronous_connection()
    try:
        async with server_timeout(options.handshake_timeout):
            await connection.connect()
    except Exception as error:  # redis-py lets pass what a peer's nonsense makes of its parser
        await connection.disconnect(nowait=True)
        raise options.refused(error) from error
    wire = Wire(options.timeout, (LargeReader if large else SmallReader)(options.largest))
    wire.take_over(connection)
    if not lists_json(connection.handshake_metadata):
        (reply,) = await first_answer(wire, PROBE, options.address)
        wire.plain = is_plain(reply)
    return wire


def who(replies: Any) -> str | None:
    """Return what the server's process calls itself, None if it did not say (or if an error is given)."""
    # An error, or a user who may not ask: restarts are then not told of, and all else goes on.
    text = replies[0] if isinstance(replies, list) and replies else None
    found = _RUN.search(text) if isinstance(text, bytes | bytearray) else None
    return None if found is None else found[1].decode()


def unanswered(address: str, error: ConnectionLost) -> NotConnected:
    """Return the error to raise where a new connection broke at its first question: no call had been sent."""
    reason = str(error).partition("; the call")[0]
    return NotConnected(f"the server at {address} took the connection, and then: {reason}; nothing was applied")


def look_nearby(options: Options) -> None:
    """Have connections look for the server's Unix socket first.

    Only where the address is that of one server on this machine, without TLS, and only on systems
    that tell which process listens at a socket. Nothing is connected yet.
    """
    host = str(options.settings.get("host", "localhost"))
    plain = type(options) is Options and not options.tls and options.socket_path is None
    if plain and is_this_machine(host) and hasattr(socket, "SO_PEERCRED"):
        options.nearby = ServerSocket(options)


class ServerSocket:
    """What is known of the Unix socket of the server at an address.

    Args:
        options: How to reach the server by its address.

    Attributes:
        way: How to reach it through the socket; None as long as none is known, or of use.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._vain: str | None = None
        self.way: Options | None = None

    def learn(self, replies: Any) -> None:
        """Note what the server at the address says of itself, asked who it is.

        Where its port is another one, something stands in between, on purpose: a tunnel, or a proxy.
        """
        process = who(replies)
        # The socket of this process was tried and does not work (another container, no right to it): not again.
        if process is None or process == self._vain:
            return
        port, pid, path = (pattern.search(replies[0]) for pattern in (_PORT, _PID, _SOCKET))
        if port and pid and path and int(port[1]) == int(self._options.settings.get("port", 6379)):
            self.way = SocketOptions(self._options, os.fsdecode(path[1]), process, int(pid[1]))

    def give_up(self, way: Options, error: Exception) -> None:
        """Note that `way` could not be gone. As long as the same process is at the address, it is not tried again.

        Raises:
            The error, if it says that the server does not answer in time: it will not at its address either.
        """
        if isinstance(error.__cause__, TimeoutError | redis.exceptions.TimeoutError):
            raise error
        self._vain, self.way = (way.process if isinstance(way, SocketOptions) else None), None


class SocketOptions(Options):
    """How to reach a server through its Unix socket, and no other one: the login is for this process alone.

    Args:
        by_address: How to reach it by its address.
        path: The socket.
        process: What the server's process calls itself.
        pid: Its number in this system.
    """

    def __init__(self, by_address: Options, path: str, process: str, pid: int) -> None:
        self._by_address = by_address.address
        self.process = process
        self._pid = pid
        settings = {name: value for name, value in by_address.settings.items() if not name.startswith("socket_keepa")}
        settings.pop("socket_type", None)
        super().__init__(
            "localhost", by_address.timeout, settings | {"unix_socket_path": path, "largest_value": by_address.largest}
        )

    @property
    def address(self) -> str:
        """Where the user said that the server is, for messages."""
        return self._by_address

    def asynchronous_connection(self) -> Any:
        """Return a connection that makes sure, before it logs in, who listens."""
        connection = connecting_by(super().asynchronous_connection(), self._connect_asynchronously)
        log_in = connection.on_connect_check_health

        async def check_first(**options: Any) -> None:
            # Before AUTH is sent: a stranger who listens at the path must not get the password.
            self._check_listener(connection._writer.get_extra_info("socket"))
            await log_in(**options)

        connection.on_connect_check_health = check_first
        return connection

    def blocking_connection(self) -> Any:
        """Return a connection that makes sure, before it logs in, who listens."""
        connection = connecting_by(super().blocking_connection(), self._connect)
        log_in = connection.on_connect_check_health

        def check_first(**options: Any) -> None:
            self._check_listener(connection._sock)
            log_in(**options)

        connection.on_connect_check_health = check_first
        return connection

    async def _connect_asynchronously(self, connection: Any, connect: Any) -> None:
        await connect()
        await question(connection, [WHO], self._check_process)

    def _connect(self, connection: Any, connect: Any) -> None:
        connect()
        question_here(connection, [WHO], self._check_process)

    def _check_listener(self, listening: Any) -> None:
        """Raise redis.exceptions.ConnectionError if somebody else listens there: he gets no password."""
        with socket.socket(fileno=os.dup(listening.fileno())) as connected:
            # A copy of the descriptor: closing this socket object must not close the connection.
            told = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        if _CREDENTIALS.unpack(told)[0] != self._pid:
            raise redis.exceptions.ConnectionError("another process listens at the server's socket")

    def _check_process(self, reply: Any, _: Any) -> None:
        """Raise redis.exceptions.ConnectionError if it is another server: its number may be another system's."""
        if who([reply]) != self.process:
            raise redis.exceptions.ConnectionError("another server answers at the server's socket")
