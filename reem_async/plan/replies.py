"""Replies -> values, or errors that say what to do."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import orjson

from ..errors import (
    BadData,
    ClusterReply,
    LoginRefused,
    MissingDocument,
    MissingKey,
    MissingTop,
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
from . import Command, Plan, Reply, unwrap
from .documents import nested_over
from .keys import Keys
from .paths import Path, show, to_jsonpath

_REFUSALS: dict[str, tuple[type[Refused], str]] = {
    "NOAUTH": (LoginRefused, "the server needs a password: username=, password=, or redis://user:password@host:port"),
    "WRONGPASS": (LoginRefused, "the server refused this user name and password; the login was not retried"),
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
        "the server cannot save to its disk and refuses writes, nothing was written; its log says why (disk full?)",
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
    "BUSY": (ServerNotReady, "the server is busy with a script, nothing was applied; call again"),
}
_NO_JSON = re.compile(r"ERR unknown command [`'\"]?JSON\.", re.IGNORECASE)
# Characters of a server's message that an error quotes.
_LONGEST_QUOTE = 120
_DEEPEST = 130  # levels of a reply: RedisJSON parses up to 127. Deeper ones would cause a RecursionError elsewhere.
_NO_MEMBERS: frozenset[bytes] = frozenset()


def refusal(text: str) -> Refused | None:
    """Return the error for an error reply about the server, None for one about the command."""
    if _NO_JSON.match(text):
        return NoJsonSupport(
            "the server has JSON, but not this command of RedisJSON; use Redis 8 (see compose.yaml), valkey-bundle, a "
            "server without any JSON, or start one with `reem up`"
        )
    # The beginning of an error of EXEC; the reason follows.
    text = text.removeprefix("EXECABORT Transaction discarded because of: ")
    kind, remedy = _REFUSALS.get(text.partition(" ")[0], (None, ""))
    return kind(f"{remedy} (it says: {text[:_LONGEST_QUOTE]})") if kind is not None else None


def decoded(plan: Plan, replies: list[Reply]) -> Any:
    """Return what `plan` makes of its replies: the result, or the next plan. Raises BadData if no server sends such."""
    try:
        return plan.decode(unwrap(plan, replies))
    except NotAllowed:
        rest = plan.without_refused(replies[1:-1]) if plan.without_refused is not None else None
        if rest is None:
            raise
        return rest
    except (ReemError, RedisError):
        raise
    # Decoders take the shape of replies for granted. Replies of another shape come from another kind of server, or a
    # proxy has mixed up two connections.
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        commands = ", ".join(str(command[0]) for command in plan.commands)
        raise BadData(
            f"the server's replies to {commands:.80} are not what a server of documents sends ({error!r:.120}); "
            "is the address that of a Redis server?"
        ) from error


def full(keys: Keys, path: Path) -> Path:
    """Return the whole path, top-level key first."""
    return (keys.name, *path)


def loads(text: bytes, keys: Keys) -> list[Any]:
    """Return the list of one value in a reply to JSON.GET; raises BadData if it is none, or nested too deep."""
    try:
        holder = orjson.loads(text)
    except orjson.JSONDecodeError:
        raise BadData(f"{keys.name}: the server sent {text[:60]!r}, which is not JSON") from None
    if type(holder) is not list or len(holder) != 1:
        raise BadData(f"{keys.name}: the server sent {text[:60]!r} where a list of one value was due")
    # The caller may walk through the value by recursion.
    if nested_over(text, holder, _DEEPEST):
        raise BadData(f"{keys.name}: the server sent a value of over {_DEEPEST} levels, which RedisJSON does not hold")
    return holder


def checked(reply: Reply, keys: Keys, path: Path) -> Reply:
    if isinstance(reply, Exception):
        raise explained(reply, keys, path)
    return reply


def explained(error: Exception, keys: Keys, path: Path) -> Exception:
    text = str(error)
    where = show(full(keys, path))
    if isinstance(error, Refused | ClusterReply):
        return turned_down(error).at(where)
    # RedisJSON's errors have no codes.
    if "wrong Redis type" in text or text.startswith("WRONGTYPE"):
        return WrongKind(keys.document, where)
    if "that doesn't exist" in text:
        return missing(keys, path)
    if "created at the root" in text:
        return MissingTop(f"{where}: nothing is stored at {keys.name!r}; write {keys.name} itself first, as a dict")
    if "index out of range" in text:
        return out_of_range(keys, path)
    return error


def registered(reply: Reply, keys: Keys) -> frozenset[bytes]:
    # The usual case, without building a frozenset. RESP3 has sets, and a reply from EXEC a list.
    if not reply and type(reply) in (list, set):
        return _NO_MEMBERS
    members = checked(reply, keys, ())
    if not isinstance(members, list | set) or not all(type(member) is bytes for member in members):
        raise BadData(f"{keys.name}: the server sent {members!r:.60} where the members of {keys.registry} were due")
    return frozenset(members)


def settable(keys: Keys, path: Path) -> Plan:
    """Plan to find out whether a value can be set at `path`. Its decode raises PathRefused if not."""
    # The types of all values on the path, in one round trip: the first that cannot hold the next one is the reason.
    places = [path[:length] for length in range(len(path) + 1)]
    commands = [("JSON.TYPE", keys.document, to_jsonpath(place)) for place in places]

    def decode(replies: Sequence[Reply]) -> None:
        kinds = [type_name(checked(reply, keys, path)) for reply in replies]
        for place, kind, inner in zip(places[:-1], kinds[:-1], path, strict=True):
            whole, outer = show(full(keys, path)), show(full(keys, place))
            if kind is None:
                refusal = PathRefused if place else MissingTop
                raise refusal(f"{whole}: there is no {outer} to write into")
            if kind not in ("object", "array") or (kind == "object") != isinstance(inner, str):
                what, cure = f"of type {kind}", ""
                if kind == "string" and isinstance(inner, int):  # on the server an array is a text, its placeholder
                    what, cure = "an array, or text,", " to write: change a copy, and write an array as a whole"
                raise PathRefused(f"{whole}: {outer} is {what} and has no element {inner!r}{cure}")
        if kinds[-1] is None and isinstance(path[-1], int):
            raise out_of_range(keys, path)

    return Plan(commands, decode)


def diagnose(keys: Keys, path: Path, refusal: PathRefused | None) -> Plan:
    """Plan to find out why a write at `path` was refused. Its decode always raises PathRefused.

    It raises the `refusal` if the user may not read.
    """
    plan = settable(keys, path)

    def decode(replies: Sequence[Reply]) -> Any:
        try:
            plan.decode(replies)
        except NotAllowed:
            if refusal is None:
                raise
            raise refusal from None
        raise PathRefused(f"{show(full(keys, path))}: its parent changed while it was written; write again")

    return plan._replace(decode=decode)


def out_of_range(keys: Keys, path: Path) -> PathRefused:
    return PathRefused(f"{show(full(keys, path))}: the list index is out of range; a list only grows by appending")


def type_name(reply: Reply) -> str | None:
    # The reply is [[b"object"]], [b"object"], [None], [[]] or None, depending on the protocol and RedisJSON's version.
    while isinstance(reply, list):
        reply = reply[0] if reply else None
    return reply.decode() if isinstance(reply, bytes) else None


def missing(keys: Keys, path: Path, reply: Reply = ()) -> MissingKey:
    """Return the error for an empty path; the reply is nil, or [nil], if even the top-level key is missing."""
    kind = MissingDocument if reply is None or reply == [None] else MissingKey
    return kind(f"nothing is stored at {show(full(keys, path))}")


# Indexes that count from the end of a list.


def lengths(keys: Keys, path: Path) -> list[Command]:
    """Return the commands whose replies `from_front` reads: the lengths of lists that are counted from the end."""
    return [("JSON.ARRLEN", keys.document, to_jsonpath(path[:position])) for position in _from_end(path)]


def from_front(replies: Sequence[Reply], keys: Keys, path: Path, absent: type[Exception]) -> Path:
    """Return `path` with every index counted from the front; raises `absent` if there is no such item."""
    # The result holds for one instant only, so the caller watches the document and starts again if it was changed.
    front = list(path)
    for position, reply in zip(_from_end(path), replies, strict=True):
        index = path[position]
        count = _count(reply, keys, path, absent)
        where = show(full(keys, path))
        if count is None:
            raise absent(f"{where}: there is no list at {show(full(keys, path[:position]))}")
        if count + int(index) < 0:
            raise absent(f"{where}: the index {index} is out of range, the list has {count} items")
        front[position] = count + int(index)
    return tuple(front)


def _from_end(path: Path) -> Iterator[int]:
    return (position for position, key in enumerate(path) if isinstance(key, int) and key < 0)


def _count(reply: Reply, keys: Keys, path: Path, absent: type[Exception]) -> int | None:
    if isinstance(reply, Exception):
        error = explained(reply, keys, path)
        raise absent(str(error)) if isinstance(error, MissingKey) else error
    count: int | None = reply[0] if reply else None
    return count
