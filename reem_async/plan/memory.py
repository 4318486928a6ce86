"""What an interface remembers of the server, to need one round trip instead of two or three.

All of it is only a guess: every use is checked against a reply of the same round trip, except under
`track_schema_changes(False)`, where the user vouches for it.
"""

from __future__ import annotations

from typing import Any

from .paths import Path
from .placeholders import Placeholder

__all__ = ["Memory"]

_MOST = 10_000


class Memory:
    """Guesses about documents, by document key. Threads may share it: entries are only ever replaced."""

    def __init__(self) -> None:
        self._members: dict[str, frozenset[bytes]] = {}
        self._layouts: dict[tuple[str, Path], tuple[Placeholder, ...]] = {}
        self._shapes: dict[tuple[str, Path], frozenset[str]] = {}

    def members(self, document: str) -> frozenset[bytes]:
        """Return the suffixes of ships' keys that were last seen to exist."""
        return self._members.get(document, frozenset())

    def saw_members(self, document: str, members: frozenset[bytes]) -> None:
        """Remember a reply to SMEMBERS of the registry."""
        if members or document in self._members:
            _put(self._members, document, members)

    def layout(self, document: str, path: Path) -> tuple[Placeholder, ...]:
        """Return the placeholders that a read of `path` last met."""
        return self._layouts.get((document, path), ())

    def saw_layout(self, document: str, path: Path, placeholders: tuple[Placeholder, ...]) -> None:
        """Remember the placeholders that a read met."""
        if placeholders or (document, path) in self._layouts:
            _put(self._layouts, (document, path), placeholders)

    def shape(self, document: str, path: Path) -> frozenset[str] | None:
        """Return the suffixes of arrays of the last full write at `path`, None if there was none."""
        return self._shapes.get((document, path))

    def forget_shapes(self, document: str) -> None:
        """Forget the shapes of one document: a part of it was deleted."""
        for place in [place for place in list(self._shapes) if place[0] == document]:
            self._shapes.pop(place, None)

    def saw_shape(self, document: str, path: Path, suffixes: frozenset[str]) -> None:
        """Remember where the arrays of a full write were."""
        _put(self._shapes, (document, path), suffixes)


def _put(store: dict[Any, Any], key: Any, value: Any) -> None:
    if len(store) >= _MOST and key not in store:
        store.clear()
    store[key] = value
