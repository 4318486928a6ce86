"""KeyValueStore and PublishSpace for plain scripts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from reem_async.concurrency.queues import Policy
from reem_async.errors import RedisError, ReemError
from reem_async.store import space
from reem_async.store import store as core

from ._twin import documented_by
from .accessor import Accessor, PublishAccessor
from .connection import RedisInterface
from .subscribe import PatternWatch


@documented_by(core.KeyValueStore)
class KeyValueStore:
    """The dictionary on the server.

    `kvs["foo"] = value` and `kvs["foo"]["bar"] = value` write; `kvs["foo"]["bar"]` alone is an
    `Accessor`, a path that is read with `read()`.
    """

    _kind: type[core.KeyValueStore] = core.KeyValueStore
    _accessor: type[Accessor] = Accessor

    def __init__(self, interface: Any = None, **options: Any) -> None:
        if isinstance(interface, KeyValueStore):
            interface = interface.interface
        self.interface: RedisInterface = (
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

    def _ipython_key_completions_(self) -> list[str]:
        """Return the keys that IPython offers after `["`; none where they cannot be had."""
        try:
            return self.keys()
        except (ReemError, RedisError):
            return []

    def at(self, path: str) -> Accessor:
        """Return the accessor of a dotted path."""
        return self._accessor(self.interface, self._core.at(path))

    def get(self, path: str, default: Any = core._NOTHING) -> Any:
        """Return the value at a dotted path."""
        return self.interface._run(self._core.get(path, default))

    def contains(self, key: str) -> bool:
        """Return whether a top-level key is there; also `key in store`."""
        return self.interface._run(self._core.contains(key))

    def keys(self, pattern: str = "*") -> list[str]:
        """Return the top-level keys, sorted."""
        return self.interface._run(self._core.keys(pattern))

    def pop(self, key: str, *default: Any) -> Any:
        """Remove a top-level key and return what it held."""
        return self.interface._run(self._core.pop(key, *default))

    def update(self, values: Mapping[str, Any] | Iterable[tuple[str, Any]] = (), /, **more: Any) -> None:
        """Store several top-level keys."""
        self.interface._run(self._core.update(values, **more))

    def setdefault(self, key: str, default: Any = None) -> Any:
        """Return the value of a top-level key, stored first where there was none."""
        return self.interface._run(self._core.setdefault(key, default))

    def set(self, path: str, value: Any) -> None:
        """Store `value` at a dotted path."""
        self.interface._run(self._core.set(path, value))

    def watch(self, *patterns: str, policy: Policy | None = None, largest: int | None = None) -> PatternWatch:
        """Return an iterator over every change of all keys that some patterns name."""
        return PatternWatch(self.interface, patterns, policy, largest=largest)

    def track_schema_changes(
        self, set_value: bool | None = None, keys: Iterable[str] | None = None, *, track: bool | None = None
    ) -> None:
        """Do nothing: a switch of the first REEM."""
        self._core.track_schema_changes(set_value, keys, track=track)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface,)

    def __repr__(self) -> str:
        return f"<reem.{type(self).__name__} {self.interface.hostname}>"


@documented_by(space.PublishSpace)
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
        self._core: space.PublishSpace = space.PublishSpace(self.interface._core, outage, wait, on_error)

    def flush(self, timeout: float | None = None) -> None:
        """Wait until the updates of all calls so far are stored or dropped."""
        self.interface._run(self._core.flush(timeout))

    @property
    def dropped(self) -> int:
        """How many updates this has not published, or not for certain: because of outages, or of `wait=False`."""
        return self._core.dropped

    @property
    def waiting(self) -> int:
        """How many updates are queued, or kept until the server is back, or on their way and not answered yet."""
        return self._core.waiting

    def watch(self, *patterns: str, policy: Any = None, largest: int | None = None) -> Any:
        """Raise WriteOnly."""
        return self._core.watch(*patterns, policy=policy, largest=largest)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, *self._core._chosen)
