"""What a class or annotation is in the dictionary: objects made of stored values, and stored values of objects.

A class is a dict of its fields. Classes check their own constraints when an object is made.
"""

from __future__ import annotations

import collections.abc
import contextlib
import datetime
import decimal
import enum
import functools
import inspect
import logging
import math
import pathlib
import re
import sys
import types
import uuid
from collections.abc import Callable, Mapping
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NamedTuple,
    NewType,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from ..errors import BadData, BadType, BadValue, TooDeep
from .classes import (
    WHERE_TO_DEFINE,
    Field,
    Use,
    checks_itself,
    class_of,
    construct,
    fields_of,
    tag_of,
    unknown_of,
    with_unknown,
)
from .paths import Path, shorten, show

logger = logging.getLogger("reem.services")

_NONE: Any = object()


class Shape(tuple[int | None, ...]):
    """The shape of an array, in `Annotated[np.ndarray, Shape(480, None, 3), np.uint8]`; None for any length."""

    __slots__ = ()

    def __new__(cls, *lengths: int | None) -> Shape:
        """Return the shape with these lengths, outermost first."""
        return super().__new__(cls, lengths)


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


def _no_ship(_: Any) -> None:
    return None


class _Way(NamedTuple):
    """Whether objects are made of what is stored, or the reverse, and what both need."""

    reads: bool
    carries: Callable[[Any], Any] = _no_ship  # returns the ship that stores an object as it is, or None
    # Results of converting values to choices of unions, by both ids. Without them nested unions take exponential time.
    tried: dict[tuple[int, int], tuple[Any, Any, Any]] | None = None


def stored(annotation: Any, value: Any, path: Path, carries: Callable[[Any], Any] = _no_ship) -> Any:
    """Return what to store of an object; what a ship carries stays as it is.

    Raises BadValue, which names path, expected and found, BadType or TooDeep.
    """
    try:
        return _convert(annotation, value, path, _Way(reads=False, carries=carries))
    except Mismatch as error:
        raise BadValue(str(error)) from None
    except RecursionError:
        raise TooDeep(f"{show(path)}: nested too deeply, or an object contains itself") from None


def made(annotation: Any, value: Any, path: Path) -> Any:
    """Return the object that a stored value stands for.

    Raises:
        BadData: It is not what the annotation says; names path, expected and found.
        BadType: The annotation cannot be used.
    """
    try:
        return _convert(annotation, value, path, _Way(reads=True, tried={}))
    except Mismatch as error:
        raise BadData(str(error)) from None


def plain(value: Any, path: Path, carries: Callable[[Any], Any]) -> Any:
    """Return a value with what to store in place of each object in it, by the object's own class."""
    kind = type(value)
    if kind is dict:
        return {key: plain(each, (*path, key), carries) for key, each in value.items()}
    if kind in (list, tuple):
        return [plain(each, (*path, n), carries) for n, each in enumerate(value)]
    # The class of a path is that of its system.
    kind = next((each for each in _SCALARS if isinstance(value, each)), kind)
    # A set is refused where no annotation says that it is one: it would arrive as a list.
    is_object = kind not in _SETS and _is_typed(kind) and carries(value) is None
    return stored(kind, value, path, carries) if is_object else value


def check_annotation(annotation: Any, path: Path) -> None:
    """Raise BadType for what is neither a class nor an annotation, such as its name."""
    inner, _ = bare(annotation)
    if not (isinstance(inner, type) or inner in (None, Any) or get_origin(inner) is not None):
        raise BadType(f"{show(path)}: of({shorten(annotation)}) names no class; use a class or an annotation")


def element(annotation: Any, key: str | int, path: Path) -> Any:
    """Return the annotation of an element: a field of a class, a value of a dict, an item of a list.

    Raises:
        BadType: There is no such element.
    """
    annotation, _ = bare(annotation)
    fields, origin, arguments = fields_of(annotation), get_origin(annotation), get_args(annotation)
    if origin in _UNIONS:
        found = []
        for each in arguments:
            with contextlib.suppress(BadType):
                found.append(element(each, key, path))
        if found:
            return Union[tuple(found)]  # noqa: UP007 - of a list
    if fields is not None and key in fields:
        return fields[str(key)].annotation
    if isinstance(key, str) and origin in _DICTS:
        return arguments[1]
    if isinstance(key, int) and origin in _LISTS:
        return arguments[0]
    if isinstance(key, int) and origin is tuple and (arguments[-1] is ... or -len(arguments) <= key < len(arguments)):
        return arguments[0] if arguments[-1] is ... else arguments[key]
    if isinstance(key, int) and (items := _named_items(annotation)) and -len(items) <= key < len(items):
        return items[key]
    has = f"; it has {', '.join(fields)}" if fields else ""
    raise BadType(f"{show(path)}: {_name(annotation)} has no {key!r}{has}")


class Signature:
    """What the annotations of a function say of its arguments and its result.

    Only those count that plain values and arrays do not satisfy by themselves: classes with fields, Enum, dates, ...
    """

    def __init__(self, function: Any) -> None:
        while isinstance(function, functools.partial):
            function = function.func
        if not (inspect.isroutine(function) or isinstance(function, type)):
            function = getattr(function, "__call__", None)  # noqa: B004 - of an object that can be called
        hints = _hints_of(function)
        self._result = hints.pop("return", Any)
        self._arguments = {name: hint for name, hint in hints.items() if _is_typed(hint)}

    def arguments(self, given: dict[str, Any], path: Path) -> dict[str, Any]:
        """Return the arguments as the annotations say. Raises BadData."""
        typed = {
            name: made(hint, given[name], (*path, name)) for name, hint in self._arguments.items() if name in given
        }
        return {**given, **typed}

    def result(self, value: Any, path: Path, carries: Callable[[Any], Any]) -> Any:
        """Return what to send of a result. Raises BadValue."""
        return stored(self._result, value, path, carries) if _is_typed(self._result) else value


def _hints_of(function: Any) -> dict[str, Any]:
    try:
        return get_type_hints(function, include_extras=True)
    except (TypeError, AttributeError):  # it is no function
        return {}
    except NameError as error:
        logger.warning(
            "the annotations of %s are not used, so it gets arguments as they are stored: %r cannot be found; %s",
            getattr(function, "__qualname__", function),
            error.name,
            WHERE_TO_DEFINE,
        )
        return {}


def _is_typed(annotation: Any) -> bool:
    annotation, notes = bare(annotation)
    is_scalar = (
        annotation in _SCALARS
        or _is(annotation, enum.Enum)
        or class_of(annotation) in (*_SETS, tuple)
        or bool(_named_items(annotation))
    )
    below = get_args(annotation) if get_origin(annotation) not in (Literal, np.ndarray) else ()
    return bool(notes) or is_scalar or fields_of(annotation) is not None or any(_is_typed(each) for each in below)


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


# What reading gives where no ship does.
_PLAIN = frozenset((str, int, float, bool, type(None), bytes, dict, list, np.ndarray))
_DTYPES = (np.generic, bool, int, float, complex)

# The classes that may be annotations, and what reading makes.
_DICTS: dict[Any, Any] = {dict: dict, collections.abc.Mapping: dict, collections.abc.MutableMapping: dict}
_LISTS: dict[Any, Any] = {list: list, collections.abc.Sequence: list, collections.abc.MutableSequence: list}
_SETS: dict[Any, Any] = {
    set: set,
    frozenset: frozenset,
    collections.abc.Set: set,
    collections.abc.MutableSet: set,
}
_ITEMS = {**_LISTS, **_SETS, tuple: tuple}
_UNIONS = (Union, types.UnionType)


def _convert(annotation: Any, value: Any, path: Path, way: _Way) -> Any:
    annotation, notes = bare(annotation)
    for note in notes:
        if type(note).__module__ == "msgspec":  # which has been imported then
            _constrained(annotation, note, value, path)
    if annotation in (Any, object) or isinstance(annotation, TypeVar):
        return value
    kind, arguments = class_of(annotation), get_args(annotation)
    if kind in _UNIONS:
        return _one_of(annotation, value, path, way)
    if kind is Literal:
        if not any(type(each) is type(value) and each == value for each in arguments):
            raise Mismatch(path, "one of " + ", ".join(map(repr, arguments)), value)
        return value
    if kind is None or kind is type(None):
        return _checked(value, type(None), path)
    if kind is np.ndarray:
        return _array(value, arguments, notes, path)
    if kind is float:
        return value if type(value) is float else _float(value, path)
    if kind in (bool, int, str, bytes):
        return _checked(value, {int: (int, np.integer), bool: (bool, np.bool_)}.get(kind, kind), path)
    # Of what is stored, only a ship makes such an object.
    is_object = {kind, type(value)}.isdisjoint(_PLAIN) and kind in type(value).__mro__
    if is_object and (way.reads or way.carries(value) is not None):
        return value
    if (fields := fields_of(annotation)) is not None:
        return (_object if way.reads else _dict)(annotation, fields, value, path, way)
    if _is(kind, enum.Enum):
        return _member(kind, value, path, way)
    if kind in _SCALARS:
        return _scalar(kind, value, path, way)
    return _container(annotation, value, path, way)


def _float(value: Any, path: Path) -> float:
    _checked(value, (int, float, np.floating, np.integer), path)
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if number != value and not math.isnan(number):
        raise Mismatch(path, "a float that holds it exactly", value)
    return number


def _container(annotation: Any, value: Any, path: Path, way: _Way) -> Any:
    kind, arguments = class_of(annotation), get_args(annotation)
    if kind in _DICTS:
        keys, values = arguments or (Any, Any)
        if keys not in (str, Any):
            raise BadType(f"{show(path)}: the keys of a dict are str, not {_name(keys)}; use dict[str, ...]")
        return {key: _convert(values, it, (*path, key), way) for key, it in _checked(value, Mapping, path).items()}
    named, is_set = _named_items(kind), kind in _SETS
    if not (kind in _ITEMS or named):
        raise BadType(
            f"{show(path)}: {_name(annotation)} cannot be the type of what is stored; use dataclasses, msgspec.Struct, "
            "pydantic.BaseModel, NamedTuple, dict[str, ...], list, tuple, set, numpy arrays, numbers, text, bytes, "
            "Enum, dates, timedelta, Path, UUID or Decimal, or a ship for this type"
        )
    classes = collections.abc.Set if is_set and not way.reads else kind if named and not way.reads else (list, tuple)
    items = [*_checked(value, classes, path)]
    kinds = (arguments[0] if arguments else Any,) * len(items)
    if named or (kind is tuple and arguments and arguments[-1] is not ...):
        kinds = named or arguments
        if len(items) != len(kinds):
            raise Mismatch(path, f"{len(kinds)} items", value)
    converted = [_convert(each, it, (*path, n), way) for n, (each, it) in enumerate(zip(kinds, items, strict=True))]
    if not way.reads:
        return converted
    try:
        return kind(*converted) if named else _ITEMS[kind](converted)
    except TypeError:  # in a set
        raise Mismatch(path, f"{_name(annotation)}, whose items have to be hashable", value) from None


def _named_items(kind: Any) -> tuple[Any, ...]:
    """Return the annotations of the items of a NamedTuple, in their order."""
    if not (_is(kind, tuple) and hasattr(kind, "_fields")):
        return ()
    hints = get_type_hints(kind, include_extras=True)
    return tuple(hints.get(name, Any) for name in kind._fields)


def _one_of(union: Any, value: Any, path: Path, way: _Way) -> Any:
    """Return what the first fitting choice makes of a value; of several classes, the one whose fields fit best.

    Raises BadType for an object that would be read as one of another choice.
    """
    choices = get_args(union)
    chosen, result = _chosen(choices, value, path, way, _name(union))
    if not way.reads and len(choices) - (type(None) in choices) > 1:
        read, _ = _chosen(choices, result, path, _Way(reads=True, tried={}), _name(union))
        if read is not chosen:
            raise BadType(
                f"{show(path)}: in {_name(union)} this {_name(chosen)} would be read as {_name(read)}, since what is "
                "stored fits both; use one of them, or classes with a field that differs, such as kind: Literal['a']"
            )
    return result


def _chosen(choices: tuple[Any, ...], value: Any, path: Path, way: _Way, name: str) -> tuple[Any, Any]:
    deepest: Mismatch | None = None
    for choice in sorted(choices, key=lambda choice: _distance(choice, value)):
        try:
            return choice, _as_choice(choice, value, path, way)
        except Mismatch as error:
            if len(error.args[0]) > len(deepest.args[0] if deepest else path):
                deepest = error
    raise deepest or Mismatch(path, name, value)


def _as_choice(choice: Any, value: Any, path: Path, way: _Way) -> Any:
    if way.tried is None or not isinstance(value, dict | list):
        return _convert(choice, value, path, way)
    place = id(value), id(choice)
    if place not in way.tried:
        try:
            found = _convert(choice, value, path, way)
        except Mismatch as error:
            found = error
        way.tried[place] = found, value, choice  # kept, so that no others get their ids
    if isinstance(found := way.tried[place][0], Mismatch):
        raise found
    return found


def _distance(choice: Any, value: Any) -> float:
    """Return how far a value is from a choice: below any other if it is of its class."""
    kind, _ = bare(choice)
    if type(value) is class_of(kind):
        return -math.inf
    fields = fields_of(kind)
    return len(fields.keys() ^ value.keys()) if fields is not None and isinstance(value, Mapping) else 0


def _object(annotation: Any, fields: dict[str, Field], value: Any, path: Path, way: _Way) -> Any:
    _checked(value, Mapping, path)
    found: dict[Use, dict[str, Any]] = {use: {} for use in Use}
    for name, field in fields.items():
        if name in value:
            found[field.use][name] = _convert(field.annotation, value[name], (*path, name), way)
        elif field.required:
            raise Mismatch((*path, name), _name(field.annotation), _NONE)
    unknown = {name: each for name, each in value.items() if name not in fields}
    result = _constructed(annotation, found[Use.ARGUMENT], unknown, value, path)
    for name, each in found[Use.STATE].items():
        object.__setattr__(result, name, each)
    return with_unknown(result, unknown)


def _constructed(annotation: Any, values: dict[str, Any], unknown: dict[str, Any], value: Any, path: Path) -> Any:
    try:
        return construct(annotation, values, unknown)
    except Exception as error:  # what the class itself checks
        text = re.sub(r"\s*For further information visit \S+", "", str(error))  # of pydantic
        raise Mismatch(path, f"what {_name(annotation)} takes ({' '.join(text.split()):.200})", value) from error


def _constrained(annotation: Any, note: Any, value: Any, path: Path) -> None:
    """Check what a `msgspec.Meta` says: the constructor of a Struct does not."""
    msgspec = sys.modules["msgspec"]
    try:
        msgspec.convert(value, Annotated[annotation, note])
    except msgspec.ValidationError as error:
        raise Mismatch(path, f"what its Meta says ({error})", value) from None


def _dict(annotation: Any, fields: dict[str, Field], value: Any, path: Path, way: _Way) -> dict[str, Any]:
    kind = class_of(annotation)
    _checked(value, kind, path)
    if type(value) is not kind and (more := (fields_of(type(value)) or {}).keys() - fields.keys()):
        raise Mismatch(
            path, f"{_name(kind)} itself, since {', '.join(sorted(more))} of its subclass would be lost", value
        )
    found, arguments = {}, {}
    for name, field in fields.items():
        if (tag := tag_of(kind, name)) is not None:
            found[name] = tag
            continue
        item = getattr(value, name, _NONE)
        if item is _NONE:
            raise Mismatch((*path, name), _name(field.annotation), _NONE)
        found[name] = _convert(field.annotation, item, (*path, name), way)
        if field.use is Use.ARGUMENT:
            arguments[name] = item
    unknown = unknown_of(value)
    if checks_itself(annotation):  # an attribute may have been set since the object was made
        again = _constructed(annotation, arguments, unknown, value, path)
        for name, item in arguments.items():
            if not _equal(other := getattr(again, name, item), item):
                raise Mismatch(
                    (*path, name), f"a value that {_name(kind)} keeps, not one of which it makes {other}", item
                )
    return {**unknown, **found}


def _equal(one: Any, other: Any) -> bool:
    try:
        return one is other or bool(np.all(one == other)) or bool(one != one)  # NaN
    except ValueError:  # lists of arrays
        return True


def bare(annotation: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return an annotation without what only names it, and what `Annotated` adds to it."""
    notes: tuple[Any, ...] = ()
    while True:
        if isinstance(annotation, NewType):
            annotation = annotation.__supertype__
        elif hasattr(annotation, "__value__"):  # of a `type` statement
            annotation = annotation.__value__
        elif get_origin(annotation) is Final:
            annotation = get_args(annotation)[0]
        elif get_origin(annotation) is Annotated:
            annotation, notes = annotation.__origin__, (*annotation.__metadata__, *notes)
        else:
            return annotation, notes


def _array(value: Any, arguments: tuple[Any, ...], notes: tuple[Any, ...], path: Path) -> Any:
    array = _checked(value, np.ndarray, path)
    # np.typing.NDArray[np.float64] is np.ndarray[tuple[Any, ...], np.dtype[np.float64]].
    shape, dtype = (get_args(each) for each in (*arguments, None, None)[:2])
    if shape and shape[-1] is not ...:
        notes = (*notes, Shape(*[get_args(each)[0] if get_origin(each) is Literal else None for each in shape]))
    for note in (*notes, *dtype):
        if isinstance(note, tuple) and all(each is None or type(each) is int for each in note):
            if len(note) != array.ndim or any(n not in (None, m) for n, m in zip(note, array.shape, strict=False)):
                raise Mismatch(path, f"an array of shape {tuple(note)}", array)
        elif isinstance(note, np.dtype) and array.dtype != note:
            raise Mismatch(path, f"an array of {note}", array)
        elif (kinds := [each for each in get_args(note) or (note,) if _is(each, _DTYPES)]) and not any(
            np.issubdtype(array.dtype, each) for each in kinds
        ):
            raise Mismatch(path, f"an array of {' or '.join(each.__name__ for each in kinds)}", array)
    return array


def _member(kind: Any, value: Any, path: Path, way: _Way) -> Any:
    if not way.reads:
        return _lists(_checked(value, kind, path).value)
    try:
        if isinstance(value, bool) and not any(isinstance(each.value, bool) for each in kind):
            raise ValueError("a bool is no number")
        return kind(value)
    except (ValueError, TypeError):
        for each in kind:  # whose value is a tuple
            if isinstance(each.value, tuple) and _lists(each.value) == value:
                return each
        raise Mismatch(path, f"a value of {_name(kind)}: {', '.join(repr(it.value) for it in kind)}", value) from None


def _lists(value: Any) -> Any:
    return [_lists(each) for each in value] if isinstance(value, tuple) else value


def _scalar(kind: Any, value: Any, path: Path, way: _Way) -> Any:
    of, to, make = _SCALARS[kind]
    if kind is datetime.date and isinstance(value, datetime.datetime):  # whose time would be lost
        raise Mismatch(path, "date", value)
    if not way.reads:
        text = to(_checked(value, kind, path))
        if not _is_exact(text, make, value):
            raise Mismatch(path, f"a {_name(kind)} that {text!r} stands for exactly", value)
        return text
    try:
        return make(_checked(value, of, path))
    except (ValueError, ArithmeticError):
        raise Mismatch(path, _name(kind), value) from None


def _is_exact(text: Any, make: Callable[[Any], Any], value: Any) -> bool:
    if isinstance(value, decimal.Decimal) and value.is_nan():
        return True
    try:
        again = make(text)
        if isinstance(value, datetime.datetime) and value.utcoffset() is not None:
            # In the hour in which clocks are put back, a time in a zone is equal to none in another zone.
            value = value.astimezone(datetime.UTC)
    except (ValueError, ArithmeticError):  # the longest timedelta is more than its seconds as a float
        return False
    # A time of day in a zone such as Europe/Berlin has no offset, and would lose its zone.
    had_zone, has_zone = (getattr(each, "tzinfo", None) is not None for each in (value, again))
    return bool(again == value) and had_zone == has_zone


def _checked(value: Any, kind: Any, path: Path) -> Any:
    """Return a value of a class; a bool counts as no number."""
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds and object not in kinds):
        raise Mismatch(
            path, " or ".join(dict.fromkeys(_name(each) for each in kinds if not _is(each, np.generic))), value
        )
    return value.item() if isinstance(value, np.generic) and not isinstance(value, float) else value


def _is(kind: Any, base: type | tuple[type, ...]) -> bool:
    return isinstance(kind, type) and issubclass(kind, base)


def _name(annotation: Any) -> str:
    return annotation.__name__ if isinstance(annotation, type) and not get_args(annotation) else str(annotation)
