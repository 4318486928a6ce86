"""Services and parameters for plain scripts: the core's work on the background loop, functions run on threads."""

from __future__ import annotations

import functools
import inspect
from typing import Any, Generic, TypeVar

from reem_async.coordination import parameters, services
from reem_async.coordination.parameters import Live
from reem_async.coordination.services import Arguments, Result
from reem_async.errors import BadType

from ._twin import documented_by, ends, waits
from .connection import RedisInterface, quiet_at_exit
from .following import Following

T = TypeVar("T")


@documented_by(services.Service)
class Service(Following, Generic[Arguments, Result]):
    """A function that answers the calls of a service; `serve` of an accessor returns it.

    It serves until `close()`, the end of its `with` block, or the end of the interface. Called like the function, it
    calls the function.

    Args:
        interface: The server.
        service: The core's, which lives on the background loop.
    """

    def __init__(self, interface: RedisInterface, service: services.Service[Arguments, Result]) -> None:
        self._interface = interface
        self._core = service
        functools.update_wrapper(self, service.function, updated=())
        if services.is_async(service.function):
            raise BadType(f"{service.function!r} is a coroutine function, which a thread cannot call; use reem_async")
        self.listen()

    def __call__(self, *args: Arguments.args, **arguments: Arguments.kwargs) -> Result:
        """Call the function here, in this program."""
        return self._core(*args, **arguments)

    listen = waits(services.Service.listen)
    close = ends(services.Service.close)
    wait = ends(services.Service.wait)


@documented_by(parameters.Parameter)
class Parameter(parameters.Parameter[T]):
    """A value that is declared with type and bounds, kept current, and read without a round trip."""

    __slots__ = ("_interface",)

    def __init__(self, interface: RedisInterface, live: Live, declaration: Any) -> None:
        super().__init__(live, declaration)
        self._interface = interface

    def write(self, value: T) -> None:  # type: ignore[override]  # which does not wait in plain code
        """Publish a value."""
        self._interface._wait(self._live.write(value))

    def _assign(self, value: Any) -> None:
        self.write(value)

    def _check(self) -> None:
        if not self._live.group.is_followed:
            with quiet_at_exit():
                super()._check()


def declared(interface: RedisInterface, declaration: Any) -> Parameter[Any]:
    """Return the parameter of a declaration."""
    if inspect.iscoroutinefunction(declaration.on_change):
        raise BadType("on_change is a coroutine function, which a thread cannot call; use reem_async")
    live = interface._wait(parameters.declare(interface._followers.session, declaration))
    if declaration.on_change is not None:
        interface._calling(live.name, *parameters.changes_of(live, declaration))
    return Parameter(interface, live, declaration)
