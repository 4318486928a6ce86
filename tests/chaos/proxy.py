"""A TCP proxy that misbehaves when told to, in a thread of its own: blocking and asyncio clients can both be tested."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable

CHUNK = 1 << 16


class _Link:
    def __init__(self, client: asyncio.StreamWriter, server: asyncio.StreamWriter) -> None:
        self.client = client
        self.server = server
        self.swallowed = False  # for good: bytes are missing
        self.gone = False  # the client has closed; the server may still be busy with what it sent
        self.doomed = False  # the next reply is dropped and the connection reset

    def reset(self) -> None:
        _abort(self.client)
        self.swallowed = self.gone = True
        with contextlib.suppress(OSError, RuntimeError):
            self.server.write_eof()


class Proxy:
    """Stands between clients and the server at `target`; faults are set from any thread.

    With `ssl`, clients have to speak TLS. With `buffer`, the kernel takes about so many bytes ahead of the proxy.

    Attributes:
        port: Where it listens, on 127.0.0.1; a free one if none is given.
        connections: How many there were.
        delay: Seconds by which each chunk, either way, is held back.
        left: How many bytes it still hands to the server before it resets all connections, for good.
        lost: How many replies were dropped.
    """

    def __init__(
        self, target: int, port: int = 0, *, ssl: ssl.SSLContext | None = None, buffer: int | None = None
    ) -> None:
        self._target = target
        self._ssl, self._buffer = ssl, buffer
        self.port = port
        self.connections = 0
        self.delay = 0.0
        self.left: int | None = None
        self.lost = 0
        self._marker: bytes | None = None
        self._hole = False
        self._links: set[_Link] = set()
        self._loop = asyncio.new_event_loop()
        self._over = asyncio.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._serve(),), name="proxy")

    # What tests call.

    @property
    def url(self) -> str:
        return f"redis://127.0.0.1:{self.port}"

    def drop_reply(self, marker: bytes) -> None:
        """Lose the reply to the next request that contains `marker`: it is applied, and the connection reset."""
        self._marker = marker

    def reset(self) -> None:
        self._do(lambda: [link.reset() for link in list(self._links)])

    def settled(self, seconds: float = 10.0) -> bool:
        """Wait until the server is done with all connections that clients have lost or closed; whether it is."""
        deadline = time.monotonic() + seconds
        while any(link.gone for link in list(self._links)):
            if time.monotonic() > deadline:
                return False
            time.sleep(0.0005)
        return True

    def half_close(self) -> None:
        """End all connections in the direction of the clients only; what they send is swallowed."""

        def close() -> None:
            for link in list(self._links):
                link.swallowed = True
                with contextlib.suppress(OSError, RuntimeError):
                    link.client.write_eof()

        self._do(close)

    def black_hole(self) -> None:
        """From now on swallow every byte, either way, of old and new connections, and close none."""

        def open_hole() -> None:
            self._hole = True
            for link in self._links:
                link.swallowed = True

        self._do(open_hole)

    def heal(self) -> None:
        """Serve new connections again, without delay; those that lost bytes stay dead."""
        self.delay, self._marker = 0.0, None

        def close_hole() -> None:
            self._hole = False

        self._do(close_hole)

    def __enter__(self) -> Proxy:
        self._thread.start()
        self._ready.wait(10)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join(10)
        self._loop.close()

    # What runs in the proxy's thread.

    def _do(self, action: Callable[[], object]) -> None:
        done = threading.Event()
        self._loop.call_soon_threadsafe(lambda: (action(), done.set()))
        done.wait(10)

    async def _serve(self) -> None:
        tasks: set[asyncio.Task[None]] = set()

        def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self.connections += 1
            task = asyncio.get_running_loop().create_task(self._link(reader, writer))
            tasks.add(task)
            task.add_done_callback(tasks.discard)
            task.add_done_callback(lambda _: writer.transport.abort())  # even if it never began

        listening = socket.create_server(("127.0.0.1", self.port), backlog=1000)
        if self._buffer is not None:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._buffer)
        server = await asyncio.start_server(connected, sock=listening, ssl=self._ssl, backlog=1000)
        self.port = listening.getsockname()[1]
        self._ready.set()
        await self._over.wait()
        self._loop.remove_reader(listening)
        for _ in range(5):  # what was accepted before gets to `connected` first: a closed server would drop it unclosed
            await asyncio.sleep(0)
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.sleep(0.01)  # for the connections that were just aborted to be closed

    async def _link(self, reader: asyncio.StreamReader, client: asyncio.StreamWriter) -> None:
        if self.left == 0:
            _abort(client)
            return
        connecting = asyncio.ensure_future(asyncio.open_connection("127.0.0.1", self._target))
        try:
            replies, server = await asyncio.shield(connecting)
        except OSError:
            _abort(client)
            return
        except asyncio.CancelledError:  # the proxy ends: what was just begun is ended too
            _abort(client)
            with contextlib.suppress(OSError):
                (await connecting)[1].transport.abort()
            raise
        link = _Link(client, server)
        link.swallowed = self._hole
        self._links.add(link)
        pumps = [asyncio.ensure_future(pump) for pump in (self._up(link, reader), self._down(link, replies))]
        try:
            await asyncio.gather(*pumps)
        except (OSError, RuntimeError):  # RuntimeError: the other pump has ended this side meanwhile
            pass
        finally:
            self._links.discard(link)
            client.transport.abort()
            server.transport.abort()
            for pump in pumps:
                pump.cancel()
            await asyncio.gather(*pumps, return_exceptions=True)  # may be cancelled: nothing is left to do after it

    async def _up(self, link: _Link, reader: asyncio.StreamReader) -> None:
        tail = b""
        while data := await reader.read(CHUNK):
            marker = self._marker
            if marker is not None:
                if marker in tail + data:
                    self._marker, link.doomed = None, True
                tail = data[-len(marker) :]
            if self.left is not None:
                data = data[: self.left]
                self.left -= len(data)
            if not link.swallowed:
                await self._forward(data, link.server)
            if self.left == 0:
                for each in list(self._links):
                    each.reset()
        link.gone = True
        with contextlib.suppress(OSError, RuntimeError):
            link.server.write_eof()

    async def _down(self, link: _Link, replies: asyncio.StreamReader) -> None:
        while data := await replies.read(CHUNK):
            if link.doomed and not link.swallowed:
                self.lost += 1
                link.reset()
            if not link.swallowed:
                await self._forward(data, link.client)
        if not link.swallowed:
            raise ConnectionResetError("the server has closed")

    async def _forward(self, data: bytes, writer: asyncio.StreamWriter) -> None:
        if self.delay:
            await asyncio.sleep(self.delay)
        writer.write(data)
        await writer.drain()


def _abort(writer: asyncio.StreamWriter) -> None:
    """Close with a RST, as a host does that knows nothing of the connection any more."""
    with contextlib.suppress(OSError):
        link = writer.get_extra_info("socket")
        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()
