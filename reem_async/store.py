"""KeyValueStore, the dictionary on the server, and the documented Reader and Writer of one of its keys."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from .accessor import Accessor
from .connection import RedisInterface
from .document import DocumentReader, DocumentWriter
from .errors import BadType, MissingKey
from .plan.paths import parse

__all__ = ["KeyValueStore", "Reader", "Writer"]

_NOTHING: Any = object()


class Reader:
    """Reads one top-level key.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.top_key_name = top_key_name
        self._document = DocumentReader(interface.session, top_key_name)

    async def read_from_redis(self, read_path: str) -> Any:
        """Return the value at a path like ".a.b" (or "." for all); see `Accessor.read`."""
        return await self._document.read(parse(read_path))


class Writer:
    """Writes one top-level key.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    _kind = DocumentWriter

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.top_key_name = top_key_name
        self._document = self._kind(interface.session, top_key_name)

    async def send_to_redis(self, set_path: str, set_value: Any) -> None:
        """Store a value at a path like ".a.b" (or "." for all); see `Accessor.write`."""
        await self._document.set(parse(set_path), set_value)


class KeyValueStore:
    """The dictionary on the server.

    `kvs["foo"]["bar"]` is an `Accessor`: a path, nothing is sent yet; `await` its `read()`,
    `write(value)` and so on.

    Args:
        interface: The server: a RedisInterface, another store, or what RedisInterface takes as host.
    """

    _accessor: type[Accessor] = Accessor
    _writer: type[DocumentWriter] = DocumentWriter

    def __init__(self, interface: Any = "localhost") -> None:
        if isinstance(interface, KeyValueStore):
            interface = interface.interface
        self.interface: RedisInterface = (
            interface if isinstance(interface, RedisInterface) else RedisInterface(interface)
        )
        self._tops: dict[str, Accessor] = {}
        self._static = False

    def __getitem__(self, key: str) -> Accessor:
        return self._top(key)

    def _top(self, key: object) -> Accessor:
        if type(key) is str and (known := self._tops.get(key)) is not None:
            return known
        session = self.interface.session
        name = session.keys(key).name
        writer = self._writer(session, name)
        writer.static = self._static
        return self._tops.setdefault(name, self._accessor(DocumentReader(session, name), writer, ()))

    def __setitem__(self, key: str, value: Any) -> None:
        raise BadType(f"assignment cannot wait for the server; use: await store[{key!r}].write(value)")

    def __delitem__(self, key: str) -> None:
        raise BadType(f"del cannot wait for the server; use: await store[{key!r}].delete()")

    __iter__ = None
    __contains__ = None

    def at(self, path: str) -> Accessor:
        """Return the accessor of a dotted path such as "foo.bar" or "foo.tiles[2]"; sends nothing."""
        key, *rest = parse(path) or ("",)
        top = self._top(key)
        return self._accessor(top._reader, top._writer, tuple(rest))

    async def get(self, path: str, default: Any = _NOTHING) -> Any:
        """Return the value at a dotted path, or `default` if given and nothing is there.

        Raises:
            MissingKey: Nothing is there and no default was given.
        """
        try:
            return await self.at(path).read()
        except MissingKey:
            if default is _NOTHING:
                raise
            return default

    async def keys(self, pattern: str = "*") -> list[str]:
        """Return the top-level keys, sorted; with a pattern, those it names (`*` and `?` stand for others).

        One round trip for about 1000 keys of the server. Not atomic: a key that is written or deleted
        meanwhile may or may not be among them.
        """
        from .catalog import names

        return sorted([name async for name in names(self.interface, pattern)])

    async def set(self, path: str, value: Any) -> None:
        """Store `value` at a dotted path; see `Accessor.write`."""
        await self.at(path).write(value)

    def track_schema_changes(self, set_value: bool, keys: Iterable[str] | None = None) -> None:
        """Say whether the shape of what is written may change (True, the default) or never does.

        With False, a write no longer looks for arrays that it replaces: the places of the arrays at
        a path must be those of the first write there; others are refused with a TypeError.

        Args:
            set_value: Whether shapes may change.
            keys: The top-level keys meant; None for all, present and future.
        """
        if keys is None:
            self._static = not set_value
            keys = list(self._tops)
        for key in keys:
            self._top(key)._writer.static = not set_value

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface,)

    def __repr__(self) -> str:
        return f"<reem_async.{type(self).__name__} {self.interface.hostname}>"
