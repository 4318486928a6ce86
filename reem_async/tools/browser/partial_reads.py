"""Looking at parts of large documents: what is at some paths, never a whole document.

Three round trips for any number of paths: the types; the lengths, and the short values; and the items
of short lists, if all of them are plain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ...errors import BadData
from ...plan import Command, Plan, Reply
from ...plan.paths import Path, to_jsonpath
from ...plan.reads import count_in, entries_command
from ...plan.replies import type_name
from ...plan.trees import is_addressable
from ...session import Session
from .source import Node, node_of, shown_text
from .trees import tree_of

_LONGEST = 2048  # bytes of a text that are fetched to show its beginning; placeholders are shorter
_SHORT_LIST = 8  # items of a list that the tree shows in its row
# The server's words for types -> Python's.
_CONTAINERS = {"object": "dict", "array": "list"}
_PLAIN = {b"integer", b"number", b"boolean", b"null"}


async def _ask(session: Session, commands: Sequence[Command]) -> list[Reply]:
    """Return the replies, errors among them: what is not there, or not a document, is no reason to stop."""
    return list(await session.run(Plan(list(commands), list))) if commands else []


async def peek(session: Session, paths: Sequence[Path]) -> list[Node | None]:
    """Return the node at each path, None where nothing is. Three round trips at most."""
    nodes: list[Node | None] = [None] * len(paths)
    where: dict[int, tuple[str, str]] = {}
    for index, path in enumerate(paths):
        if all(map(is_addressable, path[1:])):
            where[index] = _place(session, path)
        else:
            nodes[index] = Node(path, "unreachable", "its key cannot be addressed; read the dict that holds it")
    # First the types, and the lengths of texts, which are 0 for all else. A long text is not fetched.
    replies = await _ask(session, [(name, *where[index]) for index in where for name in ("JSON.TYPE", "JSON.STRLEN")])
    kinds: dict[int, str] = {}
    for index, kind, length in zip(where, replies[::2], replies[1::2], strict=True):
        name, size = None if isinstance(kind, Exception) else type_name(kind), _number(length)
        if name is not None and size <= _LONGEST:
            kinds[index] = name
        elif name is not None:
            nodes[index] = Node(paths[index], "str", f"{size} bytes of text", size)
    # Then the lengths of containers, and the values of all else.
    replies = await _ask(session, [_question(kind)(*where[index]) for index, kind in kinds.items()])
    for (index, kind), reply in zip(kinds.items(), replies, strict=True):
        if kind in _CONTAINERS:
            nodes[index] = Node(paths[index], _CONTAINERS[kind], "", None, count_in(reply) or 0)
        elif isinstance(reply, bytes | bytearray):
            nodes[index] = _scalar(paths[index], bytes(reply))
    await _preview(session, where, nodes)
    return nodes


def _question(kind: str) -> Callable[[str, str], Command]:
    """Return what makes the command that asks for a container's length, or for the value of anything else."""
    if kind == "object":
        return entries_command
    name = "JSON.ARRLEN" if kind == "array" else "JSON.GET"
    return lambda document, place: (name, document, place)


async def _preview(session: Session, where: Mapping[int, tuple[str, str]], nodes: list[Node | None]) -> None:
    short = [
        index
        for index, node in enumerate(nodes)
        if node is not None and node.kind == "list" and node.count and node.count <= _SHORT_LIST
    ]
    kinds = await _ask(session, [("JSON.TYPE", key, f"{place}[*]") for key, place in (where[index] for index in short)])
    # Items that are not all numbers may be large: only their types were asked for.
    plain = [
        index
        for index, reply in zip(short, kinds, strict=True)
        if isinstance(reply, list) and set(_flat(reply)) <= _PLAIN
    ]
    replies = await _ask(session, [("JSON.GET", *where[index]) for index in plain])
    for index, reply in zip(plain, replies, strict=True):
        node = nodes[index]
        if node is not None and isinstance(reply, bytes | bytearray):
            (value,) = tree_of(bytes(reply), "") or [[]]
            nodes[index] = node_of(node.path, value)


def _scalar(path: Path, reply: bytes) -> Node | None:
    try:
        found = tree_of(reply, str(path[0]))
    except BadData as error:
        return Node(path, "unreadable", shown_text(str(error)))
    return node_of(path, found[0]) if found else None


async def keys_at(session: Session, path: Path) -> list[str] | int | None:
    """Return the keys of the dict at `path`, the length of the list there, or None. One round trip."""
    if not all(map(is_addressable, path[1:])):
        return None
    place = _place(session, path)
    # Asked both at once, since it is not known which it is: one of the replies says that it is not such.
    keys, length = await _ask(session, [("JSON.OBJKEYS", *place), ("JSON.ARRLEN", *place)])
    if isinstance(keys, list) and keys and isinstance(keys[0], list):
        return [key.decode(errors="replace") for key in keys[0]]
    if isinstance(length, list) and length and isinstance(length[0], int):
        return length[0]
    return None


def _place(session: Session, path: Path) -> tuple[str, str]:
    return session.keys(path[0]).document, to_jsonpath(path[1:])


def _number(reply: Any) -> int:
    flat = list(_flat(reply)) if isinstance(reply, list) else []
    return flat[0] if flat and isinstance(flat[0], int) else 0


def _flat(reply: list[Any]) -> list[Any]:
    return [item for each in reply for item in (_flat(each) if isinstance(each, list) else [each])]
