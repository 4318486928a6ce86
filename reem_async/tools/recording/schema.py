"""JSON Schemas for what is recorded, made from the first value.

Viewers use them to offer the fields of a message. Objects stay open, so more or fewer keys need no new
schema; only a field that changes its type does.
"""

from __future__ import annotations

from typing import Any

import orjson

__all__ = ["OPEN", "Signature", "fits", "schema_text", "signature"]

Signature = Any
"""The types in a message: a str for a plain value, a tuple of pairs for an object, a list of one for an array,
None where any value may be."""

OPEN: Signature = ()
"""An object of which nothing is known."""


def signature(value: Any) -> Signature:
    """Return the types in a JSON value."""
    kind = type(value)
    if kind is float or kind is int:
        return "number"
    if kind is str:
        return "string"
    if kind is bool:
        return "boolean"
    if kind is dict:
        return tuple([(key, signature(item)) for key, item in value.items()])
    if kind is list or kind is tuple:
        return _Items(signature(value[0])) if value and _alike(value) else None
    return None


class _Items(tuple[Any, ...]):
    """The signature of an array, by that of its items."""

    __slots__ = ()

    def __new__(cls, item: Signature) -> _Items:
        return super().__new__(cls, (item,))

    def __eq__(self, other: object) -> bool:
        return type(other) is _Items and super().__eq__(other)

    def __hash__(self) -> int:
        return hash(("items", *self))


def _alike(items: Any) -> bool:
    # For JSON, 1 and 1.5 are of one type.
    kinds = {float if type(item) is int else type(item) for item in items}
    return len(kinds) == 1


def fits(found: Signature, known: Signature) -> bool:
    """Return whether a message with the types `found` may go under the schema of `known`."""
    # null, or an array of mixed items: any schema lets it pass.
    if found is None or known is None:
        return True
    if type(found) is not type(known):
        return False
    if type(found) is _Items:
        return fits(found[0], known[0])
    if type(found) is tuple:
        types = dict(known)
        return all(fits(kind, types[key]) for key, kind in found if key in types)
    return bool(found == known)


def schema_text(title: str, known: Signature) -> bytes:
    """Return the JSON Schema of messages with these types."""
    return orjson.dumps({"$schema": _DRAFT, "title": title, **_schema(known)})


_DRAFT = "https://json-schema.org/draft/2020-12/schema"


def _schema(known: Signature) -> dict[str, Any]:
    if type(known) is _Items:
        return {"type": "array", "items": _schema(known[0])} if known[0] is not None else {"type": "array"}
    if type(known) is tuple:
        # null and mixed arrays have no type that viewers take: the object is open, so they may be left out.
        fields = {key: _schema(kind) for key, kind in known if kind is not None}
        return {"type": "object", "properties": fields, "additionalProperties": True}
    return {"type": known}
