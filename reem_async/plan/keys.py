"""The names on the server of everything that belongs to one top-level key, and plans that list keys.

The braces are Redis Cluster's hash tag: keys with the same tag are on the same node, so one transaction can hold them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from ..errors import ALL_NODES, ClusterNode, NotAllowed
from . import Command, Plan, Reply


class Keys(NamedTuple):
    name: str  # the key as the user knows it
    document: str  # the RedisJSON document, namespace included
    tag: str  # the beginning of every attachment's key: `{foo}`
    registry: str  # the set of the suffixes of all attachments
    channel: str  # where notices of updates are published
    last: str  # the note: publisher and number of the last notice; kept for a minute
    # The command for notices: SPUBLISH in a cluster, where a channel belongs to the key's node.
    publish: str = "PUBLISH"

    @property
    def lease(self) -> str:
        return f"{self.tag}:lease"

    @property
    def fence(self) -> str:
        return f"{self.tag}:fence"

    @property
    def sharded(self) -> bool:
        return self.publish == "SPUBLISH"


@lru_cache(maxsize=4096)
def keys_of(name: str, namespace: str = "", database: int = 0, sharded: bool = False) -> Keys:
    tag = "{" + namespace + name + "}"
    # Channels are shared by all databases of a server, keys are not.
    channel = f"{tag}:notices" + (f"@{database}" if database else "")
    publish = "SPUBLISH" if sharded else "PUBLISH"
    return Keys(name, namespace + name, tag, f"{tag}:ships", channel, f"{tag}:last", publish)


PRESENCE = ":node"  # follows the tag in the names of the keys of coordination/presence.py
DOCUMENT = "ReJSON-RL"  # the reply of TYPE for a JSON document
_PAGE = "1000"


def page(glob: str = "", kind: str = "", cursor: Any = b"0") -> Plan:
    """Plan to list about 1000 keys of one server; the result is the next cursor and the names, as bytes.

    Only those of a `glob` in the server's syntax and of a Redis type `kind`, if they are given.
    """
    return Plan([_scan(glob, kind, cursor)], lambda replies: _raised(replies[0]))


def first_page(glob: str = "", kind: str = "") -> Plan:
    """Plan to list the first keys, as `page` does; its decode raises ClusterNode if the server is one of several."""

    def decode(replies: Sequence[Reply]) -> Any:
        standing, found = replies
        if isinstance(standing, bytes) and b"cluster_enabled:1" in standing:
            return Plan([("CLUSTER", "INFO")], lambda replies: decode_cluster(replies[0], found))
        return _raised(found)

    def decode_cluster(standing: Reply, found: Reply) -> Reply:
        if not isinstance(standing, bytes) or b"cluster_size:1\r" not in standing:
            raise ClusterNode("the server is one node of a Redis Cluster and holds a part of the keys", ALL_NODES)
        return _raised(found)

    return Plan([("INFO", "cluster"), _scan(glob, kind, b"0")], decode)


def _scan(glob: str, kind: str, cursor: Any) -> Command:
    # COUNT is the number of buckets that the server visits, so a page may be empty though there are more keys.
    matching = ("MATCH", glob) if glob else ()
    return ("SCAN", cursor, *matching, "COUNT", _PAGE, *(("TYPE", kind) if kind else ()))


def count(database: int) -> Plan:
    """Plan to count the keys of a database of one server; the result is None if the user may not ask."""

    def decode(replies: Sequence[Reply]) -> int | None:
        if isinstance(replies[0], NotAllowed):
            return None
        found = re.search(rb"(?m)^db%d:keys=(\d+)" % database, _raised(replies[0]))
        return int(found[1]) if found is not None else 0

    return Plan([("INFO", "keyspace")], decode)  # DBSIZE is a right of its own, which deploy/users.acl does not give


def _raised(reply: Reply) -> Reply:
    if isinstance(reply, Exception):
        raise reply
    return reply
