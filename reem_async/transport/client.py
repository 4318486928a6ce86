"""A client of redis-py for the same server, for what REEM has no call for."""

from __future__ import annotations

import threading
from typing import Any

import redis
import redis.asyncio

from ..concurrency.locks import Inherited
from ..errors import Misuse, NoJsonSupport
from .options import Options
from .protocol import Packer

_NO_JSON = "UNKNOWN COMMAND 'JSON."
"""How the error of a server without JSON begins, in capitals; redis-py has taken its `ERR` away."""


def _in_words(error: redis.exceptions.ResponseError, command: Any) -> Exception:
    """Return an error reply, in words that help if it is that of a server without JSON."""
    if not str(error).upper().startswith(_NO_JSON):
        return error
    return NoJsonSupport(
        f"{command}: this server has no JSON, so interface.client has no JSON commands; documents are text there. "
        "Read and write them with a KeyValueStore, kvs['foo']['bar']; client.get('foo') returns the text of one"
    )


class _Client(redis.Redis):
    """With the names of rejson-py besides, which REEM 0.1 handed out: `jsonget(...)` is `json().get(...)`."""

    def jsonset(self, name: str, path: str, obj: Any, nx: bool = False, xx: bool = False) -> Any:
        """Store JSON; raises ResponseError if a parent is missing, as servers did then (they answer nil now)."""
        reply = self.json().set(name, path, obj, nx, xx)
        if reply is None and not nx and not xx:
            raise redis.exceptions.ResponseError(f"{name}: the parent of {path} is missing")
        return reply

    def parse_response(self, connection: Any, command_name: Any, **options: Any) -> Any:
        try:
            return super().parse_response(connection, command_name, **options)  # type: ignore[no-untyped-call]
        except redis.exceptions.ResponseError as error:
            raise _in_words(error, command_name) from None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("json"):
            name = name.removeprefix("json")
            return getattr(self.json(), "delete" if name == "del" else name)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")


class _AsyncioClient(redis.asyncio.Redis):
    """The same for asyncio, without rejson-py's names."""

    async def parse_response(self, connection: Any, command_name: Any, **options: Any) -> Any:
        try:
            return await super().parse_response(connection, command_name, **options)
        except redis.exceptions.ResponseError as error:
            raise _in_words(error, command_name) from None


class _Pool(redis.ConnectionPool):
    """With locks of its own in a forked child, which would find those of its parent taken for good."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        _pools.add(self)

    def _forked(self) -> None:
        for holder in filter(None, (self, getattr(self, "_event_dispatcher", None))):  # names of redis-py 8.1
            for name in {"_lock", "_fork_lock"} & vars(holder).keys():
                setattr(holder, name, threading.RLock())


_pools = Inherited(_Pool._forked)


def _settings(options: Options) -> dict[str, Any]:
    """Return how connections are made: replies are str, in the shapes of protocol 2."""
    if type(options) is not Options:
        raise Misuse(
            f"{options.address}: interface.client is for one server; use redis.RedisCluster or redis.sentinel.Sentinel"
        )
    # As redis-py comes: programs of REEM 0.1, and its documentation, expect these shapes.
    limits = {"socket_timeout": options.timeout, "socket_connect_timeout": options.handshake_timeout}
    return {**limits, **options.settings, "protocol": 2, "decode_responses": True}


def client(options: Options) -> Any:
    kind = getattr(redis.connection, options.connection_class)
    settings = {"command_packer": Packer(), **_settings(options)}
    return _Client.from_pool(_Pool(connection_class=kind, **settings))


def asyncio_client(options: Options) -> Any:
    kind = getattr(redis.asyncio.connection, options.connection_class)
    return _AsyncioClient.from_pool(redis.asyncio.ConnectionPool(connection_class=kind, **_settings(options)))
