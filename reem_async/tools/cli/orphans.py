"""Arrays that no document refers to, of all top-level keys: count them, and remove them.

They are left behind where a document expires, or is deleted or renamed by a program without REEM: the server does not
know what belongs to it.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from reem_async.errors import BadKey, RedisError, ReemError
from reem_async.plan.attachments import orphans, remove_orphans
from reem_async.plan.paths import check_top_key, parse_suffix
from reem_async.plan.sizes import STAGED
from reem_async.session import Session
from reem_async.transport import scanned

__all__ = ["Orphans", "find_orphans"]

# What carries the tag of a top-level key: {foo}:ships, {foo}.bar.image.
_TAGGED = re.compile(r"\{([^{}]*)\}(.*)", re.DOTALL)
_REGISTRY = ":ships"


class Orphans(NamedTuple):
    """What was found.

    Attributes:
        counts: How many ships' keys no document refers to, by top-level key.
        unknown: The top-level keys of which this is not known, and why.
    """

    counts: dict[str, int]
    unknown: dict[str, Exception]


async def find_orphans(session: Session, *, remove: bool = False) -> Orphans:
    """Find the ships' keys in a session's namespace that no document refers to; `remove` them.

    One round trip for about 1000 keys of the server, and one for each top-level key with arrays; two more for each key
    of which some are removed.

    Raises:
        ClusterNode: The server is one node of several.
    """
    counts, unknown = dict[str, int](), dict[str, Exception]()
    for name, suffixes in sorted((await _tagged(session)).items()):
        keys = session.keys(name)
        try:
            found = await session.run(orphans(keys, suffixes))
            if found and remove:
                found = await session.run(remove_orphans(keys, suffixes, session.cache))
        # Of a damaged document, or without the right to read it, nobody knows what belongs to it.
        except (ReemError, RedisError) as error:
            unknown[name] = error
        else:
            counts |= {name: len(found)} if found else {}
    return Orphans(counts, unknown)


async def _tagged(session: Session) -> dict[str, list[bytes]]:
    """Return the suffixes of the Redis keys that may be ships' keys, by top-level key."""
    found: dict[str, set[bytes]] = {}
    async for page in scanned(session.transport):
        for name, suffix in filter(None, [_parted(bytes(key), session.namespace) for key in page]):
            of_key = found.setdefault(name, set())
            if suffix != _REGISTRY:  # it names ships' keys, but holds none
                of_key.add(suffix.encode())
    return {name: sorted(suffixes) for name, suffixes in found.items()}


def _parted(key: bytes, namespace: str) -> tuple[str, str] | None:
    """Return top-level key and suffix of what may be a ship's key or a registry; None for any other."""
    try:
        tagged = _TAGGED.fullmatch(key.decode())
        if tagged is None or not tagged[1].startswith(namespace) or tagged[2].startswith(STAGED):
            return None
        name, suffix = check_top_key(tagged[1].removeprefix(namespace)), tagged[2]
        if suffix != _REGISTRY:
            parse_suffix(suffix)
    except (BadKey, UnicodeDecodeError):
        return None
    return name, suffix
