"""The news of one top-level key, in the order in which it is written, while some of it has to be read. Without I/O.

`pubsub/division.py` says which updates are in what was read, `order.py` what that makes of each of them.
"""

from __future__ import annotations

import collections
from collections.abc import Iterator
from itertools import islice
from typing import Any, NamedTuple

from ...plan.notices import ANNOUNCED
from ...pubsub.division import Division, Heard, Phase
from ...pubsub.gaps import GapDetector, Numbered
from .format import Role
from .order import Item, is_replaced, settled, skipped

_RECENT = 16
"""Updates that are known again if they come twice, where there may be thousands of keys."""


class Counted(NamedTuple):
    """An update with its place in the order of its key."""

    publisher: str
    sequence: int
    time: float
    order: int


class KeyQueue:
    """What waits to be written.

    Attributes:
        items: The news, oldest first.
        order: Counts updates and gaps.
        division: Which updates are in what is read.
    """

    def __init__(self) -> None:
        self.items: collections.deque[Item] = collections.deque()
        self.order = 0
        self.division: Division[Counted] = Division(GapDetector(_RECENT))
        self._lacks = False  # something published is in nothing that was written or waits
        self._line = 0  # the order of the last update that was heard of when the read was asked for

    def will_read(self, *roles: Role) -> bool:
        """Return whether the whole key will be read as one of these roles, later than now."""
        is_reading = self.division.phase is not Phase.IDLE  # what the first item asks for
        return any(item.role in roles and item.value is ANNOUNCED for item in islice(self.items, is_reading, None))

    def doubt(self) -> None:
        """What a read finds from now on may have been published: it is a state, not only what was stored."""
        for item in self.items:
            if item.role == Role.STORED:
                item.role = Role.STATE

    def hear(self, update: Numbered) -> bool:
        """Count an update; return whether it is new: one that comes twice must not be written twice."""
        missing = self.division.gaps.count(update)
        if missing is None:
            return False
        self.order += 1
        counted = Counted(update.publisher, update.sequence, update.time, self.order)
        self.division.hear(Heard(counted, max(missing, 0)))
        return True

    def ready(self) -> Iterator[Item]:
        """Take out what can be written, up to the first item that has to be read."""
        while self.items:
            head = self.items[0]
            if head.value is ANNOUNCED:
                if head.role != Role.UPDATE or not is_replaced(self.items):
                    return
                head = skipped(head)
            self.items.popleft()
            yield head

    def give_up(self) -> Item:
        """Take out the first item, which cannot be read; return what is to be written for it."""
        head = self.items.popleft()
        # What the update wrote is missing in what is recorded: the next read of the whole key finds it.
        self._lacks = self._lacks or head.role != Role.STORED
        return skipped(head) if head.role == Role.UPDATE else head

    def asked(self) -> None:
        """The read for the first item begins."""
        self._line = self.order
        self.division.asked(in_order=False)

    def settle(self, value: Any, size: int) -> bool:
        """Give the first item, and those that came meanwhile, what a read says of them.

        Returns whether the key has to be read once more: something has been changed that is not known.
        """
        covered, _ = self.division.take()
        line, loss = self._line, -1
        for heard in covered:
            if heard.update is None:  # the note names an update that was lost, which may have changed anything
                loss = line
            else:
                line = max(line, heard.update.order)
        asks_for_all = self.items[0].is_whole
        if asks_for_all:
            if loss >= 0 or self._lacks:  # what it differs in may have been published
                self.items[0].role = Role.STATE
            self._lacks = False
        items = [skipped(it) if it.announced and it.order <= loss else it for it in self.items]
        left, unknown = settled(items, value, size, line)
        self.items = collections.deque(left)
        return unknown or (loss >= 0 and not asks_for_all)
