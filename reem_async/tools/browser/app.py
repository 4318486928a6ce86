"""The application: access checks, the pages and files, and the server that runs it on a port until Ctrl-C."""

from __future__ import annotations

import contextlib
import html
import ipaddress
import mimetypes
import secrets
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Collection
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

import anyio
import orjson
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ...errors import BadKey, ServerFailed
from .api import Api, Events
from .arrays import Arrays
from .saving import Saving
from .source import Source, path_of, visible

# Access checks: the Host header, the token, where a request comes from, and what answers carry.


LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})  # the names under which a browser on this machine reaches it
_COOKIE = "reem_browse_"  # its name ends with the port: browsers send the cookies of a host to all its ports
_LONGEST_URL = 48_000  # characters: a page asks for all its open branches in one
_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}


def own_names() -> frozenset[str]:
    """Return the names of this machine, beside its addresses, that a browser elsewhere may use."""
    name = socket.gethostname().lower()
    return LOOPBACK | {name, name.partition(".")[0], f"{name.partition('.')[0]}.local", socket.getfqdn().lower()}


def own_address(bound: str) -> str:
    """Return the address of this machine at which others reach what is bound to all of them; nothing is sent.

    Which one the kernel would use to reach the world; without any network, the name of this machine.
    """
    family, far = (socket.AF_INET6, "2001:db8::1") if ":" in bound else (socket.AF_INET, "192.0.2.1")
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.connect((far, 9))  # of a datagram socket, only a choice of addresses
        return str(probe.getsockname()[0])
    return socket.gethostname()


class Guard:
    """Wraps an ASGI application; refuses before anything is read or done.

    A page of another site can make a browser send requests here. With a name of its own that leads to
    this address (DNS rebinding) it could read the answers too: hence the check of the Host header. No other site can
    have an IP address as its name. The first URL must carry the token, and a cookie thereafter; None for no token.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str], addresses: bool, token: str | None) -> None:
        self._app = app
        self._hosts = hosts
        self._addresses = addresses
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":  # there are no websockets here
            await send({"type": "websocket.close", "code": 1008})
            return

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers[name] = value
                headers.setdefault("cache-control", "no-store")
            await send(message)

        refusal = self._refusal(scope)
        await (refusal or self._app)(scope, receive, send_safely)

    def _refusal(self, scope: Scope) -> Response | None:
        # First the check of what costs most, then of where the request comes from, then of its token.
        headers = Headers(scope=scope)
        if len(scope["query_string"]) + len(scope["path"]) > _LONGEST_URL:
            return PlainTextResponse("This address is too long.\n", 414)
        if not self._is_own(headers.get("host", "")):
            return PlainTextResponse("This is not the address of this program.\n", 421)
        # Another site may lead to the first page, which asks the server nothing, and to nothing else.
        opens = headers.get("sec-fetch-mode") == "navigate" and scope["path"] == "/"
        if headers.get("sec-fetch-site") == "cross-site" and not opens:
            return PlainTextResponse("Another site asked for this. Open this program's first page instead.\n", 403)
        return self._unknown(scope, headers) if self._token is not None else None

    def _is_own(self, header: str) -> bool:
        # The port is not compared: a tunnel may have changed it, and it does not tell sites apart here.
        bracketed = header.startswith("[")  # an IPv6 address
        host = (header[1:].partition("]")[0] if bracketed else header.partition(":")[0]).lower().removesuffix(".")
        return host in self._hosts or (self._addresses and _is_address(host))

    def _unknown(self, scope: Scope, headers: Headers) -> Response | None:
        """Return the answer to a request without the right cookie; None if the cookie is right."""
        query = parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)
        offered = dict(query).get("token")
        if offered is not None and self._fits(offered) and scope["method"] == "GET":
            # The token leaves the address at once: it would stay in the history of the browser and on the screen.
            rest = urlencode([(name, value) for name, value in query if name != "token"])
            path = scope.get("raw_path", b"/").partition(b"?")[0].decode("latin-1")
            # Two slashes at the beginning would lead to another server.
            answer = RedirectResponse("/" + path.lstrip("/") + (f"?{rest}" if rest else ""), 303)
            answer.set_cookie(_cookie_name(headers), self._token or "", httponly=True, samesite="strict", path="/")
            return answer
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(_cookie_name(headers))
        except CookieError:
            cookie = None
        if cookie is not None and self._fits(cookie.value):
            return None
        return PlainTextResponse("Open the address that `reem browse` printed: it has a token in it.\n", 403)

    def _fits(self, offered: str) -> bool:
        return secrets.compare_digest(offered.encode(errors="replace"), (self._token or "").encode())


def _cookie_name(headers: Headers) -> str:
    """Return the name of the cookie for the port that the browser sees, which a tunnel may have changed."""
    port = headers.get("host", "").rpartition(":")[2]
    return _COOKIE + (port if port.isascii() and port.isdecimal() else "")


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


class CancelledWithPage:
    """Wraps the answers to what pages ask; cancels one for which no page waits any more, such as of a closed view."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "GET" or scope["path"].endswith("/events"):
            await self._app(scope, receive, send)  # events go on until the page has gone
            return

        async def watch() -> None:
            while (await receive())["type"] != "http.disconnect":
                pass
            tasks.cancel_scope.cancel()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(watch)
            await self._app(scope, _nothing, send)
            tasks.cancel_scope.cancel()


async def _nothing() -> Message:
    """Wait until cancelled: the request has been read, and `CancelledWithPage` detects that its page has gone."""
    await anyio.sleep_forever()
    return {"type": "http.disconnect"}


# Running the application on a port.

_GRACE_SECONDS = 2  # for requests that are being answered when the program ends


class PageServer(uvicorn.Server):
    """Answers requests on a bound socket: what `listen` returned, closed at the end."""

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
    """Return a socket bound to a port, 0 for a free one; raises ServerFailed."""
    try:
        family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        # asyncio turns Nagle's algorithm off, 40 ms for each answer, where it sees that this is TCP.
        sock = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(place)
            sock.listen(128)  # connections from now on are served, if a little later
        except OSError:
            sock.close()
            raise
    except OSError as error:
        raise ServerFailed(
            f"cannot listen on {host} port {port}: {error.strerror}; use another --host or --port"
        ) from None
    return sock


# The application.

_FOLDER = Path(__file__).parent
mimetypes.add_type("text/javascript", ".js")  # Python 3.11 has another type, and some systems have none


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
    api = Api(source, allow_write)
    view = _view(source, api)

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
    routes += Saving(source).routes()
    app.router.routes.extend(
        [
            Route("/", view, methods=["GET"]),
            Route("/view/{where:path}", view, methods=["GET"]),
            Mount("/static", StaticFiles(directory=_FOLDER / "static")),
            Mount("/api", routes=routes, middleware=[] if source.live else [Middleware(CancelledWithPage)]),
        ]
    )
    app.user_middleware.append(Middleware(Guard, hosts=frozenset(hosts), addresses=any_address, token=token))
    return app


def _view(source: Source, api: Api) -> Callable[[Request], Awaitable[Response]]:
    """Return what answers with the one page, in which the scripts show what its address says."""
    template = (_FOLDER / "page.html").read_text(encoding="utf-8")
    template = template.replace("{title}", html.escape(visible(source.title)))

    async def view(request: Request) -> Response:
        try:
            path_of(request.path_params.get("where", ""))
        except BadKey as error:
            return PlainTextResponse(f"{visible(str(error))}\n", 404)
        config: dict[str, Any] = {
            "title": source.title,
            "live": source.live,
            "write": api.allow_write,
            "key": api.key,
            **source.status()._asdict(),
        }
        return HTMLResponse(template.replace("{config}", html.escape(orjson.dumps(config).decode())))

    return view
