"""Outlines for people and for programs: one line for what is at a path, and the finding of paths by patterns."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING, Any

from reem_async.tools.cli.output import clean, cut, json_text, size_text, typed
from reem_async.tools.cli.wording import for_users

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.store.catalog import Outline

__all__ = ["as_data", "as_json", "below_arrays", "describe", "found"]

_AT_ONCE = 64  # round trips that are under way together


async def found(interface: RedisInterface, pattern: str) -> AsyncIterator[Outline]:
    """Yield the outlines of all that a pattern names, by name. One round trip for each top-level key.

    Raises:
        MissingKey: The pattern is a path, and nothing is there.
    """
    from reem_async.plan.paths import check_top_key, parse, parse_pattern
    from reem_async.store.catalog import names, outline

    # A plain path is asked for directly, and that nothing is there is an error; a pattern that finds nothing is none.
    if not any(mark in pattern for mark in "*?"):
        name, *_ = parse(pattern) or ("",)
        check_top_key(name)
        yield await outline(interface, parse(pattern))
        return
    wanted = parse_pattern(pattern)
    tops = sorted([name async for name in names(interface, wanted.top)])
    # In portions: a server with many keys is neither asked one by one nor for all at once.
    for start in range(0, len(tops), _AT_ONCE):
        for top in await asyncio.gather(*[_outline(interface, name) for name in tops[start : start + _AT_ONCE]]):
            if top is not None:
                for node in _matching(top, wanted, 1 + len(wanted.rest)):
                    yield node


async def _outline(interface: RedisInterface, name: str) -> Outline | None:
    """Return what is under a top-level key; None if it is gone, kind "?" if REEM did not write it."""
    from reem_async.errors import BadData, MissingKey, WrongKind
    from reem_async.store.catalog import Outline, outline

    try:
        return await outline(interface, (name,))
    except (MissingKey, WrongKind):
        return None
    except BadData as error:
        return Outline((name,), "?", for_users(error))


def _matching(node: Outline, wanted: Any, depth: int) -> Iterator[Outline]:
    if not wanted.concerns(node.path):
        return
    if len(node.path) == depth:
        yield node
        return
    for child in node.children:
        yield from _matching(child, wanted, depth)


def describe(node: Outline, limit: int) -> str:
    """Return what is at a path in at most `limit` characters: the value, or what kind of thing it is."""
    if node.plain:
        return cut(json_text(node.value), limit)
    if node.kind == "dict":
        return _counted(node, "key") if node.children else "{}"
    if node.kind != "list":
        return cut(clean(node.summary or node.kind), limit)
    if not node.children:
        return "[]"
    # The first hundred, cut to the line: a list may have a million items.
    if all(child.plain for child in node.children):
        values = ", ".join([json_text(child.value) for child in node.children[:100]])
        return cut(f"[{values}]", max(limit - 16, 16)) + f"  {_counted(node, 'item')}"
    return _counted(node, "item")


def _counted(node: Outline, what: str) -> str:
    count = len(node.children)
    return f"{count} {what}{'' if count == 1 else 's'}"


def as_data(node: Outline) -> Any:
    """Return the value with a text in place of each array and of bytes."""
    if node.plain:
        return node.value
    if node.kind == "dict":
        return {child.path[-1]: as_data(child) for child in node.children}
    if node.kind == "list":
        return [as_data(child) for child in node.children]
    return f"<{node.summary or node.kind}, {size_text(node.size)}>"


def as_json(node: Outline, depth: int | None) -> dict[str, Any]:
    """Return an outline for programs, children down to `depth` levels below."""
    entry: dict[str, Any] = {"path": typed(node.path), "type": node.kind, "size": node.size}
    if node.plain:
        entry["value"] = node.value
    elif node.kind in ("dict", "list"):
        entry["length"] = len(node.children)
        if depth is None or depth > 0:
            entry["children"] = [as_json(child, None if depth is None else depth - 1) for child in node.children]
    else:
        entry["summary"] = node.summary
    return entry


def below_arrays(node: Outline) -> int:
    """Return the bytes of all that is not JSON at a path and below: arrays, bytes, custom types."""
    if node.kind in ("dict", "list"):
        return sum([below_arrays(child) for child in node.children])
    return 0 if node.plain else node.size
