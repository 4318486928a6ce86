"""The catalogue: which keys there are and what is in them, without fetching arrays."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from typing import Any

from .connection import RedisInterface
from .document import DocumentReader, resolved
from .errors import MissingKey
from .plan import Plan, Reply
from .plan.paths import Path, check_top_key, counts_from_end, parse, show
from .plan.patterns import escaped, parse_pattern
from .plan.placeholders import Placeholder, find, marked
from .plan.reads import get_command, present
from .plan.replies import loads
from .plan.scan import documents

__all__ = ["Outline", "names", "outline"]


@dataclass(frozen=True, slots=True)
class Outline:
    """What is at one path: its type, its size, and what is below it.

    Attributes:
        path: Where it is, top-level key first.
        kind: The type: "dict", "list", "str", "int", "float", "bool", "NoneType", or the label of the ship
            that holds it, such as "numpy".
        summary: What the ship says of it, such as "float64[640,480,3]"; empty for plain values.
        value: The value, if it is a str, a number, a bool or None; else None.
        size: Bytes: of the array, or of all the arrays and texts below.
        children: What is directly below, in the order of the document.
    """

    path: Path
    kind: str
    summary: str = ""
    value: Any = None
    size: int = 0
    children: tuple[Outline, ...] = ()

    @property
    def shown(self) -> str:
        """The path as people write it."""
        return show(self.path)


async def names(interface: RedisInterface, pattern: str = "*") -> AsyncIterator[str]:
    """Yield the top-level keys that `pattern` names, in no order, each once.

    Args:
        interface: The server.
        pattern: A glob: `*` and `?` stand for other characters.

    One round trip for about 1000 keys of the server, whoever they belong to; in a cluster all primaries are
    asked, one after the other. A key that is written, deleted or moved to another node meanwhile may or
    may not be among them.
    """
    session = interface.session
    glob = escaped(session.namespace) + parse_pattern(pattern).glob
    seen: set[str] = set()
    for node in await session.transport.nodes():
        cursor: Any = b"0"
        while True:
            cursor, page = await session.run(documents(glob, cursor), node)
            for key in page:
                name = key.decode(errors="replace")[len(session.namespace) :]
                if name not in seen and _is_name(name):
                    seen.add(name)
                    yield name
            if cursor in (b"0", 0):
                break


def _is_name(name: str) -> bool:
    try:
        check_top_key(name)
    except ValueError:
        return False
    return True


async def outline(interface: RedisInterface, path: str | Path) -> Outline:
    """Return what is at a dotted path, or at a path of keys and indexes, top-level key first.

    One round trip. Arrays are not fetched: the document says what they are.

    Raises:
        MissingKey: Nothing is there.
        BadData: What is there was not written by REEM.
    """
    name, *rest = parse(path) if isinstance(path, str) else path
    reader = DocumentReader(interface.session, name)
    below = tuple(rest)
    if counts_from_end(below):
        below = await resolved(reader, below, MissingKey)

    def decode(replies: Sequence[Reply]) -> Outline:
        text = present(replies[0], reader.keys, below)
        holder = loads(text, reader.keys)
        if marked(text):
            for crate in find(holder, reader.name):
                crate.container[crate.key] = crate.placeholder
        return _outlined(holder[0], (reader.name, *below))

    it: Outline = await interface.session.run(Plan([get_command(reader.keys, below)], decode))
    return it


def _outlined(value: Any, path: Path) -> Outline:
    if isinstance(value, Placeholder):
        return Outline(path, value.label, value.summary, None, value.size)
    if isinstance(value, dict | list):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        children = tuple([_outlined(item, (*path, key)) for key, item in pairs])
        return Outline(path, type(value).__name__, "", None, sum(child.size for child in children), children)
    size = len(value.encode()) if isinstance(value, str) else 8
    return Outline(path, type(value).__name__, "", value, size)
