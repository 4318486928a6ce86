"""Server-sent events: what changed, newest only, ten times a second at most."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable

import orjson
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from .addresses import address
from .answers import Refused, answered
from .source import Source

__all__ = ["Events"]

# Seconds between two looks: a page draws no faster.
_PAUSE = 0.1
_QUIET = 1.0
"""Seconds after which something is sent though nothing changed: the page knows by it that all is well."""

# Paths that are named; beyond, the page is told only that there are more and looks at all it shows.
_MOST_PATHS = 100
# Pages that are told of changes at the same time, each over a connection that stays open.
_MOST_CLIENTS = 64


class Events:
    """Tells pages what changed in a source.

    Each page is told which paths changed since it was last told, however long that took: a slow page
    is told less often, and nothing piles up for it.

    Args:
        source: What is shown.
        ending: Whether the program ends.
    """

    def __init__(self, source: Source, ending: Callable[[], bool]) -> None:
        self._source = source
        self._ending = ending
        self._clients = 0

    def routes(self) -> list[Route]:
        """Return the route below /api."""
        return [Route("/events", answered(self.events), methods=["GET"])]

    async def events(self, request: Request) -> Response:
        """Answer with a stream that goes on until the page or the program ends."""
        if self._clients >= _MOST_CLIENTS:
            raise Refused(503, f"{_MOST_CLIENTS} pages are open already; close some")
        # The second keeps a proxy (nginx) from collecting events before it passes them on.
        headers = {"cache-control": "no-store", "x-accel-buffering": "no"}
        return StreamingResponse(self._stream(), headers=headers, media_type="text/event-stream")

    async def _stream(self) -> AsyncIterator[bytes]:
        self._clients += 1
        try:
            # Milliseconds until a browser that lost the connection tries again.
            yield b"retry: 1000\n\n"
            told, quiet, before = self._source.status().end, 0.0, ""
            while not self._ending():
                status = self._source.status()
                paths = await self._source.changes(told, status.end, _MOST_PATHS)
                if paths or status.lost != before or quiet >= _QUIET:
                    content = {
                        **status._asdict(),
                        "paths": [address(path) for path in paths],
                        "more": len(paths) >= _MOST_PATHS,
                    }
                    yield b"data: " + orjson.dumps(content) + b"\n\n"
                    told, quiet, before = status.end, 0.0, status.lost
                await asyncio.sleep(_PAUSE)
                quiet += _PAUSE
        finally:
            self._clients -= 1
