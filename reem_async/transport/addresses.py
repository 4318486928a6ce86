"""Addresses of servers, taken apart."""

from __future__ import annotations

import re
from typing import Any
from urllib.parse import SplitResult, parse_qsl, urlsplit, urlunsplit

import redis.asyncio
from redis.asyncio.connection import parse_url

from ..errors import BadType, BadValue

_SCHEMES = ("redis://", "rediss://", "unix://")


def settings_of(host: Any) -> dict[str, Any]:
    socket_path = getattr(host, "socket_path", None)
    if socket_path is not None:
        password = getattr(host, "password", None)
        return {"unix_socket_path": str(socket_path)} | ({"password": password} if password else {})
    if not isinstance(host, str):
        raise BadType(f"host is a name, a URL or an EmbeddedServer, not {type(host).__name__}")
    if "://" not in host:
        if "@" in host:
            raise BadValue("host is a name alone; user and password go in username=, password= or in a URL, redis://")
        return _host_and_port(host)
    if not host.startswith(_SCHEMES):
        raise BadValue(f"the URL of a server begins with one of {', '.join(_SCHEMES)}")
    try:
        _check_url(host)
        settings: dict[str, Any] = {**parse_url(host)}
    except BadValue:  # it names the part that is wrong
        raise
    except ValueError:  # its text may hold a part of the password
        raise BadValue(
            "the URL of the server is wrong; write it like redis://user:password@host:6379/0, special characters "
            "of the password percent-encoded"
        ) from None
    if settings.pop("connection_class", None) is redis.asyncio.connection.SSLConnection:
        settings["ssl"] = True
    return settings


def _host_and_port(host: str) -> dict[str, Any]:
    """Return the connection settings of `host`, `host:port`, `[IPv6]:port`, or an IPv6 address alone."""
    if ":" not in host or (host.count(":") > 1 and not host.startswith("[")):
        return {"host": host}
    try:
        parts = urlsplit(f"//{host}")
        if parts.netloc == host and parts.hostname and parts.port:
            return {"host": parts.hostname, "port": parts.port}
    except ValueError:
        pass
    raise BadValue(f"{host!r} is not a host with a port; write it like localhost:6379 or [::1]:6379")


def _check_url(url: str) -> None:
    """Refuse the parts of a server's URL that redis-py drops in silence: another server would be meant.

    Raises BadValue, whose message never quotes user and password.
    """
    parts = _split(url)
    login, _, place = parts.netloc.rpartition("@")
    problem, form = "", f"{parts.scheme}://{'user:password@' if login else ''}host:6379/0"
    if parts.scheme == "unix":
        form = "unix:///run/redis.sock?db=0"
        if place:
            problem = f"{place!r} stands in the place of a host; a path begins with three slashes"
        elif parts.path in ("", "/"):
            problem = "it has no path of a socket"
    elif not re.fullmatch(r"/?|/[0-9]+/?", parts.path):
        problem = f"{parts.path!r} is not the number of a database"
    elif "," in place:
        problem, form = (
            "it lists several hosts",
            "redis+cluster://host:7000,host:7001 or redis+sentinel://host:26379/name",
        )
    elif place.endswith((":", ":0")) or re.search(r"\s", place):
        problem = f"{place!r} is not a host with a port"
    if "#" in url.rpartition("@")[2]:
        problem = "it has a fragment (#...)"
    databases = [value for name, value in parse_qsl(parts.query, keep_blank_values=True) if name == "db"]
    if any(not re.fullmatch("[0-9]+", value) for value in databases):
        problem = f"db={databases[0]!r} is not the number of a database"
    elif len({*databases, parts.path.strip("/") if parts.scheme != "unix" else ""} - {""}) > 1:
        problem = "it names two databases"
    if problem:
        raise BadValue(f"the URL of the server is wrong: {problem}; write it like {form}")


def _split(url: str) -> SplitResult:
    """Return the parts of a URL; raise BadValue for one with half an IPv6 address, and never quote it."""
    try:
        return urlsplit(url)
    except ValueError:
        raise BadValue("the URL of the server is wrong: an IPv6 address is written like redis://[::1]:6379/0") from None


def address_of(url: str, port: int) -> tuple[str, int]:
    """Return host and port of a plain URL; `port` if it names none."""
    parts = urlsplit(url)
    return parts.hostname or "localhost", parts.port or port


def listed(url: str, example: str) -> list[str]:
    """Return a URL that lists several hosts as one plain URL for each: redis+x://u@a:1,b:2/c as redis://u@a:1/c, ...

    Raises:
        BadValue: No host, or a port that is no number; never quotes the URL, which may hold a password.
    """
    parts = _split(url)
    if parts.fragment:
        raise BadValue(f"the URL has a fragment (#...); write it like {example}")
    # From the right: a password may contain an @.
    login, at, hosts = parts.netloc.rpartition("@")
    if "," in login.partition("@")[2]:
        raise BadValue(f"the URL has a user for each host; one user has all hosts, write it like {example}")
    urls = []
    for each in hosts.split(","):
        try:
            one = urlsplit(f"//{each}")
            sound = bool(one.hostname) and (one.port is None or one.port > 0)
        except ValueError:
            sound = False
        if not sound:
            raise BadValue(f"{each!r} is not a host with a port; write it like {example}")
        urls.append(urlunsplit((parts.scheme.partition("+")[0], login + at + each, parts.path, parts.query, "")))
    return urls
