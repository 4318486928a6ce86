"""Plans that look for documents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from . import Plan, Reply

__all__ = ["documents"]

_PAGE = "1000"


def documents(glob: str, cursor: Any = b"0") -> Plan:
    """Plan to list about 1000 keys of one server: the next cursor, and the documents among them that match."""
    return Plan([("SCAN", cursor, "MATCH", glob, "COUNT", _PAGE, "TYPE", "ReJSON-RL")], _first)


def _first(replies: Sequence[Reply]) -> Any:
    if isinstance(replies[0], Exception):
        raise replies[0]
    return replies[0]
