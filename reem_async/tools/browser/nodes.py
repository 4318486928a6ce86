"""Nodes: what one line of the tree shows."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

from ...plan.paths import Path
from .addresses import address
from .trees import leaf_of

__all__ = ["Node", "Page", "node_of", "shown_text", "visible"]

LONGEST_TEXT = 200
"""Characters of a text that a line shows."""

# Items of a list that stand in its row.
_PREVIEW_ITEMS = 8
# Control characters, and those that turn the direction of what follows: shown as escapes, never obeyed.
_INVISIBLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff]"
)


def visible(text: str) -> str:
    """Return `text` with what cannot be seen, or reorders what can, as escapes."""
    return _INVISIBLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def shown_text(text: str, most: int = LONGEST_TEXT) -> str:
    """Return a string for one line: quoted, cut, nothing invisible in it."""
    short = text if len(text) <= most else text[:most] + "…"
    return '"' + visible(short).replace("\n", "\\n").replace("\t", "\\t") + '"'


@dataclass(frozen=True, slots=True)
class Node:
    """What is at one path, without what is below.

    Attributes:
        path: Where, top-level key first.
        kind: "dict", "list", "str", "int", "float", "bool", "NoneType", or the label of a ship.
        text: What to show of it: the value, shortened, or the summary of an array.
        size: Bytes; None for dicts and lists.
        count: How many items a dict or list has; None for anything else.
        value: A number, bool or None as it is; else None.
        time: When it was last seen to change, in seconds since 1970; None if that is not known.
        rate: Updates per second of late; None if that is not known.
        shared: What is published there goes through shared memory, too, to programs on the publisher's host.
    """

    path: Path
    kind: str
    text: str = ""
    size: int | None = None
    count: int | None = None
    value: Any = None
    time: float | None = None
    rate: float | None = None
    shared: bool = False

    def stamped(self, when: float | None, rate: float | None, *, shared: bool = False) -> Node:
        """Return the node with its last change, and how it came."""
        return replace(self, time=when, rate=rate, shared=shared)

    def as_json(self) -> dict[str, Any]:
        """Return what the page is sent."""
        key = self.path[-1] if self.path else ""
        return {
            "address": address(self.path),
            # A key with a dot looks like a path: it is shown as it is written in one.
            "label": visible(address((key,)) if isinstance(key, int) or "." in key else key),
            "kind": self.kind,
            "text": self.text,
            "size": self.size,
            "count": self.count,
            "time": self.time,
            "rate": self.rate,
            "shared": self.shared,
        }


@dataclass(frozen=True, slots=True)
class Page:
    """Some of the items of a dict or list, or of the top-level keys.

    Attributes:
        total: How many there are.
        start: Which the first is.
        nodes: The items.
    """

    total: int
    start: int
    nodes: list[Node]


def node_of(path: Path, value: Any) -> Node:
    """Return the node of a value, an array or a `Leaf`."""
    if isinstance(value, dict | list):
        return Node(path, type(value).__name__, _preview(value), None, len(value))
    if isinstance(value, str):
        return Node(path, "str", shown_text(value), len(value.encode(errors="replace")))
    if value is None or isinstance(value, bool | int | float):
        return Node(path, type(value).__name__, _plain(value), 8, None, value)
    leaf = leaf_of(value)
    return Node(path, leaf.label, visible(leaf.summary), leaf.size)


def _plain(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)


def _preview(value: dict[str, Any] | list[Any]) -> str:
    """Return the items of a short list of plain values; empty for anything else."""
    if isinstance(value, dict) or not 0 < len(value) <= _PREVIEW_ITEMS:
        return ""
    if not all(item is None or isinstance(item, bool | int | float) for item in value):
        return ""
    return "[" + ", ".join([_plain(item).removesuffix(".0") for item in value]) + "]"
