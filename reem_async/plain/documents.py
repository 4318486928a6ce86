"""The JSON module's commands on a document, executed on its text: the same replies, the same errors.

Numbers stay the same: integers of 64 bits, signed or not, and floats to the last bit, since text and number are
converted with correct rounding. Integers are added and multiplied as in the module, wrapped around at 64 bits; the plan
checks the result (`plan.arithmetic`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import orjson

from ..plan.documents import nested_over

Step = str | int | slice
Steps = tuple[Step, ...]

ALL = slice(None)  # every item of a list, every value of a dict
_STEP = re.compile(r"""\["(?P<double>[^"]*)"\]|\['(?P<single>[^']*)'\]|\[(?P<from>-?\d+)(?::(?P<to>-?\d+))?\]|\[\*\]""")


class Refusal(Exception):
    """A command is refused, with the message of the server's error."""


class Place(NamedTuple):
    """A place in a tree: `container[key]`; for the root, the only item of a list."""

    container: Any
    key: Any

    @property
    def value(self) -> Any:
        return self.container[self.key]


@lru_cache(maxsize=4096)
def steps_of(path: str) -> Steps:
    """Return the steps of a path from the root; raises Refusal for paths that REEM never sends."""
    # The root, as commands of RedisJSON 1 name it; `bare` replies belong to it.
    if path == ".":
        return ()
    position, steps = 1, []
    while position < len(path):
        found = _STEP.match(path, position)
        if found is None or path[0] != "$":
            raise Refusal(f"ERR the path {path!r:.80} is none that REEM uses; documents of this server are plain text")
        steps.append(_step(found))
        position = found.end()
    return tuple(steps)


def _step(found: re.Match[str]) -> Step:
    if found["double"] is not None or found["single"] is not None:
        return str(found["single"] if found["double"] is None else found["double"])
    if found["from"] is None:
        return ALL
    return int(found["from"]) if found["to"] is None else slice(int(found["from"]), int(found["to"]))


def places(holder: list[Any], steps: Steps) -> list[Place]:
    found = [Place(holder, 0)]
    for step in steps:
        found = [inner for place in found for inner in _inside(place.value, step)]
    return found


def _inside(value: Any, step: Step) -> list[Place]:
    if isinstance(step, str):
        return [Place(value, step)] if type(value) is dict and step in value else []
    if type(value) is dict:
        return [Place(value, key) for key in value] if step is ALL else []
    if type(value) is not list:
        return []
    if isinstance(step, slice):
        return [Place(value, index) for index in range(*step.indices(len(value)))]
    # Strictly: no item for an index that is too negative; the module would name the first.
    index = step if step >= 0 else len(value) + step
    return [Place(value, index)] if 0 <= index < len(value) else []


MARK = b" "
"""The first byte of a document's string, before its JSON text. JSON ignores it, and other programs do not begin a
string
with it, so it identifies a document."""

_ABSENT = "ERR could not perform this operation on a key that doesn't exist"
_NUMBERS = (int, float)
_LOWEST, _HIGHEST, _WHOLE = -(2**63), 2**63 - 1, 2**64


def stored(text: str | bytes | bytearray) -> bytes:
    """Return the string of a document; a user's ship may have given a str."""
    return MARK + (text.encode() if isinstance(text, str) else bytes(text))


def is_document(text: bytes | bytearray) -> bool:
    return text[:1] == MARK


_DEEPEST = 128  # levels of a document that the module accepts


class TextDocument:
    """One document, given the key's string, or None if there is no key, on which commands are executed."""

    def __init__(self, text: bytes | bytearray | None) -> None:
        # The text is None while the tree has newer changes, the tree until it is needed.
        self._text = text
        self._holder: list[Any] | None = None
        self.changed = False

    def run(self, command: Sequence[Any]) -> Any:
        """Execute a JSON command and return its reply; raises Refusal with the module's message."""
        name, _, *words = command
        path = _text_of(words[0]) if words else "$"
        if name in _WRITES:
            return _WRITES[name](self, path, words[1:])
        if name in _MEASURES:
            return self._measured(name, path)
        return self.get(path, not words) if name == "JSON.GET" else self.type(path, not words)

    @property
    def exists(self) -> bool:
        return self._text is not None or bool(self._holder)

    def string(self) -> bytes:
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
            # orjson writes no more than 254 levels.
            if self._text is not None and nested_over(bytes(self._text), self._holder[0], _DEEPEST):
                self._holder = None
                raise Refusal(f"ERR the document under this key is nested over {_DEEPEST} levels")
        return self._holder

    def _at(self, path: str) -> list[Place]:
        return places(self._tree(), steps_of(path))

    def _measured(self, name: str, path: str) -> list[Any]:
        if not self.exists:
            raise Refusal(f"ERR Path '{path}' does not exist or not an object" if name == "JSON.OBJLEN" else _ABSENT)
        kind, measure = _MEASURES[name]
        return [measure(place.value) if type(place.value) is kind else None for place in self._at(path)]

    def get(self, path: str, bare: bool) -> bytes | None:
        if not self.exists:
            return None
        # The usual read, of the whole document, copies the text without parsing.
        if not steps_of(path):
            text = memoryview(self.string())[1:]
            return bytes(text) if bare or path == "." else b"".join((b"[", text, b"]"))
        return orjson.dumps([place.value for place in self._at(path)])

    def type(self, path: str, bare: bool) -> list[Any]:
        if not self.exists:
            return [None]
        names = [_type(place.value) for place in self._at(path)]
        return names if bare else [names]

    # Writing.

    def set(self, path: str, words: Sequence[Any]) -> bytes | None:
        text, only = words[0], {_text_of(word) for word in words[1:]}
        if not steps_of(path):
            if ("NX" in only and self.exists) or ("XX" in only and not self.exists):
                return None
            # Not parsed: it comes from orjson or from a ship.
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
        """Put a new key into a dict; return whether there is such a dict."""
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
        if not self.exists:
            return 0
        if not steps_of(path):
            self._holder, self._text, self.changed = [], None, True
            return 1
        found = self._at(path)
        # From the end, since removing an item moves those behind it.
        for place in reversed(found):
            _remove(place)
        self._noted(bool(found))
        return len(found)

    def append(self, path: str, words: Sequence[Any]) -> Any:
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
        return self._calculated(path, words[0], lambda a, b: a + b)

    def multiply(self, path: str, words: Sequence[Any]) -> Any:
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
            # Parsed as JSON, since adding 1 and adding 1.0 give results of different types.
            operand = _loaded(word)
            if type(operand) not in _NUMBERS:
                raise Refusal("ERR bad input number")
            place.container[place.key] = new = _arithmetic(old, operand, operation)
            self._noted(True)
            results.append(new)
        return results


def _check_static(steps: Sequence[Any]) -> None:
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
    # In a dict, the last entry takes the place of the removed one in the order, as in the module.
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

_MEASURES: dict[str, tuple[type, Callable[[Any], Any]]] = {
    "JSON.OBJKEYS": (dict, lambda value: [key.encode() for key in value]),
    "JSON.OBJLEN": (dict, len),
    "JSON.ARRLEN": (list, len),
    "JSON.STRLEN": (str, lambda value: len(value.encode())),
}
_WRITES: dict[str, Callable[[TextDocument, str, Sequence[Any]], Any]] = {
    "JSON.SET": TextDocument.set,
    "JSON.DEL": TextDocument.delete,
    "JSON.ARRAPPEND": TextDocument.append,
    "JSON.NUMINCRBY": TextDocument.add,
    "JSON.NUMMULTBY": TextDocument.multiply,
}
READS, WRITES = frozenset(["JSON.GET", "JSON.TYPE", *_MEASURES]), frozenset(_WRITES)
"""The names of the commands that read a document, and of those that change it."""
