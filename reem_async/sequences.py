"""Which updates of a top-level key were heard of, by publisher and number, and how many were not."""

from __future__ import annotations

from .plan.notices import parsed_note

__all__ = ["Sequences"]

_MOST_PUBLISHERS = 10_000


class Sequences:
    """Counts the updates of each publisher, and what was lost since somebody was last told.

    The server keeps a note of the last update of each top-level key, `publisher number`. Asked for on
    the connection that notices come on, it must have been heard of when the answer is here.
    """

    def __init__(self) -> None:
        self._last: dict[str, int] = {}
        self._missed: int | None = 0
        self._known_note: bytes | None = None
        self._compares = False  # the note at the beginning is known: a later one can be told from it

    def begin(self, *, broken: bool) -> None:
        """Start anew on another connection; `broken` if updates may have been lost with the last one."""
        self._compares = False
        self._last.clear()  # what is heard next follows the snapshot that is taken now
        self._missed = None if broken else 0

    def count(self, publisher: str, sequence: int) -> str:
        """Take an update into account: "next", or "again" or "late" for one of the past."""
        last = self._last.get(publisher)
        if last is not None and sequence <= last:
            return "again" if sequence == last else "late"
        if last is not None and sequence > last + 1:
            self.lose(sequence - last - 1)
        self._put(publisher, sequence)
        return "next"

    def _put(self, publisher: str, sequence: int) -> None:
        if len(self._last) >= _MOST_PUBLISHERS and publisher not in self._last:
            self._last.clear()
        self._last[publisher] = sequence

    def lose(self, number: int | None) -> None:
        """Note that updates were lost; None if nobody knows how many."""
        self._missed = None if number is None or self._missed is None else self._missed + number

    def lost(self) -> tuple[bool, int | None]:
        """Return whether updates were lost since this was last asked, and how many (None: not known)."""
        missed, self._missed = self._missed, 0
        return missed != 0, missed

    def has(self, note: bytes | None) -> bool:
        """Return whether the update that a note names was heard of: then so were those before it."""
        publisher, sequence = parsed_note(note)
        return 0 < sequence <= self._last.get(publisher, 0)

    def snapshot(self, note: bytes | None) -> None:
        """Take into account that a snapshot has all updates up to the one that its note names."""
        publisher, sequence = parsed_note(note)
        if sequence > self._last.get(publisher, 0):
            self._put(publisher, sequence)
        self._known_note, self._compares = note, True

    def lacks(self, note: bytes | None) -> bool:
        """Return whether an update was lost that a note, asked for in order with notices, names."""
        if not self._compares:
            self._known_note, self._compares = note, True
            return False
        if note is None or note == self._known_note or self.has(note):
            return False
        publisher, sequence = parsed_note(note)
        self.lose(sequence - self._last[publisher] if publisher in self._last else None)
        self._put(publisher, sequence)
        self._known_note = note
        return True
