"""Which updates of a top-level key were heard of, by publisher and number, and how many were not."""

from __future__ import annotations

import collections
from collections.abc import Hashable
from typing import Protocol

from ..plan import Reply
from ..plan.notices import parsed_note

# Ids of interfaces. A stranger may make up any number of them, so what is kept of them is bounded.
_MOST_PUBLISHERS = 10_000
_RECENT = 256  # updates that are known again if they come twice

Stamp = tuple[str, int, float]  # publisher, number and time of an update


class Numbered(Protocol):
    @property
    def publisher(self) -> str: ...
    @property
    def sequence(self) -> int: ...
    @property
    def time(self) -> float: ...


class Numbers:
    """The number of the last update of each sender, and what is missing before the next.

    One sender's updates come in their order, so a number that goes back, or far ahead, may be a stranger's under
    his name. Both ways are open then: the sender may go on behind either of his last two numbers.
    """

    def __init__(self) -> None:
        self.last: dict[Hashable, int] = {}
        self._other: dict[Hashable, int] = {}

    def take(self, sender: Hashable, number: int) -> int:
        """Return how many updates of a sender are missing before this one; -1 if it goes back."""
        last = self.last.get(sender)
        if last is None or number == last + 1:
            self.put(sender, number)
            return 0
        # From here on two numbers may be the last one: the one before the leap, and the one after it.
        other, self._other[sender] = self._other.get(sender), last
        self.put(sender, number)
        # It goes on behind the other one: the leap was a stranger's.
        if number - 1 == other:
            return 0
        return number - last - 1 if number > last else -1

    def has(self, sender: Hashable, number: int) -> bool:
        """Return whether an update was heard of; where two numbers may be the last, it must be one of them."""
        last = self.last.get(sender, 0)
        if sender in self._other:
            return number in (last, self._other[sender])
        return 0 < number <= last

    def put(self, sender: Hashable, number: int) -> None:
        if len(self.last) >= _MOST_PUBLISHERS and sender not in self.last:
            self.clear()
        self.last[sender] = number

    def clear(self) -> None:
        self.last.clear()
        self._other.clear()


class GapDetector:
    """Counts the updates of each publisher of one top-level key, and says how many were lost before each.

    The server keeps a note of the last update of each top-level key, `publisher number`. Asked for on the connection
    that notices come on, it must have been heard of when the answer is here. If it is unknown how many were lost, that
    is None. No number shows a loss before the first update that is heard of a publisher.
    """

    def __init__(self, recent: int = _RECENT) -> None:
        self._heard = Numbers()
        self._recent: collections.deque[Stamp] = collections.deque(maxlen=recent)
        self._known_note: bytes | None = None
        self._newest: Stamp | None = None  # what was heard last since a note was last compared
        self._compares = False  # the note at the beginning is known: a later one can be told from it

    def begin(self) -> None:
        """Start again on another connection: what is heard next follows the snapshot that is taken now."""
        self._compares, self._newest = False, None
        self._heard.clear()

    def count(self, update: Numbered) -> int | None:
        """Return how many updates of its publisher are missing before an update.

        It is -1 if its number goes back, and None for one that was heard before: it must not be told twice.
        """
        stamp = publisher, sequence, _ = update.publisher, update.sequence, update.time
        numbers = self._heard.last
        last = numbers.get(publisher)
        if last is not None and sequence == last + 1:  # as nearly always: without a call
            numbers[publisher] = sequence
            missing = 0
        elif (last is None or sequence <= last) and stamp in self._recent:
            return None
        else:
            missing = self._heard.take(publisher, sequence)
        self._recent.append(stamp)
        self._newest = stamp
        return missing

    def is_next(self, update: Numbered) -> bool:
        last = self._heard.last.get(update.publisher)
        return last is not None and update.sequence == last + 1

    def has(self, note: Reply) -> bool:
        """Return whether the update that a note names was heard of: then so were those before it."""
        update = parsed_note(note)
        return self._heard.has(*update) or any(stamp[:2] == update for stamp in self._recent)

    def begin_with(self, note: Reply) -> None:
        """Take the note that was asked for at the beginning, in order with notices: one from before is no loss."""
        publisher, sequence = parsed_note(note)
        # Notices may have come already, which are newer than the note.
        if sequence and publisher not in self._heard.last:
            self._heard.put(publisher, sequence)
        if not self._compares:
            self._known_note, self._compares = note, True

    def snapshot(self, note: Reply) -> int | None:
        """Take the note of a snapshot, which has all updates up to that one; return how many of these were lost."""
        self._known_note, self._compares = note, True
        publisher, sequence = parsed_note(note)
        if note is None or self.has(note) or sequence < self._heard.last.get(publisher, 0):
            return 0  # a lost one was counted when a later one of its publisher was heard
        self._newest = None  # what was heard before is older
        return self._missed(note)

    def compare(self, note: Reply) -> int | None:
        """Return how many updates were lost, by a note that was asked for in order with notices.

        Either the last update was lost, or what was heard last is no update: a client has published a bare notice.
        """
        newest, self._newest = self._newest, None
        known, self._known_note = self._known_note, note
        if not self._compares:
            self._compares = True
            return 0
        if (newest is not None and newest[:2] == parsed_note(note)) or (newest is None and note in (None, known)):
            return 0
        if note is not None and not self.has(note):
            return self._missed(note)
        return 0 if newest is None else None

    def _missed(self, note: Reply) -> int | None:
        """Take an update that was never heard of as the last of its publisher; return how many were lost up to it."""
        publisher, sequence = parsed_note(note)
        last = self._heard.last.get(publisher)
        self._heard.put(publisher, sequence)
        return None if last is None or last >= sequence else sequence - last
