"""Encode Python values as JSON text and attachments; refuse what cannot be stored.

The fast way is one pass of orjson and a few searches at memory speed for what orjson would change silently: NaN
becomes null, UUIDs and enums become strings, long floats lose their last bit on the server. Only if one of these may be
present, a walk in Python visits every node, decides exactly, and names the path of what it refuses.
"""

from __future__ import annotations

import array
import datetime
import enum
import itertools
import marshal
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import orjson

from ..errors import BadKey, BadType, BadValue, NotFinite, TooDeep
from . import placeholders
from .floats import exact_list, exact_text, may_lose
from .paths import Path, shorten, show
from .placeholders import Placeholder

DEEPEST = 100  # levels of nesting a document may have; RedisJSON parses up to 127
PLAIN_ARRAYS = frozenset({np.ndarray, np.memmap, np.matrix, np.recarray})
"""Array classes that hold only items. Others may have a unit or a mask, which would be lost."""

_MANY = 32  # floats in a list from which converting them together is faster
_NOT_BRACKETS = bytes(set(range(256)) - set(b"{}[]"))

_PLAIN: dict[type, Callable[[Any], Any]] = {str: str.__str__, int: int.__index__, float: float.__float__}
"""Get the plain value of an instance of a subclass, whose own __str__ and the like may return something else."""

# By default orjson writes dataclasses and datetimes as text; here they are refused, or a ship carries them.
_OPTIONS = orjson.OPT_PASSTHROUGH_DATACLASS | orjson.OPT_PASSTHROUGH_DATETIME
# RedisJSON stores signed integers of 64 bits, and unsigned ones above them; orjson writes just these.
_LOWEST, _HIGHEST = -(2**63), 2**64 - 1


Fits = Callable[[Any], Any]  # returns the ship for a value that is not JSON, or None


class Attachment(NamedTuple):
    suffix: str
    ship: Any
    value: Any
    size: int


class EncodedValue(NamedTuple):
    text: bytes
    attachments: tuple[Attachment, ...] = ()


def encode(value: Any, place: Path, fits: Fits, name: Callable[[Path], str]) -> EncodedValue:
    """Encode `value` for the full path `place`, top-level key first, which messages name, and whose depth counts.

    `fits` chooses ships; `name` turns a path below `place` into the suffix of an attachment's key. Raises BadType,
    BadValue, BadKey or TooDeep, with the path and what to do.
    """
    text = plain(value, len(place) - 1)
    return EncodedValue(text) if text is not None else walk(value, place, fits, name)


def plain(value: Any, above: int) -> bytes | None:
    """Return `value`, with `above` levels above it in its document, as JSON; None if only a `walk` can encode it."""
    try:
        text = orjson.dumps(value, option=_OPTIONS)
    except TypeError:
        return None
    # Each search begins with one byte, which is found at memory speed: most documents lack it.
    may_differ = (
        (b"$" in text and placeholders.marked(text))
        or ((b"." in text or b"-" in text or b"+" in text) and may_lose(text))
        or nested_over(text, value, DEEPEST - above)
        or _may_be_converted(text, value)
    )
    return None if may_differ else text


def number_text(value: float, place: Path) -> bytes:
    """Return the JSON text of an operand, exact on the server.

    Raises:
        BadType: Not an int or float.
        BadValue: NaN, infinite, out of range, or a float without an exact text.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadType(f"{show(place)}: cannot calculate with {shorten(value)}; use an int or a float")
    if isinstance(value, int):
        return b"%d" % _check_int(value, place)
    text = exact_text(_check_float(value, place))
    if text is None:
        raise BadValue(f"{show(place)}: {value!r} cannot be sent exactly as an operand; write the result instead")
    return text


def nested_over(text: bytes, value: Any, limit: int) -> bool:
    """Return whether containers in `value`, of which `text` is the JSON, are nested over `limit` levels."""
    if len(text) < 2 * limit:  # each level takes two brackets
        return False
    if text.find(b"{", 1) < 0 and text.find(b"[", 1) < 0:
        return limit < 1
    before, after = text[: len(text) // 2], text[len(text) // 2 :]
    # In the first half no more are open than were opened in it, in the second no more than are closed in it.
    if _up_to(limit, before, b"{", b"[") and _up_to(limit, after, b"}", b"]"):
        return False
    brackets = text.translate(None, _NOT_BRACKETS)
    for _ in range(limit // 2):  # each turn strips one or two levels
        stripped = brackets.replace(b"{}", b"").replace(b"[]", b"")
        if len(stripped) == len(brackets):
            break
        brackets = stripped
    # The rest are very deep levels, or brackets inside of strings.
    return bool(brackets) and _levels(value, limit) > limit


def _up_to(limit: int, text: bytes, one: bytes, other: bytes) -> bool:
    """Return whether two bytes occur no more than `limit` times together; `replace` finds them at memory speed."""
    left = limit - len(text) + len(text.replace(one, b"", limit + 1))
    return left >= 0 and len(text) - len(text.replace(other, b"", left + 1)) <= left


def _may_be_converted(text: bytes, value: Any) -> bool:
    """Return whether orjson may have converted something.

    marshal is the one walk at C speed in the standard library that refuses UUIDs, enums and subclasses, which orjson
    converts silently. It writes NaN and infinity, which become `null` in JSON, with 7f or ff as the last byte.
    """
    try:
        dumped = marshal.dumps(value)
    except ValueError:
        return True
    return (b"\x7f" in dumped or b"\xff" in dumped) and b"null" in text


def _levels(value: Any, limit: int) -> int:
    level, depth = [value] if isinstance(value, dict | list | tuple) else [], 0
    while level and depth <= limit:
        depth += 1
        items = [each.values() if isinstance(each, dict) else each for each in level]
        level = [item for each in items for item in each if isinstance(item, dict | list | tuple)]
    return depth


def walk(
    value: Any, place: Path, fits: Fits, name: Callable[[Path], str], claimed: frozenset[type] = frozenset()
) -> EncodedValue:
    """Encode as `encode` does, visiting every node; values of the types `claimed` are offered to ships first."""
    walker = _AskingWalker(place, fits, name, claimed) if claimed else _Walker(place, fits, name)
    tree = walker.convert(value, ())
    return EncodedValue(orjson.dumps(tree), tuple(walker.attachments))


class _Walker:
    def __init__(self, place: Path, fits: Fits, name: Callable[[Path], str]) -> None:
        self._place = place
        self._fits = fits
        self._name = name
        self._open: set[int] = set()  # ids of the containers around the current node: one of them inside is a circle
        self.attachments: list[Attachment] = []

    def convert(self, value: Any, path: Path) -> Any:
        kind = type(value)
        if kind is str:
            return self._text(value, path)
        if kind is bool or value is None:
            return value
        if kind is int:
            return _check_int(value, self._place + path)
        if kind is float:
            return _exact(_check_float(value, self._place + path))
        if kind is dict:
            return self._container(value, path, self._dict)
        if kind is list or kind is tuple:
            return self._container(value, path, self._list)
        return self._other(value, path)

    def _text(self, value: str, path: Path) -> str:
        try:
            value.isascii() or value.encode()
        except UnicodeEncodeError:
            where = show(self._place + path)
            raise BadValue(f"{where}: {shorten(value)} has half a surrogate pair; repair the text") from None
        return placeholders.inline_text(value) if value.startswith(placeholders.MARK) else value

    def _container(self, value: Any, path: Path, convert: Callable[[Any, Path], Any]) -> Any:
        if id(value) in self._open:
            raise TooDeep(f"{show(self._place + path)}: circular, this {type(value).__name__} contains itself")
        if len(self._place) + len(path) > DEEPEST:
            raise TooDeep(
                f"{show(self._place + path[:3])}...: nested over {DEEPEST} levels; "
                "store the inner part as a key of its own"
            )
        self._open.add(id(value))
        result = convert(value, path)
        self._open.remove(id(value))
        return result

    def _list(self, value: Sequence[Any], path: Path) -> Any:
        # Scans and trajectories are such lists; converting the floats together takes a third of the time.
        if len(value) >= _MANY and set(map(type, value)) == {float}:
            for index, item in enumerate(value):
                if not math.isfinite(item):
                    _check_float(item, (*self._place, *path, index))
            return [
                placeholders.inline_float(item) if text is None else orjson.Fragment(text)
                for item, text in zip(value, exact_list(list(value)), strict=True)
            ]
        return [self.convert(item, (*path, index)) for index, item in enumerate(value)]

    def _dict(self, value: dict[Any, Any], path: Path) -> dict[str, Any]:
        return {self._key(key, path): self.convert(item, (*path, key)) for key, item in value.items()}

    def _key(self, key: Any, path: Path) -> str:
        if not isinstance(key, str) or isinstance(key, enum.Enum):
            raise BadKey(
                f"{show(self._place + path)}: the key {shorten(key)} is not a str; use str(key) "
                f"({type(key).__name__} keys would come back as text)"
            )
        try:
            key.isascii() or key.encode()
        except UnicodeEncodeError:
            raise BadKey(f"{show(self._place + path)}: the key {shorten(key)} has half a surrogate pair") from None
        return str.__str__(key)

    def _other(self, value: Any, path: Path) -> Any:
        # Ships come before subclasses: a ship for a subclass of dict is meant to be used.
        ship = self._fits(value)
        if ship is not None:
            return self._parcel(ship, value, path)
        # An enum that is also a str or a number is stored as that.
        if isinstance(value, enum.Enum) and not isinstance(value, str | int | float):
            raise self._refusal(value, path)
        if isinstance(value, np.generic):
            return self._numpy_scalar(value, path)
        if isinstance(value, dict):
            return self._container(value, path, self._dict)
        if isinstance(value, list | tuple):
            return self._container(value, path, self._list)
        for base, plain_value in _PLAIN.items():
            if isinstance(value, base):
                return self.convert(plain_value(value), path)
        raise self._refusal(value, path)

    def _parcel(self, ship: Any, value: Any, path: Path) -> str:
        try:
            size, summary = ship.describe(value)
        except (BadType, BadValue) as error:
            raise type(error)(f"{show(self._place + path)}: {error}") from None
        suffix = self._name(path)
        self.attachments.append(Attachment(suffix, ship, value, size))
        return str(Placeholder(ship.label, suffix, size, summary))

    def _numpy_scalar(self, value: np.generic, path: Path) -> Any:
        plain = value.item()
        if isinstance(value, np.longdouble | np.clongdouble):
            use = "np.asarray(x, np.complex128)" if isinstance(value, np.clongdouble) else "float(x)"
            raise BadType(
                f"{show(self._place + path)}: {shorten(value)} is a long double, which differs between machines; "
                f"use {use}"
            )
        if type(plain) not in (bool, int, float, str) or isinstance(value, np.datetime64 | np.timedelta64):
            raise BadType(
                f"{show(self._place + path)}: the numpy scalar {shorten(value)} has no plain Python equal; "
                "store np.asarray(value), a 0-d array"
            )
        return self.convert(plain, path)

    def _refusal(self, value: Any, path: Path) -> BadType:
        # The repr of an array has several lines.
        what = f"an array {value.dtype}{list(value.shape)}" if isinstance(value, np.ndarray) else shorten(value)
        return BadType(
            f"{show(self._place + path)}: {what} ({type(value).__name__}) cannot be stored; {_remedy(value)}"
        )


class _AskingWalker(_Walker):
    def __init__(self, place: Path, fits: Fits, name: Callable[[Path], str], claimed: frozenset[type]) -> None:
        super().__init__(place, fits, name)
        self._claimed = claimed

    def convert(self, value: Any, path: Path) -> Any:
        ship = self._fits(value) if type(value) in self._claimed else None
        return self._parcel(ship, value, path) if ship is not None else super().convert(value, path)

    def _list(self, value: Sequence[Any], path: Path) -> Any:
        return [self.convert(item, (*path, index)) for index, item in enumerate(value)]


# By library and class, since none of them is imported here: what to store in place of an object.
_LIBRARIES = {
    ("pandas", "DataFrame"): "value.to_dict('list'), or value.to_numpy()",
    ("pandas", "Series"): "value.to_numpy()",
    ("polars", "DataFrame"): "value.to_dict(as_series=False), or value.to_numpy()",
    ("polars", "Series"): "value.to_numpy()",
    ("pyarrow", "Table"): "value.to_pydict()",
    ("PIL", "Image"): "np.asarray(value)",
    ("torch", "Tensor"): "value.numpy(force=True)",
}

# By an attribute of classes with fields, in this order: what makes a dict of an object.
_CLASSES = {
    "model_dump": "value.model_dump(mode='json')",
    "__struct_fields__": "msgspec.to_builtins(value)",
    "__dataclass_fields__": "dataclasses.asdict(value)",
}


def _remedy(value: Any) -> str:
    # Imported here, since they take time and only refusals need them.
    import decimal
    import numbers
    import pathlib
    import uuid

    if (how := getattr(value, "_how_to_read", None)) is not None:
        return f"it is a handle: store the value there, with {how}"
    kind = type(value)
    for each in kind.__mro__:
        if (how := _LIBRARIES.get((each.__module__.partition(".")[0], each.__name__))) is not None:
            return f"use {how}"
    # What a typed view stores as well, and its name there: that of the class if it is empty.
    typed: tuple[tuple[Any, str, str], ...] = (
        (enum.Enum, "", "value.value, or value.name"),
        (set, "set", "list(value), or sorted(value)"),
        (frozenset, "frozenset", "list(value), or sorted(value)"),
        (datetime.datetime, "datetime", "value.isoformat(), value.timestamp() or integer nanoseconds"),
        (datetime.date, "date", "value.isoformat()"),
        (datetime.time, "time", "value.isoformat()"),
        (datetime.timedelta, "timedelta", "value.total_seconds()"),
        (decimal.Decimal, "Decimal", "str(value), or float(value), which rounds"),
        (pathlib.PurePath, "pathlib.Path", "str(value)"),
        (uuid.UUID, "UUID", "str(value)"),
    )
    classes = (("", how) for attribute, how in _CLASSES.items() if hasattr(kind, attribute))
    scalars = ((name, how) for base, name, how in typed if isinstance(value, base))
    for name, how in itertools.chain(classes, scalars):
        name = name or kind.__name__
        return f"use {how}; or use kvs[...].of({name}).write(value), which .of({name}).read() reads back"
    remedies: tuple[tuple[Any, str], ...] = (
        (placeholders.Unreadable, "it could not be read; leave it out, or store a value in its place"),
        (complex, "use [value.real, value.imag] or a numpy array"),
        (numbers.Number, "use float(value) or str(value)"),
        (np.ma.MaskedArray, "use {'data': x.filled(0), 'mask': np.ma.getmaskarray(x)}, or a ship for its class"),
        ((np.ndarray, array.array), _array_remedy(value)),
        ((bytes, bytearray), "add BytesShip() to the interface's ships, or use bytes(value)"),
        (memoryview, "use bytes(value), or np.asarray(value)"),
        (Mapping, "use dict(value)"),
        (Iterable, "use list(value)"),
    )
    anything = "convert it to plain values, or write a ship for this type (see SpecialDatatypeShip)"
    return next((text for kinds, text in remedies if isinstance(value, kinds)), anything)


def _array_remedy(value: Any) -> str:
    # isinstance would also take subclasses, for which NumpyShip does not fit.
    if type(value) in PLAIN_ARRAYS:
        return "add NumpyShip() to the interface's ships"
    if isinstance(value, np.ndarray):
        return "use np.asarray(x) and store beside it what its class adds (unit, mask), or a ship for its class"
    return "use np.asarray(x)"


def _check_int(value: int, place: Path) -> int:
    if not _LOWEST <= value <= _HIGHEST:
        raise BadValue(
            f"{show(place)}: the int {shorten(value)} is outside [-2**63, 2**64-1]; store it as text or as a float"
        )
    return value


def _check_float(value: float, place: Path) -> float:
    if not math.isfinite(value):
        raise NotFinite(f"{show(place)}: {value!r} is not JSON; use None, or a numpy array, which keeps it")
    return value


def _exact(value: float) -> Any:
    text = exact_text(value)
    return placeholders.inline_float(value) if text is None else orjson.Fragment(text)
