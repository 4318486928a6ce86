"""Which keys of a server are REEM's, found by SCAN, and which are not."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress

from ..errors import BadKey
from ..plan.paths import check_top_key
from ..plan.patterns import Pattern, escaped
from ..plan.staging import STAGED
from ..session import Session
from .plans import DOCUMENT, scan, shown, strangers, types
from .values import Entry

__all__ = ["Survey", "matcher", "survey"]

_OF_KEY = {b":ships", b":last"}
_COMING = STAGED.encode()
_TAGGED = re.compile(rb"\{([^{}]*)\}(.*)", re.DOTALL)

Wanted = Callable[[str], bool]
"""Whether a top-level key is meant."""


class Survey:
    """What was found in the namespace of one session.

    Attributes:
        names: The top-level keys, sorted.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self._tagged: dict[str, set[bytes]] = {}  # what carries a key's tag: suffixes by name, until it is known whose
        self._foreign: list[str] = []

    def owns(self, entry: Entry) -> None:
        """Take note of a key that was fetched: what belongs to it is not foreign."""
        tagged = self._tagged.get(entry.name, set())
        tagged -= {suffix.encode() for suffix in entry.registry}
        tagged -= {value.suffix.encode() for value in entry.values}

    async def foreign(self, session: Session) -> list[str]:
        """Return the keys that are not REEM's, each with its type. One round trip for each tag in question."""
        found, documents = list(self._foreign), set(self.names)
        for name, suffixes in sorted(self._tagged.items()):
            suffixes = {suffix for suffix in suffixes if not suffix.startswith(_COMING)}
            if suffixes and (name not in documents or suffixes - _OF_KEY):
                found += await session.run(strangers(session.keys(name), sorted(suffixes)))
        return found

    def add_page(self, page: Sequence[bytes], kinds: Sequence[str], namespace: bytes, wanted: Wanted) -> None:
        """Sort the keys of one page of a SCAN."""
        for key, kind in zip(page, kinds, strict=True):
            tagged = _TAGGED.fullmatch(key)
            name = _name((tagged[1] if tagged else key)[len(namespace) :])
            if name is None:
                self._foreign.append(shown(key, kind))
            elif not wanted(name):
                continue
            elif tagged:
                self._tagged.setdefault(name, set()).add(tagged[2])
            elif kind == DOCUMENT:
                self.names.append(name)
            elif kind != "none":
                self._foreign.append(shown(key, kind))


def matcher(match: str) -> Wanted:
    """Return what tells whether a top-level key matches; `*` and `?` stand for other characters.

    Raises:
        BadKey: Not a pattern of a top-level key.
    """
    pattern = Pattern(check_top_key(match))
    return lambda name: pattern.concerns((name,))


def _name(key: bytes) -> str | None:
    """Return the top-level key of these bytes, None if it cannot be one."""
    with suppress(UnicodeDecodeError, BadKey):
        return check_top_key(key.decode())
    return None


async def survey(session: Session, match: str) -> Survey:
    """Find the keys of a session's namespace; a plain name is taken as it is, without a look."""
    wanted, found = matcher(match), Survey()
    if not set("*?") & set(match):
        found.names.append(check_top_key(match))
        return found
    space = session.namespace
    begins = (space.encode(), b"{" + space.encode())
    pattern = f"*{escaped(space)}*" if space else ""
    cursor, seen = b"0", set[bytes]()
    while True:
        cursor, page = await session.run(scan(cursor, pattern))
        fresh = [bytes(key) for key in page if key.startswith(begins) and bytes(key) not in seen]
        seen.update(fresh)
        kinds: list[str] = await session.run(types(fresh))
        found.add_page(fresh, kinds, begins[0], wanted)
        if cursor == b"0":
            found.names.sort()
            return found
