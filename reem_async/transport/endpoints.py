"""Which transport an address asks for: one server's, a cluster's, or one that asks sentinels for the server."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit, urlunsplit

from ..errors import BadType, BadValue
from . import Transport
from .nearby import look_nearby
from .options import Options

if TYPE_CHECKING:
    from .replicas import Replicated

__all__ = ["NewTransport", "address_of", "listed", "way_to"]

NewTransport = Callable[[Options], Transport]
"""Makes the transport to one server: on an event loop, or for plain threads."""

_CLUSTER = ("redis+cluster://", "rediss+cluster://")
_SENTINEL = ("redis+sentinel://", "rediss+sentinel://")


def way_to(
    host: Any, timeout: float, options: dict[str, Any], new_transport: NewTransport, *, replicas: bool = False
) -> tuple[Options, Transport, Transport]:
    """Return how to reach what `host` names, the transport to it, and the one for what a user only reads.

    The latter is the same unless `replicas` are to be read from. Nothing is connected yet.

    Raises:
        BadType, BadValue: An address or an option that means nothing.
    """
    if not isinstance(replicas, bool):
        raise BadType(f"read_from_replicas={replicas!r} is not True or False")
    url = host if isinstance(host, str) else getattr(host, "url", "")
    if url.startswith(_CLUSTER):
        from .cluster import ClusterOptions, ClusterTransport

        cluster = ClusterOptions(url, timeout, options)
        nodes = ClusterTransport(cluster, new_transport)
        return cluster, nodes, _readers(nodes, cluster, new_transport) if replicas else nodes
    if url.startswith(_SENTINEL):
        from .sentinel import SentinelOptions, SentinelTransport

        watched = SentinelOptions(url, timeout, options)
        primary = SentinelTransport(watched, new_transport)
        return watched, primary, _readers(primary, watched, new_transport) if replicas else primary
    if replicas:
        raise BadValue(
            "read_from_replicas=True: the address of one server does not tell of its replicas; use "
            "redis+cluster://host:port,host:port or redis+sentinel://host:26379/mymaster, or connect to the replica"
        )
    one = Options(host, timeout, options)
    if one.settings.get("host", "localhost") == "localhost":  # a number means TCP
        look_nearby(one)
    server = new_transport(one)
    return one, server, server


def _readers(primaries: Replicated, options: Options, new_transport: NewTransport) -> Transport:
    from .replicas import Readers

    return Readers(primaries, options, new_transport)


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
