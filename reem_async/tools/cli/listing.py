"""`reem ls` and `reem tree`: which keys there are, and what is below them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from reem_async.tools.cli.completion import complete_path
from reem_async.tools.cli.options import DEFAULT_URL, AsJson, Namespace, Url
from reem_async.tools.cli.output import (
    columns,
    cut,
    emit,
    emit_json,
    is_terminal,
    note,
    size_text,
    styled,
    typed,
    width,
)
from reem_async.tools.cli.running import NOTHING, run

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.store.catalog import Outline

__all__ = ["ls", "tree"]

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


def ls(pattern: OnePattern = "*", as_json: AsJson = False, url: Url = DEFAULT_URL, namespace: Namespace = "") -> None:
    """List keys with type and size.

    One line for each key that the pattern names: name, type, what it is, bytes. Arrays are not
    fetched. Where the output is no terminal, tabs separate the columns.

    Exit code 3 if there is no such key.

    Examples:
        reem ls
        reem ls 'cam_*'
        reem ls 'robot.*'          what is directly below robot
        reem ls --json | jq -r .path
    """

    async def work(interface: RedisInterface) -> int:
        from reem_async.tools.cli.outlines import as_json as for_programs
        from reem_async.tools.cli.outlines import describe, found

        # All rows before the first is printed: the widths of the columns depend on them. JSON lines go out as they
        # come.
        rows = []
        async for node in found(interface, pattern):
            if as_json:
                emit_json(for_programs(node, 0))
            rows.append((typed(node.path), node.kind, describe(node, 48), size_text(node.size)))
        if not as_json:
            columns(rows, ("bold", "cyan", "", "green"), right=frozenset({3}), shrink=(2, 0))
        return 0 if rows else _nothing(pattern, interface)

    run("ls", work, url, namespace)


def tree(
    pattern: OnePattern = "*",
    depth: Annotated[
        int | None, typer.Option("--depth", "-d", min=0, metavar="N", help="Only so many levels below each.")
    ] = None,
    whole: Annotated[
        bool, typer.Option("--all", help=f"Also what comes after the first {_MOST_CHILDREN} entries of a dict or list.")
    ] = False,
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Show what is below keys; arrays as dtype, shape and size, without fetching them.

    One round trip for each top-level key. Exit code 3 if there is no such key.

    Examples:
        reem tree
        reem tree robot.arm --depth 1
        reem tree 'cam_*'
    """

    async def work(interface: RedisInterface) -> int:
        from reem_async.tools.cli.outlines import as_json as for_programs
        from reem_async.tools.cli.outlines import found

        count = 0
        async for node in found(interface, pattern):
            count += 1
            if as_json:
                emit_json(for_programs(node, depth))
                continue
            for line in _drawn(node, typed(node.path), "", "", depth, None if whole else _MOST_CHILDREN):
                emit(line)
        return 0 if count else _nothing(pattern, interface)

    run("tree", work, url, namespace)


def _nothing(pattern: str, interface: RedisInterface) -> int:
    where = f"at {interface.hostname}"
    if interface.namespace:
        where += f" in the namespace {interface.namespace}"
    note(f"no key of REEM {where}" if pattern == "*" else f"no key {pattern} {where}")
    return NOTHING


def _drawn(node: Outline, name: str, lead: str, below: str, depth: int | None, most: int | None) -> Iterator[str]:
    """Yield the lines of a tree.

    Args:
        node: What is drawn.
        name: What it is called.
        lead: What stands before it, and
        below: what stands before what is below it.
        depth: How many levels below it are drawn, None for all.
        most: How many children of one node are drawn, None for all.
    """
    from reem_async.tools.cli.outlines import describe

    # A list of plain values is one line, as people write it.
    inline = node.kind == "list" and all(child.plain for child in node.children)
    size = "" if node.plain or not node.size else size_text(node.size)
    room = width() - len(lead) - len(name) - len(size) - 5 if is_terminal() else 200
    what = describe(node, max(room, 16))
    colour = "yellow" if node.plain or inline else "cyan"
    text = cut(name, max(width() - len(lead) - 1, 8)) if is_terminal() else name
    parts = [styled(text, "bold"), styled(what, colour), styled(size, "green")]
    yield styled(lead, "dim") + "  ".join(part for part in parts if part)
    if inline or not node.children or depth == 0:
        return
    children = node.children[:most]
    left = len(node.children) - len(children)
    for place, child in enumerate(children):
        last = place == len(children) - 1 and not left
        lead, deeper = below + ("└── " if last else "├── "), below + ("    " if last else "│   ")
        yield from _drawn(child, _key(child), lead, deeper, None if depth is None else depth - 1, most)
    if left:
        yield styled(below + "└── ", "dim") + f"… {left} more (--all)"


def _key(node: Outline) -> str:
    """Return the last element of a path as a user would type it."""
    key = node.path[-1]
    return f"[{key}]" if isinstance(key, int) else typed((key,))
