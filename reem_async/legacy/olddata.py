"""Detect data of REEM 0.0 and 0.1, with the first read of a key."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import orjson

from ..errors import BadData
from ..plan import Command, Plan, Reply
from ..plan.keys import Keys
from ..plan.paths import Path, shorten
from ..plan.shapes import ShapeCache

METADATA = "&&&&metadata"  # the end of the name of a key's second document

ROOT = "%%%%ROOT%%%%"  # the entry of a value that is no dict

_ROOT = ROOT.encode()

CURE = "run `reem migrate` once, which converts it in place; see docs/migration.md"

_INDEXED = re.compile(r"(?P<key>[^\[\]]*)(?P<indexes>(?:\[-?\d{1,9}\])+)")


def root_command(document: str) -> Command:
    return ("JSON.TYPE", document, f'$["{ROOT}"]')


def is_rooted(reply: Reply) -> bool:
    while isinstance(reply, list):
        reply = reply[0] if reply else None
    return isinstance(reply, bytes)


def special_paths(reply: Reply) -> dict[str, str] | None:
    """Return the ships' labels by place, from a second document; None if it is none."""
    if not isinstance(reply, bytes | bytearray):
        return None
    try:
        places = orjson.loads(reply)[0]["special_paths"]
    except (orjson.JSONDecodeError, KeyError, IndexError, TypeError):
        return None
    if not isinstance(places, dict) or not all(isinstance(label, str) for label in places.values()):
        return None
    return places


def is_new(keys: Keys, path: Path, cache: ShapeCache) -> bool:
    shape = cache.of(keys.document)
    return shape.is_new_below if path else shape.is_new


def first_read(plan: Plan, keys: Keys, path: Path, cache: ShapeCache) -> Plan:
    """Return a read that also checks, in the same round trip, that the key is not old; its decode raises BadData.

    Not in a cluster, which old programs could not use: the second document may be on another node. If the reply leaves
    open whether the document has the entry of a value that is no dict, there is another round trip.
    """
    # Once for each key and interface.
    if is_new(keys, path, cache):
        return plan
    # In a transaction a missing right to the second document would refuse the read; later reads are no transactions.
    if plan.atomic:
        return plan
    end = len(plan.commands)
    look = [] if keys.sharded else [_second_document(keys)]

    def decode(replies: Sequence[Reply]) -> Any:
        read = replies[:end]
        _check_places(replies[end:], keys)
        if _may_be_rooted(read[0]):
            return Plan([root_command(keys.document)], lambda rooted: decode_new(rooted, read))
        cache.of(keys.document).saw_new(path)
        return plan.decode(read)

    def decode_new(rooted: Sequence[Reply], read: Sequence[Reply]) -> Any:
        _check_new(rooted, keys, cache)
        return plan.decode(read)

    return plan._replace(commands=(*plan.commands, *look), decode=decode)


def look_first(plan: Plan, keys: Keys, cache: ShapeCache) -> Plan:
    """As `first_read`, for a read that is a transaction: with a round trip of its own before."""
    if is_new(keys, (), cache):
        return plan

    def decode(replies: Sequence[Reply]) -> Any:
        _check_new(replies, keys, cache)
        return plan

    look = root_command(keys.document)
    return Plan([look] if keys.sharded else [look, _second_document(keys)], decode)


def _second_document(keys: Keys) -> Command:
    return ("JSON.GET", keys.document + METADATA, "$")


def _may_be_rooted(reply: Reply) -> bool:
    """Return whether a reply to JSON.GET has the entry, or nothing, as at a place beside the entry."""
    return isinstance(reply, bytes | bytearray) and (reply == b"[]" or _ROOT in reply)


def _check_places(second: Sequence[Reply], keys: Keys) -> None:
    if any(special_paths(reply) for reply in second):
        raise _old(keys)


def _check_new(replies: Sequence[Reply], keys: Keys, cache: ShapeCache) -> None:
    rooted, *second = replies
    if is_rooted(rooted):
        raise _old(keys)
    _check_places(second, keys)
    cache.of(keys.document).saw_new()


def _old(keys: Keys) -> BadData:
    return BadData(f"{keys.name} was written by REEM 0.1 or older, and would be read wrong; {CURE}")


def candidates(place: str) -> list[Path]:
    """Return the possible paths of an old place: `.a[0]` is an item of the list `a`, or the entry `a[0]`.

    Names with brackets were allowed, so only the document can tell. Raises BadData if it is no place.
    """
    if place == ".":
        return [()]
    if not place.startswith((".", "[")):
        raise BadData(f"{shorten(place)} is not a place that REEM 0.1 would write")
    parts = place.removeprefix(".").split(".")
    indexed = tuple(step for part in parts for step in _steps(part))
    return [indexed] if indexed == tuple(parts) else [indexed, tuple(parts)]


def _steps(part: str) -> list[str | int]:
    found = _INDEXED.fullmatch(part)
    if found is None:
        return [part]
    indexes = [int(text) for text in re.findall(r"-?\d+", found["indexes"])]
    return [found["key"], *indexes] if found["key"] else list(indexes)
