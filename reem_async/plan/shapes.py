"""The shape cache: what an interface remembers of documents, to need one round trip instead of two or three.

All of it is a guess: every use is checked against a reply of the same round trip.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from .paths import Path
from .placeholders import Placeholder

_MOST = 10_000
"""Documents. All are forgotten at once: those in use come back with the next calls, and no order has to be kept."""
_MOST_PLACES = 1000  # places in one document with arrays, and with results of calculations
_NO_MEMBERS: frozenset[bytes] = frozenset()


@dataclass(slots=True)
class Shape:
    """Guesses about one document. Threads may share it: entries are only ever replaced."""

    members: frozenset[bytes] = _NO_MEMBERS  # the suffixes of attachments that may exist
    interrupted: bool = False  # a change was interrupted: it may have left attachments that nothing refers to
    may_look: bool = False  # the user has the right to read the registry, see `writes._is_tried`
    is_new: bool = False  # the document was found not to be of REEM 0.1 (`legacy/olddata.py`), and
    is_new_below: bool = False  # the same, where only places below the root were looked at
    _layouts: dict[Path, tuple[Placeholder, ...]] = field(default_factory=dict)
    _numbers: dict[Path, float] = field(default_factory=dict)

    def sure_members(self) -> frozenset[bytes]:
        """Return the suffixes of attachments that exist; none if a change was interrupted."""
        return _NO_MEMBERS if self.interrupted else self.members

    def saw_new(self, path: Path = ()) -> None:
        self.is_new_below = True
        self.is_new = self.is_new or not path

    def saw_members(self, members: frozenset[bytes]) -> None:
        self.may_look, self.members = True, members
        if not members:  # so nothing was left
            self.interrupted = False

    def saw_interrupted(self) -> None:
        self.interrupted = True
        self.forget_numbers()

    def layout(self, path: Path) -> tuple[Placeholder, ...]:
        return self._layouts.get(path, ())

    def saw_layout(self, path: Path, placeholders: tuple[Placeholder, ...]) -> None:
        if placeholders or path in self._layouts:
            _put(self._layouts, path, placeholders)

    def number(self, path: Path) -> float | None:
        """Return the last result of a calculation at `path`; None if the document was changed otherwise since."""
        return self._numbers.get(path)

    def saw_number(self, path: Path, number: float) -> None:
        _put(self._numbers, path, number)

    def forget_numbers(self) -> None:
        self._numbers.clear()


class ShapeCache:
    def __init__(self) -> None:
        self._shapes: dict[str, Shape] = {}

    def of(self, document: str) -> Shape:
        shape = self._shapes.get(document)
        if shape is None:
            shape = Shape()
            _put(self._shapes, document, shape, _MOST)
        return shape


def _put(store: dict[Any, Any], key: Any, value: Any, most: int = _MOST_PLACES) -> None:
    if len(store) >= most and key not in store:
        store.clear()
    store[key] = value
