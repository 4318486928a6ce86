"""What a class or annotation is in the dictionary: objects made of stored values, and stored values of objects.

A class is a dict of its fields. Nothing is imported for that: `msgspec.Struct` and `pydantic.BaseModel` are told by
what they have, and check their own constraints when an object is made.
"""

from __future__ import annotations

import dataclasses
import datetime
import decimal
import enum
import functools
import math
import pathlib
import sys
import types
import uuid
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AnySet
from typing import Annotated, Any, Literal, NamedTuple, NewType, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from ..errors import BadData, BadType, BadValue
from .paths import Path, shorten, show

_UNKNOWN = "_reem_unknown_fields"  # an attribute of objects that were read: what is stored beside their fields
_NONE: Any = object()


class Shape(tuple[int | None, ...]):
    """The shape of an array, in `Annotated[np.ndarray, Shape(480, None, 3), np.uint8]`; None for any length."""

    __slots__ = ()

    def __new__(cls, *lengths: int | None) -> Shape:
        """Return the shape with these lengths, outermost first."""
        return super().__new__(cls, lengths)


class Field(NamedTuple):
    annotation: Any
    required: bool


class Mismatch(Exception):
    """A value is not what an annotation says."""

    def __init__(self, path: Path, expected: str, found: Any) -> None:
        super().__init__(path, expected, found)

    def __str__(self) -> str:
        path, expected, found = self.args
        if found is _NONE:
            return f"{show(path)}: {expected} is missing"
        what = f"{found.dtype}{list(found.shape)}" if isinstance(found, np.ndarray) else shorten(found)
        return f"{show(path)}: expected {expected}, found {what} ({type(found).__name__})"


def stored(annotation: Any, value: Any, path: Path) -> Any:
    """Return what to store of an object. Raises BadValue, which names path, expected and found, or BadType."""
    try:
        return _convert(annotation, value, path, _Direction.WRITE)
    except Mismatch as error:
        raise BadValue(str(error)) from None


def made(annotation: Any, value: Any, path: Path) -> Any:
    """Return the object that a stored value stands for.

    Raises:
        BadData: It is not what the annotation says; names path, expected and found.
        BadType: The annotation cannot be used.
    """
    try:
        return _convert(annotation, value, path, _Direction.READ)
    except Mismatch as error:
        raise BadData(str(error)) from None


def plain(value: Any) -> Any:
    """Return what to store of an object by its own class; anything but objects of classes with fields as it is."""
    return stored(type(value), value, ()) if fields_of(type(value)) is not None else value


def element(annotation: Any, key: str | int, path: Path) -> Any:
    """Return the annotation of an element: a field of a class, a value of a dict, an item of a list.

    Raises:
        BadType: There is no such element.
    """
    annotation, _ = _bare(annotation)
    fields, origin, arguments = fields_of(annotation), get_origin(annotation), get_args(annotation)
    if fields is not None and key in fields:
        return fields[str(key)].annotation
    if isinstance(key, str) and origin is not None and _is(origin, Mapping):
        return arguments[1]
    if isinstance(key, int) and origin is not None and _is(origin, Sequence):
        return arguments[0] if len(arguments) < 2 or arguments[1] is ... else arguments[key]
    has = f"; it has {', '.join(fields)}" if fields else ""
    raise BadType(f"{show(path)}: {_name(annotation)} has no {key!r}{has}")


class Signature:
    """What the annotations of a function say of its arguments and its result.

    Only those count that plain values and arrays do not satisfy by themselves: classes with fields, Enum, dates, ...
    """

    def __init__(self, function: Any) -> None:
        try:
            hints = get_type_hints(function, include_extras=True)
        except (NameError, TypeError, AttributeError):  # names that are only there for type checkers; no function
            hints = {}
        self._result = hints.pop("return", Any)
        self._arguments = {name: hint for name, hint in hints.items() if _is_typed(hint)}

    def arguments(self, given: dict[str, Any], path: Path) -> dict[str, Any]:
        """Return the arguments as the annotations say. Raises BadData."""
        typed = {
            name: made(hint, given[name], (*path, name)) for name, hint in self._arguments.items() if name in given
        }
        return {**given, **typed}

    def result(self, value: Any, path: Path) -> Any:
        """Return what to send of a result. Raises BadValue."""
        return stored(self._result, value, path) if _is_typed(self._result) else plain(value)


def _is_typed(annotation: Any) -> bool:
    annotation, notes = _bare(annotation)
    is_scalar = annotation in _SCALARS or _is(annotation, enum.Enum) or _is(annotation, AnySet)
    below = get_args(annotation) if get_origin(annotation) not in (Literal, np.ndarray) else ()
    return bool(notes) or is_scalar or fields_of(annotation) is not None or any(_is_typed(each) for each in below)


class _Direction(enum.Enum):
    READ = enum.auto()
    WRITE = enum.auto()


_READ, _WRITE = _Direction.READ, _Direction.WRITE


def _text(kind: Any) -> tuple[type, Callable[[Any], Any], Callable[[Any], Any]]:
    return str, str, kind


# By class: the type of what is stored, what makes that of an object, and the other way.
_SCALARS: dict[Any, tuple[type | tuple[type, ...], Callable[[Any], Any], Callable[[Any], Any]]] = {
    datetime.datetime: (str, datetime.datetime.isoformat, datetime.datetime.fromisoformat),
    datetime.date: (str, datetime.date.isoformat, datetime.date.fromisoformat),
    datetime.time: (str, datetime.time.isoformat, datetime.time.fromisoformat),
    datetime.timedelta: ((int, float), datetime.timedelta.total_seconds, lambda it: datetime.timedelta(seconds=it)),
    decimal.Decimal: _text(decimal.Decimal),
    uuid.UUID: _text(uuid.UUID),
    pathlib.PurePath: _text(pathlib.PurePath),
    pathlib.Path: _text(pathlib.Path),
}


def _convert(annotation: Any, value: Any, path: Path, way: _Direction) -> Any:
    annotation, notes = _bare(annotation)
    for note in notes:
        if type(note).__module__ == "msgspec":  # which has been imported then
            _constrained(annotation, note, value, path)
    if annotation in (Any, object) or isinstance(annotation, TypeVar):
        return value
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        return _one_of(arguments, value, path, way, _name(annotation))
    if origin is Literal:
        if not any(type(each) is type(value) and each == value for each in arguments):
            raise Mismatch(path, "one of " + ", ".join(map(repr, arguments)), value)
        return value
    kind = origin or annotation
    if kind is None or kind is type(None):
        return _checked(value, type(None), path)
    if kind is np.ndarray:
        return _array(value, arguments, notes, path)
    if (fields := fields_of(kind)) is not None:
        return _object(kind, fields, value, path) if way is _READ else _dict(kind, fields, value, path)
    if _is(kind, enum.Enum):
        return _member(kind, value, path, way)
    if kind in _SCALARS:
        return _scalar(kind, value, path, way)
    if kind is float:
        return value if type(value) is float else float(_checked(value, (int, float, np.floating, np.integer), path))
    if kind in (bool, int, str, bytes):
        return _checked(value, (kind, np.integer) if kind is int else kind, path)
    return _container(kind, arguments, value, path, way)


def _container(kind: Any, arguments: Any, value: Any, path: Path, way: _Direction) -> Any:
    if _is(kind, Mapping):
        keys, values = arguments or (Any, Any)
        if keys not in (str, Any):
            raise BadType(f"{show(path)}: the keys of a dict are str, not {_name(keys)}; use dict[str, ...]")
        return {key: _convert(values, it, (*path, key), way) for key, it in _checked(value, Mapping, path).items()}
    is_set = _is(kind, AnySet)
    if not (_is(kind, Sequence) or is_set):
        raise BadType(
            f"{show(path)}: {_name(kind)} cannot be the type of what is stored; use dataclasses, msgspec.Struct, "
            "pydantic.BaseModel, dict[str, ...], list, tuple, set, numpy arrays, numbers, text, bytes, Enum, dates, "
            "timedelta, Path, UUID or Decimal"
        )
    items = [*_checked(value, AnySet if is_set and way is _WRITE else (list, tuple), path)]
    kinds = (arguments[0] if arguments else Any,) * len(items)
    if _is(kind, tuple) and arguments and arguments[-1] is not ...:
        if len(items) != len(arguments):
            raise Mismatch(path, f"{len(arguments)} items", value)
        kinds = arguments
    converted = [_convert(each, it, (*path, n), way) for n, (each, it) in enumerate(zip(kinds, items, strict=True))]
    if way is _WRITE or not (is_set or _is(kind, tuple)):
        return converted
    of: Callable[[list[Any]], Any] = tuple if _is(kind, tuple) else frozenset if _is(kind, frozenset) else set
    return of(converted)


def _one_of(choices: tuple[Any, ...], value: Any, path: Path, way: _Direction, name: str) -> Any:
    """Return what the first fitting choice makes of a value; of several classes, the one whose fields fit best."""
    deepest: Mismatch | None = None
    for choice in sorted(choices, key=lambda choice: _distance(choice, value)):
        try:
            return _convert(choice, value, path, way)
        except Mismatch as error:
            if len(error.args[0]) > len(deepest.args[0] if deepest else path):
                deepest = error
    raise deepest or Mismatch(path, name, value)


def _distance(choice: Any, value: Any) -> float:
    """Return how far a value is from a choice: below any other if it is of its class."""
    kind, _ = _bare(choice)
    if type(value) is (get_origin(kind) or kind):
        return -math.inf
    fields = fields_of(kind)
    return len(fields.keys() ^ value.keys()) if fields is not None and isinstance(value, Mapping) else 0


def _object(kind: Any, fields: dict[str, Field], value: Any, path: Path) -> Any:
    _checked(value, Mapping, path)
    found = {}
    for name, field in fields.items():
        if name in value:
            found[name] = _convert(field.annotation, value[name], (*path, name), _READ)
        elif field.required:
            raise Mismatch((*path, name), _name(field.annotation), _NONE)
    try:
        result = kind.model_validate(found) if hasattr(kind, "model_validate") else kind(**found)
    except (TypeError, ValueError) as error:  # what the class itself checks
        raise Mismatch(path, f"what {_name(kind)} takes ({error!s:.200})", value) from error
    if (unknown := {name: each for name, each in value.items() if name not in fields}) and hasattr(result, "__dict__"):
        object.__setattr__(result, _UNKNOWN, unknown)
    return result


def _constrained(annotation: Any, note: Any, value: Any, path: Path) -> None:
    """Check what a `msgspec.Meta` says: the constructor of a Struct does not."""
    msgspec = sys.modules["msgspec"]
    try:
        msgspec.convert(value, Annotated[annotation, note])
    except msgspec.ValidationError as error:
        raise Mismatch(path, f"what its Meta says ({error})", value) from None


def _dict(kind: Any, fields: dict[str, Field], value: Any, path: Path) -> dict[str, Any]:
    _checked(value, kind, path)
    found = {name: _convert(it.annotation, getattr(value, name), (*path, name), _WRITE) for name, it in fields.items()}
    return {**getattr(value, _UNKNOWN, {}), **found}


def fields_of(kind: Any) -> dict[str, Field] | None:
    """Return the fields of a class by their names; None if it has none."""
    return _fields_of(kind) if isinstance(kind, type) else None


@functools.lru_cache(maxsize=1024)
def _fields_of(kind: Any) -> dict[str, Field] | None:
    if dataclasses.is_dataclass(kind):
        missing = dataclasses.MISSING
        required = {
            each.name: each.default is missing and each.default_factory is missing
            for each in dataclasses.fields(kind)
            if each.init
        }
    elif hasattr(kind, "model_fields") and hasattr(kind, "model_validate"):
        required = {name: field.is_required() for name, field in kind.model_fields.items()}
    elif hasattr(kind, "__struct_fields__"):
        none = sys.modules["msgspec"].NODEFAULT
        defaults = [none] * (len(kind.__struct_fields__) - len(kind.__struct_defaults__)) + [*kind.__struct_defaults__]
        required = {name: given is none for name, given in zip(kind.__struct_fields__, defaults, strict=True)}
    else:
        return None
    hints = get_type_hints(kind, include_extras=True)
    return {name: Field(hints[name], needed) for name, needed in required.items()}


def _bare(annotation: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return an annotation without what only names it, and what `Annotated` adds to it."""
    notes: tuple[Any, ...] = ()
    while True:
        if isinstance(annotation, NewType):
            annotation = annotation.__supertype__
        elif get_origin(annotation) is Annotated:
            annotation, notes = annotation.__origin__, (*annotation.__metadata__, *notes)
        else:
            return annotation, notes


def _array(value: Any, arguments: tuple[Any, ...], notes: tuple[Any, ...], path: Path) -> Any:
    array = _checked(value, np.ndarray, path)
    # np.typing.NDArray[np.float64] is np.ndarray[Any, np.dtype[np.float64]].
    for note in (*notes, *(get_args(arguments[1]) if len(arguments) > 1 else ())):
        if isinstance(note, Shape):
            if len(note) != array.ndim or any(n not in (None, m) for n, m in zip(note, array.shape, strict=False)):
                raise Mismatch(path, f"an array of shape {tuple(note)}", array)
        elif isinstance(note, np.dtype) and array.dtype != note:
            raise Mismatch(path, f"an array of {note}", array)
        elif _is(note, np.generic) and not np.issubdtype(array.dtype, note):
            raise Mismatch(path, f"an array of {note.__name__}", array)
    return array


def _member(kind: Any, value: Any, path: Path, way: _Direction) -> Any:
    if way is _WRITE:
        return _checked(value, kind, path).value
    try:
        return kind(value)
    except ValueError:
        raise Mismatch(path, f"a value of {_name(kind)}: {', '.join(repr(it.value) for it in kind)}", value) from None


def _scalar(kind: Any, value: Any, path: Path, way: _Direction) -> Any:
    of, to, make = _SCALARS[kind]
    if kind is datetime.date and isinstance(value, datetime.datetime):  # whose time would be lost
        raise Mismatch(path, "date", value)
    if way is _WRITE:
        text = to(_checked(value, kind, path))
        if make(text) != value and value == value:
            raise Mismatch(path, f"a {_name(kind)} that {text!r} stands for exactly", value)
        return text
    try:
        return make(_checked(value, of, path))
    except (ValueError, ArithmeticError):
        raise Mismatch(path, _name(kind), value) from None


def _checked(value: Any, kind: Any, path: Path) -> Any:
    """Return a value of a class; a bool counts as no number."""
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds and object not in kinds):
        raise Mismatch(
            path, " or ".join(dict.fromkeys(_name(each) for each in kinds if not _is(each, np.generic))), value
        )
    return value.item() if isinstance(value, np.generic) and not isinstance(value, float) else value


def _is(kind: Any, base: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, base)


def _name(annotation: Any) -> str:
    return annotation.__name__ if isinstance(annotation, type) and not get_args(annotation) else str(annotation)
