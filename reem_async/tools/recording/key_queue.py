"""The news of one top-level key, in the order in which it is written, while some of it has to be read. Without I/O.

`pubsub/division.py` says which updates are in what was read. Each announced update up to that line then has its value
or is skipped, as `plan/trees.py` draws it. Nothing is moved before what came before it.
"""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, NamedTuple

from ...plan.notices import ANNOUNCED
from ...plan.paths import Path, below, has_index
from ...plan.trees import MISSING, get, is_own, rest_of
from ...pubsub.division import Division, GapDetector, Heard, Numbered, Phase
from .format import Role
from .stored import carried
from .times import AFTER

_RECENT = 16
"""Updates that are known again if they come twice, where there may be thousands of keys."""


@dataclasses.dataclass(slots=True, eq=False)
class Item:
    """One piece of news that waits for its turn."""

    role: Role  # a read may have made SKIP of an update, or FOUND of what is at its place besides
    path: Path
    value: Any  # ANNOUNCED if it must be read, MISSING if nothing is there
    stamp: tuple[int, int, int]  # log time, publish time and number
    order: int = 0  # counts the updates of the key, and the gaps between them; of other news, that of the last one
    size: int = 0

    @property
    def deleted(self) -> bool:
        return self.role == Role.DELETE

    @property
    def announced(self) -> bool:
        """It is an update whose value must be read."""
        return self.role == Role.UPDATE and self.value is ANNOUNCED

    @property
    def is_whole(self) -> bool:
        """It is all of the key, as it is read."""
        return self.role in (Role.STATE, Role.STORED)

    @property
    def changes(self) -> bool:
        """Whether a change of the key was published, known or not; a gap stands for all that was lost in it."""
        return self.role in (Role.UPDATE, Role.DELETE, Role.SKIP, Role.GAP)


def is_replaced(items: Iterable[Item]) -> bool:
    """Return whether a later update has replaced all that the first one wrote: it need not even be read."""
    first, *later = items
    if has_index(first.path):  # its place may be another one by now
        return False
    return any(item.changes and below(first.path, item.path) for item in later)


def skipped(item: Item) -> Item:
    return dataclasses.replace(item, role=Role.SKIP, value=None, size=0)


def settled(items: Sequence[Item], value: Any, size: int, line: int) -> tuple[list[Item], bool]:
    """Return the queue after what its first item asked for was read, and whether the key has to be read once more.

    The value, MISSING if nothing is there, includes the updates up to the order `line`.
    """
    head, left = items[0], list(items[1:] if items[0].is_whole else items)
    included = [item for item in left if item.changes and item.order <= line]
    queue: list[Item] = []
    lists: dict[int, list[Path]] = {}  # to be taken as they were read, behind the update of an order
    unknown = False
    for item in left:
        if _is_told(item, head, line):
            later = [each for each in included if each.order > item.order]
            found = get(value, item.path[len(head.path) :])
            queue += _outcome(item, found, item.size if item.path != head.path else size, later)
            for path, place in rest_of(found, item.path, later).lists.items():
                lists.setdefault(later[place].order, []).append(path)
        else:
            queue.append(item)
        for path in lists.pop(item.order, ()) if item.changes else ():
            if below(path, head.path):
                queue.append(_found(item, path, get(value, path[len(head.path) :]), 0))
            else:
                unknown = True
    return (_with_state(queue, head, value, size, line) if head.is_whole else queue), unknown


def _is_told(item: Item, head: Item, line: int) -> bool:
    """Return whether what `head` asked for tells of an item, too."""
    return item.announced and item.order <= line and below(item.path, head.path)


def _outcome(item: Item, found: Any, size: int, later: Sequence[Item]) -> list[Item]:
    """Return what becomes of an announced update, given what was `found` at its place."""
    if is_own(item.path, later):
        if found is not MISSING:
            return [dataclasses.replace(item, value=found, size=size)]
        # The server refused it, or what it wrote was removed by a client that does not publish.
        return [skipped(item), _found(item, item.path, MISSING, 0)]
    rest = rest_of(found, item.path, later).value
    return [skipped(item)] if rest is MISSING else [skipped(item), _found(item, item.path, rest, size)]


def _found(item: Item, path: Path, value: Any, size: int) -> Item:
    """Return what is known to be at a path behind an update, though it was not published like that."""
    return Item(Role.FOUND, path, value, (item.stamp[0], item.stamp[1], 0), item.order, size)


def _with_state(queue: list[Item], head: Item, value: Any, size: int, line: int) -> list[Item]:
    """Return a queue with a state in it, behind all that is in what was read."""
    place = next((place for place, item in enumerate(queue) if item.order > line), len(queue))
    before = queue[place - 1] if place else head
    if before is not head and before.is_whole and before.value is not ANNOUNCED:  # in whose place it is
        role = Role.STATE if Role.STATE in (before.role, head.role) else Role.STORED
        whole = carried(value, before.value)
        queue[place - 1] = dataclasses.replace(before, role=role, value=whole, size=before.size + size, order=line)
        return queue
    stamp = head.stamp if place == 0 else (queue[place - 1].stamp[0] + AFTER, *head.stamp[1:])
    queue.insert(place, dataclasses.replace(head, value=value, size=size, stamp=stamp, order=line))
    return queue


class Counted(NamedTuple):
    """An update with its place in the order of its key."""

    publisher: str
    sequence: int
    time: float
    order: int


class KeyQueue:
    """What waits to be written, oldest first."""

    def __init__(self) -> None:
        self.items: collections.deque[Item] = collections.deque()
        self.order = 0  # counts updates and gaps
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
