"""What stands in a document where a value is not JSON: a string that says what is there.

    $ship numpy .image 7372800 float64[640,480,3]
    |     |     |      |       what it is, for people
    |     |     |      bytes, so that a reader can choose how to fetch it
    |     |     the key that holds it, after the tag {foo}
    |     the label of the ship that wrote it
    the mark

A string, since a path can lead into an object and a write could then change a placeholder's inside;
nothing leads into a string. Two labels are REEM's own and hold their value in place: `text` for a
user's string that begins with the mark, `float` for a float no decimal text of which survives.
"""

from __future__ import annotations

import collections
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple
from urllib.parse import quote, unquote

from ..errors import BadData
from .paths import Path, shorten, suffix
from .unreadable import Unreadable

__all__ = [
    "INLINE_LABELS",
    "MARK",
    "Placeholder",
    "PlaceholderSlot",
    "Unfetched",
    "find",
    "inline_float",
    "inline_text",
    "marked",
    "parse",
    "place_of",
]  # fmt: skip

MARK = "$ship "
_MARK_BYTES = MARK.encode()
INLINE_LABELS = frozenset({"text", "float"})


class Placeholder(NamedTuple):
    """What a document says of a value that a ship holds under a key of its own.

    Attributes:
        label: The ship's label.
        suffix: The key's name after the tag.
        size: Bytes of the value, 0 where the ship does not say.
        summary: What it is, for people: `float64[640,480,3]`.
    """

    label: str
    suffix: str
    size: int = 0
    summary: str = ""

    def __str__(self) -> str:
        return _written(self)


@dataclass(frozen=True, slots=True, eq=False)
class Unfetched:
    """An array, or another value that a ship carries, that was left at the server: what the document says of it.

    Two are equal only if they are the same object, which stands for one state of what is at the server.

    Attributes:
        label: The ship's label: "numpy", "bytes".
        size: Bytes of the value, 0 where the ship does not say.
        summary: What it is, for people: `float64[640,480,3]`.
    """

    label: str
    size: int
    summary: str


@lru_cache(maxsize=4096)
def _written(it: Placeholder) -> str:
    words = [MARK[:-1], quote(it.label, safe=_SAFE), quote(it.suffix, safe=_SAFE), str(it.size)]
    return " ".join([*words, it.summary] if it.summary else words)


# Everything but blanks, controls and the percent sign stays readable.
_SAFE = "".join(chr(code) for code in range(33, 127) if chr(code) != "%")


class PlaceholderSlot(NamedTuple):
    """A placeholder found in a decoded tree, and where: `container[key]` is to be replaced."""

    placeholder: Placeholder
    container: Any
    key: Any


def inline_text(text: str) -> str:
    """Return the placeholder of a user's string that looks like one."""
    return f"{MARK}text {text}"


def inline_float(value: float) -> str:
    """Return the placeholder of a float that no decimal text carries."""
    return f"{MARK}float {value.hex()}"


def parse(text: str) -> Placeholder | str | float:
    """Return what the string `text`, which begins with the mark, stands for.

    Raises:
        BadData: Not what REEM writes.
    """
    return _parse_short(text) if len(text) <= _SHORT else _parse(text)


def _parse(text: str) -> Placeholder | str | float:
    label, _, rest = text[len(MARK) :].partition(" ")
    if label == "text":
        return rest
    if label == "float":
        return _parse_float(rest)
    # 18 digits are below 2**63: a stranger's number must not become a large int of Python.
    words = rest.split(" ", 2)
    if not label or len(words) < 2 or not words[1].isascii() or not words[1].isdigit() or len(words[1]) > 18:
        raise BadData(f"the server holds {shorten(text)}, which looks like a placeholder of REEM but is none")
    return Placeholder(unquote(label), unquote(words[0]), int(words[1]), words[2] if len(words) > 2 else "")


# Long texts, of which a stranger may put any number there, are not kept.
_parse_short = lru_cache(maxsize=4096)(_parse)
_SHORT = 256


def _parse_float(text: str) -> float:
    try:
        number = float.fromhex(text)
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise BadData(f"the server holds the float {shorten(text)}, which is not hexadecimal and finite")
    return number


def marked(text: bytes) -> bool:
    """Return whether JSON `text` may hold a placeholder; most has no `$`, and one byte is found at memory speed."""
    return b"$" in text and _MARK_BYTES in text


def find(holder: list[Any], name: str, unreadable: list[Unreadable] | None = None) -> list[PlaceholderSlot]:
    """Resolve what stands in place inside `holder` and return the placeholders that are left.

    `holder` is a freshly decoded tree in a list of one; it is changed in place. Costs one visit to
    every node, so callers look for the mark in the text first.

    If there is a list of what is `unreadable`, nothing is raised: an `Unreadable` takes the place, and is added to it.

    Raises:
        BadData: A string has the mark but is no placeholder, or two stand for the same key: a document of a
            few bytes could demand any number of copies. Says where, below the top-level key `name`.
    """
    slots: list[PlaceholderSlot] = []
    stack: list[Any] = [holder]
    while stack:
        container = stack.pop()
        for key, value in container.items() if type(container) is dict else enumerate(container):
            # A stack and not recursion: what a stranger wrote may be nested deeper than Python calls may.
            kind = type(value)
            if kind is dict or kind is list:
                stack.append(value)
            elif kind is str and value.startswith(MARK):
                try:
                    meaning = parse(value)
                except BadData as error:
                    where = f"{name}{_place(holder[0], value)}"
                    if unreadable is None:
                        raise BadData(f"{where}: {error}") from None
                    unreadable.append(Unreadable(where, str(error)))
                    container[key] = unreadable[-1]
                    continue
                if type(meaning) is Placeholder:
                    slots.append(PlaceholderSlot(meaning, container, key))
                else:
                    container[key] = meaning
    # A set only where there are several: most documents with arrays have one or two.
    if len(slots) > 1 and len({slot.placeholder.suffix for slot in slots}) < len(slots):
        reason = "several placeholders name the same key, which REEM does not write; write it anew"
        if unreadable is None:
            raise BadData(f"{name}: {reason}")
        counts = collections.Counter(slot.placeholder.suffix for slot in slots)
        for slot in [slot for slot in slots if counts[slot.placeholder.suffix] > 1]:
            slot.container[slot.key] = Unreadable(place_of(name, slot.placeholder.suffix), reason)
            unreadable.append(slot.container[slot.key])
        slots = [slot for slot in slots if counts[slot.placeholder.suffix] == 1]
    return slots


def place_of(name: str, suffix: str) -> str:
    """Return where a value that a ship holds is, as people write it: its key ends in the path, and maybe a number."""
    return f"{name}{suffix.partition('~')[0]}"


def _place(tree: Any, text: str) -> str:
    """Return where in `tree` the string `text` is, as people write paths; it may be nested deeper than calls may."""
    stack: list[tuple[Path, Any]] = [((), tree)]
    while stack:
        path, node = stack.pop()
        if isinstance(node, str) and node == text:
            return suffix(path)
        pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        stack.extend(((*path, key), child) for key, child in pairs)
    return ""
