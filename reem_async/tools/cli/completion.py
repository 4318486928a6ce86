"""Shell completion of paths: top-level keys, then what is below them."""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface

__all__ = ["complete_path"]

_SECONDS = 1.0  # nobody waits longer for a completion
# Names that are offered: a shell asks before it shows more than about a hundred.
_MOST = 200
_NEEDED = ("reem_async.store.catalog", "reem_async.store.store", "reem_async.tools.cli.running", "redis")


def complete_path(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the paths that begin with what was typed, up to the next dot; nothing if the server cannot be asked."""
    url = ctx.params.get("url") or os.environ.get("REEM_URL") or "localhost"
    with suppress(Exception):  # a shell that completes is no place for messages
        for module in _NEEDED:  # importing is not part of the time that a server has to answer
            import_module(module)
        return asyncio.run(asyncio.wait_for(_names(url, ctx.params.get("namespace") or "", incomplete), _SECONDS))
    return []


async def _names(url: str, namespace: str, incomplete: str) -> list[str]:
    from reem_async.tools.cli.running import interface_to

    async with interface_to(url, namespace, _SECONDS) as interface:
        outer = _begun(incomplete)
        found = await (_below(interface, outer, incomplete) if outer else _top(interface, incomplete))
        if len(found) != 1 or not await _goes_on(interface, found[0]):
            return sorted(found)
        # A shell puts a blank behind the only choice. With two it waits for more to be typed, such as the next dot.
        return [found[0], f"{found[0]}."]


async def _top(interface: RedisInterface, incomplete: str) -> list[str]:
    """Return the top-level keys that go on as typed."""
    from reem_async.store.catalog import names
    from reem_async.tools.cli.output import typed

    found: list[str] = []
    async for name in names(interface, "*"):
        shown = typed((name,))
        if shown.startswith(incomplete):
            found.append(shown)
        # The rest of the keys is not asked for either: this may be a server with a million.
        if len(found) >= _MOST:
            break
    return found


async def _goes_on(interface: RedisInterface, path: str) -> bool:
    """Return whether there are keys below a path."""
    from reem_async.errors import ReemError
    from reem_async.store.store import KeyValueStore

    with suppress(ReemError):  # a list, an array, a number
        return bool(await KeyValueStore(interface).at(path).keys())
    return False


def _begun(incomplete: str) -> tuple[str | int, ...]:
    """Return the whole elements of a path before the one that is being typed; none at the top."""
    from reem_async.plan.paths import parse

    # The longest whole path in front of the last separator. Within a quoted key a separator is none, and what stands
    # before it does not parse.
    for end in range(len(incomplete), 0, -1):
        if incomplete[end - 1] in ".[" and end > 1:
            with suppress(ValueError):  # within a quoted key
                return parse(incomplete[: end - 1])
    return ()


async def _below(interface: RedisInterface, outer: tuple[str | int, ...], incomplete: str) -> list[str]:
    """Return the keys of the dict at `outer` that go on as typed; nothing of it is fetched."""
    from reem_async.store.store import KeyValueStore
    from reem_async.tools.cli.output import typed

    place = KeyValueStore(interface)[str(outer[0])]
    for element in outer[1:]:
        place = place[element]
    shown = [typed((*outer, key)) for key in await place.keys()]
    return [each for each in shown if each.startswith(incomplete)][:_MOST]
