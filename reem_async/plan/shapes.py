"""What an interface remembers of the server, to need one round trip instead of two or three.

All of it is only a guess: every use is checked against a reply of the same round trip.
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
        new: Documents that no version before 1.0 wrote, as a look has shown (`legacy/olddata.py`).
        new_below: The same of what is below their root.
    """

    def __init__(self) -> None:
        self._members: dict[str, frozenset[bytes]] = {}
        self._broken_off: set[str] = set()
        self._layouts: dict[tuple[str, Path], tuple[Placeholder, ...]] = {}
        self._numbers: dict[str, dict[Path, float]] = {}
        self._looked: dict[str, bool] = {}
        self.new: dict[str, None] = {}
        self.new_below: dict[str, None] = {}

    def saw_new(self, document: str, path: Path = ()) -> None:
        """Remember that no version before 1.0 wrote a document; below its root, if only what is at `path` was seen."""
        _put(self.new_below, document, None)
        if not path:
            _put(self.new, document, None)

    def members(self, document: str) -> frozenset[bytes]:
        """Return the suffixes of ships' keys that may exist: all that this interface knows of."""
        return self._members.get(document, frozenset())

    def sure_members(self, document: str) -> frozenset[bytes]:
        """Return the suffixes of ships' keys that were seen to exist, unless a change was broken off since."""
        return frozenset() if self.is_unsure(document) else self.members(document)

    def is_unsure(self, document: str) -> bool:
        """Return whether a change was broken off, so that there may be ships' keys that nobody here has seen."""
        return document in self._broken_off

    def saw_members(self, document: str, members: frozenset[bytes]) -> None:
        """Remember a reply to SMEMBERS of the registry."""
        # The first look that succeeds shows that the user has the right, see `writes._is_tried`.
        if document not in self._looked:
            _put(self._looked, document, True)
        # Documents without arrays, which are most, take no entry.
        if members or document in self._members:
            _put(self._members, document, members)
        if not members:  # so nothing was left
            self._broken_off.discard(document)

    def may_look(self, document: str) -> bool:
        """Return whether this user was seen to be allowed to look into the registry."""
        return document in self._looked

    def may_not_look(self, document: str) -> None:
        """Note that the server did not let this user look into the registry."""
        self._looked.pop(document, None)

    def broke_off(self, document: str) -> None:
        """Remember that nobody took the replies to a change: it may have left keys that nothing refers to."""
        self.forget_numbers(document)
        if len(self._broken_off) >= _MOST:
            self._broken_off.clear()
        self._broken_off.add(document)

    def was_broken_off(self, document: str) -> bool:
        """Return whether a change was, since this was last asked."""
        if document not in self._broken_off:
            return False
        self._broken_off.discard(document)
        return True

    def layout(self, document: str, path: Path) -> tuple[Placeholder, ...]:
        """Return the placeholders that a read of `path` last met."""
        return self._layouts.get((document, path), ())

    def saw_layout(self, document: str, path: Path, placeholders: tuple[Placeholder, ...]) -> None:
        """Remember the placeholders that a read met."""
        if placeholders or (document, path) in self._layouts:
            _put(self._layouts, (document, path), placeholders)

    def number(self, document: str, path: Path) -> float | None:
        """Return the last result of a calculation at `path`, None if anything else was done to the document since."""
        return self._numbers.get(document, {}).get(path)

    def saw_number(self, document: str, path: Path, number: float) -> None:
        """Remember the result of a calculation."""
        if document not in self._numbers:
            _put(self._numbers, document, {})
        _put(self._numbers.get(document, {}), path, number, _MOST_NUMBERS)

    def forget_numbers(self, document: str) -> None:
        """Forget the results of calculations: the document is written, or it is not known what became of one."""
        self._numbers.pop(document, None)


def _put(store: dict[Any, Any], key: Any, value: Any, most: int = _MOST) -> None:
    # All at once: whoever uses that many documents asks again for those that are in use, and no order has to be kept.
    if len(store) >= most and key not in store:
        store.clear()
    store[key] = value
