"""The shape cache: what an interface remembers of documents, to need one round trip instead of two or three.

All of it is a guess: every use is checked against a reply of the same round trip.
"""

from __future__ import annotations

from typing import Any

from .paths import Path
from .placeholders import Placeholder

# Documents, or places in them, of each kind of guess.
_MOST = 10_000
_MOST_NUMBERS = 100
"""Results of calculations in one document."""


class ShapeCache:
    """Guesses about documents, by document key. Threads may share it: entries are only ever replaced.

    Attributes:
        new: Documents that were found not to be of REEM 0.1 (`legacy/olddata.py`).
        new_below: The same, where only places below the root were looked at.
    """

    def __init__(self) -> None:
        self._members: dict[str, frozenset[bytes]] = {}
        self._interrupted: set[str] = set()
        self._layouts: dict[tuple[str, Path], tuple[Placeholder, ...]] = {}
        self._numbers: dict[str, dict[Path, float]] = {}
        self._looked: dict[str, bool] = {}
        self.new: dict[str, None] = {}
        self.new_below: dict[str, None] = {}

    def saw_new(self, document: str, path: Path = ()) -> None:
        _put(self.new_below, document, None)
        if not path:
            _put(self.new, document, None)

    def members(self, document: str) -> frozenset[bytes]:
        """Return the suffixes of attachments that may exist."""
        return self._members.get(document, frozenset())

    def sure_members(self, document: str) -> frozenset[bytes]:
        """Return the suffixes of attachments that exist; none if a change was interrupted."""
        return frozenset() if self.is_unsure(document) else self.members(document)

    def is_unsure(self, document: str) -> bool:
        """Return whether a change was interrupted, so that there may be unknown attachments."""
        return document in self._interrupted

    def saw_members(self, document: str, members: frozenset[bytes]) -> None:
        # The first reply shows that the user has the right, see `writes._is_tried`.
        if document not in self._looked:
            _put(self._looked, document, True)
        # Documents without arrays, which are most, take no entry.
        if members or document in self._members:
            _put(self._members, document, members)
        if not members:  # so nothing was left
            self._interrupted.discard(document)

    def may_look(self, document: str) -> bool:
        return document in self._looked

    def may_not_look(self, document: str) -> None:
        self._looked.pop(document, None)

    def saw_interrupted(self, document: str) -> None:
        """Note that a change was interrupted: it may have left attachments that nothing refers to."""
        self.forget_numbers(document)
        if len(self._interrupted) >= _MOST:
            self._interrupted.clear()
        self._interrupted.add(document)

    def pop_interrupted(self, document: str) -> bool:
        """Return whether a change was interrupted since the last call of this."""
        if document not in self._interrupted:
            return False
        self._interrupted.discard(document)
        return True

    def layout(self, document: str, path: Path) -> tuple[Placeholder, ...]:
        """Return the placeholders that the last read of `path` found."""
        return self._layouts.get((document, path), ())

    def saw_layout(self, document: str, path: Path, placeholders: tuple[Placeholder, ...]) -> None:
        if placeholders or (document, path) in self._layouts:
            _put(self._layouts, (document, path), placeholders)

    def number(self, document: str, path: Path) -> float | None:
        """Return the last result of a calculation at `path`; None if the document was changed otherwise since."""
        return self._numbers.get(document, {}).get(path)

    def saw_number(self, document: str, path: Path, number: float) -> None:
        if document not in self._numbers:
            _put(self._numbers, document, {})
        _put(self._numbers.get(document, {}), path, number, _MOST_NUMBERS)

    def forget_numbers(self, document: str) -> None:
        self._numbers.pop(document, None)


def _put(store: dict[Any, Any], key: Any, value: Any, most: int = _MOST) -> None:
    # All at once: those in use come back with the next calls, and no order has to be kept.
    if len(store) >= most and key not in store:
        store.clear()
    store[key] = value
