"""Messages of ROS 2: the text of a message definition, and the CDR bytes of a message, to plain dicts.

A definition is compiled once into functions that read one message after the other. Numeric arrays become numpy arrays.
`mcap-ros2-support` does not do here: it shortens an array that is cut off, makes a list of any numbers, and counts to
four billion where a damaged message says so. The tests compare this module with it.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

_MOST_VALUES = 4_000_000
"""Dicts, lists and texts of one message: each takes a hundred bytes of memory, and may take one in the message."""
_DEEPEST = 50
"""Levels of types inside of types."""
_PADDING = 7
"""Bytes that may follow a message: serializers fill up to a multiple of 4 or 8."""
_COPIED = 64
"""Numbers up to which an array is copied. A longer one is a view of its message, which it keeps in memory."""

_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=(?P<bound>\d+))?(?P<array>\[(?P<upper><=)?(?P<size>\d*)\])?\s+(?P<name>[A-Za-z]\w*)"
    r"\s*(?P<constant>=)?"
)
_HEAD = re.compile(r"MSG:\s+(\S+)")

# ROS 2's names of numbers -> dtypes without a byte order.
_NUMBERS = {
    "bool": "?", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_CODES = {"?": "?", "u1": "B", "i1": "b", "u2": "H", "i2": "h", "u4": "I", "i4": "i", "u8": "Q", "i8": "q", "f4": "f",
          "f8": "d"}  # fmt: skip
_STRUCTS = {order + form: struct.Struct(order + code) for form, code in _CODES.items() for order in "<>"}

# Definitions need not have these. In a message, both have a fixed form.
_BUILT_IN = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "service_msgs/ServiceEventInfo": (
        "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number"
    ),
}
_EVENT = "service_msgs/ServiceEventInfo info\n{0}_Request[<=1] request\n{0}_Response[<=1] response"


class _Message:
    """The bytes of one message, read from the front. Raises ValueError or struct.error where they end too early."""

    __slots__ = ("_data", "_left", "_order", "_position")

    def __init__(self, data: bytes) -> None:
        # Two bytes name the encoding: 0 and 1 are CDR, big endian and little endian. Two more are not used.
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise ValueError(f"not CDR: it begins with {data[:4].hex(' ') or 'nothing'}")
        self._data = data
        self._order = "<" if data[1] else ">"
        self._position = 4
        self._left = _MOST_VALUES

    @property
    def rest(self) -> int:
        return len(self._data) - self._position

    def spend(self) -> None:
        self.foresee(1)
        self._left -= 1

    def foresee(self, values: int) -> None:
        if values > self._left:
            raise ValueError(f"it holds over {_MOST_VALUES} values")

    def _align(self, size: int) -> None:
        self._position += -(self._position - 4) % size

    def skip(self, size: int) -> None:
        if size > self.rest:
            raise ValueError(f"it is cut off: {size} bytes should follow, {max(self.rest, 0)} do")
        self._position += size

    def number(self, form: str, size: int) -> Any:
        self._align(size)
        (value,) = _STRUCTS[self._order + form].unpack_from(self._data, self._position)
        self._position += size
        return value

    def count(self, least: int) -> int:
        """Return how many items follow, each of at least so many bytes."""
        count: int = self.number("u4", 4)
        self.check(count, least)
        return count

    def check(self, count: int, least: int) -> None:
        """Raise ValueError if there cannot be so many items."""
        if count * least > self.rest:
            raise ValueError(f"{count} items should follow, in {max(self.rest, 0)} bytes")

    def array(self, form: str, size: int, count: int) -> np.ndarray[Any, Any]:
        if count:  # nothing is aligned for no items
            self._align(size)
        start = self._position
        self.skip(count * size)
        dtype = "u1" if form == "?" else self._order + form
        found: np.ndarray[Any, Any] = np.frombuffer(self._data, dtype, count, start)
        native = found.dtype.newbyteorder("=")
        found = found != 0 if form == "?" else found.astype(native, copy=count <= _COPIED)
        found.flags.writeable = False
        return found

    def text(self) -> str:
        self.spend()
        length = self.count(1)
        start = self._position
        self.skip(length)
        # Readers differ on whether an empty text has its NUL. Bytes that are no UTF-8 are shown as \xff.
        return self._data[start : start + length].rstrip(b"\0").decode(errors="backslashreplace")


_Read = Callable[[_Message], Any]


class _Type(NamedTuple):
    read: _Read
    least: int  # bytes that a value takes


def compiled(name: str, text: str) -> Callable[[bytes], dict[str, Any]]:
    """Return the function that reads messages of a type; raises ValueError if the definition cannot be understood."""
    texts = dict(_BUILT_IN)
    parts = re.split(r"^={3,}\s*$", text, flags=re.MULTILINE)
    texts |= _services(_short(name), parts[0])
    for part in parts[1:]:
        head = _HEAD.match(part.strip())
        if head is None:
            raise ValueError(f"the definition has a part without a name: {part.strip()[:40]!r}")
        texts |= _services(_short(head[1]), part.strip()[head.end() :])
    known: dict[str, _Type] = {}
    root = _type_of(_short(name), texts, known, ())

    def read(data: bytes) -> dict[str, Any]:
        message = _Message(data)
        value: dict[str, Any] = root.read(message)
        if message.rest > _PADDING:
            raise ValueError(f"{message.rest} bytes follow its last field: it is not of the type {name}")
        return value

    return read


def _short(name: str) -> str:
    """Return package and name of a type: `std_msgs/String` of `std_msgs/msg/String`."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 1 else name


def _services(name: str, text: str) -> dict[str, str]:
    """Return the definition of a type; of the events of a service, which are recorded as its own text, three."""
    halves = re.split(r"^---\s*$", text, flags=re.MULTILINE)
    service = name.removesuffix("_Event")
    if len(halves) != 2 or service == name:
        return {name: text}
    return {name: _EVENT.format(service), f"{service}_Request": halves[0], f"{service}_Response": halves[1]}


def _type_of(name: str, texts: dict[str, str], known: dict[str, _Type], outer: tuple[str, ...]) -> _Type:
    if name in known:
        return known[name]
    if name in outer or len(outer) >= _DEEPEST:
        raise ValueError(f"the type {name} is inside of itself, or over {_DEEPEST} levels deep")
    if name not in texts:
        raise ValueError(f"the definition lacks the type {name}")
    fields: list[tuple[str, _Read]] = []
    least = 0
    for line in map(str.strip, texts[name].splitlines()):
        if not line or line.startswith("#"):
            continue
        found = _FIELD.match(line)
        if found is None:
            raise ValueError(f"{line[:60]!r} is no line of a message definition")
        if not found["constant"]:
            read, size = _field(found, name, texts, known, (*outer, name))
            fields.append((found["name"], read))
            least += size
    if not fields:  # a type without fields has one byte
        known[name] = _Type(_nothing, 1)
    else:
        known[name] = _Type(_reading(tuple(fields)), least)
    return known[name]


def _nothing(message: _Message) -> dict[str, Any]:
    message.spend()
    message.skip(1)
    return {}


def _reading(fields: tuple[tuple[str, _Read], ...]) -> _Read:
    def read(message: _Message) -> dict[str, Any]:
        message.spend()
        return {name: each(message) for name, each in fields}

    return read


def _field(
    found: re.Match[str], holder: str, texts: dict[str, str], known: dict[str, _Type], outer: tuple[str, ...]
) -> _Type:
    """Return how a field is read."""
    kind = found["type"]
    # A number of items in brackets is fixed, unless it is only the most there may be.
    fixed = int(found["size"][:10]) if found["size"] and not found["upper"] else None
    form = _NUMBERS.get(kind)
    if form is not None:
        size = np.dtype(form).itemsize
        if not found["array"]:
            return _Type(lambda message: message.number(form, size), size)
        if fixed is not None:
            return _Type(lambda message: message.array(form, size, fixed), fixed * size)
        return _Type(lambda message: message.array(form, size, message.count(size)), 4)
    if kind == "wstring":
        raise ValueError("it has a wstring, which each middleware writes in its own way")
    item = _Type(_Message.text, 4) if kind == "string" else _type_of(_full(kind, holder, texts), texts, known, outer)
    if not found["array"]:
        return item

    def read(message: _Message) -> list[Any]:
        if fixed is None:
            count = message.count(item.least)
        else:
            count = fixed
            message.check(count, item.least)
        message.foresee(count)
        return [item.read(message) for _ in range(count)]

    return _Type(read, 4 if fixed is None else fixed * item.least)


def _full(kind: str, holder: str, texts: dict[str, str]) -> str:
    """Return the full name of a type that is named in the definition of another."""
    if kind in ("time", "duration"):  # as ROS 1 named them
        return f"builtin_interfaces/{kind.capitalize()}"
    if "/" in kind:
        return _short(kind)
    full = f"{holder.split('/')[0]}/{kind}"
    return "std_msgs/Header" if kind == "Header" and full not in texts else full
