"""What the JSON module does to a document, done to its text: the same replies, the same refusals.

Numbers stay what they are: integers of 64 bits, signed or not, and floats to the last bit, since both ways between
text and number round correctly. Integers are added and multiplied as the module does it, wrapped around at 64 bits;
whoever calls for it checks the result (`plan.arithmetic`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import orjson

from ..plan.documents import nested_over
from .paths import Place, Refusal, places, steps_of

MARK = b" "
"""The first byte of the string that is a document, before its JSON text. To JSON it means nothing, and programs of
others do not begin a string with it: so a document is told from their strings by its first byte alone."""

_ABSENT = "ERR could not perform this operation on a key that doesn't exist"
_NUMBERS = (int, float)
_LOWEST, _HIGHEST, _WHOLE = -(2**63), 2**63 - 1, 2**64


def stored(text: str | bytes | bytearray) -> bytes:
    """Return the string that is a document of JSON text; a ship of a user's may have given a str."""
    return MARK + (text.encode() if isinstance(text, str) else bytes(text))


def is_document(text: bytes | bytearray) -> bool:
    """Return whether what a string begins with says that it is a document."""
    return text[:1] == MARK


_DEEPEST = 128
"""Levels of a document that the module takes."""


class Document:
    """One document while commands are carried out on it, one after the other.

    Args:
        text: What the key's string holds, None if there is no key. It is a document's.

    Attributes:
        changed: It is not any more as it was given.
    """

    def __init__(self, text: bytes | bytearray | None) -> None:
        # Either may be None: the text while the tree has changes that are not written yet, the tree until it is needed.
        self._text = text
        self._holder: list[Any] | None = None
        self.changed = False

    def run(self, command: Sequence[Any]) -> Any:
        """Carry out a JSON command; return its reply.

        Raises:
            Refusal: With the text that the module refuses it with.
        """
        name, _, *words = command
        path = _text_of(words[0]) if words else "$"
        if name in _WRITES:
            return _WRITES[name](self, path, words[1:])
        return _READS[name](self, path, not words)

    @property
    def exists(self) -> bool:
        """Whether there is a document."""
        return self._text is not None or bool(self._holder)

    def string(self) -> bytes:
        """Return what the key's string is to hold."""
        if self._text is None:
            assert self._holder
            self._text = MARK + orjson.dumps(self._holder[0])
        return bytes(self._text)

    # Reading.

    def _tree(self) -> list[Any]:
        """Return a list of the tree alone; empty if there is no document."""
        if self._holder is None:
            try:
                self._holder = [] if self._text is None else [orjson.loads(memoryview(self._text))]
            except orjson.JSONDecodeError:
                raise Refusal("ERR the string under this key is no document: it is not JSON") from None
            # Deeper ones are not REEM's, and orjson writes no more than 254 levels.
            if self._text is not None and nested_over(bytes(self._text), self._holder[0], _DEEPEST):
                self._holder = None
                raise Refusal(f"ERR the document under this key is nested over {_DEEPEST} levels")
        return self._holder

    def _at(self, path: str) -> list[Place]:
        return places(self._tree(), steps_of(path))

    def _each(self, path: str, measure: Callable[[Any], Any], absent: str = _ABSENT) -> list[Any]:
        if not self.exists:
            raise Refusal(absent)
        return [measure(place.value) for place in self._at(path)]

    def get(self, path: str, bare: bool) -> bytes | None:
        """Return the JSON text of what is at a path, in a list; of the root alone if `bare`."""
        if not self.exists:
            return None
        # The whole document is copied as text, without parsing: what programs read most.
        if not steps_of(path):
            text = memoryview(self.string())[1:]
            return bytes(text) if bare or path == "." else b"".join((b"[", text, b"]"))
        return orjson.dumps([place.value for place in self._at(path)])

    def type(self, path: str, bare: bool) -> list[Any]:
        """Return the name of the type of each value at a path."""
        if not self.exists:
            return [None]
        names = [_type(place.value) for place in self._at(path)]
        return names if bare else [names]

    def keys(self, path: str, bare: bool) -> Any:
        """Return the keys of each dict at a path."""
        return self._each(path, lambda value: [key.encode() for key in value] if type(value) is dict else None)

    def entries(self, path: str, bare: bool) -> Any:
        """Return how many entries each dict at a path has."""
        absent = f"ERR Path '{path}' does not exist or not an object"
        return self._each(path, lambda value: len(value) if type(value) is dict else None, absent)

    def items(self, path: str, bare: bool) -> Any:
        """Return how many items each list at a path has."""
        return self._each(path, lambda value: len(value) if type(value) is list else None)

    def length(self, path: str, bare: bool) -> Any:
        """Return how many bytes each text at a path has."""
        return self._each(path, lambda value: len(value.encode()) if type(value) is str else None)

    # Writing.

    def set(self, path: str, words: Sequence[Any]) -> bytes | None:
        """Put a value at a path, if that is there (XX), or if it is not (NX)."""
        text, only = words[0], {_text_of(word) for word in words[1:]}
        if not steps_of(path):
            if ("NX" in only and self.exists) or ("XX" in only and not self.exists):
                return None
            # Not parsed: it comes from orjson, or from a ship that vouches for it.
            self._holder, self._text, self.changed = None, stored(text), True
            return b"OK"
        value = _loaded(text)
        if not self.exists:
            raise Refusal("ERR new objects must be created at the root")
        found = self._at(path)
        if found and "NX" in only:
            _check_static(steps_of(path))
            return None
        for place in found:
            place.container[place.key] = value
        if found or "XX" in only:
            return self._noted(bool(found))
        return self._noted(self._added(path, value))

    def _added(self, path: str, value: Any) -> bool:
        """Put a new key into a dict; return whether there was one without it."""
        steps = steps_of(path)
        _check_static(steps)
        if isinstance(steps[-1], int):
            raise Refusal("ERR array index out of range")
        for place in places(self._tree(), steps[:-1]):
            if type(place.value) is dict and steps[-1] not in place.value:
                place.value[steps[-1]] = value
                return True
        return False

    def _noted(self, changed: bool) -> bytes | None:
        if changed:
            self._text, self.changed = None, True
        return b"OK" if changed else None

    def delete(self, path: str, words: Sequence[Any]) -> int:
        """Remove what is at a path; return how many values that were."""
        if not self.exists:
            return 0
        if not steps_of(path):
            self._holder, self._text, self.changed = [], None, True
            return 1
        found = self._at(path)
        # From the end, so that removing an item does not move those that are still to be removed.
        for place in reversed(found):
            _remove(place)
        self._noted(bool(found))
        return len(found)

    def append(self, path: str, words: Sequence[Any]) -> Any:
        """Append values to each list at a path; return how long they are then."""
        if not self.exists:
            raise Refusal(_ABSENT)
        values = [_loaded(word) for word in words]
        lengths: list[int | None] = []
        for place in self._at(path):
            into = place.value
            if type(into) is list:
                into.extend(values)
                self._noted(True)
            lengths.append(len(into) if type(into) is list else None)
        return lengths

    def add(self, path: str, words: Sequence[Any]) -> Any:
        """Add a number to each number at a path; return the sums."""
        return self._calculated(path, words[0], lambda a, b: a + b)

    def multiply(self, path: str, words: Sequence[Any]) -> Any:
        """Multiply each number at a path by a number; return the products."""
        return self._calculated(path, words[0], lambda a, b: a * b)

    def _calculated(self, path: str, word: Any, operation: Callable[[Any, Any], Any]) -> Any:
        if not self.exists:
            raise Refusal(_ABSENT)
        results: list[Any] = []
        for place in self._at(path):
            old = place.value
            if type(old) not in _NUMBERS:
                results.append(None)
                continue
            # Parsed as JSON, so an integer stays one: adding 1 and adding 1.0 give results of different types.
            operand = _loaded(word)
            if type(operand) not in _NUMBERS:
                raise Refusal("ERR bad input number")
            place.container[place.key] = new = _arithmetic(old, operand, operation)
            self._noted(True)
            results.append(new)
        return results


def _check_static(steps: Sequence[Any]) -> None:
    """Refuse a path that may lead to several places where it must not."""
    if any(isinstance(step, slice) for step in steps):
        raise Refusal("ERR Err wrong static path")


def _arithmetic(one: Any, other: Any, operation: Callable[[Any, Any], Any]) -> Any:
    if type(one) is int and type(other) is int and max(one, other) <= _HIGHEST:
        return (operation(one, other) - _LOWEST) % _WHOLE + _LOWEST  # as the module: wrapped around
    result = operation(float(one), float(other))
    if not math.isfinite(result):
        raise Refusal("ERR result is not a number")
    return result


def _remove(place: Place) -> None:
    """Remove what is there. Of a dict, the last entry takes its place in the order, as in the module."""
    if type(place.container) is list:
        del place.container[place.key]
        return
    it: dict[str, Any] = place.container
    last, value = it.popitem()
    if last == place.key:
        return
    entries = [(last, value) if key == place.key else (key, old) for key, old in it.items()]
    it.clear()
    it.update(entries)


def _loaded(text: Any) -> Any:
    try:
        return orjson.loads(text)
    except orjson.JSONDecodeError as error:
        raise Refusal(f"ERR {error}") from None


def _text_of(word: Any) -> str:
    return word.decode() if isinstance(word, bytes) else str(word)


def _type(value: Any) -> bytes:
    return _TYPES[type(value)]


_TYPES: dict[type, bytes] = {
    dict: b"object",
    list: b"array",
    str: b"string",
    int: b"integer",
    float: b"number",
    bool: b"boolean",
    type(None): b"null",
}

_READS: dict[str, Callable[[Document, str, bool], Any]] = {
    "JSON.GET": Document.get,
    "JSON.TYPE": Document.type,
    "JSON.OBJKEYS": Document.keys,
    "JSON.OBJLEN": Document.entries,
    "JSON.ARRLEN": Document.items,
    "JSON.STRLEN": Document.length,
}
_WRITES: dict[str, Callable[[Document, str, Sequence[Any]], Any]] = {
    "JSON.SET": Document.set,
    "JSON.DEL": Document.delete,
    "JSON.ARRAPPEND": Document.append,
    "JSON.NUMINCRBY": Document.add,
    "JSON.NUMMULTBY": Document.multiply,
}
READS, WRITES = frozenset(_READS), frozenset(_WRITES)
"""The names of the commands that look at a document, and of those that change it."""
