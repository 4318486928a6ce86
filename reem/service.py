"""Services for plain scripts: the core's answer on the background loop, functions run on threads."""

from __future__ import annotations

import functools
from typing import Any

from reem_async.coordination import services as core
from reem_async.errors import BadType

from ._twin import documented_by, ends, waits
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

    listen = waits(core.Service.listen)
    close = ends(core.Service.close)
    wait = ends(core.Service.wait)
