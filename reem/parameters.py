"""Parameters for plain scripts: the core's follow on the background loop."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

from reem_async.coordination import parameters as core
from reem_async.errors import BadType

from ._twin import documented_by
from .connection import quiet_at_exit

if TYPE_CHECKING:
    from .connection import RedisInterface


@documented_by(core.Parameter)
class Parameter(core.Parameter):
    """A value that is declared with type and bounds, kept current, and read without a round trip."""

    __slots__ = ("_interface",)

    def __init__(self, interface: RedisInterface, live: core.LiveParameter, declaration: core.Declaration) -> None:
        super().__init__(live, declaration)
        self._interface = interface

    def write(self, value: Any) -> None:  # type: ignore[override]  # which does not wait in plain code
        """Publish a value."""
        self._interface._wait(self._live.write(value))

    def _assign(self, value: Any) -> None:
        self.write(value)

    def _check(self) -> None:
        if not self._live.group.is_followed:
            with quiet_at_exit():
                super()._check()


def declared(interface: RedisInterface, declaration: core.Declaration) -> Parameter:
    """Return the parameter of a declaration."""
    if inspect.iscoroutinefunction(declaration.on_change):
        raise BadType("on_change is a coroutine function, which a thread cannot call; use reem_async")
    live = interface._wait(core.declare(interface._followers.session, declaration))
    if declaration.on_change is not None:
        interface._calling(live.name, *core.changes_of(live, declaration))
    return Parameter(interface, live, declaration)
