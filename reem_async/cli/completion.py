"""Shell completion of the names of top-level keys."""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress

import typer

__all__ = ["complete_path"]

_SECONDS = 1.0  # nobody waits longer for a completion
_MOST = 200


def complete_path(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the top-level keys that begin with what was typed; nothing if the server cannot be asked."""
    url = ctx.params.get("url") or os.environ.get("REEM_URL") or "localhost"
    with suppress(Exception):  # a shell that completes is no place for messages
        return asyncio.run(asyncio.wait_for(_names(url, ctx.params.get("namespace") or "", incomplete), _SECONDS))
    return []


async def _names(url: str, namespace: str, incomplete: str) -> list[str]:
    from reem_async.catalog import names
    from reem_async.cli.output import typed
    from reem_async.connection import RedisInterface

    found: list[str] = []
    async with RedisInterface(url, namespace=namespace, timeout=_SECONDS) as interface:
        async for name in names(interface, "*"):
            shown = typed((name,))
            if shown.startswith(incomplete):
                found.append(shown)
            if len(found) >= _MOST:
                break
    return sorted(found)
