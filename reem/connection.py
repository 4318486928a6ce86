"""RedisInterface for plain scripts: the core's, with blocking calls."""

from __future__ import annotations

import atexit
import contextlib
import os
import threading
import weakref
from collections.abc import Coroutine, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

import reem_async
from reem_async.ships.base import SpecialDatatypeShip
from reem_async.transport import Transport
from reem_async.transport.blocking import BlockingTransport

from ._portal import Portal, finish
from ._twin import documented_by

__all__ = ["RedisInterface"]

Result = TypeVar("Result")


class _OnThread(reem_async.RedisInterface):
    """The core's interface over connections that the caller's own thread drives."""

    def _new_transport(self) -> Transport:
        return BlockingTransport(self.options)


@documented_by(reem_async.RedisInterface)
class RedisInterface:
    """A connection to one server; everything else is made from it.

    Nothing is connected before the first call that needs it. Any number of threads may share it:
    reads and writes run on the caller's thread over a connection of their own. Subscriptions and
    ships with `async def` methods run on a background event loop, one daemon thread per interface,
    started when first needed and ended by `close()` or at exit.

    Args:
        host: A host name, a URL (`redis://`, `rediss://`, `unix://`) or an `EmbeddedServer`.
        ships: What carries values that are not JSON, first fit first; replaces the default list of
            `NumpyShip` and `BytesShip`.
        namespace: Goes before every key and channel, so that several robots can share a server.
        timeout: Seconds without a byte received after which a call is given up.
        options: redis-py's connection options: `port`, `db`, `username`, `password`, `ssl`, ...

    Raises:
        BadType, BadValue: An option or URL that means nothing.
    """

    def __init__(
        self,
        host: Any = "localhost",
        ships: Sequence[SpecialDatatypeShip] | None = None,
        *,
        namespace: str = "",
        timeout: float = 1.0,
        **options: Any,
    ) -> None:
        settings = {"namespace": namespace, "timeout": timeout, **options}
        self._direct = _OnThread(host, ships, **settings)
        self._lock = threading.RLock()
        self._looped: tuple[int, Portal, reem_async.RedisInterface] | None = None
        _open.add(self)

    @property
    def hostname(self) -> str:
        """Where the server is, without credentials."""
        return self._direct.hostname

    @property
    def namespace(self) -> str:
        """What goes before every key and channel."""
        return self._direct.namespace

    @property
    def core(self) -> reem_async.RedisInterface:
        """The core's interface that stores are made from."""
        return self._background()[1] if self._direct.ships.asynchronous else self._direct

    @property
    def followers(self) -> reem_async.RedisInterface:
        """The core's interface that subscribers are made from: it lives on the background loop."""
        return self._background()[1]

    def _background(self) -> tuple[Portal, reem_async.RedisInterface]:
        with self._lock:
            self._direct.transport.check()
            if self._looped is None or self._looped[0] != os.getpid():  # threads do not survive a fork
                self._looped = os.getpid(), Portal("reem-loop"), self._direct.twin()
            return self._looped[1:]

    def run(self, coroutine: Coroutine[Any, Any, Result]) -> Result:
        """Run one of the core's coroutines on a store to its end and return the result."""
        looped = self._looped
        if self._direct.ships.asynchronous or (looped is not None and looped[1].inside):
            return self.wait(coroutine)
        return finish(coroutine)

    def wait(self, coroutine: Coroutine[Any, Any, Result]) -> Result:
        """Run one of the core's coroutines on the background loop and return the result."""
        return self._background()[0].call(coroutine)

    def initialize(self) -> None:
        """Connect now and check the server."""
        self.run(self.core.initialize())

    def close(self) -> None:
        """End all subscriptions and close all connections."""
        finish(self._direct.close())
        with self._lock:
            looped, self._looped = self._looped, None
        if looped is not None and looped[0] == os.getpid():
            with contextlib.suppress(TimeoutError):
                looped[1].call(looped[2].close(), timeout=1.0)
            looped[1].stop()

    def __enter__(self) -> Self:
        self.initialize()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        rebuild, (_, *given) = self._direct.__reduce__()
        return rebuild, (type(self), *given)

    def __repr__(self) -> str:
        return f"<reem.RedisInterface {self.hostname}>"


_open: weakref.WeakSet[RedisInterface] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Close what was left open, so that the program ends without a word."""
    for interface in list(_open):
        with contextlib.suppress(Exception):
            interface.close()
