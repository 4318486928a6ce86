"""Keys of other programs in the command line: found by path or pattern, and only read.

With a namespace none are shown: their names are whole keys of the server.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Iterator
from contextlib import suppress
from typing import Any

from ...connection import RedisInterface
from ...errors import BadKey, MissingKey, WrongType
from ...plan.keys import DOCUMENT
from ...plan.paths import Path, Pattern, parse, parse_pattern
from ...plan.raw import LARGEST, RawValue, fetched, read
from ...plan.trees import MISSING, get
from ...session import Session
from ...store.catalog import Outline, outlined
from ...store.raw import raw_kinds
from .output import counted, note

MOST = 10_000  # keys that are shown
_PREVIEW = 1 << 16  # bytes of a key that are fetched to be shown in a line
_AT_ONCE = 64  # round trips that are under way together

Shown = tuple[str, Outline]
"""The Redis type of a key, and what is at a path in it."""


async def raw_at(interface: RedisInterface, text: str, largest: float = LARGEST) -> tuple[Path, RawValue] | None:
    """Return where a typed path leads to in a key of another program, and what is there; None if there is no such key.

    The text may be the whole key, which may have dots in it, or a path as those of REEM. Raises MissingKey if there is
    such a key, and nothing at the path; and TooLarge, if the key is too large to look into.
    """
    if interface.namespace or not text:
        return None
    paths: list[Path] = [(text,)]
    with suppress(BadKey):
        paths.append(parse(text))
    is_there = False
    for path in dict.fromkeys(filter(None, paths)):
        name, rest = str(path[0]), path[1:]
        it: RawValue = await interface.session.run(read(name, LARGEST if rest else largest))
        if it.kind in ("none", DOCUMENT):
            continue
        is_there = True
        if rest:
            fetched(name, it, LARGEST)  # raises TooLarge
        if (value := get(it.value, rest)) is not MISSING:
            return path, RawValue(it.kind, value, it.size)
    if is_there:
        raise MissingKey(f"nothing is stored at {text}")
    return None


async def raw_found(interface: RedisInterface, pattern: str) -> AsyncGenerator[Shown, None]:
    """Yield all that a path or pattern names in keys of other programs, by name, 10,000 keys at most."""
    if interface.namespace:
        return
    if not any(mark in pattern for mark in "*?"):
        if (found := await raw_at(interface, pattern, _PREVIEW)) is not None:
            yield found[1].kind, _outline(*found)
        return
    wanted = parse_pattern(pattern)
    names = await raw_listed(interface.session, wanted.top)
    if len(names) > MOST:
        note(
            f"only {MOST} keys of other programs are shown, there are more: "
            "a pattern that names fewer shows them all, such as 'sai::*'"
        )
    chosen = sorted(names)[:MOST]
    for start in range(0, len(chosen), _AT_ONCE):
        portion = chosen[start : start + _AT_ONCE]
        for name, it in zip(portion, await asyncio.gather(*[_read(interface, name) for name in portion]), strict=True):
            if it is not None:
                for node in matching(_outline((name,), it), wanted, 1 + len(wanted.rest)):
                    yield it.kind, node


async def raw_listed(session: Session, glob: str = "*") -> dict[str, str]:
    """Return keys of other programs with their types: all, or somewhat more than are shown."""
    found: dict[str, str] = {}
    async for page in raw_kinds(session, glob):
        found |= page
        if len(found) > MOST:
            break
    return found


async def _read(interface: RedisInterface, name: str) -> RawValue | None:
    try:
        it: RawValue = await interface.session.run(read(name, _PREVIEW))
    except WrongType:  # a type that has no form in Python
        return None
    return None if it.kind in ("none", DOCUMENT) else it


def _outline(path: Path, it: RawValue) -> Outline:
    return outlined(it.value, path)


def matching(node: Outline, wanted: Pattern, depth: int) -> Iterator[Outline]:
    """Yield what a pattern names, so many elements deep."""
    if not wanted.concerns(node.path):
        return
    if len(node.path) == depth:
        yield node
        return
    for child in node.children:
        yield from matching(child, wanted, depth)


def how_many(names: dict[str, Any]) -> str:
    """Return how many keys of other programs there are, and of which types."""
    kinds = list(names.values())
    types = ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds)))
    number = f"over {MOST} keys" if len(names) > MOST else counted(len(names), "key")
    return f"{number} of programs without REEM ({types})"
