"""Services for plain scripts: the core's answer on the background loop, functions run on threads."""

from __future__ import annotations

import contextlib
import functools
from typing import Any

from reem_async.coordination import services as core
from reem_async.errors import BadType, InterfaceClosed

from ._twin import documented_by
from .connection import RedisInterface
from .following import Following


@documented_by(core.Service)
class Service(Following):
    """A function that answers the calls of a service; `serve` of an accessor returns it.

    It serves until `close()`, the end of its `with` block, or the end of the interface. Called like the function, it
    calls the function.

    Args:
        interface: The server.
        service: The core's, which lives on the background loop.
    """

    def __init__(self, interface: RedisInterface, service: core.Service) -> None:
        self._interface = interface
        self._core = service
        functools.update_wrapper(self, service.function, updated=())
        if core.is_async(service.function):
            raise BadType(f"{service.function!r} is a coroutine function, which a thread cannot call; use reem_async")
        self.listen()

    def __call__(self, *args: Any, **arguments: Any) -> Any:
        """Call the function here, in this program."""
        return self._core(*args, **arguments)

    def listen(self) -> None:
        """Begin to serve; when this returns, calls find it."""
        self._interface._wait(self._core.listen())

    def close(self) -> None:
        """Stop serving."""
        with contextlib.suppress(InterfaceClosed):  # whatever closed the interface has closed this too
            self._interface._wait(self._core.close())

    def wait(self) -> None:
        """Wait until it has stopped serving."""
        with contextlib.suppress(InterfaceClosed):
            self._interface._wait(self._core.wait())
