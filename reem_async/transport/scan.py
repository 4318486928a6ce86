"""The one way to look through all keys: every node of a cluster, one after the other."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

from ..plan.keys import count, first_page, page
from . import Transport, drive

__all__ = ["counted", "scanned"]


async def scanned(transport: Transport, glob: str = "", kind: str = "") -> AsyncIterator[list[bytes]]:
    """Yield the names of all keys, about 1000 at a time; one round trip for each 1000, and a node at least one.

    A key that is there from the beginning to the end is among them, unless it moves from node to node
    meanwhile. Others may or may not be, and any may be twice.

    Args:
        transport: The way to the servers.
        glob: A pattern of the names, in the server's syntax; all if it is empty.
        kind: The Redis type; any if it is empty.

    Raises:
        ClusterNode: It is the way to one node of several.
        NotConnected: A part of the keys cannot be reached.
    """
    for node in await transport.nodes():
        plan = page(glob, kind) if transport.sharded else first_page(glob, kind)
        while True:
            cursor, names = await drive(node, plan)
            yield names
            # A cursor of 0 is the end; a page may be empty before that.
            if cursor in (b"0", 0):
                break
            plan = page(glob, kind, cursor)


async def counted(transport: Transport, database: int) -> int | None:
    """Return how many keys the servers count in a database; None if this user may not ask. A round trip for each."""
    total = 0
    for node in await transport.nodes():
        held: Any = await drive(node, count(database))
        if held is None:
            return None
        total += held
    return total
