"""Reader, Writer and Publisher for plain scripts: one top-level key, its paths as text."""

from __future__ import annotations

from typing import Any

from reem_async.store import accessor as core
from reem_async.store import publish as core_publish

from ._twin import documented_by
from .connection import RedisInterface

__all__ = ["Publisher", "Reader", "Writer"]


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


class Publisher(Writer):
    """Writes one top-level key and notifies its subscribers, in the same transaction.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    _kind = core_publish.Publisher
