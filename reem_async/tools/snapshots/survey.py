"""Which keys of a server are REEM's, found by SCAN, and which are not."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress

from ...errors import BadKey
from ...plan.keys import DOCUMENT
from ...plan.paths import Pattern, check_top_key
from ...plan.sizes import STAGED
from ...session import Session
from ...transport.scan import counted, scanned
from .plans import NOT_ALLOWED, shown, strangers, types
from .values import Entry

__all__ = ["Survey", "matcher", "survey"]

# Of each top-level key: the registry, and the note of its last update.
_OF_KEY = {b":ships", b":last"}
# Large arrays that are on their way to a key are not foreign; they are renamed in a moment.
_COMING = STAGED.encode()
_LOOKS = 3
"""How often the servers are looked through before it is said that their count does not agree."""
# The keys beside a document carry its name in braces: {foo}:ships, {foo}.bar.image.
_TAGGED = re.compile(rb"\{([^{}]*)\}(.*)", re.DOTALL)

Wanted = Callable[[str], bool]
"""Whether a top-level key is meant."""


class Survey:
    """What was found in the namespace of one session.

    Attributes:
        names: The top-level keys, sorted.
        seen: All keys that the servers named, whoever they belong to.
        unsaved: The top-level keys, and arrays, that could not be saved, and why.
        doubt: Why keys may be missing, for people; empty if the servers hold no more keys than they named.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.seen: set[bytes] = set()
        self.unsaved: dict[str, str] = {}
        self.doubt = ""
        self._tagged: dict[str, set[bytes]] = {}  # what carries a key's tag: suffixes by name, until it is known whose
        self._foreign: list[str] = []

    def owns(self, entry: Entry) -> None:
        """Take note of a key that was fetched: what belongs to it is not foreign."""
        tagged = self._tagged.get(entry.name, set())
        tagged -= {suffix.encode() for suffix in entry.registry}
        tagged -= {value.suffix.encode() for value in entry.values}
        for suffix in entry.missing:
            self.unsaved[entry.name + suffix.partition("~")[0]] = "the server does not have it any more, only its name"

    def failed(self, name: str, why: str) -> None:
        """Take note of a key that could not be fetched; what belongs to it is not foreign."""
        self.unsaved[name] = why
        self._tagged.pop(name, None)

    async def foreign(self, session: Session) -> list[str]:
        """Return the keys that are not REEM's, each with its type. One round trip for each tag in question."""
        found, documents = list(self._foreign), set(self.names)
        for name, suffixes in sorted(self._tagged.items()):
            suffixes = {suffix for suffix in suffixes if not suffix.startswith(_COMING)}
            # Registry and note alone need no look where the document was found.
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
            elif kind == NOT_ALLOWED:
                # Of what belongs to a document, the document is named. Its rights may be other ones.
                if tagged is None:
                    self.failed(name, "this user may not read it")
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
    """Find the keys of a session's namespace; a plain name is taken as it is, without a look.

    The servers are looked through again if they count more keys than they named: a key that moves from
    node to node may be named by neither.
    """
    wanted, found = matcher(match), Survey()
    if not set("*?") & set(match):
        found.names.append(check_top_key(match))
        return found
    for _ in range(_LOOKS):
        named = await _look(session, found, wanted)
        held = await counted(session.transport, session.options.database)
        if held is None:
            found.doubt = "this user may not ask the server for its count (+info), so it was not compared"
            break
        # Keys that were written meanwhile are counted but not seen: another look finds them, or keys that moved
        # between nodes. Of one look only: what was deleted since the first would hide as many that were missed.
        more = held - named
        found.doubt = f"the server counts {more} Redis keys more than it named: new ones, or missed" if more > 0 else ""
        if not found.doubt:
            break
    found.names.sort()
    return found


async def _look(session: Session, found: Survey, wanted: Wanted) -> int:
    """Add the keys that were not seen before; returns how many were named, seen before or not."""
    space = session.namespace.encode()
    named: set[bytes] = set()  # SCAN may name a key twice
    async for page in scanned(session.transport):
        named.update(map(bytes, page))
        fresh = [key for key in dict.fromkeys(map(bytes, page)) if key not in found.seen]
        found.seen.update(fresh)
        # In the namespace itself, or with a tag of it.
        ours = [key for key in fresh if key.startswith((space, b"{" + space))]
        kinds: list[str] = await session.run(types(ours)) if ours else []
        found.add_page(ours, kinds, space, wanted)
    return len(named)
