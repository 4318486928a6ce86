"""Placeholders: strings that a document holds in the place of values that are not JSON.

    $ship numpy .image 7372800 float64[640,480,3]
    |     |     |      |       what it is, for people
    |     |     |      bytes, so that a reader can choose how to fetch it
    |     |     the key that holds it, after the tag {foo}
    |     the label of the ship that wrote it
    the mark

A string, since a path cannot lead into it: a write cannot change the inside of a placeholder. Two labels are REEM's
own and hold their value in place: `text` for a user's string that begins with the mark, `float` for a float that
RedisJSON reads back exactly from no decimal text.
"""

from __future__ import annotations

import collections
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, NoReturn
from urllib.parse import quote, unquote

from ..errors import BadData
from .paths import Path, shorten, suffix

MARK = "$ship "
_MARK_BYTES = MARK.encode()
INLINE_LABELS = frozenset({"text", "float"})


class Placeholder(NamedTuple):
    label: str  # the ship's label
    suffix: str  # the key's name after the tag
    size: int = 0  # bytes of the value, 0 where the ship does not say
    summary: str = ""  # what it is, for people: `float64[640,480,3]`

    def __str__(self) -> str:
        return _written(self)


@dataclass(frozen=True, slots=True, eq=False)
class Unfetched:
    """In the place of an array, or another value that a ship carries, that was not fetched from the server.

    Equal only to itself: the object changes when the value on the server changes.

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
    placeholder: Placeholder
    container: Any
    key: Any


def inline_text(text: str) -> str:
    return f"{MARK}text {text}"


def inline_float(value: float) -> str:
    return f"{MARK}float {value.hex()}"


def parse(text: str) -> Placeholder | str | float:
    """Return the meaning of a string that begins with the mark; raises BadData if REEM does not write such."""
    return _parse_short(text) if len(text) <= _SHORT else _parse(text)


def _parse(text: str) -> Placeholder | str | float:
    label, _, rest = text[len(MARK) :].partition(" ")
    if label == "text":
        return rest
    if label == "float":
        return _parse_float(rest)
    # 18 digits are below 2**63: a foreign program's number must not become a large int of Python.
    words = rest.split(" ", 2)
    if not label or len(words) < 2 or not words[1].isascii() or not words[1].isdigit() or len(words[1]) > 18:
        raise BadData(f"the server holds {shorten(text)}, which looks like a placeholder of REEM but is none")
    return Placeholder(unquote(label), unquote(words[0]), int(words[1]), words[2] if len(words) > 2 else "")


# Long texts are not cached: a foreign program may store any number of them.
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
    # Most texts have no `$`, and one byte is found at memory speed.
    return b"$" in text and _MARK_BYTES in text


def find(holder: list[Any], name: str, unreadable: list[Unreadable] | None = None) -> list[PlaceholderSlot]:
    """Resolve the inline placeholders in `holder` and return those of attachments.

    `holder` is a freshly decoded tree in a list of one; it is changed in place. Every node is visited, so callers check
    `marked` first. With a list of what is `unreadable`, nothing is raised: an `Unreadable` is put into the tree and
    added to the list.

    Raises:
        BadData: A string has the mark but is no placeholder, or two placeholders name the same key: a document of a
            few bytes could demand any number of copies.
    """
    slots: list[PlaceholderSlot] = []
    stack: list[Any] = [holder]
    while stack:
        container = stack.pop()
        for key, value in container.items() if type(container) is dict else enumerate(container):
            # A stack and not recursion: a foreign document may be nested deeper than Python's calls.
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
    if len(slots) > 1 and len({slot.placeholder.suffix for slot in slots}) < len(slots):
        reason = "several placeholders name the same key, which REEM does not write; write it again"
        if unreadable is None:
            raise BadData(f"{name}: {reason}")
        counts = collections.Counter(slot.placeholder.suffix for slot in slots)
        for slot in [slot for slot in slots if counts[slot.placeholder.suffix] > 1]:
            slot.container[slot.key] = Unreadable(place_of(name, slot.placeholder.suffix), reason)
            unreadable.append(slot.container[slot.key])
        slots = [slot for slot in slots if counts[slot.placeholder.suffix] == 1]
    return slots


def place_of(name: str, suffix: str) -> str:
    return f"{name}{suffix.partition('~')[0]}"


def _place(tree: Any, text: str) -> str:
    stack: list[tuple[Path, Any]] = [((), tree)]
    while stack:
        path, node = stack.pop()
        if isinstance(node, str) and node == text:
            return suffix(path)
        pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        stack.extend(((*path, key), child) for key, child in pairs)
    return ""


class _Used(BadData, AttributeError):
    """For `hasattr` and `copy`, which expect an AttributeError."""


class Unreadable:
    """In the place of a value that cannot be read; any use of it raises BadData with the reason.

    The bytes of an array may be gone, damaged, or not readable by this user, or the interface may lack the ship that
    wrote it. Watches, subscribers, mirrors, recordings and the page of `reem browse` have it in their data.
    Test for it with `isinstance(value, reem.Unreadable)`; two are equal if their reasons are.

    Attributes:
        place: Where the value is, as far as that is known: "arm.image".
        reason: Why it cannot be read, and what to do.
    """

    __slots__ = ("place", "reason")

    def __init__(self, place: str, reason: str) -> None:
        self.place = place
        self.reason = reason.removeprefix(f"{place}: ")

    def __repr__(self) -> str:
        return f"<unreadable {self.place}: {self.reason}>"

    def __eq__(self, other: object) -> bool:
        return type(other) is Unreadable and other.reason == self.reason

    def __hash__(self) -> int:
        return hash(self.reason)

    def __reduce__(self) -> tuple[Any, ...]:
        return Unreadable, (self.place, self.reason)

    def __getattr__(self, name: str) -> NoReturn:
        raise _Used(f"{self.place}: {self.reason}")

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise BadData(f"{self.place}: {self.reason}")

    __getitem__ = __setitem__ = __delitem__ = __iter__ = __len__ = __contains__ = __bool__ = __call__ = _refuse
    __float__ = __int__ = __index__ = __complex__ = __bytes__ = __array__ = __lt__ = __le__ = __gt__ = __ge__ = _refuse
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __neg__ = _refuse
    __floordiv__ = __rfloordiv__ = __mod__ = __rmod__ = __pow__ = __rpow__ = __matmul__ = __rmatmul__ = _refuse
    __abs__ = __and__ = __rand__ = __or__ = __ror__ = __round__ = _refuse
