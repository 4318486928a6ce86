"""The local copy of a path, kept equal to the server's: a state machine without I/O, clock or tasks.

Its methods take what happens. Commands and events come out of `outputs`, in order. `follower.py` drives it.

        begin()
           |
           |  +-- a large value, and the server tells of changes --> ARMING --+
           v  |                                                               | armed()
        READING <-------------------------------------------------------------+
           |  ^
           |  +---- it is not known which of the updates that came meanwhile it has, or the plan goes on
           |
           |  the reply, all that is in it heard of             opened()
           +---------------------------------------> OPENING ------------> CURRENT
                                                                              |
        READING <-------------------------------------------------------------+
               an update that has to be read, or a loss, or a note that names
               something else than was heard, or look() after changed()

        ARMING, READING, OPENING -- an error --> UNREAD (of the server: a note or an update reads again)
                                             or  BROKEN (of what is there: an update reads again)
        any -- lost() --> OFFLINE -- begin() --> READING

Large values are read over another connection than that of the notices: servers close a subscribed connection that owes
over 32 MB, and small updates should not wait behind an image. `feed.py` draws the steps of a read, `division.py` says
which of the updates that were heard meanwhile are in what was read.

With CLIENT TRACKING the server reports once (`changed`) that a key was modified which was read over the connection of
the notices, in order with notices and replies. The next snapshot shows what was changed, and has the next change
reported. The notices in it are applied to the old copy. What differs from that in the snapshot is reported as `Stored`.

- READING in order: a change that is reported before the reply is in the reply.
- ARMING: keys that are read over another connection are touched over this one first. What is reported between that and
  the snapshot may or may not be in it, so there is a look.
- Attachments whose keys were not changed are not fetched again. With a snapshot that was taken aside they belong
  together only if no change of theirs comes before its fence.
"""

from __future__ import annotations

import collections
import contextlib
import math
from collections.abc import Callable
from enum import Enum, auto
from functools import partial
from typing import Any

from ..errors import BadData, NotAllowed, RedisError, ReemError, WrongKind
from ..plan import Reply
from ..plan.keys import Keys
from ..plan.notices import ANNOUNCED, Notice
from ..plan.paths import Path, show
from ..plan.placeholders import Unreadable
from ..plan.reads import look_first, read
from ..plan.shapes import ShapeCache
from ..plan.trees import MISSING, CannotApply, applied, concerns, get, is_whole
from ..ships.registry import Ships
from .division import Heard, Phase
from .events import EventMaker, Failed, Look, Output, Ready, Report, Skipped, Snapshot, Stored, Updated
from .feed import Arm, Fence, KeyFeed, Open, Read, Step

__all__ = [
    "Arm", "Failed", "Fence", "Look", "Open", "Output", "Read", "Ready", "Replica", "Skipped", "Snapshot", "State",
    "Stored", "Updated",
]  # fmt: skip


_NONE = object()
_UNCONFIRMED = 100  # early updates of one publisher in a copy; further ones are reported when they are confirmed
_PATIENT = 3  # notes, one a second, after which what was told early should have been confirmed: at least two seconds


class State(Enum):
    OFFLINE = auto()
    ARMING = auto()
    READING = auto()
    OPENING = auto()
    CURRENT = auto()
    UNREAD = auto()
    BROKEN = auto()


_OFFLINE, _CURRENT = State.OFFLINE, State.CURRENT  # an attribute of an Enum takes 40 ns
_AT_REST = State.CURRENT, State.UNREAD, State.BROKEN  # no read is under way


class Replica:
    """A local copy of one path.

    Attributes:
        path: What is kept, below the top-level key: what is followed, up to the first index that counts from the
            end (which item that is changes with its list; updates count from the front).
        rest: What is followed below `path`.
    """

    def __init__(self, keys: Keys, path: Path, ships: Ships, cache: ShapeCache, largest: float = math.inf) -> None:
        end = next((place for place, key in enumerate(path) if isinstance(key, int) and key < 0), len(path))
        self.path, self.rest = path[:end], path[end:]
        self.tree: Any = MISSING  # the copy, never changed in place; other threads may look at it
        self.state = State.OFFLINE
        # What is to be done and told, oldest first; who drives takes it out
        self.outputs: collections.deque[Output] = collections.deque()
        self._keys = keys
        self._ships = ships
        self._cache = cache
        # Bytes of an attachment up to which it is fetched; a larger one is left: an `Unfetched` is kept
        self._largest = largest
        self._events = EventMaker(self.path, self.rest, self.outputs)
        self._tell = self._events.update
        self._feed: KeyFeed[Notice] = KeyFeed(keys)
        self._division = self._feed.division
        self._gaps = self._division.gaps
        self._begins = True  # nothing was read over this connection yet
        self._early = EarlyUpdates(self.path)

    def at(self, inner: Path = ()) -> Any:
        """Return what is at `inner` below what is followed, or MISSING; not to be changed. Any thread may."""
        return get(self.tree, (*self.rest, *inner))

    @property
    def is_current(self) -> bool:
        return self.state is _CURRENT and not self._feed.dirty

    # --- what happens to the connection

    def begin(self, *, initial: bool, tracked: bool = False, born: bool = False) -> None:
        """Start on a connection that is subscribed: the first one (`initial`), or one after a loss.

        If nothing was there a moment ago (`born`), what is there now is reported as what changed. If `tracked`,
        `changed` is called for what is read over it and changed afterwards.
        """
        self._feed.begin(initial=initial or born, tracked=tracked)
        self._begins = True
        self._events.begin(Report.UPDATES if born else Report.INITIAL if initial else Report.GAP)
        self._read()

    def begin_with(self, note: Reply) -> None:
        """The server's note of the last update, asked for right behind `begin`, in order with notices."""
        self._gaps.begin_with(note)

    def lost(self) -> None:
        self.state = State.OFFLINE
        self._early.clear()

    # --- what is published

    def on_notice(self, notice: Notice) -> None:
        state = self.state
        if state is _OFFLINE:
            return
        missing = self._gaps.count(notice)
        if self._early and missing is not None and self._settles(notice, missing):
            return
        if missing == 0 and state is _CURRENT:
            if concerns(notice, self.path):
                self._apply(notice)
        elif missing is not None:  # else it was heard before
            self._take(Heard(notice, max(missing, 0), missing >= 0))

    @property
    def unconfirmed_since(self) -> float:
        """When the oldest early update in the copy was received; infinite if there is none. Any thread may ask."""
        return self._early.since

    def on_early(self, notice: Notice, moment: float = 0.0) -> None:
        """Report what a publisher is about to publish, if it certainly comes next to a copy that is CURRENT."""
        early = self._early
        if self.state is not _CURRENT or notice.value is ANNOUNCED or not early.fits(notice):
            return
        last = early.last(notice.publisher)
        if not (self._gaps.is_next(notice) if last is None else notice.sequence == last + 1):
            return
        before = self.tree
        if not concerns(notice, self.path) or self._changes(notice):
            early.told(notice, before, moment)

    def _settles(self, notice: Notice, missing: int) -> bool:
        confirmed = self._early.settle(notice, missing)
        if confirmed is False:
            self._early.clear()
            self._take(Heard(notice, None))
        elif self._early.look_waits and not self._early:
            self.look()
        return confirmed is not None

    def unreadable(self) -> None:
        if self.state is not State.OFFLINE:
            self._take(Heard(None, None))

    def on_note(self, note: Reply) -> None:
        """The server's note of the last update, asked for in order with notices."""
        if self.state not in _AT_REST:
            return  # the snapshot tells
        lost = self._gaps.compare(note)
        if self._early and self._early.overdue():  # its publisher has died, or the server has refused it
            self._early.clear()
            lost = None
        if lost != 0 or self.state is State.UNREAD:
            self._read_after(Heard(None, lost))

    # --- what the server says was changed

    def changed(self, key: str | None) -> None:
        """A document or attachment was changed after it had been read over this connection; None for every key."""
        feed = self._feed
        was_dirty = feed.dirty
        if feed.tracked and self.state is not State.OFFLINE and feed.change(key) and not was_dirty:
            self._ask_to_look()

    def _ask_to_look(self) -> None:
        if self._feed.dirty and self.state in _AT_REST:
            self.outputs.append(Look())

    def look(self) -> None:
        if not self._feed.dirty or self.state not in _AT_REST:
            return
        if self._early:  # the server may not have these yet: they would be taken back, and reported again
            self._early.look_waits = True
        else:
            self._read()

    def armed(self, number: int, error: Exception | None = None) -> None:
        if number != self._feed.number or self.state is not State.ARMING:
            return
        if error is not None:
            self._fail(error)
        else:
            self._perform(self._feed.armed())

    def untracked(self, number: int) -> None:
        """The user may not touch keys: from now on only what is published is reported."""
        if number == self._feed.number:
            self._feed.tracked = False
            self.armed(number)

    def _take(self, heard: Heard[Notice]) -> None:
        """Apply an update that follows on a copy that is current; keep any other with the snapshot that tells."""
        notice = heard.update
        if self.state not in _AT_REST:
            self._division.hear(heard)
        elif heard.missed != 0:  # what was lost may have been anywhere
            self._read_after(heard)
        elif notice is not None and concerns(notice, self.path):
            if self.state is State.CURRENT and heard.follows:
                self._apply(notice)
            else:
                self._read_after(heard)

    def _apply(self, notice: Notice) -> None:
        if not self._changes(notice):
            self._read_after(Heard(notice, 0))

    def _changes(self, notice: Notice) -> bool:
        """Change the copy as an update says and tell of it, if it says all; return whether it does."""
        if is_whole(notice, self.path, self.tree):
            before = self.at() if self.rest else None
            try:
                self.tree = applied(self.tree, notice, self.path)
            except CannotApply:  # the server has refused it too, or this copy is behind: look
                pass
            else:
                if not self.rest or self.at() is not before:  # what did not change is shared with the old tree
                    self._tell(notice, self.tree)
                return True
        return False

    # --- snapshots

    def _read_after(self, heard: Heard[Notice]) -> None:
        self._division.covered.append(heard)
        self._read()

    def _read(self) -> None:
        """Take a snapshot: it has all that has been heard of."""
        self._early.read()
        keys, noted, held = self._keys, (("GET", self._keys.last),), self._feed.attachments.values
        try:
            plan = read(keys, self.path, self._ships, self._cache, noted, held, self._largest, tolerant=True)
        except ReemError as error:
            self._fail(error)
        else:
            self._perform(self._feed.read(look_first(plan, keys, self._cache)))

    def _perform(self, step: Step) -> None:
        self.state = (
            State.ARMING if isinstance(step, Arm) else State.OPENING if isinstance(step, Open) else State.READING
        )
        self.outputs.append(step)

    def replies(self, number: int, outcome: list[Reply] | Exception) -> None:
        if self._awaits(number, Phase.IN_ORDER, Phase.ASIDE):
            self._go_on(outcome if isinstance(outcome, Exception) else partial(self._feed.answered, outcome))

    def fenced(self, number: int, error: Exception | None = None) -> None:
        if self._awaits(number, Phase.FENCING):
            self._go_on(error or self._feed.fenced)

    def _awaits(self, number: int, *phases: Phase) -> bool:
        return self.state is State.READING and self._feed.awaits(number, *phases)

    def _go_on(self, outcome: Callable[[], Step | None] | Exception) -> None:
        """Take the next step of a read; if it is not known which updates are in what was read, read again."""
        try:
            if isinstance(outcome, Exception):
                raise outcome
            step = outcome()
        except Exception as error:
            self._fail(error)
            return
        if step is None:
            self._read()
        else:
            self._perform(step)

    def opened(self, number: int, tree: Any) -> None:
        """Take the tree of a snapshot for the copy, report the updates in it, and apply later ones."""
        if number != self._feed.number or self.state is not State.OPENING:
            return
        covered, later = self._feed.take()
        before, self.tree, self.state = self._early.confirmed(self.tree), tree, State.CURRENT
        self._events.snapshot(before, tree, covered, stored=self._feed.tracked)
        if self._begins:
            self._begins = False
            self.outputs.append(Ready())
        for heard in later:
            self._take(heard)
        self._ask_to_look()

    def failed(self, number: int, error: Exception) -> None:
        if number == self._feed.number and self.state is State.OPENING:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        covered, later = self._feed.give_up()
        self._events.miss(covered)
        self.state = State.UNREAD if isinstance(error, RedisError) else State.BROKEN
        self.outputs.append(Failed(error))
        if not self._begins and isinstance(error, BadData | WrongKind | NotAllowed):
            # The copy must not go on saying what was there before.
            before, self.tree = self.tree, Unreadable(show((self._keys.name, *self.path)), str(error))
            if self.tree != before:
                self._events.lose(self.tree)
        if self._events.report is not Report.INITIAL:
            self._events.report = Report.GAP
            for heard in later:  # newer than what could not be read
                self._take(heard)
        self._ask_to_look()


class EarlyUpdates:
    """Updates that were reported before the server had them, in the order of each publisher.

    The update itself confirms one. A wrong one has the place read and reported with a gap.

            told()                     settle(): the update itself comes
        ----------> in the copy ------------------------------------------> confirmed, not reported again
                         | read(): a snapshot, which may not have it
                         v
                      awaited --------------------------------------------> reported again by its notice

        both -- settle(): something else comes first, or overdue(): refused, or its publisher is dead --> wrong

    """

    def __init__(self, path: Path) -> None:
        self.look_waits = False  # the copy is to be read once all are confirmed; until then no other one is reported
        self.since = math.inf  # when the oldest of those in the copy was received; infinite if there is none
        self._path = path  # what the copy holds
        self._told: dict[str, collections.deque[tuple[Notice, float]]] = {}  # and when each was received
        self._in_copy = False  # else all are awaited
        self._base: Any = _NONE  # the copy without them, until they are confirmed or a snapshot is opened
        self._notes: dict[str, int] = {}  # that have come since the first of each publisher was told or confirmed

    def __bool__(self) -> bool:
        return bool(self._told)

    def fits(self, notice: Notice) -> bool:
        """Return whether an update may be reported: it is known again, and depends on no other publisher's."""
        if self.look_waits or (self._told and not self._in_copy):
            return False
        return len(self._told.get(notice.publisher, ())) < _UNCONFIRMED and not self._touches(notice)

    def last(self, publisher: str) -> int | None:
        chain = self._told.get(publisher)
        return chain[-1][0].sequence if chain else None

    def told(self, notice: Notice, before: Any, moment: float) -> None:
        """Note an update that was reported, and applied to the copy, which was `before` until then."""
        if not self._told:
            self._base, self._in_copy = before, True
        self._notes.setdefault(notice.publisher, 0)
        without_value = notice._replace(value=ANNOUNCED)  # a large one is not to be kept until it is confirmed
        self._told.setdefault(notice.publisher, collections.deque()).append((without_value, moment))
        self.since = min(self.since, moment)

    def settle(self, notice: Notice, missing: int) -> bool | None:
        """Compare with an update that the server has, before which so many of its publisher are missing.

        Returns whether it confirms one, or shows that one is wrong; None if it does neither.
        """
        publisher = notice.publisher
        confirmed: bool | None = None
        chain = self._told.get(publisher)
        if chain is None:
            if self._touches(notice):
                return False
        else:
            early, _ = chain.popleft()
            if missing != 0 or _identity(early) != _identity(notice):
                return False
            if chain:
                self._notes[publisher] = 0
            else:
                del self._told[publisher], self._notes[publisher]
            if self._in_copy:
                confirmed = True
        if self._in_copy:
            self.since = min([each[0][1] for each in self._told.values()], default=math.inf)
            if not self._told:
                self._base = _NONE
            elif missing == 0 and concerns(notice, self._path) and is_whole(notice, self._path, self._base):
                with contextlib.suppress(CannotApply):  # the copy itself is read in this case
                    self._base = applied(self._base, notice, self._path)
        return confirmed

    def overdue(self) -> bool:
        """Return, for each note of the server, whether one of them should have been confirmed by now."""
        for publisher in self._notes:
            self._notes[publisher] += 1
        return any(notes >= _PATIENT for notes in self._notes.values())

    def read(self) -> None:
        """A snapshot will take the place of the copy. It is reported without a gap as far as this goes."""
        self._in_copy = self.look_waits = False

    def confirmed(self, tree: Any) -> Any:
        """Return the copy, which a snapshot replaces, without the updates that the server may not have yet."""
        base, self._base, self.since = self._base, _NONE, math.inf
        return tree if base is _NONE else base

    def clear(self) -> None:
        self._told.clear()
        self._notes.clear()
        self._in_copy = self.look_waits = False

    def _touches(self, notice: Notice) -> bool:
        """Return whether what an update changes depends on whether another publisher's of these came before it."""
        return concerns(notice, self._path) and any(
            concerns(other, self._path) and (concerns(notice, other.path) or concerns(other, notice.path))
            for publisher, chain in self._told.items()
            if publisher != notice.publisher
            for other, _ in chain
        )


def _identity(notice: Notice) -> tuple[object, ...]:
    return notice.sequence, notice.time, notice.path, notice.deleted, notice.slot
