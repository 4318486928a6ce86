"""The catalogue: which keys there are and what is in them, without fetching arrays."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from ..connection import RedisInterface
from ..errors import MissingKey
from ..plan import Plan, Reply
from ..plan.paths import Path, parse, parse_pattern, shorten, show
from ..plan.placeholders import Placeholder, Unfetched, find, marked
from ..plan.reads import get_command, present
from ..plan.replies import from_front, lengths, loads

_PLAIN = frozenset({"str", "int", "float", "bool", "NoneType"})
# Lines of an outline that are printed: more would fill a terminal, or a cell of a notebook.
_MOST_LINES = 200


@dataclass(frozen=True, slots=True, repr=False)
class Outline:
    """What is at one path: its type, its size, and what is below it.

    Printed, or as the last line of a notebook's cell, it is a line for each value, 200 at most.

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

    @property
    def plain(self) -> bool:
        """Whether it is a text, a number, a bool or None."""
        return self.kind in _PLAIN

    def __repr__(self) -> str:
        lines = list(islice(self._lines(self.shown, ""), _MOST_LINES + 1))
        return "\n".join([*lines[:_MOST_LINES], *["…"] * (len(lines) > _MOST_LINES)])

    def _lines(self, name: str, indent: str) -> Iterator[str]:
        # A list of numbers takes one line: an outline is to fit a screen.
        inline = self.kind == "list" and all(child.plain for child in self.children)
        # A key may hold anything, also what a terminal would obey.
        yield f"{indent}{name if name.isprintable() else ascii(name)}: {self._described(inline)}"
        for child in () if inline else self.children:
            key = child.path[-1]
            yield from child._lines(f"[{key}]" if isinstance(key, int) else show((key,)), indent + "    ")

    def _described(self, inline: bool) -> str:
        if self.plain:
            return shorten(self.value)
        if inline:
            return f"list of {len(self.children)}, {shorten([child.value for child in self.children])}"
        if self.kind in ("dict", "list"):
            return f"{self.kind} of {len(self.children)}"
        what = shorten(self.summary).strip("'") if self.summary else self.kind
        return f"{what}, {self.size:,} bytes"


async def names(interface: RedisInterface, pattern: str = "*") -> AsyncIterator[str]:
    """Yield the top-level keys that a glob names, in no order, each once; raises and costs as `KeyValueStore.keys`.

    In a cluster all primaries are asked, one after the other; a connection to one node alone raises ClusterNode.
    """
    async for name in interface.session.names(parse_pattern(pattern)):
        yield name


async def outline(interface: RedisInterface, path: str | Path) -> Outline:
    """Return what is at a dotted path, or at a path of keys and indexes; raises and costs as `Accessor.outline`."""
    name, *rest = parse(path) if isinstance(path, str) else path
    keys, below = interface.session.keys(name), tuple(rest)
    counted = lengths(keys, below)

    def decode(replies: Sequence[Reply]) -> Outline:
        text = present(replies[0], keys, below)
        holder = loads(text, keys)
        if marked(text):
            for slot in find(holder, keys.name):
                slot.container[slot.key] = slot.placeholder
        return outlined(holder[0], (keys.name, *from_front(replies[1:], keys, below, MissingKey)))

    # A transaction only where the path counts from the end of a list: its length is to be of the same instant.
    it: Outline = await interface.session.run(Plan([get_command(keys, below), *counted], decode, atomic=bool(counted)))
    return it


def outlined(value: Any, path: Path) -> Outline:
    """Return the outline of a value that was read, with placeholders for what was not."""
    if isinstance(value, Placeholder | Unfetched):
        return Outline(path, value.label, value.summary, None, value.size)
    if isinstance(value, bytes):
        return Outline(path, "bytes", "bytes", None, len(value))
    if isinstance(value, dict | list):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        children = tuple([outlined(item, (*path, key)) for key, item in pairs])
        return Outline(path, type(value).__name__, "", None, sum(child.size for child in children), children)
    size = len(value.encode()) if isinstance(value, str) else 8
    return Outline(path, type(value).__name__, "", value, size)
