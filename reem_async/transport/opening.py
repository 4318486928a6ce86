"""Making connections: the transport that an address asks for, and what is asked first over a connection."""

from __future__ import annotations

from typing import Any

from ..concurrency.timeouts import server_timeout
from ..errors import ConnectionLost, NotConnected
from ..plan import Command, Reply
from . import Transport
from .composite import NewTransport
from .options import Options, look_nearby
from .parsing import LargeReader, SmallReader
from .text import PROBE, is_plain, lists_json
from .wire import Wire

__all__ = ["first_answer", "make_transport", "open_wire", "unanswered"]

_CLUSTER = ("redis+cluster://", "rediss+cluster://")
_SENTINEL = ("redis+sentinel://", "rediss+sentinel://")


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
        NotConnected: No server listens there.
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


def unanswered(address: str, error: ConnectionLost) -> NotConnected:
    """Return the error to raise where a new connection broke at its first question: no call had been sent."""
    reason = str(error).partition("; the call")[0]
    return NotConnected(
        f"the server at {address} accepted the connection, but the first request failed: {reason}; nothing was applied"
    )
