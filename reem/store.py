"""KeyValueStore and PublishSpace for plain scripts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from reem_async.store import store as core

from ._twin import FOLLOWER, calls, documented_by, makes, runs, shares
from .accessor import Accessor, PublishAccessor, known_keys
from .connection import RedisInterface
from .following import Join
from .raw import RawKeys
from .subscribe import PatternWatch


@documented_by(core.KeyValueStore)
class KeyValueStore:
    """The dictionary on the server."""

    _kind: type[core.KeyValueStore] = core.KeyValueStore
    _accessor: type[Accessor] = Accessor

    def __init__(self, interface: Any = None, **options: Any) -> None:
        if isinstance(interface, KeyValueStore):
            interface = interface.interface
        self.interface: RedisInterface
        self.interface = self._interface = (
            core.without_options(interface, options)
            if isinstance(interface, RedisInterface)
            else RedisInterface(interface, **options)
        )
        # The core's interface that suits its ships: on this thread, or on the loop if one of them has `async def`
        # methods.
        self._core = self._kind(self.interface._core)

    def __getitem__(self, key: str) -> Accessor:
        return self._accessor(self.interface, self._core[key])

    def __setitem__(self, key: str, value: Any) -> None:
        self[key]._assign(value)

    def __delitem__(self, key: str) -> None:
        self[key].delete()

    def __contains__(self, key: str) -> bool:
        return self.contains(key)

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def _follower(self) -> core.KeyValueStore:
        """Return the core's store on the background loop."""
        return type(self._core)(self.interface._followers)

    def at(self, path: str) -> Accessor:
        """Return the accessor of a dotted path."""
        return self._accessor(self.interface, self._core.at(path))

    get = runs(core.KeyValueStore.get)
    contains = runs(core.KeyValueStore.contains)
    keys = runs(core.KeyValueStore.keys)
    pop = runs(core.KeyValueStore.pop)
    update = runs(core.KeyValueStore.update)
    setdefault = runs(core.KeyValueStore.setdefault)
    set = runs(core.KeyValueStore.set)
    watch = makes(core.KeyValueStore.watch, PatternWatch, FOLLOWER)
    join = makes(core.KeyValueStore.join, Join, FOLLOWER)

    @property
    def raw(self) -> RawKeys:
        """Keys of programs without REEM, as these wrote them: `kvs.raw["sai::q"].read()`."""
        return RawKeys(self.interface)

    track_schema_changes = calls(core.KeyValueStore.track_schema_changes)
    _ipython_key_completions_ = known_keys

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface,)

    def __repr__(self) -> str:
        return f"<reem.{type(self).__name__} {self.interface.hostname}>"


@documented_by(core.PublishSpace)
class PublishSpace(KeyValueStore):
    """A store that can only be written, and that notifies subscribers of every change."""

    _accessor = PublishAccessor

    def __init__(
        self,
        interface: Any = None,
        outage: str = "raise",
        wait: bool = True,
        on_error: Callable[[Exception], object] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(interface, **options)
        self.outage = outage
        # In place of the one that KeyValueStore has made, which knows no outages; neither has sent anything.
        self._core: core.PublishSpace = core.PublishSpace(self.interface._core, outage, wait, on_error)

    flush = runs(core.PublishSpace.flush)
    dropped = shares(core.PublishSpace.dropped)
    waiting = shares(core.PublishSpace.waiting)
    watch = calls(core.PublishSpace.watch)
    join = calls(core.PublishSpace.join)
    raw: Any = shares(core.PublishSpace.raw)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, *self._core._chosen)
