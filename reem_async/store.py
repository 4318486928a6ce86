"""Reader and Writer of one top-level key, and KeyValueStore, the dictionary made of them."""

from __future__ import annotations

import inspect
import secrets
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from .accessor import Accessor
from .connection import RedisInterface
from .errors import BadType, MissingKey
from .plan import Command, Plan
from .plan.arithmetic import Operation, calculate, compute
from .plan.documents import Encoded, Parcel, encode, number_text
from .plan.paths import Path, parse, show, suffix
from .plan.reads import Sealed, length, read, type_of
from .plan.writes import (
    Change,
    Loaded,
    append_change,
    change,
    delete_change,
    exchange,
    set_change,
    static_change,
)

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
        self.keys = interface.keys(top_key_name)
        self.top_key_name = self.keys.name

    async def read_from_redis(self, read_path: str) -> Any:
        """Return the value at a path like ".a.b" (or "." for all); see `Accessor.read`."""
        return await self.read(parse(read_path))

    async def read(self, path: Path) -> Any:
        """Return the value at `path`; raises MissingKey."""
        return await opened(await self.sealed(path))

    async def sealed(self, path: Path) -> Sealed:
        """Return what the server has at `path`, ships' replies not yet interpreted."""
        if self.interface.ships.asynchronous:
            await self.interface.ships.ready()
        sealed: Sealed = await self.interface.run(read(self.keys, path, self.interface.ships, self.interface.memory))
        return sealed

    async def type_at(self, path: Path) -> type:
        """Return the Python type of the value at `path`."""
        await self.interface.ships.ready()
        kind: type | None = await self.interface.run(type_of(self.keys, path, self.interface.ships))
        return type(await self.read(path)) if kind is None else kind

    async def length_at(self, path: Path) -> int:
        """Return the length of the value at `path`."""
        count: int | None = await self.interface.run(length(self.keys, path))
        if count is not None:
            return count
        value = await self.read(path)
        try:
            return len(value)
        except TypeError:
            where = show((self.top_key_name, *path))
            raise BadType(f"{where} is of type {type(value).__name__} and has no length") from None


async def opened(sealed: Sealed) -> Any:
    """Return the value a read brought, everything the ships hold put in its place."""
    for crate, ship, reply in sealed.crates:
        value = ship.ship.interpret_read([reply])
        crate.container[crate.key] = await value if inspect.isawaitable(value) else value
    return sealed.holder[0]


class Writer:
    """Writes one top-level key.

    Args:
        top_key_name: The key.
        interface: The server.

    Attributes:
        static: The shape of what is written never changes; see `track_schema_changes`.
    """

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.keys = interface.keys(top_key_name)
        self.top_key_name = self.keys.name
        self.static = False

    async def send_to_redis(self, set_path: str, set_value: Any) -> None:
        """Store a value at a path like ".a.b" (or "." for all); see `Accessor.write`."""
        await self.set(parse(set_path), set_value)

    async def set(self, path: Path, value: Any) -> None:
        """Store `value` at `path`: one transaction."""
        unique = "" if _is_fixed(path) else _unique()
        encoded, loaded = await self._prepared(path, value, unique)
        await self._set(path, encoded, loaded)

    async def _set(self, path: Path, encoded: Encoded, loaded: tuple[Loaded, ...]) -> None:
        await self.interface.run(self._plan(set_change(self.keys, path, encoded.text, loaded)))

    async def delete(self, path: Path) -> None:
        """Remove what is at `path`."""
        await self.interface.run(change(delete_change(self.keys, path), self.interface.memory))

    async def extend(self, path: Path, values: Sequence[Any]) -> None:
        """Append `values` to the list at `path`, all or none."""
        unique = _unique()
        texts: list[bytes] = []
        loaded: list[Loaded] = []
        for number, value in enumerate(values):
            encoded, parcels = await self._prepared((*path, -1), value, f"{unique}.{number}")
            texts.append(encoded.text)
            loaded.extend(parcels)
        if texts:
            await self._append(path, texts, tuple(loaded))

    async def _append(self, path: Path, texts: Sequence[bytes], loaded: tuple[Loaded, ...]) -> None:
        await self.interface.run(change(append_change(self.keys, path, texts, loaded), self.interface.memory))

    async def calculate(self, path: Path, command: str, operation: Operation, operand: float) -> Any:
        """Apply a JSON arithmetic command; returns the new number."""
        text = number_text(operand, (self.top_key_name, *path))
        if isinstance(operand, np.generic):
            operand = operand.item()
        return await self._run(
            path, lambda notices: calculate(self.keys, path, command, operation, operand, text, notices)
        )

    async def compute(self, path: Path, function: Any) -> Any:
        """Replace the number at `path` by a function of it; returns the new number."""
        return await self._run(path, lambda notices: compute(self.keys, path, function, notices))

    async def _run(self, path: Path, plan: Any) -> Any:
        return await self.interface.run(plan(()))

    async def exchange(self, path: Path, value: Any, before: Sealed) -> None:
        """Store `value` at `path` if what is there is still `before`; raises Conflict."""
        encoded, loaded = await self._prepared(path, value, _unique())
        await self._exchange(set_change(self.keys, path, encoded.text, loaded), before)

    async def _exchange(self, it: Change, before: Sealed) -> None:
        await self.interface.run(exchange(it, before.commands, before.raw, self.interface.memory))

    def _plan(self, it: Change) -> Plan:
        """Return the plan of a write, the short one where the shape is vouched for."""
        memory = self.interface.memory
        if not self.static or not _is_fixed(it.path):
            return change(it, memory)
        known = memory.shape(it.keys.document, it.path)
        suffixes = frozenset(each.suffix for each in it.loaded)
        if known is None:
            memory.saw_shape(it.keys.document, it.path, suffixes)
            return change(it, memory)
        if known != suffixes:
            odd = min(known ^ suffixes)
            raise BadType(
                f"{self.top_key_name}{odd}: an array (or other shipped value) where none was, or none where one was, "
                "but track_schema_changes(False) says that the shape never changes; switch it back on for this write"
            )
        return static_change(it)

    async def _prepared(self, path: Path, value: Any, unique: str) -> tuple[Encoded, tuple[Loaded, ...]]:
        """Encode `value`, refusing what cannot be stored, and have the ships record their commands."""
        ships = self.interface.ships
        fits: Any = ships.fits
        if ships.asynchronous:
            await ships.ready()
            fits = await ships.choices(value)

        def name(inner: Path) -> str:
            return suffix(path + inner) + (f"~{unique}" if unique else "")

        encoded = encode(value, (self.top_key_name, *path), fits, name)
        return encoded, tuple([await self._load(parcel) for parcel in encoded.parcels])

    async def _load(self, parcel: Parcel) -> Loaded:
        key, ship = self.keys.tag + parcel.suffix, parcel.ship
        if ship.fields is not None:
            fields = ship.fields.pack(parcel.value)
            words = [word for pair in fields.items() for word in pair]
            return Loaded(parcel.suffix, ship.label, (("HSET", key, *words),), fields)
        recorder = self.interface.ships.new_recorder()
        result = ship.ship.write(key, parcel.value, recorder)
        if inspect.isawaitable(result):
            await result
        commands: tuple[Command, ...] = tuple(recorder.commands)
        return Loaded(parcel.suffix, ship.label, commands)


def _is_fixed(path: Path) -> bool:
    """Return whether what is at `path` stays there: items of lists move when others are deleted."""
    return not any(isinstance(key, int) for key in path)


def _unique() -> str:
    return secrets.token_hex(5)


class KeyValueStore:
    """The dictionary on the server.

    `kvs["foo"]["bar"]` is an `Accessor`: a path, nothing is sent yet; `await` its `read()`,
    `write(value)` and so on.

    Args:
        interface: The server: a RedisInterface, another store, or what RedisInterface takes as host.
    """

    _accessor: type[Accessor] = Accessor
    _writer: type[Writer] = Writer

    def __init__(self, interface: Any = "localhost") -> None:
        if isinstance(interface, KeyValueStore):
            interface = interface.interface
        self.interface: RedisInterface = (
            interface if isinstance(interface, RedisInterface) else RedisInterface(interface)
        )
        self._entries: dict[str, tuple[Reader, Writer]] = {}
        self._static = False

    def __getitem__(self, key: str) -> Accessor:
        return self._accessor(*self._entry(key), ())

    def _entry(self, key: str) -> tuple[Reader, Writer]:
        try:
            return self._entries[key]
        except (KeyError, TypeError):
            entry = Reader(key, self.interface), self._writer(key, self.interface)
            entry[1].static = self._static
            return self._entries.setdefault(key, entry)

    def __setitem__(self, key: str, value: Any) -> None:
        raise BadType(f"assignment cannot wait for the server; use: await store[{key!r}].write(value)")

    def __delitem__(self, key: str) -> None:
        raise BadType(f"del cannot wait for the server; use: await store[{key!r}].delete()")

    __iter__ = None
    __contains__ = None

    def at(self, path: str) -> Accessor:
        """Return the accessor of a dotted path such as "foo.bar" or "foo.tiles[2]"; sends nothing."""
        key, *rest = parse(path)
        return self._accessor(*self._entry(key), tuple(rest))  # type: ignore[arg-type]

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
            keys = list(self._entries)
        for key in keys:
            self._entry(key)[1].static = not set_value

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface,)

    def __repr__(self) -> str:
        return f"<{type(self).__module__.partition('.')[0]}.{type(self).__name__} {self.interface.hostname}>"
