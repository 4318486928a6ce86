"""Where the server is and how to log in; making connections with redis-py's own handshake.

redis-py does what is easy to get wrong (AUTH, TLS, SELECT, CLIENT SETINFO). Once it is done, the
transports of this package take the socket over, since its reading and writing are what costs time.
"""

from __future__ import annotations

import os
from typing import Any

import redis
import redis.asyncio
import redis.exceptions
from redis.asyncio.connection import parse_url

from ..errors import BadType, BadValue, NotConnected, ReemError

__all__ = ["Options"]

_SCHEMES = ("redis://", "rediss://", "unix://")


class Options:
    """How to reach one server.

    Args:
        host: A host name, a URL (`redis://`, `rediss://`, `unix://`), or an `EmbeddedServer`.
        timeout: Seconds without a byte moving after which a call is given up.
        options: redis-py's connection options (`port`, `db`, `username`, `password`, `ssl`, ...).

    Raises:
        BadValue: A URL that cannot be parsed.
        BadType: An option that redis-py does not know.
    """

    def __init__(self, host: Any, timeout: float, options: dict[str, Any]) -> None:
        self.timeout = timeout
        self.settings = {**_address(host), **options}
        if self.settings.setdefault("protocol", 3) not in (3, "3"):
            raise BadValue("REEM speaks protocol 3 (notices and replies share a connection); leave protocol= out")
        self.handshake_timeout = max(timeout, 1.0)
        self.settings.setdefault("socket_connect_timeout", self.handshake_timeout)
        self.tls = bool(self.settings.pop("ssl", False))
        self.socket_path: str | None = self.settings.pop("unix_socket_path", self.settings.pop("path", None))
        if self.socket_path is not None:
            self.settings.pop("host", None)
            self.settings.pop("port", None)
        try:
            self.asynchronous_connection()
            self.blocking_connection()
        except TypeError as error:
            raise BadType(f"RedisInterface: {error}; see redis-py's connection options") from None

    @property
    def database(self) -> int:
        """The number of the database."""
        return int(self.settings.get("db") or 0)

    @property
    def address(self) -> str:
        """Where the server is, for messages: never a password."""
        return self.socket_path or f"{self.settings.get('host', 'localhost')}:{self.settings.get('port', 6379)}"

    def asynchronous_connection(self) -> Any:
        """Return a fresh connection of redis.asyncio, not yet connected."""
        module: Any = redis.asyncio.connection
        # No timeout of redis-py's own: its wait_for can swallow a cancellation before Python 3.12.
        settings = {"socket_timeout": None, **self.settings}
        if self.socket_path is not None:
            return module.UnixDomainSocketConnection(path=self.socket_path, **settings)
        return (module.SSLConnection if self.tls else module.Connection)(**settings)

    def blocking_connection(self) -> Any:
        """Return a fresh connection of redis, not yet connected."""
        module: Any = redis.connection
        settings = {"socket_timeout": self.handshake_timeout, **self.settings}
        if self.socket_path is not None:
            return module.UnixDomainSocketConnection(path=self.socket_path, **settings)
        return (module.SSLConnection if self.tls else module.Connection)(**settings)

    def refused(self, error: Exception) -> Exception:
        """Return the error to raise when connecting failed with `error`."""
        if "HELLO must be called" in str(error) or "NOAUTH" in str(error):
            return redis.exceptions.AuthenticationError(
                f"the server at {self.address} needs a password: RedisInterface(..., username=..., password=...)"
            )
        if isinstance(error, redis.exceptions.AuthenticationError | ReemError):
            return error
        reason = error.__cause__ if isinstance(error.__cause__, OSError) else error
        if isinstance(error, redis.exceptions.ResponseError):
            return error
        return NotConnected(
            f"no server answers at {self.address} ({_shown(reason)}); start one with `reem up` or with "
            "compose.yaml, or pass the right address: RedisInterface('redis://host:port')"
        )


def _shown(error: BaseException) -> str:
    if isinstance(error, OSError) and error.errno is not None:
        return os.strerror(error.errno) if error.errno > 0 else str(error)
    return str(error) or type(error).__name__


def _address(host: Any) -> dict[str, Any]:
    """Return the connection settings that `host` stands for."""
    socket_path = getattr(host, "socket_path", None)
    if socket_path is not None:
        password = getattr(host, "password", None)
        return {"unix_socket_path": str(socket_path)} | ({"password": password} if password else {})
    if not isinstance(host, str):
        raise BadType(f"host is a name, a URL or an EmbeddedServer, not {type(host).__name__}")
    if "://" not in host:
        return {"host": host}
    if not host.startswith(_SCHEMES):
        raise BadValue(f"the URL of a server begins with one of {', '.join(_SCHEMES)}")
    try:
        settings: dict[str, Any] = {**parse_url(host)}
    except ValueError:  # its text may hold a part of the password
        raise BadValue(
            "the URL of the server is wrong; write it like redis://user:password@host:6379/0, special characters "
            "of the password percent-encoded"
        ) from None
    if settings.pop("connection_class", None) is redis.asyncio.connection.SSLConnection:
        settings["ssl"] = True
    return settings
