"""Replies -> values, or errors that say what to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import orjson

from ..errors import BadData, MissingKey, NoJsonSupport, PathRefused, WrongKind
from . import Plan, Reply
from .keys import Keys
from .paths import Path, show, to_jsonpath

__all__ = ["checked", "diagnose", "explained", "full", "loads", "missing", "no_json", "type_name"]


def full(keys: Keys, path: Path) -> Path:
    """Return the whole path, top-level key first."""
    return (keys.name, *path)


def loads(text: bytes, keys: Keys) -> list[Any]:
    """Return the list of one value that the server answers to a path in JSON.

    Raises:
        BadData: Not JSON, or not a list of one.
    """
    try:
        holder = orjson.loads(text)
    except orjson.JSONDecodeError:
        raise BadData(f"{keys.name}: the server sent {text[:60]!r}, which is not JSON") from None
    if type(holder) is not list or len(holder) != 1:
        raise BadData(f"{keys.name}: the server sent {text[:60]!r} where a list of one value was due")
    return holder


def checked(reply: Reply, keys: Keys, path: Path) -> Reply:
    """Return `reply`; raise what it means if it is an error."""
    if isinstance(reply, Exception):
        raise explained(reply, keys, path)
    return reply


def explained(error: Exception, keys: Keys, path: Path) -> Exception:
    """Return the error to raise for an error reply: one that says what to do, or the server's own."""
    text = str(error)
    where = show(full(keys, path))
    if "wrong Redis type" in text or text.startswith("WRONGTYPE"):
        return WrongKind(keys.document, where)
    if "unknown command" in text.lower() and "JSON." in text:
        return NoJsonSupport(no_json())
    if "that doesn't exist" in text:
        return missing(keys, path)
    if "created at the root" in text:
        return PathRefused(f"{where}: nothing is stored at {keys.name!r}; write {keys.name} itself first, as a dict")
    if "index out of range" in text:
        return PathRefused(f"{where}: the list index is out of range; use append() to make a list longer")
    return error


def no_json() -> str:
    """Return what to do about a server without RedisJSON."""
    return (
        "the server has no RedisJSON; use Redis 8 (see compose.yaml), Redis Stack, valkey-bundle, "
        "or start one with `reem up`"
    )


def diagnose(keys: Keys, path: Path) -> Plan:
    """Plan to find out why a write at `path` was refused. Its decode always raises PathRefused."""
    prefixes = [path[:length] for length in range(len(path))]
    commands = [("JSON.TYPE", keys.document, to_jsonpath(prefix)) for prefix in prefixes]

    def decode(replies: Sequence[Reply]) -> Any:
        for prefix, reply in zip(prefixes, replies, strict=True):
            kind = type_name(checked(reply, keys, prefix))
            key = path[len(prefix)]
            if kind is None:
                raise PathRefused(f"{show(full(keys, path))}: there is no {show(full(keys, prefix))} to write into")
            if kind not in ("object", "array") or (kind == "object") != isinstance(key, str):
                raise PathRefused(
                    f"{show(full(keys, path))}: {show(full(keys, prefix))} is of type {kind} and has no element {key!r}"
                )
        raise PathRefused(f"{show(full(keys, path))}: its parent changed while it was written; write again")

    return Plan(commands, decode)


def type_name(reply: Reply) -> str | None:
    """Return the name of the JSON type in a reply to JSON.TYPE: [[b"object"]], [b"object"], [None], [[]] or None."""
    while isinstance(reply, list):
        reply = reply[0] if reply else None
    return reply.decode() if isinstance(reply, bytes) else None


def missing(keys: Keys, path: Path) -> MissingKey:
    """Return the error for a path where nothing is stored."""
    return MissingKey(f"nothing is stored at {show(full(keys, path))}")
