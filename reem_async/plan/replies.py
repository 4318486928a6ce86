"""Replies -> values, or errors that say what to do."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import orjson

from ..errors import (
    BadData,
    ClusterReply,
    LoginRefused,
    MissingKey,
    NoJsonSupport,
    NotAllowed,
    PathRefused,
    RedisError,
    ReemError,
    Refused,
    ServerFull,
    ServerNotReady,
    ServerReadOnly,
    WrongKind,
    turned_down,
)
from . import Plan, Reply, unwrap
from .keys import Keys
from .paths import Path, show, to_jsonpath

__all__ = [
    "checked", "decoded", "diagnose", "explained", "full", "loads", "missing", "no_json", "refusal",
    "registered", "settable", "type_name",
]  # fmt: skip

_REFUSALS: dict[str, tuple[type[Refused], str]] = {
    "NOAUTH": (LoginRefused, "the server needs a password: RedisInterface(..., username=..., password=...)"),
    "WRONGPASS": (LoginRefused, "the server does not take this user name and password; nothing was tried again"),
    "NOPERM": (
        NotAllowed,
        "the user may not do this; deploy/users.acl lists the rights REEM needs, `ACL LOG` shows what was refused",
    ),
    "OOM": (
        ServerFull,
        "the server's memory is full (maxmemory), nothing was written; delete something, or raise maxmemory",
    ),
    "READONLY": (ServerReadOnly, "the server is a read-only replica, nothing was written; connect to its primary"),
    "MISCONF": (
        ServerReadOnly,
        "the server cannot save to its disk and takes no writes, nothing was written; its log says why (disk full?)",
    ),
    "NOREPLICAS": (
        ServerReadOnly,
        "too few replicas follow the server (min-replicas-to-write), nothing was written; start them",
    ),
    "LOADING": (
        ServerNotReady,
        "the server is still loading its data from disk, nothing was applied; call again in a moment",
    ),
    "MASTERDOWN": (
        ServerNotReady,
        "the server is a replica that has lost its primary, nothing was applied; connect to the primary",
    ),
    "BUSY": (ServerNotReady, "the server is busy with somebody's script, nothing was applied; call again"),
}
_NO_JSON = re.compile(r"ERR unknown command [`'\"]?JSON\.", re.IGNORECASE)
_LONGEST_QUOTE = 120
_NO_MEMBERS: frozenset[bytes] = frozenset()


def refusal(text: str) -> Refused | None:
    """Return the error to raise for an error reply that is about the server, None for one about the command."""
    if _NO_JSON.match(text):
        return NoJsonSupport(no_json())
    kind, remedy = _REFUSALS.get(text.partition(" ")[0], (None, ""))
    return kind(f"{remedy} (it says: {text[:_LONGEST_QUOTE]})") if kind is not None else None


def decoded(plan: Plan, replies: list[Reply]) -> Any:
    """Return what `plan` makes of its replies: the result, or the next plan.

    Raises:
        BadData: The replies are of a shape that no server sends to these commands.
    """
    try:
        return plan.decode(unwrap(plan, replies))
    except (ReemError, RedisError):
        raise
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        commands = ", ".join(str(command[0]) for command in plan.commands)
        raise BadData(
            f"the server's replies to {commands:.80} are not what a server with RedisJSON sends ({error!r:.120}); "
            "is the address that of a Redis server?"
        ) from error


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
    if isinstance(error, Refused | ClusterReply):
        return turned_down(error).at(where)
    if "wrong Redis type" in text or text.startswith("WRONGTYPE"):
        return WrongKind(keys.document, where)
    if "that doesn't exist" in text:
        return missing(keys, path)
    if "created at the root" in text:
        return PathRefused(f"{where}: nothing is stored at {keys.name!r}; write {keys.name} itself first, as a dict")
    if "index out of range" in text:
        return out_of_range(keys, path)
    return error


def registered(reply: Reply, keys: Keys) -> frozenset[bytes]:
    """Return what the registry of ships' keys holds, from a reply to SMEMBERS; raises BadData if it is none."""
    if not reply and type(reply) in (list, set):
        return _NO_MEMBERS
    members = checked(reply, keys, ())
    if not isinstance(members, list | set) or not all(type(member) is bytes for member in members):
        raise BadData(f"{keys.name}: the server sent {members!r:.60} where the members of {keys.registry} were due")
    return frozenset(members)


def no_json() -> str:
    """Return what to do about a server without RedisJSON."""
    return (
        "the server has no RedisJSON; use Redis 8 (see compose.yaml), Redis Stack, valkey-bundle, "
        "or start one with `reem up`"
    )


def settable(keys: Keys, path: Path) -> Plan:
    """Plan to find out whether something can be set at `path`. Its decode raises PathRefused if not."""
    places = [path[:length] for length in range(len(path) + 1)]
    commands = [("JSON.TYPE", keys.document, to_jsonpath(place)) for place in places]

    def decode(replies: Sequence[Reply]) -> None:
        kinds = [type_name(checked(reply, keys, path)) for reply in replies]
        for place, kind, inner in zip(places[:-1], kinds[:-1], path, strict=True):
            whole, outer = show(full(keys, path)), show(full(keys, place))
            if kind is None:
                raise PathRefused(f"{whole}: there is no {outer} to write into")
            if kind not in ("object", "array") or (kind == "object") != isinstance(inner, str):
                raise PathRefused(f"{whole}: {outer} is of type {kind} and has no element {inner!r}")
        if kinds[-1] is None and isinstance(path[-1], int):
            raise out_of_range(keys, path)

    return Plan(commands, decode)


def diagnose(keys: Keys, path: Path) -> Plan:
    """Plan to find out why a write at `path` was refused. Its decode always raises PathRefused."""
    plan = settable(keys, path)

    def decode(replies: Sequence[Reply]) -> Any:
        plan.decode(replies)
        raise PathRefused(f"{show(full(keys, path))}: its parent changed while it was written; write again")

    return plan._replace(decode=decode)


def out_of_range(keys: Keys, path: Path) -> PathRefused:
    """Return the error for an item beyond the end of a list."""
    return PathRefused(f"{show(full(keys, path))}: the list index is out of range; use append() to make a list longer")


def type_name(reply: Reply) -> str | None:
    """Return the name of the JSON type in a reply to JSON.TYPE: [[b"object"]], [b"object"], [None], [[]] or None."""
    while isinstance(reply, list):
        reply = reply[0] if reply else None
    return reply.decode() if isinstance(reply, bytes) else None


def missing(keys: Keys, path: Path) -> MissingKey:
    """Return the error for a path where nothing is stored."""
    return MissingKey(f"nothing is stored at {show(full(keys, path))}")
