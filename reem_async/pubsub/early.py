"""What a publisher told before the server had it, and the server has not confirmed: pure bookkeeping of a replica.

        told()                                   settle(): the update itself comes
    ----------> in the copy --------------------------------------------------------> confirmed, told already
                   |  |                          settle(): something else comes first
                   |  +-------------------------------------------------------------> wrong, told with a gap
                   | read(): a snapshot takes the copy's place, and may not have it
                   v
                awaited ------------------------------------------------------------> told again by its notice
                      |                          settle(): something else comes first
                      +-------------------------------------------------------------> wrong, told with a gap

In both states it is wrong, too, if it does not come for long (`overdue`): the server has refused it, or its publisher
is dead.
"""

from __future__ import annotations

from enum import Enum, auto

from ..plan.copies import concerns
from ..plan.notices import Notice

__all__ = ["EarlyUpdates", "Outcome"]

_PATIENT = 3
"""Notes, one a second, after which what was told early should have been confirmed: at least two seconds."""


class Outcome(Enum):
    """What an update says of those that were told early."""

    NEW = auto()
    """Nothing: it is to be taken as any other."""

    CONFIRMED = auto()
    """It is one of them."""

    WRONG = auto()
    """One of them is not what the server has, or in another order."""


class EarlyUpdates:
    """One update of each publisher at most."""

    def __init__(self) -> None:
        self._told: dict[str, Notice] = {}
        self._in_copy: set[str] = set()
        self._notes: dict[str, int] = {}  # that have come since each of them

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._told)

    def fits(self, notice: Notice) -> bool:
        """Return whether an update may be told: it has a slot to be known by, and depends on none of the others."""
        return notice.slot is not None and notice.publisher not in self._told and not self._touches(notice)

    def told(self, notice: Notice) -> None:
        """Note that an update was told, and is in the copy."""
        self._told[notice.publisher] = notice
        self._notes[notice.publisher] = 0
        self._in_copy.add(notice.publisher)

    def settle(self, notice: Notice, missing: int) -> Outcome:
        """Compare with an update that the server has, before which so many of its publisher are missing."""
        early = self._told.pop(notice.publisher, None)
        is_in_copy = notice.publisher in self._in_copy
        self._in_copy.discard(notice.publisher)
        self._notes.pop(notice.publisher, None)
        if early is None:
            return Outcome.WRONG if self._touches(notice) else Outcome.NEW
        if missing != 0 or (early.sequence, early.slot, early.path) != (notice.sequence, notice.slot, notice.path):
            return Outcome.WRONG
        return Outcome.CONFIRMED if is_in_copy else Outcome.NEW

    def overdue(self) -> bool:
        """Note that the server was asked for its note; return whether one of them should have been confirmed by now."""
        for publisher in self._notes:
            self._notes[publisher] += 1
        return any(notes >= _PATIENT for notes in self._notes.values())

    def read(self) -> None:
        """Note that a snapshot takes the place of the copy, which is told without a gap as far as this goes."""
        self._in_copy.clear()

    def clear(self) -> None:
        """Forget them all: what is there is told with a gap."""
        self._told.clear()
        self._in_copy.clear()
        self._notes.clear()

    def _touches(self, notice: Notice) -> bool:
        """Return whether what an update changes depends on whether one of these came before it."""
        return any(concerns(notice, other.path) or concerns(other, notice.path) for other in self._told.values())
