"""Which of the updates that were heard of are in what was read: a state machine without I/O, clock or tasks.

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

from collections.abc import Awaitable, Callable
from enum import Enum, auto
from typing import Generic, NamedTuple, TypeVar

from ..errors import Conflict
from ..plan import Reply
from ..plan.notices import parsed_note
from .gaps import GapDetector, Numbered

U = TypeVar("U", bound=Numbered)
T = TypeVar("T")
_TRIES = 10  # maximum attempts; exceeded only if an unseen publisher keeps writing


class Phase(Enum):
    """Where a read is; the module's docstring draws it."""

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
