"""The short way to a server on this machine: its Unix socket, which costs both sides less than TCP's loopback."""

from __future__ import annotations

import os
import re
import socket
import struct
from typing import Any

import redis.exceptions

from .identity import WHO, who
from .options import Options, connecting_by, is_this_machine, question, question_here

__all__ = ["Nearby", "look_nearby"]

_PORT = re.compile(rb"^tcp_port:(\d+)\r?$", re.MULTILINE)
_PID = re.compile(rb"^process_id:(\d+)\r?$", re.MULTILINE)
_SOCKET = re.compile(rb"^listener\d+:name=unix,bind=(/[^,\r\n]+)", re.MULTILINE)
_CREDENTIALS = struct.Struct("3i")  # process, user and group of whoever listens


def look_nearby(options: Options) -> None:
    """Have connections look for the server's Unix socket first.

    Only where the address is that of one server on this machine, without TLS, and only on systems
    that tell which process listens at a socket. Nothing is connected yet.
    """
    host = str(options.settings.get("host", "localhost"))
    plain = type(options) is Options and not options.tls and options.socket_path is None
    if plain and is_this_machine(host) and hasattr(socket, "SO_PEERCRED"):
        options.nearby = Nearby(options)


class Nearby:
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
            self.way = Way(self._options, os.fsdecode(path[1]), process, int(pid[1]))

    def give_up(self, way: Options, error: Exception) -> None:
        """Note that `way` could not be gone. As long as the same process is at the address, it is not tried again.

        Raises:
            The error, if it says that the server does not answer in time: it will not at its address either.
        """
        if isinstance(error.__cause__, TimeoutError | redis.exceptions.TimeoutError):
            raise error
        self._vain, self.way = (way.process if isinstance(way, Way) else None), None


class Way(Options):
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
