"""Parameters that are objects of a class: each field is a parameter, and the program gets and writes them together."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, NamedTuple, get_args, get_origin

import numpy as np

from ..errors import BadData, BadType, BadValue, MissingKey
from ..plan.classes import Use, fields_of
from ..plan.paths import Path, check_name, show
from ..plan.trees import get
from ..plan.typed import bare, made, stored
from ..store.document import DocumentReader, opened, retried
from ..store.publish import publisher
from . import parameters
from .parameters import Declaration, Live, LiveParameter, ParameterGroup, check_on_change, publish
from .specification import as_json, equal

_OPTIONS = ("low", "high", "unit", "help", "choices")
_NAMES = {"ge": "low", "le": "high", "description": "help"}  # in `msgspec.Meta` and `pydantic.Field`


class ObjectDeclaration(NamedTuple):
    path: Path
    kind: type
    parts: tuple[Declaration, ...]
    dtypes: dict[Path, Any]  # of the parts that are arrays
    on_change: Callable[[Any], Any] | None

    def given(self, tree: Any) -> Any:
        """Return a new object of the values of its fields; raises BadData."""
        return made(self.kind, tree, self.path)

    def tree(self, values: Mapping[Path, Any]) -> dict[str, Any]:
        """Return the values of the parts as what is stored of an object; arrays are such."""
        tree: dict[str, Any] = {}
        for part in self.parts:
            *above, name = map(str, part.path[len(self.path) :])
            inner = tree
            for each in above:
                inner = inner.setdefault(each, {})
            inner[name] = value = as_json(values[part.path])
            if (dtype := self.dtypes.get(part.path)) is not None:
                inner[name] = array = np.array(value, dtype)
                array.flags.writeable = False  # all objects that are made of this tree share it
        return tree

    async def begin(self, group: ParameterGroup) -> Live:
        parts = [await group.declare(each) for each in self.parts]
        place = self.path, self.kind
        live: Live = group.objects.get(place) or group.objects.setdefault(place, LiveObject(group, self, parts))
        return live


def prepared(
    parent: Path, name: Any, default: Any, *, on_change: Callable[[Any], Any] | None = None, **specification: Any
) -> Declaration | ObjectDeclaration:
    """Return a declaration; raises BadInput for what cannot be declared. Nothing is sent."""
    kind = type(default)
    if fields_of(kind) is None:
        return parameters.prepared(parent, name, default, on_change=on_change, **specification)
    path = (*parent, check_name(name, parent))
    given = [key for key, value in specification.items() if value not in (None, "")]
    if given:
        raise BadValue(
            f"{show(path)}: {', '.join(given)} of an object cannot be given here; each field has its own: use "
            "dataclasses.field(metadata={'low': 0.0, 'unit': 'm'}), msgspec.Meta(ge=0.0) or pydantic.Field(ge=0.0)"
        )
    check_on_change(show(path), on_change)
    tree = stored(kind, default, path)
    parts = tuple(_parts(kind, tree, path))
    if not parts:
        raise BadType(f"{show(path)}: {kind.__name__} has no fields; use a class that has")
    dtypes = {each.path: get(tree, each.path[len(path) :]).dtype for each in parts if each.is_array}
    return ObjectDeclaration(path, kind, parts, dtypes, on_change)


def _parts(kind: Any, tree: Any, path: Path) -> Iterator[Declaration]:
    for name, field in (fields_of(kind) or {}).items():
        if field.use is Use.COMPUTED:
            continue
        annotation, _ = bare(field.annotation)
        if fields_of(annotation) is not None:
            yield from _parts(annotation, tree[name], (*path, name))
        else:
            yield parameters.prepared(path, name, tree[name], **_options(kind, name, field.annotation))


def _options(kind: Any, name: str, annotation: Any) -> dict[str, Any]:
    """Return the bounds, unit, help and choices that a class gives a field."""
    annotation, notes = bare(annotation)
    options: dict[str, Any] = {}
    if get_origin(annotation) is Literal:
        options["choices"] = get_args(annotation)
    elif isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        options["choices"] = [each.value for each in annotation]
    of_pydantic = getattr(kind, "model_fields", {}).get(name)
    inner = [each for note in notes for each in getattr(note, "metadata", ())]  # of a `pydantic.Field`
    for note in (*notes, *inner, of_pydantic):
        found = {to: getattr(note, of, None) for of, to in _NAMES.items()}
        for extra in ("extra", "json_schema_extra"):
            found |= _known(getattr(note, extra, None))
        options |= {key: value for key, value in found.items() if value is not None}
    of_dataclass = getattr(kind, "__dataclass_fields__", {}).get(name)
    return options | _known(getattr(of_dataclass, "metadata", None))


def _known(options: Any) -> dict[str, Any]:
    return {key: options[key] for key in _OPTIONS if key in options} if isinstance(options, Mapping) else {}


class LiveObject(Live):
    """The last good object: while a field is not valid, or the class refuses them together, it stays as it is."""

    def __init__(self, group: ParameterGroup, declaration: ObjectDeclaration, parts: list[LiveParameter]) -> None:
        super().__init__(group, declaration.path, declaration.tree({each.path: each.default for each in parts}))
        self._declaration = declaration
        self._parts = parts
        self._values = {each.path: each.default for each in parts}
        self.take()
        self.begun = True

    def take(self) -> None:
        values = {each.path: each.value for each in self._parts}
        wrong = next((each.invalid for each in self._parts if each.invalid), "")
        if not wrong and not _same(values, self._values):
            try:
                tree = self._declaration.tree(values)
                self._declaration.given(tree)
            except (BadData, OverflowError) as error:  # the number of an array that is too large for its dtype
                wrong = str(error)
                self.report(f"what is stored is ignored, and the last object stays: {error}")
            else:
                self._values, self.invalid = values, ""
                self._set(tree)
        self.invalid = wrong
        self._wake()

    async def write(self, value: Any) -> None:
        """Check and publish an object. What is stored beside its fields stays."""
        tree = stored(self._declaration.kind, value, self.path)
        values = {
            each.path: each.specification.checked(each.name, get(tree, each.path[len(self.path) :]))
            for each in self._parts
        }
        plain: dict[str, Any] = self._declaration._replace(dtypes={}).tree(values)
        await self._written(lambda: not self.invalid and _same(values, self._values), self._publish(plain))

    async def _publish(self, tree: dict[str, Any]) -> None:
        session, name, inner = self.group.session, self.path[0], self.path[1:]

        async def attempt() -> None:
            try:
                before = await DocumentReader(session, name).raw_read(inner)
            except MissingKey:
                await publish(session, self.path, tree)
            else:
                merged = _merged(await opened(before), tree)
                await publisher(session, name, "raise").exchange(inner, merged, before)

        await retried(attempt)


def _same(one: Mapping[Path, Any], other: Mapping[Path, Any]) -> bool:
    return all(equal(value, other[path]) for path, value in one.items())


def _merged(old: Any, new: Any) -> Any:
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    return old | {key: _merged(old.get(key), value) for key, value in new.items()}
