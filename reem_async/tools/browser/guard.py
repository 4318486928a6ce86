"""Who may ask: the Host header, the token, where a request comes from, and what answers carry."""

from __future__ import annotations

import contextlib
import ipaddress
import secrets
import socket
from collections.abc import Collection
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, urlencode

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["LOOPBACK", "Guard", "is_loopback", "new_token", "own_address", "own_names", "same_origin"]

LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
"""The names under which a browser on this machine reaches it."""

_COOKIE = "reem_browse_"
"""Its name ends with the port: browsers send the cookies of a host to all its ports."""

_LONGEST_URL = 48_000
"""Characters: a page asks for all its open branches in one."""

_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}


def new_token() -> str:
    """Return a token that cannot be guessed."""
    return secrets.token_urlsafe(24)


def is_loopback(host: str) -> bool:
    """Return whether only programs of this machine can reach what is bound to `host`."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


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


def same_origin(headers: Headers) -> bool:
    """Return whether the page that sends a request came from here: both headers are set by the browser."""
    origin, site = headers.get("origin", ""), headers.get("sec-fetch-site", "same-origin")
    return site == "same-origin" and origin.partition("://")[2] == headers.get("host", "") != ""


class Guard:
    """Wraps an ASGI application; refuses before anything is read or done.

    A page of another site can make a browser send requests here. With a name of its own that leads to
    this address (DNS rebinding) it could read the answers too: hence the check of the Host header.

    Args:
        app: What is guarded.
        hosts: The names that a Host header may have.
        addresses: Any IP address may be in the Host header as well: no other site can have one as its name.
        token: What the first URL must carry and a cookie thereafter; None for no token.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str], addresses: bool, token: str | None) -> None:
        self._app = app
        self._hosts = hosts
        self._addresses = addresses
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or hand it on."""
        # There are no websockets here.
        if scope["type"] != "http":
            await (self._app(scope, receive, send) if scope["type"] == "lifespan" else _close(send))
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
        # In order: what costs most if it is let through first, then who is asking, then whether he may.
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
        """Return what to answer to somebody whose cookie is not right."""
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


async def _close(send: Send) -> None:
    await send({"type": "websocket.close", "code": 1008})
