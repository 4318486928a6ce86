"""`reem ls` and `reem tree`: which keys there are, and what is below them."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Iterator
from typing import Annotated, Any

import typer

from ...connection import RedisInterface
from ...errors import BadData, BadKey, MissingKey, ReemError, WrongKind
from ...plan.paths import check_top_key, parse, parse_pattern
from ...store.catalog import Outline, names, outline
from .options import AsJson, complete_path, with_server
from .output import (
    clean,
    columns,
    counted,
    cut,
    emit,
    emit_json,
    is_terminal,
    json_text,
    note,
    size_text,
    styled,
    typed,
    width,
)
from .raw import matching, raw_found
from .running import NOTHING, for_users

# Entries that are drawn of one dict or list: lists of thousands of numbers would fill the screen.
_MOST_CHILDREN = 50

OnePattern = Annotated[
    str,
    typer.Argument(
        metavar="PATTERN",
        autocompletion=complete_path,
        help="A path, or a pattern: * and ? stand for other characters of a key.",
    ),
]

_AT_ONCE = 64  # round trips that are under way together


@with_server("ls")
async def ls(interface: RedisInterface, pattern: OnePattern = "*", as_json: AsJson = False) -> int:
    """List keys with type and size.

    One line for each key that the pattern names: name, type, what it is, bytes. Arrays are not
    fetched. Where the output is no terminal, tabs separate the columns. Keys of programs without REEM come
    last. Their type is that of Redis, such as "raw hash".

    Exit code 3 if there is no such key.

    Examples:
        reem ls
        reem ls 'cam_*'
        reem ls 'robot.*'          what is directly below robot
        reem ls --json | jq -r .path
    """
    # All rows before the first is printed: the widths of the columns depend on them. JSON lines go out as they
    # come.
    rows = []
    async for raw, node in found_all(interface, pattern):
        if as_json:
            emit_json(outline_json(node, raw, whole=False))
        rows.append((typed(node.path), f"raw {raw}" if raw else node.kind, describe(node, 48), size_text(node.size)))
    if not as_json:
        columns(rows, ("bold", "cyan", "", "green"), right=frozenset({3}), shrink=(2, 0))
    if others := sum(row[1].startswith("raw ") for row in rows):
        note(f"{counted(others, 'key')} of other programs, marked raw")
    return 0 if rows else _nothing(pattern, interface)


@with_server("tree")
async def tree(
    interface: RedisInterface,
    pattern: OnePattern = "*",
    whole: Annotated[
        bool, typer.Option("--all", help=f"Also what comes after the first {_MOST_CHILDREN} entries of a dict or list.")
    ] = False,
    as_json: AsJson = False,
) -> int:
    """Show what is below keys; arrays as dtype, shape and size, without fetching them.

    Keys of programs without REEM come last, marked with their Redis type, such as (raw hash). One round trip for
    each top-level key. Exit code 3 if there is no such key.

    Examples:
        reem tree
        reem tree robot.arm
        reem tree 'cam_*'
    """
    count = 0
    async for raw, node in found_all(interface, pattern):
        count += 1
        if as_json:
            emit_json(outline_json(node, raw, whole=True))
            continue
        mark = styled(f"  (raw {raw})", "dim") if raw else ""
        for line in _drawn(node, typed(node.path), "", "", None if whole else _MOST_CHILDREN):
            emit(line + mark)
            mark = ""
    return 0 if count else _nothing(pattern, interface)


def _nothing(pattern: str, interface: RedisInterface) -> int:
    where = f"at {interface.hostname}"
    if interface.namespace:
        where += f" in the namespace {interface.namespace}"
    note(f"no key of REEM {where}" if pattern == "*" else f"no key {pattern} {where}")
    return NOTHING


def _drawn(node: Outline, name: str, lead: str, below: str, most: int | None) -> Iterator[str]:
    """Yield the lines of a tree: `lead` stands before the first one, `below` before those of its children."""
    # A list of plain values is one line, as people write it.
    inline = node.kind == "list" and all(child.plain for child in node.children)
    size = "" if node.plain or not node.size else size_text(node.size)
    room = width() - len(lead) - len(name) - len(size) - 5 if is_terminal() else 200
    what = describe(node, max(room, 16))
    colour = "yellow" if node.plain or inline else "cyan"
    text = cut(name, max(width() - len(lead) - 1, 8)) if is_terminal() else name
    parts = [styled(text, "bold"), styled(what, colour), styled(size, "green")]
    yield styled(lead, "dim") + "  ".join(part for part in parts if part)
    if inline or not node.children:
        return
    children = node.children[:most]
    left = len(node.children) - len(children)
    for place, child in enumerate(children):
        last = place == len(children) - 1 and not left
        lead, deeper = below + ("└── " if last else "├── "), below + ("    " if last else "│   ")
        yield from _drawn(child, _key(child), lead, deeper, most)
    if left:
        yield styled(below + "└── ", "dim") + f"… {left} more (--all)"


def _key(node: Outline) -> str:
    key = node.path[-1]
    return f"[{key}]" if isinstance(key, int) else typed((key,))


async def found_all(interface: RedisInterface, pattern: str) -> AsyncGenerator[tuple[str, Outline], None]:
    """Yield the outlines of all that a pattern names, those in keys of other programs with their Redis type.

    Raises:
        MissingKey, BadKey: The pattern is a path, and nothing is there, or no key can have that name.
    """
    missing: ReemError | None = None
    try:
        async for node in found(interface, pattern):
            yield "", node
    except (MissingKey, WrongKind, BadKey) as error:
        missing = error
    async for raw, node in raw_found(interface, pattern):
        missing = None
        yield raw, node
    if missing is not None:
        raise missing


async def found(interface: RedisInterface, pattern: str) -> AsyncGenerator[Outline, None]:
    """Yield the outlines of all that a pattern names, by name. One round trip for each top-level key.

    Raises:
        MissingKey: The pattern is a path, and nothing is there.
    """
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
                for node in matching(top, wanted, 1 + len(wanted.rest)):
                    yield node


async def _outline(interface: RedisInterface, name: str) -> Outline | None:
    """Return what is under a top-level key; None if it is gone, kind "?" if REEM did not write it."""
    try:
        return await outline(interface, (name,))
    except (MissingKey, WrongKind):
        return None
    except BadData as error:
        return Outline((name,), "?", for_users(error))


def describe(node: Outline, limit: int) -> str:
    """Return what is at a path in at most `limit` characters: the value, or what kind of thing it is."""
    if node.plain:
        return cut(json_text(node.value), limit)
    if node.kind == "dict":
        return counted(len(node.children), "key") if node.children else "{}"
    if node.kind != "list":
        return cut(clean(node.summary or node.kind), limit)
    if not node.children:
        return "[]"
    # The first hundred, cut to the line: a list may have a million items.
    if all(child.plain for child in node.children):
        values = ", ".join([json_text(child.value) for child in node.children[:100]])
        return cut(f"[{values}]", max(limit - 16, 16)) + f"  {counted(len(node.children), 'item')}"
    return counted(len(node.children), "item")


def as_data(node: Outline) -> Any:
    if node.plain:
        return node.value
    if node.kind == "dict":
        return {child.path[-1]: as_data(child) for child in node.children}
    if node.kind == "list":
        return [as_data(child) for child in node.children]
    return f"<{node.summary or node.kind}, {size_text(node.size)}>"


def outline_json(node: Outline, raw: str = "", *, whole: bool) -> dict[str, Any]:
    entry: dict[str, Any] = {"path": typed(node.path), "type": node.kind, "size": node.size}
    if raw:
        entry["raw"] = raw  # the Redis type of a key of another program
    if node.plain:
        entry["value"] = node.value
    elif node.kind in ("dict", "list"):
        entry["length"] = len(node.children)
        if whole:
            entry["children"] = [outline_json(child, whole=True) for child in node.children]
    else:
        entry["summary"] = node.summary
    return entry
