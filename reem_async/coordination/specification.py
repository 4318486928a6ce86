"""What values a parameter may have: its type, bounds and choices. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import BadData, BadInput, BadType, BadValue
from ..plan.paths import shorten

_MOST_CHOICES = 100
_MOST_ELEMENTS = 64  # of a vector
_LONGEST_UNIT, _LONGEST_HELP, _LONGEST_TEXT = 40, 500, 1000  # characters
_HINTS = {
    "int": "; a parameter takes floats if its default is one, such as 2.0",
    "str": '; put a text into quotes, such as "off"',  # in YAML off and 2026-01-01 are none
}
_LOWEST, _HIGHEST = -(2**63), 2**63 - 1  # servers calculate with 64 bits

_OPTIONAL = {"low": None, "high": None, "unit": "", "help": "", "choices": ()}


@dataclass(frozen=True)
class Specification:
    """What values one parameter may have; see `Accessor.parameter`. `specified` makes and checks it.

    Vectors, and bounds that are vectors, are tuples.
    """

    type: str  # "bool", "int", "float" or "str"; of vectors with their length, such as "float[3]"
    default: Any
    low: Any = None
    high: Any = None
    unit: str = ""
    help: str = ""
    choices: tuple[Any, ...] = ()  # empty for all of its type

    def checked(self, where: str, value: Any) -> Any:
        """Return a value as it is kept: a scalar of Python, or a tuple of numbers.

        Raises:
            BadType, BadValue: It is not what this allows; the message begins with `where`.
        """
        value = _converted(where, value, self.type)
        if self.choices:
            if value not in self.choices:
                raise BadValue(f"{where}: {shorten(value)} is not among the choices; use {self.range_text()}")
            return value
        for number, low, high in self._bounded(value):
            # Each is false for NaN, which is no value of a parameter.
            if (low is not None and not number >= low) or (high is not None and not number <= high):
                unit = f" {self.unit}" if self.unit else ""
                raise BadValue(f"{where}: {shorten(as_json(value))} is out of range; use {self.range_text()}{unit}")
        return value

    def _bounded(self, value: Any) -> Iterable[tuple[Any, Any, Any]]:
        if self.type in ("bool", "str"):
            return []
        numbers = value if isinstance(value, tuple) else (value,)
        bounds = [each if isinstance(each, tuple) else (each,) * len(numbers) for each in (self.low, self.high)]
        return zip(numbers, *bounds, strict=True)

    def range_text(self) -> str:
        """Return what is allowed, for people: "0.0 to 10.0", "at least 0", "one of a, b"; empty if all of the type."""
        if self.choices:
            return "one of " + ", ".join(str(each) for each in self.choices)
        low, high = as_json(self.low), as_json(self.high)
        if low is None:
            return "" if high is None else f"at most {high}"
        return f"at least {low}" if high is None else f"{low} to {high}"

    def stored(self) -> dict[str, Any]:
        """Return it as it is stored, for `from_stored`: what is not given is left out."""
        data = {"type": self.type, "default": as_json(self.default)}
        given = {name: getattr(self, name) for name, absent in _OPTIONAL.items() if getattr(self, name) != absent}
        return {**data, **{name: as_json(value) for name, value in given.items()}}


def specified(
    where: str,
    default: Any,
    *,
    low: Any = None,
    high: Any = None,
    unit: str = "",
    help: str = "",  # noqa: A002
    choices: Iterable[Any] | None = None,
) -> Specification:
    """Return the specification of a parameter; its type is that of the default.

    Raises:
        BadType, BadValue: Something cannot be used; the message begins with `where`.
    """
    kind = _type_of(where, default)
    for name, text, longest in (("unit", unit, _LONGEST_UNIT), ("help", help, _LONGEST_HELP)):
        if not isinstance(text, str):
            raise BadType(f"{where}: {name}={shorten(text)} is not a str; use a short text")
        if len(text) > longest:
            raise BadValue(f"{where}: {name} has {len(text)} characters; use at most {longest}")
    allowed = () if choices is None else _choices(where, choices, kind)
    if (low is not None or high is not None) and (allowed or kind in ("bool", "str")):
        reason = "choices" if allowed else f"the type {kind}"
        raise BadValue(f"{where}: bounds do not go with {reason}; leave out low and high")
    low, high = _bound(f"{where}: low", low, kind), _bound(f"{where}: high", high, kind)
    unchecked = Specification(kind, None, low, high, str(unit), str(help), allowed)
    return replace(unchecked, default=unchecked.checked(f"{where}: default", default))


def from_stored(where: str, data: Any) -> Specification:
    """Return the specification that `Specification.stored` made; any program may have written it.

    Raises:
        BadData: It is not one.
    """
    try:
        if not isinstance(data, dict) or not isinstance(data.get("type"), str):
            raise BadType(f"{where}: {shorten(data)} is not the specification of a parameter")
        # A program in another language may have written 2 for 2.0.
        default = _floats(data.get("default")) if data["type"].startswith("float") else data.get("default")
        given = {name: data[name] for name in _OPTIONAL if data.get(name) is not None}
        specification = specified(where, default, **given)
        if specification.type != data["type"]:
            raise BadType(f"{where}: the default {shorten(default)} is not of type {shorten(data['type'])}")
    except BadInput as error:
        raise BadData(f"{error}; declare the parameter again, or remove this with: reem param forget") from None
    return specification


def as_json(value: Any) -> Any:
    """Return a value of `Specification.checked` as it is stored: a vector is a list."""
    return list(value) if isinstance(value, tuple) else value


def equal(one: Any, other: Any) -> bool:
    """Return whether two values of `Specification.checked` are the same; 1 and True are not."""
    return type(one) is type(other) and bool(one == other)


def _type_of(where: str, default: Any) -> str:
    if _is_vector(default):
        items = _items(default)
        if not 1 <= len(items) <= _MOST_ELEMENTS:
            raise BadValue(f"{where}: a vector of {len(items)} elements; use 1 to {_MOST_ELEMENTS}")
        kinds = {_scalar_type(item) for item in items}
        if kinds <= {"int", "float"}:
            return f"{'float' if 'float' in kinds else 'int'}[{len(items)}]"
    elif kind := _scalar_type(default):
        return kind
    raise BadType(
        f"{where}: the default {shorten(default)} is not a bool, int, float, str or one-dimensional vector of numbers; "
        "use one of these, or an object of a class whose fields are"
    )


def _scalar_type(value: Any) -> str:
    kinds = {"bool": bool | np.bool_, "int": int | np.integer, "float": float | np.floating, "str": str}
    return next((name for name, kind in kinds.items() if isinstance(value, kind)), "")


def _is_vector(value: Any) -> bool:
    return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim == 1)


def _items(vector: Any) -> Sequence[Any]:
    items: Sequence[Any] = vector.tolist() if isinstance(vector, np.ndarray) else vector
    return items


def _converted(where: str, value: Any, kind: str) -> Any:
    name, _, length = kind.partition("[")
    if not length:
        return _scalar(where, value, kind)
    if not _is_vector(value):
        raise BadType(f"{where}: {shorten(value)} is not a vector; use {length[:-1]} numbers")
    if len(value) != int(length[:-1]):
        raise BadValue(f"{where}: {shorten(value)} has {len(value)} elements; use {length[:-1]}")
    return tuple(_scalar(where, item, name) for item in _items(value))


def _scalar(where: str, value: Any, kind: str) -> Any:
    found = _scalar_type(value)
    if found != kind and not (kind == "float" and found == "int"):
        raise BadType(f"{where}: {shorten(value)} is not of type {kind}{_HINTS.get(kind, '')}")
    if kind == "str":
        text = str.__str__(value)
        if len(text) > _LONGEST_TEXT:
            raise BadValue(f"{where}: a text of {len(text)} characters; use at most {_LONGEST_TEXT}")
        return text
    if kind == "bool":
        return bool(value)
    if kind == "int":
        if not _LOWEST <= value <= _HIGHEST:
            raise BadValue(f"{where}: {shorten(value)} is out of range; use a number of 64 bits")
        return int(value)
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise BadValue(f"{where}: {shorten(value)} is not finite; use a finite number")
    return number


def _bound(where: str, value: Any, kind: str) -> Any:
    if value is None:
        return None
    scalar, _, length = kind.partition("[")
    is_vector = _is_vector(value)
    # Bounds of whole numbers may be floats, as in low=0.0.
    has_floats = any(_scalar_type(item) == "float" for item in (_items(value) if is_vector else [value]))
    numbers = "float" if scalar == "int" and has_floats else scalar
    whole = f"{numbers}[{length}" if length and is_vector else numbers
    return _converted(where, value, whole)


def _choices(where: str, choices: Iterable[Any], kind: str) -> tuple[Any, ...]:
    if isinstance(choices, str | bytes | dict) or not isinstance(choices, Iterable) or "[" in kind or kind == "bool":
        raise BadType(f"{where}: choices={shorten(choices)} cannot be used; use a list of str or numbers")
    values = tuple(_scalar(f"{where}: choices", each, kind) for each in choices)
    if not 1 <= len(values) <= _MOST_CHOICES:
        raise BadValue(f"{where}: {len(values)} choices; use 1 to {_MOST_CHOICES}")
    return values


def _floats(value: Any) -> Any:
    if isinstance(value, list):
        return [_floats(each) for each in value]
    return float(value) if type(value) is int else value
