"""The application: pages, files, and what the pages ask for."""

from __future__ import annotations

import contextlib
import html
from collections.abc import AsyncIterator, Collection
from importlib import resources
from typing import Any

import anyio.to_thread
import orjson
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Mount, Route

from ...errors import BadKey
from .addresses import path_of
from .answers import answered, at_of
from .api import Api
from .arrays import Arrays
from .downloads import disposition, file_of
from .events import Events
from .guard import LOOPBACK, Guard
from .nodes import visible
from .previews import Preview
from .source import NotKept, Source

__all__ = ["create_app"]

_TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".html": "text/html"}


def create_app(
    source: Source,
    *,
    allow_write: bool = False,
    token: str | None = None,
    hosts: Collection[str] = LOOPBACK,
    any_address: bool = False,
) -> Starlette:
    """Return the browser as an ASGI application, to be run by uvicorn or mounted at the root of a server.

    The source is started with it and closed with it. Sends nothing by itself.

    Args:
        source: What to show: a `LiveSource` or a `LogSource`.
        allow_write: Pages may change values; they are published.
        token: What the first URL must carry as `?token=`; None for no token, for loopback only.
        hosts: The names that a request's Host header may have; anything else is refused.
        any_address: An IP address may be in the Host header as well.
    """
    # Read once, at the start: nothing that a request says becomes the name of a file.
    files = _files()
    api = Api(source, allow_write)
    pages = _Pages(source, api, files)

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        await source.start()
        try:
            yield
        finally:
            await source.close()

    app = Starlette(lifespan=lifespan)
    # Set when the program is to end: open streams of events would keep it waiting.
    app.state.ending = False
    routes = [*api.routes(), *Arrays(source).routes(), *Events(source, lambda: app.state.ending).routes()]
    app.router.routes.extend(
        [
            Route("/", pages.root, methods=["GET"]),
            Route("/view/{where:path}", pages.view, methods=["GET"]),
            Route("/static/{name}", pages.static, methods=["GET"]),
            Mount("/api", routes=routes),
        ]
    )
    app.user_middleware.append(Middleware(Guard, hosts=frozenset(hosts), addresses=any_address, token=token))
    return app


def _files() -> dict[str, bytes]:
    """Return the files of the page, by name: nothing else is ever served."""
    folder = resources.files(__package__) / "static"
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.name.endswith(tuple(_TYPES))}


class _Pages:
    """The one page, in which the scripts show what its address says, and its files."""

    def __init__(self, source: Source, api: Api, files: dict[str, bytes]) -> None:
        self._source = source
        self._api = api
        self._files = files

    async def root(self, request: Request) -> Response:
        """Return the page with the tree."""
        return self._page()

    async def view(self, request: Request) -> Response:
        """Return the page for one path, or the value there as a file."""
        try:
            path = path_of(request.path_params["where"])
        except BadKey as error:
            return PlainTextResponse(f"{visible(str(error))}\n", 400 if "format" in request.query_params else 404)
        if "format" in request.query_params and path:
            return await answered(self._download)(request)
        return self._page()

    async def _download(self, request: Request) -> Response:
        path, kind = path_of(request.path_params["where"]), request.query_params["format"]
        value = (await self._source.value(path, at_of(request))).value
        if isinstance(value, Preview):
            raise NotKept("only a small picture of this array is kept for this instant; choose a later one")
        chosen = request.query_params.get("slice")
        content, media_type = await anyio.to_thread.run_sync(lambda: file_of(value, path, kind, chosen))
        return Response(
            content, headers={"content-disposition": disposition(path, kind, chosen)}, media_type=media_type
        )

    async def static(self, request: Request) -> Response:
        """Return one of the known files."""
        name = request.path_params["name"]
        content = self._files.get(name)
        if content is None or name == "page.html":
            return PlainTextResponse("There is no such file.\n", 404)
        kind = next(kind for suffix, kind in _TYPES.items() if name.endswith(suffix))
        return Response(content, media_type=kind, headers={"cache-control": "no-cache"})

    def _page(self) -> Response:
        config: dict[str, Any] = {
            "title": self._source.title,
            "live": self._source.live,
            "write": self._api.allow_write,
            "key": self._api.key if self._api.allow_write else "",
            **self._api.span(),
        }
        page = self._files["page.html"].decode()
        page = page.replace("{title}", html.escape(visible(self._source.title)))
        return Response(page.replace("{config}", html.escape(orjson.dumps(config).decode())), media_type="text/html")
