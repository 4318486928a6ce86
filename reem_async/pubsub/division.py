"""Which updates of a top-level key were heard of, and which of them are in what was read, without I/O, clock or tasks.

`GapDetector` counts the updates of each publisher by their numbers. `Division` is a state machine.

Updates go on coming during a read. Those that are in what was read are `covered`; the others come `later`.

        IDLE --- asked(in_order=True) ----> IN_ORDER ------------------------+
         |                                                                   |
         +------ asked(in_order=False) ---> ASIDE --- answered(): True ------+---- divide(): True ----> DIVIDED
                                              |                              |                            |
                                              | answered(): False            | divide(): False            | take()
                                              v                              v                            v
                                           FENCING --- the fence passed ---> IDLE: read again            IDLE

        any -- asked() --> IN_ORDER or ASIDE: what is asked for now has all that was heard
        any -- give_up() --> IDLE

Updates are heard in the server's order. What makes a read fit between them:

- IN_ORDER: its reply comes over the connection of the notices. What came before the reply is in it, what comes
  behind it is newer.
- ASIDE: it comes over another connection. It has what was heard of before it was asked for. Of what came since, its
  note (`{foo}:last`, read in the same transaction) says which was the last that it has.
- FENCING: that one may still be on its way. A PING on the connection of the notices is answered behind it.
"""

from __future__ import annotations

import collections
from collections.abc import Awaitable, Callable, Hashable
from enum import Enum, auto
from typing import Generic, NamedTuple, Protocol, TypeVar

from ..errors import Conflict
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


U = TypeVar("U", bound=Numbered)
T = TypeVar("T")
_TRIES = 10  # maximum attempts; exceeded only if an unseen publisher keeps writing


class Phase(Enum):
    IDLE = auto()
    IN_ORDER = auto()
    ASIDE = auto()
    FENCING = auto()
    DIVIDED = auto()


_IDLE, _DIVIDED = Phase.IDLE, Phase.DIVIDED  # an attribute of an Enum takes 40 ns
_ASIDE = Phase.ASIDE, Phase.FENCING


class Heard(NamedTuple, Generic[U]):
    update: U | None  # the update; None if something was published, or lost, of which nothing else is known
    missed: int | None  # how many updates were lost before it, None if unknown
    follows: bool = True  # its number is not lower than what was heard of its publisher before


class Division(Generic[U]):
    """The updates of one top-level key, divided by what is read of it."""

    def __init__(self, gaps: GapDetector | None = None) -> None:
        self.gaps = gaps or GapDetector()  # which updates were heard of; its owner counts there what it hears
        self.phase = Phase.IDLE
        self.begins = True  # nothing was heard of or read yet: an update that was never heard of is one from before
        # What is in what is being read, oldest first. What is to be covered by the next read may be added.
        self.covered: list[Heard[U]] = []
        self._doubtful: list[Heard[U]] = []  # heard while a read is aside: it has the first of them
        self._later: list[Heard[U]] = []  # heard after what was divided

    def begin(self, *, initial: bool) -> None:
        self.gaps.begin()
        self.phase, self.begins = _IDLE, initial
        self.covered, self._doubtful, self._later = [], [], []

    def hear(self, heard: Heard[U]) -> None:
        """Keep what was heard until it is known whether a read has it; while nothing is read, it is not kept."""
        phase = self.phase
        # The most frequent cases first: this runs for each update.
        if phase in _ASIDE:
            self._doubtful.append(heard)
        elif phase is Phase.IN_ORDER:
            self.covered.append(heard)
        elif phase is _DIVIDED:
            self._later.append(heard)
        else:
            self.begins = False

    def asked(self, *, in_order: bool) -> None:
        """A read begins: it contains all updates that were heard."""
        # What is asked for now is read by the server after it has sent all of these.
        self.covered += [*self._doubtful, *self._later]
        self._doubtful, self._later = [], []
        self.phase = Phase.IN_ORDER if in_order else Phase.ASIDE

    def answered(self, note: Reply, *, fence: bool = False) -> bool:
        """Return whether all that is in what was read, by its note, has been heard of; if not, a fence must pass first.

        It must pass anyway if what was read is not in order, and `fence` is set.
        """
        unheard = isinstance(note, bytes) and not self.gaps.has(note)
        if self.phase is Phase.ASIDE and (fence or unheard):
            self.phase = Phase.FENCING
        return self.phase is not Phase.FENCING

    def divide(self, note: Reply) -> bool:
        """Tell the updates that are in what was read from those that are not, by its note.

        Returns whether that is known. It is not if updates came meanwhile and the note names none of them, and none
        from before: that one was lost, or published before following began. The next read has them all.
        """
        note = note if isinstance(note, bytes) else None
        last, doubtful = parsed_note(note), self._doubtful
        # Of equal stamps the last counts: an update may be told twice, and what came between them is in it as well.
        stamps = [None if each.update is None else (each.update.publisher, each.update.sequence) for each in doubtful]
        known = len(stamps) - stamps[::-1].index(last) if last in stamps else 0
        unsure = not self.gaps.has(note) or any(each.missed != 0 for each in doubtful)  # it may be one of those lost
        undecided = bool(doubtful) and not known and note is not None and unsure
        # After the question above: it takes the note's update for heard.
        lost = self.gaps.snapshot(note)
        covered, later = (doubtful, []) if undecided else (doubtful[:known], doubtful[known:])
        self.covered += covered
        self._later, self._doubtful = later, []
        if lost != 0 and not self.begins:
            self.covered.append(Heard(None, lost))
        self.phase, self.begins = (_IDLE, False) if undecided else (_DIVIDED, self.begins)
        return not undecided

    def take(self) -> tuple[list[Heard[U]], list[Heard[U]]]:
        covered, later = self.covered, [*self._doubtful, *self._later]
        self.phase, self.begins = _IDLE, False
        self.covered, self._doubtful, self._later = [], [], []
        return covered, later

    def give_up(self) -> tuple[list[Heard[U]], list[Heard[U]]]:
        """Return what would have been covered, and what came later: nothing could be read."""
        begins = self.begins
        divided = self.take()
        self.begins = begins
        return divided


async def divided_read(
    division: Division[U], read: Callable[[], Awaitable[tuple[T, Reply]]], fence: Callable[[], Awaitable[None]]
) -> T:
    """Read a key, and again in the rare case that it is not known which updates are in what was read.

    If this raises or is cancelled, the division is as if nothing had been asked.

    Args:
        division: Hears the updates of the key meanwhile.
        read: Returns a value and the note of the last update, read in one transaction. It calls `asked` of the division
            before. It may ask the division itself whether a fence has to pass, and wait for it.
        fence: Returns when all that was published before has been heard of.

    Raises:
        Conflict: A publisher wrote all the time whose notices never arrived.
    """
    try:
        for _ in range(_TRIES):
            found, note = await read()
            if division.phase is not Phase.FENCING and not division.answered(note):
                await fence()
            if division.divide(note):
                return found
        raise Conflict("updates came all the time that were never heard of")
    except BaseException:
        division.give_up()
        raise
