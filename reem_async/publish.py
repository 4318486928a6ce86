"""Publishing: a write and its notice in one transaction."""

from __future__ import annotations

import builtins
import time
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from .accessor import Accessor
from .document import DocumentWriter
from .errors import WriteOnly
from .plan import Command, Plan
from .plan.notices import announce, published, with_value
from .plan.paths import Path, show
from .plan.reads import Sealed
from .plan.writes import Change, Loaded, append_change, change, delete_change, set_change
from .store import KeyValueStore, Writer

__all__ = ["PublishAccessor", "PublishSpace", "Publisher"]


class DocumentPublisher(DocumentWriter):
    """Writes one top-level key and tells its subscribers, in the same transaction.

    Updates of one interface to one top-level key are numbered and arrive in this order, so such
    calls wait for each other; those to different keys do not.
    """

    async def _let_pass(self, loaded: tuple[Loaded, ...]) -> bool:
        """Return False: a later call to the same key would overtake it."""
        return False

    async def _set(self, path: Path, text: bytes, loaded: tuple[Loaded, ...]) -> None:
        async with self.session.transport.ordered(self.keys.channel):
            if not self._is_settled():
                await self._settle()
            if loaded:
                await self._check_place(path, loaded)
            looks, stamp = not self.static or self._looks(path, loaded), self._stamp(path)
            it = set_change(
                self.keys,
                path,
                text,
                loaded,
                looks=looks,
                notices=self._notice(stamp, with_value(*stamp, text, loaded)),
                retraction=lambda: self._announced(path),
            )
            await self.session.run(change(it, self.session.memory))
            self._saw_shape(path, loaded)

    async def _delete(self, path: Path) -> None:
        async with self.session.transport.ordered(self.keys.channel):
            if not self._is_settled():
                await self._settle()
            it = delete_change(self.keys, path, notices=self._announced(path, deleted=True))
            await self.session.run(change(it, self.session.memory))

    async def _append(self, path: Path, texts: Sequence[bytes], loaded: tuple[Loaded, ...]) -> None:
        async with self.session.transport.ordered(self.keys.channel):
            if not self._is_settled():
                await self._settle()
            await self._check_list(path, loaded)
            it = append_change(self.keys, path, texts, loaded, notices=self._announced(path))
            await self.session.run(change(it, self.session.memory))

    async def _run(self, path: Path, plan: Callable[[Callable[[], Sequence[Command]]], Plan]) -> Any:
        async with self.session.transport.ordered(self.keys.channel):
            return await self._calculated(plan(lambda: self._announced(path)))

    def _announced(self, path: Path, *, deleted: bool = False) -> list[Command]:
        """Return the commands of a notice without the value."""
        stamp = self._stamp(path)
        return self._notice(stamp, announce(*stamp, deleted=deleted))

    def _notice(self, stamp: tuple[str, int, float, Path], payload: bytes) -> list[Command]:
        return published(self.keys, *stamp[:2], payload, everywhere=self.session.is_fresh(self.keys))

    async def _exchange(self, it: Change, before: Sealed) -> None:
        raise WriteOnly(_cannot_read((self.name, *it.path)))

    def _stamp(self, path: Path) -> tuple[str, int, float, Path]:
        return *self.session.stamp(self.keys), time.time(), path


def _cannot_read(path: Path) -> str:
    return (
        f"{show(path)}: a PublishSpace can only be written; read through KeyValueStore(interface), "
        "or follow it with a subscriber"
    )


class PublishAccessor(Accessor):
    """One place of a PublishSpace: as `Accessor`, but what would read raises WriteOnly."""

    __slots__ = ()

    def _refuse(self) -> NoReturn:
        raise WriteOnly(_cannot_read(self.full_path))

    async def read(self) -> Any:
        """Raise WriteOnly."""
        self._refuse()

    async def get(self, *default: Any) -> Any:
        """Raise WriteOnly."""
        self._refuse()

    async def length(self) -> int:
        """Raise WriteOnly."""
        self._refuse()

    async def type(self) -> builtins.type:
        """Raise WriteOnly."""
        self._refuse()

    def edit(self) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()

    def watch(self, policy: Any = None) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()


class Publisher(Writer):
    """Writes one top-level key and tells its subscribers, in the same transaction.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    _kind = DocumentPublisher


class PublishSpace(KeyValueStore):
    """A store that can only be written, and whose subscribers are told of every change.

    Written like a `KeyValueStore`. A change and its notice are one transaction; a small value
    travels in the notice, a large one is announced and subscribers fetch the newest.

    Args:
        interface: The server: a RedisInterface, a store, or what RedisInterface takes as host.
    """

    _accessor = PublishAccessor
    _writer = DocumentPublisher

    async def get(self, path: str, default: Any = None) -> Any:
        """Raise WriteOnly."""
        await self.at(path).read()
