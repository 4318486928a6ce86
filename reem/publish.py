"""Publishing for plain scripts."""

from __future__ import annotations

from typing import Any

from reem_async import publish as core

from .accessor import PublishAccessor
from .store import KeyValueStore, Writer

__all__ = ["PublishSpace", "Publisher"]


class Publisher(Writer):
    """Writes one top-level key and tells its subscribers, in the same transaction.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    _kind = core.Publisher


class PublishSpace(KeyValueStore):
    """A store that can only be written, and whose subscribers are told of every change.

    Written like a `KeyValueStore`. A change and its notice are one transaction; a small value
    travels in the notice, a large one is announced and subscribers fetch the newest.

    Args:
        interface: The server: a RedisInterface, a store, or what RedisInterface takes as host.
    """

    _kind = core.PublishSpace
    _accessor = PublishAccessor

    def get(self, path: str, default: Any = None) -> Any:
        """Raise WriteOnly."""
        return self.interface._run(self._core.get(path, default))
