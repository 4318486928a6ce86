"""One top-level key: reading and writing it, from values to plans."""

from __future__ import annotations

import inspect
import secrets
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import BadData, BadType, MissingKey, PathRefused
from .plan import Command, Plan
from .plan.documents import Parcel, number_text, plain, walk
from .plan.paths import Path, counts_from_end, has_index, show, suffix
from .plan.reads import Sealed, interpret, length, read, type_of
from .plan.sizes import has_large
from .plan.writes import (
    Change,
    Loaded,
    append_change,
    appendable,
    change,
    delete_change,
    exchange,
    set_change,
    takes,
)
from .session import Session

if TYPE_CHECKING:
    from .plan.arithmetic import Operation
    from .transport import Transport

__all__ = ["DocumentReader", "DocumentWriter", "opened"]

_NO_ARRAYS: frozenset[str] = frozenset()


class DocumentReader:
    """Reads one top-level key.

    Args:
        session: The server.
        name: The key.
    """

    def __init__(self, session: Session, name: object) -> None:
        self.session = session
        self.keys = session.keys(name)
        self.name = self.keys.name

    async def read(self, path: Path) -> Any:
        """Return the value at `path`; raises MissingKey."""
        session = self.session
        at = session.readers
        if counts_from_end(path):
            path, at = await self._resolved(path)
        if session.ships.asynchronous:
            await session.ships.ready()
        try:
            sealed: Sealed = await session.run(read(self.keys, path, session.ships, session.memory), at)
            return await opened(sealed) if sealed.crates else sealed.holder[0]
        except BadData:
            if at is session.transport:
                raise
        # From a replica of a node that gives up a slot, arrays may have gone before their document.
        return await opened(await self.sealed(path))

    async def sealed(self, path: Path) -> Sealed:
        """Return what the server has at `path`, ships' replies not yet interpreted."""
        if self.session.ships.asynchronous:
            await self.session.ships.ready()
        sealed: Sealed = await self.session.run(read(self.keys, path, self.session.ships, self.session.memory))
        return sealed

    async def type_at(self, path: Path) -> type:
        """Return the Python type of the value at `path`."""
        at = self.session.readers
        if counts_from_end(path):
            path, at = await self._resolved(path)
        await self.session.ships.ready()
        kind: type | None = await self.session.run(type_of(self.keys, path, self.session.ships), at)
        return type(await self.read(path)) if kind is None else kind

    async def length_at(self, path: Path) -> int:
        """Return the length of the value at `path`."""
        at = self.session.readers
        if counts_from_end(path):
            path, at = await self._resolved(path)
        count: int | None = await self.session.run(length(self.keys, path), at)
        if count is not None:
            return count
        value = await self.read(path)
        try:
            return len(value)
        except TypeError:
            where = show((self.name, *path))
            raise BadType(f"{where} is of type {type(value).__name__} and has no length") from None

    async def _resolved(self, path: Path) -> tuple[Path, Transport]:
        """Return `path` with every index counted from the front, and whom to ask for what is there."""
        session = self.session
        try:
            return await resolved(self, path, MissingKey, session.readers), session.readers
        except MissingKey:  # a replica need not have all items yet
            if session.readers is session.transport:
                raise
            return await resolved(self, path, MissingKey), session.transport


async def opened(sealed: Sealed) -> Any:
    """Return the value a read brought, everything the ships hold put in its place."""
    for crate, ship, reply in sealed.crates:
        value = interpret(sealed.name, crate, ship, reply)
        crate.container[crate.key] = await value if ship.blob is None and inspect.isawaitable(value) else value
    return sealed.holder[0]


async def resolved(
    document: DocumentReader | DocumentWriter, path: Path, error: type[Exception], at: Transport | None = None
) -> Path:
    """Return `path` with every index counted from the front; one round trip for each that was not.

    The server takes an index that is too negative for the first item, so it must not see any.
    """
    for position, key in enumerate(path):
        if isinstance(key, int) and key < 0:
            try:
                count = await document.session.run(length(document.keys, path[:position]), at)
            except MissingKey as missing:
                raise error(str(missing)) from None
            if count is not None and -key > count:
                raise error(
                    f"{show((document.name, *path))}: the index {key} is out of range, the list has {count} items"
                )
            path = (*path[:position], key + (count or 0), *path[position + 1 :])
    return path


class DocumentWriter:
    """Writes one top-level key.

    Args:
        session: The server.
        name: The key.

    Attributes:
        static: The shape of what is written never changes; see `track_schema_changes`.
    """

    def __init__(self, session: Session, name: object) -> None:
        self.session = session
        self.keys = session.keys(name)
        self.name = self.keys.name
        self.static = False

    async def set(self, path: Path, value: Any) -> None:
        """Store `value` at `path`: one transaction."""
        if counts_from_end(path):
            path = await self._from_front(path, PathRefused)
        text = plain(value, len(path))
        if text is not None:
            await self._set(path, text, ())
            return
        unique = _unique() if has_index(path) else ""
        text, loaded = await self._walked(path, value, unique)
        if loaded and await self._let_pass(loaded):
            # Another task may have changed an array meanwhile; all that is stored is to be of one instant.
            text, loaded = await self._walked(path, value, unique)
        await self._set(path, text, loaded)

    async def _let_pass(self, loaded: tuple[Loaded, ...]) -> bool:
        """Let small calls that are under way be answered before a large one; returns whether it waited."""
        return any(has_large(each.commands) for each in loaded) and await self.session.transport.let_pass()

    def _is_settled(self) -> bool:
        """Return whether large values that cancelled calls have left on their way, over another connection, are there.

        If not, `_settle` waits for them; there is nearly never anything to wait for, and a coroutine costs time.
        """
        return self.session.transport.is_settled(self.keys.document)

    async def _settle(self) -> None:
        await self.session.transport.settle(self.keys.document)

    async def _from_front(self, path: Path, error: type[Exception]) -> Path:
        if not self._is_settled():
            await self._settle()
        return await resolved(self, path, error)

    async def _set(self, path: Path, text: bytes, loaded: tuple[Loaded, ...]) -> None:
        if not self._is_settled():
            await self._settle()
        if loaded:
            await self._check_place(path, loaded)
        it = set_change(self.keys, path, text, loaded, looks=not self.static or self._looks(path, loaded))
        await self.session.run(change(it, self.session.memory))
        self._saw_shape(path, loaded)

    async def delete(self, path: Path) -> None:
        """Remove what is at `path`."""
        if counts_from_end(path):
            path = await self._from_front(path, MissingKey)
        await self._delete(path)
        self.session.memory.forget_shapes(self.keys.document)

    async def _delete(self, path: Path) -> None:
        if not self._is_settled():
            await self._settle()
        await self.session.run(change(delete_change(self.keys, path), self.session.memory))

    async def extend(self, path: Path, values: Sequence[Any]) -> None:
        """Append `values` to the list at `path`, all or none."""
        if counts_from_end(path):
            path = await self._from_front(path, MissingKey)
        unique = _unique()
        texts: list[bytes] = []
        loaded: list[Loaded] = []
        for number, value in enumerate(values):
            text, parcels = await self._prepared((*path, -1), value, f"{unique}.{number}")
            texts.append(text)
            loaded.extend(parcels)
        if texts:
            await self._append(path, texts, tuple(loaded))

    async def _append(self, path: Path, texts: Sequence[bytes], loaded: tuple[Loaded, ...]) -> None:
        if not self._is_settled():
            await self._settle()
        await self._check_list(path, loaded)
        await self.session.run(change(append_change(self.keys, path, texts, loaded), self.session.memory))

    async def _check_list(self, path: Path, loaded: tuple[Loaded, ...]) -> None:
        """Raise MissingKey or BadType if ships' values would be stored for nothing."""
        if loaded:
            await self.session.run(appendable(self.keys, path))

    async def _check_place(self, path: Path, loaded: tuple[Loaded, ...]) -> None:
        """Raise PathRefused if ships' values would be stored for nothing."""
        plan = takes(self.keys, path, loaded, self.session.memory)
        if plan is not None:
            await self.session.run(plan)

    async def calculate(self, path: Path, command: str, operation: Operation, operand: float) -> Any:
        """Apply a JSON arithmetic command; returns the new number."""
        from .plan.arithmetic import calculate

        if counts_from_end(path):
            path = await self._from_front(path, MissingKey)
        text = number_text(operand, (self.name, *path))
        if isinstance(operand, np.generic):
            operand = operand.item()
        return await self._run(
            path,
            lambda notices: calculate(self.keys, path, command, operation, operand, text, notices, self.session.memory),
        )

    async def compute(self, path: Path, function: Any) -> Any:
        """Replace the number at `path` by a function of it; returns the new number."""
        from .plan.arithmetic import compute

        if counts_from_end(path):
            path = await self._from_front(path, MissingKey)
        return await self._run(path, lambda notices: compute(self.keys, path, function, notices, self.session.memory))

    async def _run(self, path: Path, plan: Callable[[Callable[[], Sequence[Command]]], Plan]) -> Any:
        return await self._calculated(plan(lambda: ()))

    async def _calculated(self, plan: Plan) -> Any:
        if not self._is_settled():
            await self._settle()
        try:
            return await self.session.run(plan)
        except BaseException:  # it may have been applied or not
            self.session.memory.forget_numbers(self.keys.document)
            raise

    async def exchange(self, path: Path, value: Any, before: Sealed) -> None:
        """Store `value` at `path` if what is there is still `before`; raises Conflict."""
        text, loaded = await self._prepared(path, value, _unique())
        await self._exchange(set_change(self.keys, path, text, loaded), before)

    async def _exchange(self, it: Change, before: Sealed) -> None:
        if not self._is_settled():
            await self._settle()
        gone = tuple(crate.placeholder.suffix.encode() for crate, _, _ in before.crates)
        it = it._replace(gone=gone)
        await self.session.run(exchange(it, before.commands, before.raw, self.session.memory))

    def _saw_shape(self, path: Path, loaded: tuple[Loaded, ...]) -> None:
        """Note where the arrays of a value are that was set."""
        if not has_index(path):
            suffixes = frozenset([each.suffix for each in loaded]) if loaded else _NO_ARRAYS
            self.session.memory.saw_shape(self.keys.document, path, suffixes)

    def _looks(self, path: Path, loaded: tuple[Loaded, ...]) -> bool:
        """Return whether to look for arrays that are replaced though the shape is vouched for; raises BadType."""
        if has_index(path):
            return True
        known = self.session.memory.shape(self.keys.document, path)
        if known is None:
            return True
        suffixes = frozenset([each.suffix for each in loaded])
        if known != suffixes:
            raise self._new_shape(min(known ^ suffixes))
        return False

    def _new_shape(self, suffix: str) -> BadType:
        return BadType(
            f"{self.name}{suffix}: an array (or other shipped value) where none was, or none where one was, but "
            "track_schema_changes(False) says that the shape never changes; switch it back on for this write"
        )

    async def _prepared(self, path: Path, value: Any, unique: str) -> tuple[bytes, tuple[Loaded, ...]]:
        """Encode `value`, refusing what cannot be stored, and have the ships record their commands."""
        text = plain(value, len(path))
        return (text, ()) if text is not None else await self._walked(path, value, unique)

    async def _walked(self, path: Path, value: Any, unique: str) -> tuple[bytes, tuple[Loaded, ...]]:
        """Do so with a value that is not plain JSON."""
        ships = self.session.ships
        fits: Any = ships.fits
        if ships.asynchronous:
            await ships.ready()
            fits = await ships.choices(value)

        def name(inner: Path) -> str:
            return suffix(path + inner) + (f"~{unique}" if unique else "")

        encoded = walk(value, (self.name, *path), fits, name)
        loaded = [
            self._packed(parcel) if parcel.ship.blob is not None else await self._recorded(parcel)
            for parcel in encoded.parcels
        ]
        return encoded.text, tuple(loaded)

    def _packed(self, parcel: Parcel) -> Loaded:
        blob = parcel.ship.blob.pack(parcel.value)
        command = ("SET", self.keys.tag + parcel.suffix, blob[0] if len(blob) == 1 else blob)
        return Loaded(parcel.suffix, parcel.ship.label, (command,), blob)

    async def _recorded(self, parcel: Parcel) -> Loaded:
        key, ship = self.keys.tag + parcel.suffix, parcel.ship
        recorder = self.session.ships.new_recorder()
        result = ship.ship.write(key, parcel.value, recorder)
        if inspect.isawaitable(result):
            await result
        commands: tuple[Command, ...] = tuple(recorder.commands)
        return Loaded(parcel.suffix, ship.label, commands)


def _unique() -> str:
    return secrets.token_hex(5)
