"""One top-level key: reads of it, put between its updates. A state machine without I/O, clock or tasks.

Subscribers, recordings and the page receive the updates, and read what these do not contain. A read is a sequence of
steps, which a driver performs:

        read(plan) ----> Arm -- armed() --> Read -- answered() --+------------> Open -- take() --> at rest
            |                                ^                   |               ^
            +--- in order, or not tracked ---+                   +--> Fence -----+ fenced()
                                             |                   |
                                             +-------------------+  the plan goes on, or (None) it has to be read again

- Arm: touch the keys over the connection of the notices. The server reports their next change from then on.
- Read: send the plan's commands.
- Fence: send a PING over the connection of the notices. When it is answered, all updates that the read contains have
  been received.
- Open: have the ships make values. The division then says which updates are in them (`division.py`).

A read over the connection of the notices is in order with them. It needs neither Arm nor Fence. The recorder performs
the same steps as one coroutine: `arm`, `touched`, and `divided_read` of `division.py`.
"""

from __future__ import annotations

from typing import Any, Generic, NamedTuple, TypeVar

from ..plan import Plan, Reply
from ..plan.keys import Keys
from ..plan.placeholders import Unreadable
from ..plan.reads import RawRead
from ..plan.replies import decoded
from .division import Division, GapDetector, Heard, Numbered, Phase

U = TypeVar("U", bound=Numbered)


class Read(NamedTuple):
    """Send the commands of a plan and bring the replies to `answered`.

    Over the connection of the notices, or if the plan is `bulk` or the feed reads `aside` over another one.
    """

    number: int
    plan: Plan


class Arm(NamedTuple):
    """Touch keys over the connection of the notices, so that the server reports changes; then call `armed`."""

    number: int
    keys: tuple[str, ...]


class Fence(NamedTuple):
    """Send a PING over the connection of the notices. When it is answered, call `fenced`."""

    number: int


class Open(NamedTuple):
    """Have the ships make values of their replies. Then `take` returns which updates are in them."""

    number: int
    raw_read: RawRead


Step = Read | Arm | Fence | Open


class HeldAttachments:
    """The attachments of a copy that need not be read again."""

    def __init__(self, keys: Keys) -> None:
        self.values: dict[tuple[str, str], Any] = {}  # what ships made of them, by label and suffix
        self.asked: frozenset[str] = frozenset()  # the keys that the last plan reads
        self._keys = keys
        self._stale: set[str] = set()  # suffixes of those that were changed since they were asked for
        self.raw: RawRead | None = None  # what ships make values of

    def ask(self, plan: Plan) -> None:
        """A plan is sent: its reply has all that was changed until now."""
        self._stale.clear()
        # The note changes with every update, and is no part of the value.
        self.asked = frozenset(str(command[1]) for command in plan.commands) - {self._keys.last}

    def change(self, key: str | None, *, covered: bool) -> bool:
        """Forget what was changed; return whether this copy has it, or reads it.

        The key is a document's or an attachment's, None for every key. If `covered`, what is being read has the change.
        """
        if key is None:
            self.values.clear()
            if not covered:
                self._stale.update([name.removeprefix(self._keys.tag) for name in self.asked])
            return True
        if key == self._keys.document:
            return True
        suffix = key.removeprefix(self._keys.tag)  # empty for an array that is all of the document
        held = [place for place in self.values if place[1] == suffix]
        for place in held:
            del self.values[place]
        if not held and key not in self.asked:
            return False  # another listener's on this connection
        # It comes while a read is under way over another connection: what that brings may be older.
        if not covered:
            self._stale.add(suffix)
        return True

    def opened(self) -> None:
        """Keep those that ships have made values of and whose keys were not changed since."""
        raw, self.raw = self.raw, None
        if raw is None:
            return
        for slot, ship, _ in raw.slots:
            label, suffix = slot.placeholder.label, slot.placeholder.suffix
            value = slot.container[slot.key]
            if ship.blob is not None and suffix not in self._stale and type(value) is not Unreadable:
                self.values[label, suffix] = value
        self.values.update({place: it for place, it in raw.left.items() if place[1] not in self._stale})


class KeyFeed(Generic[U]):
    """The updates of one top-level key and the read that is under way; see the module."""

    def __init__(self, keys: Keys, division: Division[U] | None = None, *, aside: bool = False) -> None:
        self._aside = aside  # every read goes over another connection than that of the notices
        self.division: Division[U] = division or Division(GapDetector())
        self.number = 0  # Of the last read. Answers to others are too late.
        self.reads_all = True  # the read that is under way has all that is followed of the key
        self.tracked = False  # the server reports when what is read is changed
        self.dirty = False  # something was changed that no read which was asked for may have
        self.attachments = HeldAttachments(keys)  # those that need not be read again
        self._plan: Plan | None = None  # on its way
        self._outcome: list[Reply] = []  # of the plan, while its fence is on its way

    def begin(self, *, initial: bool, tracked: bool) -> None:
        self.division.begin(initial=initial)
        self.tracked, self.dirty = tracked, False
        self.attachments.values.clear()

    def change(self, key: str | None) -> bool:
        """Note that a key was changed, None for every key; return whether only a new read of all shows the change."""
        # Before a reply that is in order, and before keys are armed, a change is in what is being read.
        covered = self.division.phase is Phase.IN_ORDER
        is_news = self.attachments.change(key, covered=covered) and not (covered and self.reads_all)
        self.dirty = self.dirty or is_news
        return is_news

    def read(self, plan: Plan) -> Read | Arm:
        """Begin a read; it replaces one that is under way."""
        self.number += 1
        return self._ask(plan)

    def _ask(self, plan: Plan) -> Read | Arm:
        aside = plan.bulk or self._aside
        arms = aside and self.tracked
        self.division.asked(in_order=arms or not aside)
        self._plan = plan
        if self.tracked:
            self._arm(plan)
        return Arm(self.number, tuple(self.attachments.asked)) if arms else Read(self.number, plan)

    def arm(self, plan: Plan, *, reads_all: bool = True) -> frozenset[str]:
        """Return the keys to touch before a plan is sent over another connection; then call `touched`."""
        self.division.asked(in_order=True)
        self._arm(plan)
        self.reads_all = reads_all
        return self.attachments.asked

    def touched(self) -> None:
        """The keys were touched, in order with reports of changes: what is changed from now on may not be read."""
        if self.division.phase is Phase.IN_ORDER:
            self.division.asked(in_order=False)

    def _arm(self, plan: Plan) -> None:
        self.dirty = False
        self.attachments.ask(plan)

    def armed(self) -> Read:
        assert self._plan is not None
        self.division.asked(in_order=False)
        return Read(self.number, self._plan)

    def awaits(self, number: int, *phases: Phase) -> bool:
        return number == self.number and self.division.phase in phases

    def answered(self, outcome: list[Reply]) -> Step | None:
        """Go on with the replies to a plan; None if it has to be read again."""
        # Held attachments belong together with the rest only if no change of theirs comes before the fence.
        if self.division.answered(last_note(outcome), fence=bool(self.attachments.values)):
            return self._decode(outcome)
        self._outcome = outcome
        return Fence(self.number)

    def fenced(self) -> Step | None:
        outcome, self._outcome = self._outcome, []
        return self._decode(outcome)

    def _decode(self, outcome: list[Reply]) -> Step | None:
        assert self._plan is not None
        result: RawRead | Plan = decoded(self._plan, outcome)
        if isinstance(result, Plan):
            return self._ask(result)
        if not self.division.divide(result.also[0]):
            return None
        self._plan = None
        if self.tracked:
            self.attachments.raw = result
        return Open(self.number, result)

    def take(self) -> tuple[list[Heard[U]], list[Heard[U]]]:
        if self.tracked:
            self.attachments.opened()
        return self.division.take()

    def give_up(self) -> tuple[list[Heard[U]], list[Heard[U]]]:
        """Return the same for a read that has failed."""
        self.attachments.raw = None
        self._plan, self._outcome = None, []
        return self.division.give_up()


def last_note(replies: list[Reply]) -> Reply:
    last = replies[-1] if replies else None
    return last[-1] if isinstance(last, list) and last else None
