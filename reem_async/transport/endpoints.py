"""Which transport an address asks for: one server's, a cluster's, or one that asks sentinels for the server."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..errors import BadType, BadValue
from . import Transport
from .addresses import NewTransport
from .nearby import look_nearby
from .options import Options

if TYPE_CHECKING:
    from .replicas import Replicated

__all__ = ["way_to"]

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
        # Imported only where an address asks for it: a program for one server starts without it.
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
