"""Making asyncio connections: what is sent before anybody calls over one."""

from __future__ import annotations

from ..concurrency.timeouts import server_timeout
from ..errors import ConnectionLost
from ..plan import Command, Reply
from .identity import unanswered
from .options import Options
from .parsing import LargeReader, SmallReader
from .text import PROBE, is_plain, lists_json
from .wire import Wire

__all__ = ["first_answer", "open_wire"]


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
