"""The names on the server: everything that belongs to one top-level key.

The braces are Redis Cluster's hash tag: whatever carries the same tag lives on the same node, so
that one transaction can hold it all.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

__all__ = ["Keys", "keys_of"]


class Keys(NamedTuple):
    """The server-side names of one top-level key.

    Attributes:
        name: The key as the user knows it.
        document: The RedisJSON document, namespace included.
        tag: What every ship's key begins with: `{foo}`.
        registry: The set of the suffixes of all ships' keys that exist.
        channel: Where notices of updates are published.
        last: Which notice was published last; kept for a minute.
        publish: The command for notices: SPUBLISH in a cluster, where a channel belongs to the key's node.
    """

    name: str
    document: str
    tag: str
    registry: str
    channel: str
    last: str
    publish: str = "PUBLISH"

    @property
    def sharded(self) -> bool:
        """Whether it is in a cluster."""
        return self.publish == "SPUBLISH"


@lru_cache(maxsize=4096)
def keys_of(name: str, namespace: str = "", database: int = 0, sharded: bool = False) -> Keys:
    """Return the server-side names of the top-level key `name`."""
    tag = "{" + namespace + name + "}"
    # Channels are shared by all databases of a server, keys are not.
    channel = f"{tag}:notices" + (f"@{database}" if database else "")
    publish = "SPUBLISH" if sharded else "PUBLISH"
    return Keys(name, namespace + name, tag, f"{tag}:ships", channel, f"{tag}:last", publish)
