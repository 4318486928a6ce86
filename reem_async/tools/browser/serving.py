"""Running the application on a port, until Ctrl-C."""

from __future__ import annotations

import socket
from typing import Any

import uvicorn
from starlette.applications import Starlette

from ...errors import ServerFailed

__all__ = ["PageServer", "listen"]

# For requests that are being answered when the program ends.
_GRACE_SECONDS = 2


class PageServer(uvicorn.Server):
    """Answers requests on a bound socket.

    Args:
        app: What `create_app` returned.
        sock: What `listen` returned; closed at the end.
    """

    def __init__(self, app: Starlette, sock: socket.socket) -> None:
        config = uvicorn.Config(
            app,
            # In Python, so that there is nothing to compile; a page asks some ten times a second.
            http="h11",
            ws="none",
            loop="none",
            log_level="error",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=_GRACE_SECONDS,
            limit_concurrency=512,
        )
        super().__init__(config)
        self._page = app
        self._sock = sock

    async def run_until_stopped(self) -> None:
        """Answer until `stop`, SIGINT or SIGTERM; signals are seen in the main thread only."""
        await self.serve(sockets=[self._sock])

    def stop(self) -> None:
        """End: the streams of events first, since they would be waited for. From any thread."""
        self._page.state.ending = True
        # The second time ends at once, whatever is still being answered.
        self.force_exit = self.should_exit
        self.should_exit = True

    def handle_exit(self, sig: int, frame: Any) -> None:
        """End at a signal. It is not sent again afterwards, so that the caller can clean up."""
        self.stop()


def listen(host: str, port: int) -> socket.socket:
    """Return a socket bound to a port, 0 for a free one.

    Raises:
        ServerFailed: The port is taken, or the address is not one of this machine.
    """
    try:
        family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        # asyncio turns Nagle's algorithm off, 40 ms for each answer, where it sees that this is TCP.
        sock = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(place)
            sock.listen(128)  # whoever connects from now on is served, if a little later
        except OSError:
            sock.close()
            raise
    except OSError as error:
        raise ServerFailed(
            f"cannot listen on {host} port {port}: {error.strerror}; use another --host or --port"
        ) from None
    return sock
