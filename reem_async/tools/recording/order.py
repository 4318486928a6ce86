"""The news of one top-level key that waits to be written, in order, and what a read tells of it. Pure.

`plan/copies.py` draws how a note tells which updates are in what was read. Here that becomes a queue of which
each announced update up to the line has its value or is skipped; nothing is moved before what came before it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

from ...plan.copies import is_own, rest_of
from ...plan.notices import ANNOUNCED
from ...plan.paths import Path, below, has_index
from ...plan.trees import MISSING, get
from .format import Role
from .stored import carried
from .times import AFTER


@dataclasses.dataclass(slots=True, eq=False)
class Item:
    """One piece of news that waits for its turn.

    Attributes:
        role: What it says; a read may have made SKIP of an update, or FOUND of what is at its place besides.
        path: The full path.
        value: What is there: ANNOUNCED if it must be read, MISSING if nothing is.
        stamp: Log time, publish time and number.
        order: Counts the updates of the key, and the gaps between them; of other news, that of the last one before.
        size: Its bytes.
    """

    role: Role
    path: Path
    value: Any
    stamp: tuple[int, int, int]
    order: int = 0
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

    Args:
        items: The queue.
        value: What is at the path of the first, MISSING if nothing is.
        size: Its bytes.
        line: The order of the last update that is in it.
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
