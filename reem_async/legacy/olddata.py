"""Data of REEM 0.0 and 0.1 told from new data: its names, and a look for it with the first read of a key."""

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

METADATA = "&&&&metadata"
"""What follows a key's name in the name of its second document."""

ROOT = "%%%%ROOT%%%%"
"""The entry under which a value was stored that is no dict."""

_ROOT = ROOT.encode()

CURE = "run `reem migrate` once, which converts it in place; see docs/migration.md"

_INDEXED = re.compile(r"(?P<key>[^\[\]]*)(?P<indexes>(?:\[-?\d{1,9}\])+)")


def root_command(document: str) -> Command:
    """Return the command whose reply `is_rooted` reads."""
    return ("JSON.TYPE", document, f'$["{ROOT}"]')


def is_rooted(reply: Reply) -> bool:
    """Return whether a document has the entry of a value that is no dict."""
    while isinstance(reply, list):
        reply = reply[0] if reply else None
    return isinstance(reply, bytes)


def special_paths(reply: Reply) -> dict[str, str] | None:
    """Return the ships' labels by place, from a reply to JSON.GET of all of a second document; None if it is none."""
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
    """Return whether what is at `path` was once found to be new, which counts for as long as the interface lives."""
    return keys.document in (cache.new_below if path else cache.new)


def first_read(plan: Plan, keys: Keys, path: Path, cache: ShapeCache) -> Plan:
    """Return a read of a place, with a look whether it is old in the same round trip unless it is known to be new.

    In a cluster the second document may
    be on another node, and old programs could not use a cluster, so it is not asked for there. Whether the document
    has the entry of a value that is no dict is asked only where the reply leaves that open: another round trip.

    Raises (in decode):
        BadData: It is old.
    """
    # Once for each key and interface: a read costs the same round trip, and what was found to be new stays so.
    if is_new(keys, path, cache):
        return plan
    # In a transaction a look that is not allowed would cost the read; later reads are none.
    if plan.atomic:
        return plan
    end = len(plan.commands)
    look = [] if keys.sharded else [_second_document(keys)]

    def decode(replies: Sequence[Reply]) -> Any:
        read = replies[:end]
        _check_places(replies[end:], keys)
        # The text of most documents rules the old entry out, so the second round trip is rare.
        if _may_be_rooted(read[0]):
            return Plan([root_command(keys.document)], lambda rooted: decode_new(rooted, read))
        cache.saw_new(keys.document, path)
        return plan.decode(read)

    def decode_new(rooted: Sequence[Reply], read: Sequence[Reply]) -> Any:
        _check_new(rooted, keys, cache)
        return plan.decode(read)

    return plan._replace(commands=(*plan.commands, *look), decode=decode)


def look_first(plan: Plan, keys: Keys, cache: ShapeCache) -> Plan:
    """As `first_read`, for a read that is a transaction: the look is a round trip of its own, ahead of it."""
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
    """Return whether a reply to JSON.GET names the entry, or shows nothing, as it does at a place beside the entry."""
    return isinstance(reply, bytes | bytearray) and (reply == b"[]" or _ROOT in reply)


def _check_places(second: Sequence[Reply], keys: Keys) -> None:
    if any(special_paths(reply) for reply in second):
        raise _old(keys)


def _check_new(replies: Sequence[Reply], keys: Keys, cache: ShapeCache) -> None:
    rooted, *second = replies
    if is_rooted(rooted):
        raise _old(keys)
    _check_places(second, keys)
    cache.saw_new(keys.document)


def _old(keys: Keys) -> BadData:
    return BadData(f"{keys.name} was written by REEM 0.1 or older, and would be read wrong; {CURE}")


def candidates(place: str) -> list[Path]:
    """Return what an old place below a key may mean: `.a[0]` an item of the list `a`, or the entry `a[0]`.

    Names with brackets were allowed, so only the document can tell.

    Raises:
        BadData: Not a place.
    """
    if place == ".":
        return [()]
    if not place.startswith((".", "[")):
        raise BadData(f"{shorten(place)} is not a place that REEM 0.1 would write")
    parts = place.removeprefix(".").split(".")
    indexed = tuple(step for part in parts for step in _steps(part))
    # The likelier one first: names with brackets are rare.
    return [indexed] if indexed == tuple(parts) else [indexed, tuple(parts)]


def _steps(part: str) -> list[str | int]:
    found = _INDEXED.fullmatch(part)
    if found is None:
        return [part]
    indexes = [int(text) for text in re.findall(r"-?\d+", found["indexes"])]
    return [found["key"], *indexes] if found["key"] else list(indexes)
