"""The fields of a class: their names, annotations and defaults, for dataclasses, `msgspec.Struct` and pydantic models.

Nothing is imported for that: the classes of msgspec and pydantic are recognized by their attributes.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import inspect
import sys
from typing import Annotated, Any, Generic, Literal, NamedTuple, Protocol, TypeVar, get_args, get_origin, get_type_hints

from ..errors import BadType

_UNKNOWN = "_reem_unknown_fields"  # an attribute of objects that were read: what is stored beside their fields
WHERE_TO_DEFINE = "define or import it at the top of the module, outside of functions and of `if TYPE_CHECKING`"


class Use(enum.Enum):
    """What reading does with the stored value of a field."""

    ARGUMENT = enum.auto()  # give it to the constructor
    STATE = enum.auto()  # set it when the object is made: `field(init=False, default=...)`
    COMPUTED = enum.auto()  # nothing: the class computes it, or it only names the class


class Field(NamedTuple):
    annotation: Any
    required: bool
    use: Use = Use.ARGUMENT


def class_of(annotation: Any) -> Any:
    """Return `Box` of `Box[float]`."""
    return get_origin(annotation) or annotation


def fields_of(annotation: Any) -> dict[str, Field] | None:
    """Return the fields of a class by their names; None if it has none.

    Raises:
        BadType: It is a class with fields of which no object can be made again.
    """
    return _fields_of(annotation) if isinstance(class_of(annotation), type) else None


@functools.lru_cache(maxsize=1024)
def _fields_of(annotation: Any) -> dict[str, Field] | None:
    kind = class_of(annotation)
    try:
        if dataclasses.is_dataclass(kind):
            return _of_dataclass(annotation, kind)
        if is_pydantic(kind):
            return _of_pydantic(kind)
        return _of_struct(annotation, kind) if hasattr(kind, "__struct_fields__") else None
    except NameError as error:  # pydantic's own is one too
        missing = error.name or str(error)
        raise BadType(
            f"{kind.__name__}: its annotations name {missing!r}, which cannot be found; {WHERE_TO_DEFINE}"
        ) from None


def is_pydantic(kind: Any) -> bool:
    return hasattr(kind, "model_fields") and hasattr(kind, "model_validate")


def unknown_of(value: Any) -> dict[str, Any]:
    """Return what is stored beside the fields of an object, as far as the object has it."""
    return {**getattr(value, _UNKNOWN, {}), **(getattr(value, "__pydantic_extra__", None) or {})}


def with_unknown(value: Any, unknown: dict[str, Any]) -> Any:
    """Return an object with what is stored beside its fields, if it can keep that."""
    if unknown and hasattr(value, "__dict__") and getattr(value, "__pydantic_extra__", None) is None:
        object.__setattr__(value, _UNKNOWN, unknown)
    return value


def construct(annotation: Any, values: dict[str, Any], unknown: dict[str, Any]) -> Any:
    """Return the object with these arguments. Raises what the class itself raises."""
    kind = class_of(annotation)
    if not is_pydantic(kind):
        config = getattr(kind, "__struct_config__", None)
        if unknown and config is not None and config.forbid_unknown_fields:
            raise ValueError(f"it has no field {', '.join(sorted(unknown))}")
        return kind(**values)
    if kind.model_config.get("extra") in ("allow", "forbid"):
        values = {**unknown, **values}
    has_alias = any(each.validation_alias is not None for each in kind.model_fields.values())
    return kind.model_validate(values, **({"by_name": True} if has_alias else {}))  # which is of pydantic 2.11


def checks_itself(annotation: Any) -> bool:
    """Return whether the constructor may refuse values of the right types."""
    return is_pydantic(class_of(annotation)) or hasattr(class_of(annotation), "__post_init__")


def _of_dataclass(annotation: Any, kind: Any) -> dict[str, Field]:
    hints, fields = _hints(annotation), {}
    for each in dataclasses.fields(kind):
        has_default = each.default is not dataclasses.MISSING or each.default_factory is not dataclasses.MISSING
        use = Use.ARGUMENT if each.init else Use.STATE if has_default else Use.COMPUTED
        fields[each.name] = Field(hints[each.name], each.init and not has_default, use)
    arguments = {name for name, each in fields.items() if each.use is Use.ARGUMENT}
    taken = inspect.signature(kind).parameters
    several = {name for name, it in taken.items() if it.kind in (it.VAR_KEYWORD, it.VAR_POSITIONAL)}
    for name, it in taken.items():
        if name not in arguments | several and it.default is it.empty:
            raise BadType(
                f"{kind.__name__}: its constructor needs {name!r}, which is no field and not stored; give it a default"
            )
    if (lacking := arguments - taken.keys()) and not several:
        raise BadType(f"{kind.__name__}: its constructor does not take the fields {', '.join(sorted(lacking))}")
    return fields


def _of_pydantic(kind: Any) -> dict[str, Field]:
    if kind.__pydantic_root_model__:
        raise BadType(f"{kind.__name__}: a RootModel has no fields of its own; use the type of its root")
    kind.model_rebuild()  # names that were defined after the class; nothing if it is complete
    fields = {}
    for name, each in kind.model_fields.items():
        # What an `Annotated` says is in the metadata.
        notes = (each.annotation, *each.metadata)
        fields[name] = Field(Annotated[notes] if each.metadata else each.annotation, each.is_required())
    return fields


def _of_struct(annotation: Any, kind: Any) -> dict[str, Field]:
    hints = _hints(annotation)
    fields = {each.name: Field(hints[each.name], each.required) for each in sys.modules["msgspec"].structs.fields(kind)}
    config = kind.__struct_config__
    if config.tag is not None:
        fields[config.tag_field] = Field(Literal[config.tag], False, Use.COMPUTED)
    return fields


def tag_of(kind: Any, name: str) -> Any:
    """Return the tag of a Struct if that is stored under this name, else None."""
    config = getattr(kind, "__struct_config__", None)
    return config.tag if config is not None and config.tag_field == name else None


def _hints(annotation: Any) -> dict[str, Any]:
    """Return the annotations of a class and its bases, with the types that `Box[float]` has for type variables."""
    kind = class_of(annotation)
    try:
        hints = get_type_hints(kind, include_extras=True)
    except NameError:  # a class in a function may name itself
        hints = get_type_hints(kind, localns={kind.__name__: kind}, include_extras=True)
    if not hasattr(kind, "__orig_bases__"):
        return hints
    for base in reversed(vars(kind).get("__orig_bases__", kind.__bases__)):
        if class_of(base) not in (Generic, Protocol) and hasattr(class_of(base), "__orig_bases__"):
            own = inspect.get_annotations(kind)
            hints |= {name: hint for name, hint in _hints(base).items() if name not in own}
    bound = dict(zip(getattr(kind, "__parameters__", ()), get_args(annotation), strict=False))
    return {name: bind(hint, bound) for name, hint in hints.items()}


def bind(hint: Any, bound: dict[Any, Any]) -> Any:
    """Return an annotation with other types for its type variables."""
    if isinstance(hint, TypeVar):
        return bound.get(hint, hint)
    variables = () if isinstance(hint, type) else getattr(hint, "__parameters__", ())
    return hint[tuple(bound.get(each, each) for each in variables)] if variables else hint
