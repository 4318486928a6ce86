"""Reading one top-level key, from replies to values."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np

from ..errors import MissingKey, WrongType
from ..plan.paths import Path, check_name, show
from ..plan.reads import RawRead, awaited, exists, first_read, has_key, interpreted, keys_at, length, read, type_of
from ..session import Session


class DocumentReader:
    """Reads one top-level key."""

    def __init__(self, session: Session, name: object) -> None:
        self.session = session
        self.keys = session.keys(name)
        self.name = self.keys.name

    async def read(self, path: Path) -> Any:
        raw_read = await self.raw_read(path)
        return await opened(raw_read) if raw_read.slots else raw_read.holder[0]

    async def no_item(self, path: Path) -> MissingKey:
        outer, where = path[:-1], show((self.name, *path))
        try:
            kind = await self.type_at(outer)
        except MissingKey:
            kind = type(None)
        if kind is not np.ndarray:
            return MissingKey(f"nothing is stored at {where}")
        return MissingKey(
            f"{where}: {show((self.name, *outer))} is an array, and arrays are read whole: "
            f"read it, then take [{path[-1]}] of what that gives"
        )

    async def exists(self) -> bool:
        found: bool = await self.session.run(exists(self.keys))
        return found

    async def raw_read(self, path: Path) -> RawRead:
        if self.session.ships.asynchronous:
            await self.session.ships.ready()
        session = self.session
        plan = read(self.keys, path, session.ships, session.cache)
        # Until a key is known not to be of REEM 0.1, its reads check that in the same round trip.
        raw_read: RawRead = await session.run(first_read(plan, self.keys, path, session.cache))
        return raw_read

    async def contains_at(self, path: Path, key: object) -> bool:
        name = check_name(key, (self.name, *path))
        found: bool = await self.session.run(has_key(self.keys, path, name))
        return found

    async def keys_at(self, path: Path) -> list[str]:
        names: list[str] = await self.session.run(keys_at(self.keys, path))
        return names

    async def type_at(self, path: Path) -> type:
        await self.session.ships.ready()
        kind: type | None = await self.session.run(type_of(self.keys, path, self.session.ships))
        return type(await self.read(path)) if kind is None else kind

    async def length_at(self, path: Path) -> int:
        count: int | None = await self.session.run(length(self.keys, path))
        if count is not None:
            return count
        # A text or an array: the server knows only the length of its placeholder.
        value = await self.read(path)
        try:
            return len(value)
        except TypeError:
            where = show((self.name, *path))
            raise WrongType(f"{where} is of type {type(value).__name__} and has no length") from None


async def opened(raw_read: RawRead) -> Any:
    """Return the value of a read, with the ships' values in it; see `RawRead.give_up`."""
    for slot, ship, reply in raw_read.slots:
        value = interpreted(raw_read, slot, ship, reply)
        waits = ship.blob is None and inspect.isawaitable(value)
        slot.container[slot.key] = await awaited(raw_read, slot, value) if waits else value
    return raw_read.holder[0]
