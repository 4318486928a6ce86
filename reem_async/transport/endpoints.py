"""Which transport an address asks for: one server's, a cluster's, or one that asks sentinels for the server."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from ..errors import BadValue
from . import Transport
from .options import Options

__all__ = ["NewTransport", "address_of", "listed", "way_to"]

NewTransport = Callable[[Options], Transport]
"""Makes the transport to one server: on an event loop, or for plain threads."""

_CLUSTER = ("redis+cluster://", "rediss+cluster://")
_SENTINEL = ("redis+sentinel://", "rediss+sentinel://")


def way_to(
    host: Any, timeout: float, options: dict[str, Any], new_transport: NewTransport
) -> tuple[Options, Transport]:
    """Return how to reach what `host` names, and the transport to it; nothing is connected yet.

    Raises:
        BadType, BadValue: An address or an option that means nothing.
    """
    url = host if isinstance(host, str) else getattr(host, "url", "")
    if url.startswith(_CLUSTER):
        from .cluster import ClusterOptions, ClusterTransport

        cluster = ClusterOptions(url, timeout, options)
        return cluster, ClusterTransport(cluster, new_transport)
    if url.startswith(_SENTINEL):
        from .sentinel import SentinelOptions, SentinelTransport

        watched = SentinelOptions(url, timeout, options)
        return watched, SentinelTransport(watched, new_transport)
    one = Options(host, timeout, options)
    return one, new_transport(one)


def address_of(url: str, port: int) -> tuple[str, int]:
    """Return host and port of a plain URL; `port` if it names none."""
    parts = urlsplit(url)
    return parts.hostname or "localhost", parts.port or port


def listed(url: str, example: str) -> list[str]:
    """Return a URL that lists several hosts as one plain URL for each: redis+x://u@a:1,b:2/c as redis://u@a:1/c, ...

    Raises:
        BadValue: No host, or a port that is no number; never quotes the URL, which may hold a password.
    """
    parts = urlsplit(url)
    login, at, hosts = parts.netloc.rpartition("@")
    urls = []
    for each in hosts.split(","):
        one = urlsplit(f"//{each}")
        try:
            sound = bool(one.hostname) and (one.port is None or one.port > 0)
        except ValueError:
            sound = False
        if not sound:
            raise BadValue(f"{each!r} is not a host with a port; write it like {example}")
        urls.append(urlunsplit((parts.scheme.partition("+")[0], login + at + each, parts.path, parts.query, "")))
    return urls
