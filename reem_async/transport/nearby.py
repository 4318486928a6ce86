"""The short way to a server on this machine: its Unix socket, which costs the server less than TCP's loopback."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Any

from .identity import WHO, who
from .options import Options, is_this_machine, question

if TYPE_CHECKING:
    from ..session import Session

__all__ = ["take_shortcut"]

_PATIENCE = 1.0
"""Seconds for whoever is at the socket to say who he is."""

_OF_TCP = ("host", "port", "socket_keepalive", "socket_keepalive_options", "socket_type")


async def take_shortcut(session: Session) -> str | None:
    """Have later connections go through the server's Unix socket, if it has one that is open to this program.

    Only where the address is that of one server on this machine, without TLS, and the same server process
    answers at the socket. Whoever cannot connect there any more goes by the address again. One round
    trip, and another one over a new connection; cancelling leaves everything as it was.

    Returns:
        The path of the socket; None if everything stays as it is.
    """
    options = session.options
    host = str(options.settings.get("host", "localhost"))
    if type(options) is not Options or options.tls or options.socket_path is not None or not is_this_machine(host):
        return None
    try:
        server, told = await session.transport.roundtrip([WHO, ("CONFIG", "GET", "unixsocket")])
        name = told.get(b"unixsocket") if isinstance(told, dict) else None
        process = who([server])
        if process is None or not isinstance(name, bytes) or not os.path.isabs(name):
            return None
        path = os.fsdecode(name)
        nearer = Options("localhost", options.timeout, _settings(options) | {"unix_socket_path": path})
        await _verify(nearer, process)
    except Exception:  # not allowed to ask, or to connect, or a stranger's nonsense: it is only a shortcut
        return None
    options.nearer = nearer
    return path


def _settings(options: Options) -> dict[str, Any]:
    return {name: value for name, value in options.settings.items() if name not in _OF_TCP}


async def _verify(nearer: Options, process: str) -> None:
    """Raise ConnectionError if it is another server: what is behind an address may be somewhere else."""

    def check(reply: Any, _: Any) -> None:
        if who([reply]) != process:
            raise ConnectionError("another server")

    connection = nearer.asynchronous_connection()
    try:
        async with asyncio.timeout(_PATIENCE):
            await connection.connect()
            await question(connection, [WHO], check)
    finally:
        await connection.disconnect(nowait=True)
