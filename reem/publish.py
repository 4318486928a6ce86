"""Publishing for plain scripts."""

from __future__ import annotations

from typing import Any

from reem_async.store import publish as core

from ._twin import documented_by
from .accessor import PublishAccessor
from .store import KeyValueStore


@documented_by(core.PublishSpace)
class PublishSpace(KeyValueStore):
    """A store that can only be written, and that notifies subscribers of every change."""

    _accessor = PublishAccessor

    def __init__(self, interface: Any = None, outage: str = "raise", **options: Any) -> None:
        super().__init__(interface, **options)
        self.outage = outage
        # In place of the one that KeyValueStore has made, which knows no outages; neither has sent anything.
        self._core: core.PublishSpace = core.PublishSpace(self.interface._core, outage)

    @property
    def dropped(self) -> int:
        """How many updates this has not published because of outages, or not for certain."""
        return self._core.dropped

    @property
    def waiting(self) -> int:
        """How many updates are kept until the server is back, or on their way then and not answered yet."""
        return self._core.waiting

    def watch(self, *patterns: str, policy: Any = None, largest: int | None = None) -> Any:
        """Raise WriteOnly."""
        return self._core.watch(*patterns, policy=policy, largest=largest)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, self.outage)
