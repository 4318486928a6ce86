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
        self._unsure: set[str] = set()
        self._layouts: dict[tuple[str, Path], tuple[Placeholder, ...]] = {}
        self._shapes: dict[tuple[str, Path], frozenset[str]] = {}
        self._numbers: dict[str, dict[Path, float]] = {}

    def members(self, document: str) -> frozenset[bytes]:
        """Return the suffixes of ships' keys that may exist: all that this interface knows of."""
        return self._members.get(document, frozenset())

    def sure_members(self, document: str) -> frozenset[bytes]:
        """Return the suffixes of ships' keys that were seen to exist when this interface last wrote."""
        return frozenset() if document in self._unsure else self.members(document)

    def expects_members(self, document: str, members: frozenset[bytes]) -> None:
        """Remember what may exist while a write is under way, and if its reply is lost."""
        self._unsure.add(document)
        _put(self._members, document, members)

    def saw_members(self, document: str, members: frozenset[bytes]) -> None:
        """Remember a reply to SMEMBERS of the registry."""
        if members or document in self._members:
            _put(self._members, document, members)
            self._unsure.discard(document)

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

    def number(self, document: str, path: Path) -> float | None:
        """Return the last result of a calculation at `path`, None if anything else was done to the document since."""
        return self._numbers.get(document, {}).get(path)

    def saw_number(self, document: str, path: Path, number: float) -> None:
        """Remember the result of a calculation."""
        if document not in self._numbers:
            _put(self._numbers, document, {})
        _put(self._numbers.get(document, {}), path, number)

    def forget_numbers(self, document: str) -> None:
        """Forget the results of calculations: the document is written, or it is not known what became of one."""
        self._numbers.pop(document, None)


def _put(store: dict[Any, Any], key: Any, value: Any) -> None:
    if len(store) >= _MOST and key not in store:
        store.clear()
    store[key] = value
