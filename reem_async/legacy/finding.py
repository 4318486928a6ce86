"""Find the old keys of a server, by SCAN."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..errors import BadData, NotAllowed
from ..plan import Plan, Reply
from ..plan.keys import DOCUMENT
from ..plan.paths import escaped
from ..session import Session
from ..transport import scanned
from .olddata import METADATA, candidates, is_rooted, root_command, special_paths
from .values import is_array

_SECOND = METADATA.encode()


@dataclass
class OldKey:
    name: str  # without namespace
    places: dict[str, str] | None = None  # of ships' values, with labels; None if there is no second document
    rooted: bool = False  # its value is no dict and was stored in one
    stale: list[str] = field(default_factory=list)  # Redis keys of arrays that old programs have left behind

    @property
    def misread(self) -> bool:
        """Whether new programs would read another value than was written."""
        return self.rooted or bool(self.places)


async def find(session: Session, *, stale: bool = True) -> list[OldKey]:
    """Return the old keys of a session's namespace, sorted; two round trips for about 1000 keys of the server.

    `stale` finds arrays that were left behind, too, by another SCAN.
    """
    found: dict[str, OldKey] = {}
    async for names in _pages(session, DOCUMENT):
        for name, reply in zip(names, await asked(session, [_question(name) for name in names]), strict=True):
            _note(session, found, name, reply)
    if stale and any(each.places is not None for each in found.values()):
        async for names in _pages(session, "hash"):
            await _add_stale(session, found, names)
    return [found[name] for name in sorted(found)]


async def _pages(session: Session, kind: str) -> AsyncIterator[list[str]]:
    # SCAN may name a key several times.
    seen: set[bytes] = set()
    async for page in scanned(session.transport, escaped(session.namespace) + "*", kind):
        fresh = [key for key in dict.fromkeys(map(bytes, page)) if key not in seen]
        seen.update(fresh)
        yield [name for key in fresh if (name := _decoded(key)) is not None]


def _decoded(key: bytes) -> str | None:
    try:
        return key.decode()
    except UnicodeDecodeError:
        return None


async def asked(session: Session, commands: Sequence[tuple[Any, ...]]) -> Sequence[Reply]:
    if not commands:
        return []
    replies: Sequence[Reply] = await session.run(Plan(commands, lambda replies: replies))
    return replies


def _question(document: str) -> tuple[Any, ...]:
    # Second documents are read whole; of others only one entry matters.
    return ("JSON.GET", document, "$") if document.endswith(METADATA) else root_command(document)


def _note(session: Session, found: dict[str, OldKey], document: str, reply: Reply) -> None:
    second = document.endswith(METADATA)
    places = special_paths(reply) if second else None
    if places is None and (second or not is_rooted(reply)):
        return
    name = document[len(session.namespace) :].removesuffix(METADATA if second else "")
    key = found.setdefault(name, OldKey(name))
    if second:
        key.places = places
    else:
        key.rooted = True


async def _add_stale(session: Session, found: dict[str, OldKey], names: Sequence[str]) -> None:
    """Add the hashes that are arrays of old keys, but not in their documents."""
    owned = [(name, owner) for name in names if (owner := _owner(session, found, name)) is not None]
    replies = await asked(session, [("HKEYS", name) for name, _ in owned])
    for (name, owner), fields in zip(owned, replies, strict=True):
        if isinstance(fields, NotAllowed):  # else the arrays would silently stay for ever
            raise fields
        place = name[len(session.namespace) + len(owner.name) :]
        if (
            isinstance(fields, list | set)
            and is_array(frozenset(map(bytes, fields)))
            and not _may_be_lost(place, owner.places or ())
        ):
            owner.stale.append(name)


def _may_be_lost(place: str, places: Iterable[str]) -> bool:
    """Return whether this name begins with that of another place, but is not inside it.

    Writing `foo.image` made old programs forget `foo.image2`: that array stays.
    """
    return any(place.startswith(each) and place[len(each) :][:1] not in ("", ".", "[") for each in places)


def _owner(session: Session, found: dict[str, OldKey], name: str) -> OldKey | None:
    """Return the old key that a hash belongs to, though its second document does not name the hash."""
    for top in _tops(name[len(session.namespace) :]):
        key = found.get(top)
        if key is None or key.places is None:
            continue
        place = name[len(session.namespace) + len(top) :]
        # Named by the second document, so it was not left behind; or the second document itself.
        if place in key.places or place.startswith("&"):
            return None
        try:
            candidates(place)
        except BadData:
            return None
        return key
    return None


def _tops(name: str) -> Iterator[str]:
    """Yield the possible top-level keys in `foo.bar` or `foo[0].bar`; none has a dot."""
    top = name.partition(".")[0]
    yield top
    while top.endswith("]") and "[" in top:
        top = top[: top.rindex("[")]
        yield top
