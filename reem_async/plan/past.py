"""What was at a path at an instant, over changes that are known in their order.

One algorithm for everything that keeps changes: a recording (in a file) and the page's buffer (in memory). First comes
the newest change that brought all that is at the path. Then the changes inside of it that came later are applied:

    change            what is at arm after it
    ------            -----------------------
    arm = {q: 1}      all of arm: everything before is left out
    arm.q = 2         left out: a later change has the same path
    arm.v = 5         {q: 1, v: 5}
    arm.q = 3         {q: 3, v: 5}

Where a list has lost an item, its other items have other paths since. Then no change may be left out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, Generic, TypeVar

from .paths import Path
from .trees import MISSING, get

C = TypeVar("C")


class Past(ABC, Generic[C]):
    """Reconstructs what was at a path. A backing overrides where the changes are found and what each one does.

    Each change has a position: a number that grows from one change to the next, from 0 on. `C` is what the backing
    finds a change by.
    """

    def at(self, path: Path, until: int) -> Any:
        """Return what was at a full path after the changes up to a position, MISSING if nothing was."""
        anchor = self._anchor(path)
        return self._inside(self._rebuilt(anchor, until), path[len(anchor) :])

    def after(self, tree: Any, path: Path, change: C, value: Any) -> Any:
        """Return what is at a path after one more change, which brought a value, given what was there."""
        where = self._path(change)
        # A change of the path or of what is around it brings all of it; one from inside changes a part.
        if len(where) <= len(path):
            return self._inside(value, path[len(where) :])
        return self._applied(tree, where[len(path) :], change, value)

    def _rebuilt(self, path: Path, until: int) -> Any:
        newest = self._newest_whole(path, until)
        position, tree = -1, self._first(path)
        if newest is not None:
            position, tree = newest[0], self.after(MISSING, path, newest[1], self._value(newest[1]))
        if self._has_moves(path, position, until):
            changes = self._inner(path, position, until)
        else:
            # One change for each path, however often it was changed: this is what makes going back in time quick.
            lasts = sorted(self._inner_lasts(path, position, until), key=lambda it: it[0])
            changes = (change for _, change in lasts)
        for change in changes:
            tree = self.after(tree, path, change, self._value(change))
        return tree

    # What a backing knows.

    @abstractmethod
    def _path(self, change: C) -> Path:
        """Return the full path of a change."""

    @abstractmethod
    def _value(self, change: C) -> Any:
        """Return what is at the path of a change since then, MISSING for a deletion."""

    @abstractmethod
    def _anchor(self, path: Path) -> Path:
        """Return the part of a path that always leads to the same place: up to a list that lost an item."""

    @abstractmethod
    def _newest_whole(self, path: Path, until: int) -> tuple[int, C] | None:
        """Return the newest change at or above a path, up to a position, and its own position."""

    @abstractmethod
    def _has_moves(self, path: Path, after: int, until: int) -> bool:
        """Return whether a list inside a path may have lost an item between two positions."""

    @abstractmethod
    def _inner(self, path: Path, after: int, until: int) -> Iterable[C]:
        """Return the changes inside a path between two positions, in order."""

    @abstractmethod
    def _inner_lasts(self, path: Path, after: int, until: int) -> Iterable[tuple[int, C]]:
        """Return the last change of each path inside a path between two positions, with its own, in any order."""

    @abstractmethod
    def _applied(self, tree: Any, path: Path, change: C, value: Any) -> Any:
        """Return `tree` after a change of `path` in it; unchanged where the server had refused it."""

    def _first(self, path: Path) -> Any:
        return MISSING

    def _inside(self, tree: Any, path: Path) -> Any:
        return get(tree, path)
