"""Reader and Writer: one top-level key, its paths as text."""

from __future__ import annotations

from typing import Any

from ..connection import RedisInterface
from ..errors import MissingDocument
from ..plan.paths import parse
from .document import DocumentWriter
from .reader import DocumentReader

__all__ = ["Reader", "Writer"]


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
        try:
            return await self._document.read(parse(read_path))
        # As the original did, and as GET does.
        except MissingDocument:
            return None


class Writer:
    """Writes one top-level key.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    _kind: type[DocumentWriter] = DocumentWriter

    def __init__(self, top_key_name: str, interface: RedisInterface) -> None:
        self.interface = interface
        self.top_key_name = top_key_name
        self._document = self._kind(interface.session, top_key_name)

    async def send_to_redis(self, set_path: str, set_value: Any) -> None:
        """Store a value at a path like ".a.b" (or "." for all); see `Accessor.write`."""
        await self._document.set(parse(set_path), set_value)
