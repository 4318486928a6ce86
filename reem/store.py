"""KeyValueStore, Reader and Writer for plain scripts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from reem_async import store as core

from ._twin import documented_by
from .accessor import Accessor
from .connection import RedisInterface

__all__ = ["KeyValueStore", "Reader", "Writer"]


@documented_by(core.Reader)
class Reader:
    """Reads one top-level key.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.top_key_name = top_key_name
        self._core = core.Reader(top_key_name, interface._core)

    def read_from_redis(self, read_path: str) -> Any:
        """Return the value at a path like ".a.b"."""
        return self.interface._run(self._core.read_from_redis(read_path))


@documented_by(core.Writer)
class Writer:
    """Writes one top-level key.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    _kind: type[core.Writer] = core.Writer

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.top_key_name = top_key_name
        self._core = self._kind(top_key_name, interface._core)

    def send_to_redis(self, set_path: str, set_value: Any) -> None:
        """Store a value at a path like ".a.b"."""
        self.interface._run(self._core.send_to_redis(set_path, set_value))


@documented_by(core.KeyValueStore)
class KeyValueStore:
    """The dictionary on the server.

    `kvs["foo"] = value` and `kvs["foo"]["bar"] = value` write; `kvs["foo"]["bar"]` alone is an
    `Accessor`, a path that is read with `read()`.

    Args:
        interface: The server: a RedisInterface, another store, or what RedisInterface takes as host.
    """

    _kind: type[core.KeyValueStore] = core.KeyValueStore
    _accessor: type[Accessor] = Accessor

    def __init__(self, interface: Any = "localhost") -> None:
        if isinstance(interface, KeyValueStore):
            interface = interface.interface
        self.interface: RedisInterface = (
            interface if isinstance(interface, RedisInterface) else RedisInterface(interface)
        )
        self._core = self._kind(self.interface._core)

    def __getitem__(self, key: str) -> Accessor:
        return self._accessor(self.interface, self._core[key])

    def __setitem__(self, key: str, value: Any) -> None:
        self[key]._assign(value)

    def __delitem__(self, key: str) -> None:
        self[key].delete()

    __iter__ = None
    __contains__ = None

    def at(self, path: str) -> Accessor:
        """Return the accessor of a dotted path."""
        return self._accessor(self.interface, self._core.at(path))

    def get(self, path: str, default: Any = core._NOTHING) -> Any:
        """Return the value at a dotted path."""
        return self.interface._run(self._core.get(path, default))

    def keys(self, pattern: str = "*") -> list[str]:
        """Return the top-level keys, sorted."""
        return self.interface._run(self._core.keys(pattern))

    def set(self, path: str, value: Any) -> None:
        """Store `value` at a dotted path."""
        self.interface._run(self._core.set(path, value))

    def track_schema_changes(self, set_value: bool, keys: Iterable[str] | None = None) -> None:
        """Say whether the shape of what is written may change."""
        self._core.track_schema_changes(set_value, keys)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface,)

    def __repr__(self) -> str:
        return f"<reem.{type(self).__name__} {self.interface.hostname}>"
