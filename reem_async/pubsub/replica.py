"""The local copy of a path, kept equal to the server's: a state machine without I/O, clock or tasks.

What happens goes in by the methods: notices, notes, replies, a connection that begins or is lost. What is to be done,
and what is to be told, comes out of `outputs`, in order. `follower.py` drives it; tests drive it with every order of
events that a server can bring about.

        begin()
           |
           |  +-- a large value, and the server tells of changes --> ARMING --+
           v  |                                                               | armed()
        READING <-------------------------------------------------------------+
           |  ^
           |  +---- nobody knows which of the updates that came meanwhile it has, or the plan goes on
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
over 32 MB, and small updates should not wait behind an image. `division.py` tells which of the updates that were heard
meanwhile are in what was read; while this is READING or OPENING, that has states of its own.

The second source of change is the server itself (CLIENT TRACKING): of each key that was read over the connection of the
notices it says once that somebody has modified it, in order with notices and replies. That comes in as `changed`. What
was changed, and whether a notice has told of it already, the next snapshot shows, which also has the server tell of
the next change. What a snapshot differs in from the copy, the notices in it applied, is told as `Stored`.

- READING in order: a change that is told of before the reply was made before it, so the reply has it.
- ARMING: of what is read over another connection the server would tell that one. So the keys are touched first over the
  connection of the notices. What is told of between that and the snapshot may or may not be in it, so there is a look.
- Attachments whose keys were not changed since they were read are not fetched again (`attachments.py`). In a snapshot
  that was taken aside they belong together with the rest only if no change of theirs comes before its fence.

An update may be told early, before the server has it (`on_early`), to a copy that is CURRENT. The update itself
confirms it, is recognized by its slot, and is not told again. What is not confirmed, or comes in between at the same
place, has the place read, and told with a gap. After a read that begins for another reason the update is told again.
`early.py` draws it.
"""

from __future__ import annotations

import collections
import math
from enum import Enum, auto
from typing import Any

from ..errors import BadData, NotAllowed, RedisError, ReemError, WrongKind
from ..plan import Plan, Reply
from ..plan.copies import applied, concerns, is_whole
from ..plan.keys import Keys
from ..plan.notices import ANNOUNCED, Notice
from ..plan.paths import Path, show
from ..plan.placeholders import Unreadable
from ..plan.reads import look_first, read
from ..plan.replies import decoded
from ..plan.shapes import ShapeCache
from ..plan.trees import MISSING, CannotApply, get
from ..ships.registry import Ships
from .attachments import HeldAttachments
from .division import Division, Heard, Phase
from .early import EarlyUpdates, Outcome
from .events import (
    Arm,
    Failed,
    Fence,
    Look,
    Open,
    Output,
    Read,
    Ready,
    Skipped,
    Snapshot,
    Stored,
    Teller,
    Told,
    Updated,
)
from .gaps import GapDetector

__all__ = [
    "Arm", "Failed", "Fence", "Look", "Open", "Output", "Read", "Ready", "Replica", "Skipped", "Snapshot", "State",
    "Stored", "Updated",
]  # fmt: skip


class State(Enum):
    """What a replica is doing; the module's docstring draws it."""

    OFFLINE = auto()
    ARMING = auto()
    READING = auto()
    OPENING = auto()
    CURRENT = auto()
    UNREAD = auto()
    BROKEN = auto()


_OFFLINE, _CURRENT = State.OFFLINE, State.CURRENT  # an attribute of an Enum takes 40 ns
_AT_REST = State.CURRENT, State.UNREAD, State.BROKEN
"""No read is under way."""


class Replica:
    """A local copy of one path.

    Args:
        keys: The top-level key's names.
        path: The path below it.
        ships: What carries values that are not JSON.
        cache: What is known of documents.
        largest: Bytes of an attachment up to which it is fetched; a larger one is left: an `Unfetched` is kept.

    Attributes:
        path: What is kept, below the top-level key: what is followed, up to the first index that counts
            from the end (which item that is changes with its list; updates count from the front).
        rest: What is followed below `path`.
        tree: The copy, never changed in place; other threads may look at it.
        state: What it is doing.
        outputs: What is to be done and told, oldest first; who drives takes it out.
    """

    def __init__(self, keys: Keys, path: Path, ships: Ships, cache: ShapeCache, largest: float = math.inf) -> None:
        end = next((place for place, key in enumerate(path) if isinstance(key, int) and key < 0), len(path))
        self.path, self.rest = path[:end], path[end:]
        self.tree: Any = MISSING
        self.state = State.OFFLINE
        self.outputs: collections.deque[Output] = collections.deque()
        self._keys = keys
        self._ships = ships
        self._cache = cache
        self._largest = largest
        self._gaps = GapDetector()
        self._teller = Teller(self.path, self.rest, self.outputs)
        self._tell = self._teller.update
        self._number = 0  # of the last read: replies to others are too late
        self._plan: Plan | None = None  # on its way
        self._outcome: list[Reply] | Exception = []  # of the plan, while its fence is on its way
        self._division: Division[Notice] = Division(self._gaps)
        self._begins = True  # nothing was read over this connection yet
        self._tracked = False  # the server tells of what is changed
        self._dirty = False  # something was changed that no snapshot which was asked for may have
        self._attachments = HeldAttachments(self._keys)
        self._early = EarlyUpdates()

    def at(self, inner: Path = ()) -> Any:
        """Return what is at `inner` below what is followed, or MISSING; not to be changed. Any thread may."""
        return get(self.tree, (*self.rest, *inner))

    @property
    def is_current(self) -> bool:
        """Whether it is what the server has, as far as is known."""
        return self.state is _CURRENT and not self._dirty

    # --- what happens to the connection

    def begin(self, *, initial: bool, tracked: bool = False, born: bool = False) -> None:
        """A connection that is subscribed begins: the first one, or one after a loss.

        The key is just `born` if nothing was there a moment ago: what is there now is told as what changed. It is
        `tracked` if `changed` will be called for what is read over it and changed afterwards.
        """
        self._division.begin(initial=initial or born)
        self._begins = True
        self._tracked, self._dirty = tracked, False
        self._attachments.values.clear()
        self._teller.begin(Told.UPDATES if born else Told.INITIAL if initial else Told.GAP)
        self._read()

    def begin_with(self, note: Reply) -> None:
        """The server's note of the last update, asked for right behind `begin`, in order with notices."""
        self._gaps.begin_with(note)

    def lost(self) -> None:
        """The connection is gone: what is published from now on is not heard."""
        self.state = State.OFFLINE
        self._early.clear()

    # --- what is published

    def on_notice(self, notice: Notice) -> None:
        """An update was published."""
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

    def on_early(self, notice: Notice) -> None:
        """A publisher says what it is about to publish: told now, if this copy can be sure that it comes next.

        Not to a copy that also follows what is stored: that is never ahead of the server.
        """
        if self.state is not _CURRENT or self._tracked or not self._early.fits(notice):
            return
        if notice.value is ANNOUNCED or not concerns(notice, self.path) or not self._gaps.is_next(notice):
            return
        if self._changes(notice):
            self._early.told(notice)

    def _settles(self, notice: Notice, missing: int) -> bool:
        """Compare an update with what was told early; return whether there is nothing more to do for it."""
        outcome = self._early.settle(notice, missing)
        if outcome is Outcome.WRONG:
            self._early.clear()
            self._take(Heard(notice, None))
        return outcome is not Outcome.NEW

    def unreadable(self) -> None:
        """Something was published that could not be read."""
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
        """A key was changed after it had been read over this connection: told once, in order with notices.

        Args:
            key: Its name on the server, the document's or an attachment's; None for every key.
        """
        if not self._tracked or self.state is State.OFFLINE:
            return
        is_covered = self._division.phase is Phase.IN_ORDER
        if not self._attachments.change(key, covered=is_covered) or is_covered or self._dirty:
            return
        self._dirty = True
        self._ask_to_look()

    def _ask_to_look(self) -> None:
        if self._dirty and self.state in _AT_REST:
            self.outputs.append(Look())

    def look(self) -> None:
        """See what was changed, unless a snapshot was asked for since."""
        if self._dirty and self.state in _AT_REST:
            self._read()

    def armed(self, number: int, error: Exception | None = None) -> None:
        """The keys were touched, unless there was an `error`: what is changed from now on is told of."""
        if number != self._number or self.state is not State.ARMING:
            return
        if error is not None:
            self._fail(error)
            return
        assert self._plan is not None
        self._division.asked(in_order=False)
        self.state = State.READING
        self.outputs.append(Read(number, self._plan))

    def untracked(self, number: int) -> None:
        """The user may not touch keys: from now on only what is published is told of."""
        if number == self._number:
            self._tracked = False
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
        """Change the copy as an update says, or read what it does not say."""
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
        """Take a snapshot, which has what was heard last."""
        self._division.covered.append(heard)
        self._read()

    def _read(self) -> None:
        """Take a snapshot: it has all that has been heard of."""
        self._number += 1
        self._early.read()
        noted = (("GET", self._keys.last),)
        try:
            held = self._attachments.values
            plan = read(self._keys, self.path, self._ships, self._cache, noted, held, self._largest, tolerant=True)
        except ReemError as error:
            self._fail(error)
        else:
            self._send(look_first(plan, self._keys, self._cache))

    def _send(self, plan: Plan) -> None:
        arms = plan.bulk and self._tracked
        self._division.asked(in_order=arms or not plan.bulk)
        self._plan, self.state = plan, State.ARMING if arms else State.READING
        if self._tracked:
            self._dirty = False
            self._attachments.ask(plan)
        asked = tuple(self._attachments.asked)
        self.outputs.append(Arm(self._number, asked) if arms else Read(self._number, plan))

    def replies(self, number: int, outcome: list[Reply] | Exception) -> None:
        """What a plan brought; in order with notices, unless it is a `bulk` one."""
        if not self._awaits(number, Phase.IN_ORDER, Phase.ASIDE):
            return
        note = outcome[-1][-1] if isinstance(outcome, list) and isinstance(outcome[-1], list) and outcome[-1] else None
        if self._division.answered(note, fence=bool(self._attachments.values)):
            self._decode(outcome)
        else:
            self._outcome = outcome
            self.outputs.append(Fence(number))

    def fenced(self, number: int, error: Exception | None = None) -> None:
        """All that was published before the fence was asked for has arrived, unless there was an `error`."""
        if self._awaits(number, Phase.FENCING):
            self._decode(error or self._outcome)

    def _awaits(self, number: int, *phases: Phase) -> bool:
        return number == self._number and self.state is State.READING and self._division.phase in phases

    def _decode(self, outcome: list[Reply] | Exception) -> None:
        """Go on with a read: what is in it has arrived."""
        assert self._plan is not None
        try:
            if isinstance(outcome, Exception):
                raise outcome
            result = decoded(self._plan, outcome)
        except Exception as error:
            self._fail(error)
            return
        finally:
            self._outcome = []
        if isinstance(result, Plan):
            self._send(result)
        elif self._division.divide(result.also[0]):
            self.state, self._plan = State.OPENING, None
            if self._tracked:
                self._attachments.opening(result)
            self.outputs.append(Open(self._number, result))
        else:
            self._read()

    def opened(self, number: int, tree: Any) -> None:
        """The ships have made a tree of a snapshot: it is the copy now.

        Tells of the updates that it has, then applies what came later.
        """
        if number != self._number or self.state is not State.OPENING:
            return
        covered, later = self._division.take()
        before, self.tree, self.state = self.tree, tree, State.CURRENT
        if self._tracked:
            self._attachments.opened()
        self._teller.snapshot(before, tree, covered, stored=self._tracked)
        if self._begins:
            self._begins = False
            self.outputs.append(Ready())
        for heard in later:
            self._take(heard)
        self._ask_to_look()

    def failed(self, number: int, error: Exception) -> None:
        """The ships could not make a tree of a snapshot."""
        if number == self._number and self.state is State.OPENING:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        covered, later = self._division.give_up()
        self._attachments.failed()
        self._teller.miss(covered)
        self.state = State.UNREAD if isinstance(error, RedisError) else State.BROKEN
        self.outputs.append(Failed(error))
        if not self._begins and isinstance(error, BadData | WrongKind | NotAllowed):
            # The copy must not go on saying what was there before.
            before, self.tree = self.tree, Unreadable(show((self._keys.name, *self.path)), str(error))
            if self.tree != before:
                self._teller.lose(self.tree)
        if self._teller.told is not Told.INITIAL:
            self._teller.told = Told.GAP
            for heard in later:  # newer than what could not be read
                self._take(heard)
        self._ask_to_look()
