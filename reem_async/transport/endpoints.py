"""Which transport an address asks for: one server's, a cluster's, or one that asks sentinels for the server."""

from __future__ import annotations

from typing import Any

from . import Transport
from .composite import NewTransport
from .options import Options, look_nearby

_CLUSTER = ("redis+cluster://", "rediss+cluster://")
_SENTINEL = ("redis+sentinel://", "rediss+sentinel://")


def make_transport(
    host: Any, timeout: float, options: dict[str, Any], new_transport: NewTransport
) -> tuple[Options, Transport]:
    """Return how to reach what `host` names, and the transport to it. Nothing is connected yet.

    Raises:
        BadType, BadValue: An address or an option that means nothing.
    """
    url = host if isinstance(host, str) else getattr(host, "url", "")
    if url.startswith(_CLUSTER):
        # Imported only where an address asks for it: a program for one server starts without it.
        from .cluster import ClusterOptions, ClusterTransport

        cluster = ClusterOptions(url, timeout, options)
        nodes = ClusterTransport(cluster, new_transport)
        return cluster, nodes
    if url.startswith(_SENTINEL):
        from .sentinel import SentinelOptions, SentinelTransport

        watched = SentinelOptions(url, timeout, options)
        primary = SentinelTransport(watched, new_transport)
        return watched, primary
    one = Options(host, timeout, options)
    if one.settings.get("host", "localhost") == "localhost":  # a number means TCP
        look_nearby(one)
    server = new_transport(one)
    return one, server
