"""Addresses of servers taken apart, and how a transport to one of them is made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol
from urllib.parse import urlsplit, urlunsplit

from ..errors import BadValue
from . import Transport
from .options import Options

__all__ = ["NewTransport", "ToOneServer", "address_of", "listed"]


class ToOneServer(Transport, Protocol):
    """The transport to one server."""

    def retire(self) -> bool:
        """Close the connections on which nothing is due, since no new calls will come; return whether all are closed.

        To be called again if not. One that is given back, in a blocking program, is closed then.
        """
        ...


NewTransport = Callable[[Options], ToOneServer]
"""Makes the transport to one server: on an event loop, or for plain threads."""


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
    if parts.fragment:
        raise BadValue(f"the URL has a fragment (#...); write it like {example}")
    # From the right: a password may contain an @.
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
