"""What subscribers are given, and what a local copy puts out: commands for its driver, and events."""

from __future__ import annotations

import collections
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, StrEnum, auto
from typing import Any, NamedTuple

from ..plan.notices import ANNOUNCED, Notice
from ..plan.paths import Path
from ..plan.trees import MISSING, CannotApply, applied, concerns, difference, get, is_own, is_whole, replaced
from .division import Heard
from .feed import Step


class Origin(StrEnum):
    """How an update came to be known."""

    PUBLISHED = "published"
    """A client published it. It has a publisher, a number and a time, and each one is delivered."""

    STORED = "stored"
    """A client changed what is stored without publishing. Several such changes may arrive as one update."""

    FOUND = "found"
    """It was there when following began, or after a loss."""

    SILENCE = "silence"
    """Nothing was updated: no update has arrived for as long as `ttl` allows."""


@dataclass(frozen=True, slots=True)
class Update:
    """One update of what a subscriber follows.

    Attributes:
        path: What was updated, such as "callback_channel.number".
        data: The whole structure below the channel after the update, None if it is gone; the
            containers are the receiver's own, arrays are read-only.
        value: What was written: the value at `path`, or the part of it below the channel (`data` itself, if
            that is all of it); None if it was deleted. `data` may be newer than that: what was read for a large
            update may have later ones in it. If these have changed what it wrote, it is skipped.
        initial: This is the value that was there when following began.
        time: When it was published, in seconds since 1970 on the publisher's clock; None for a value
            that was read and not published: what is stored, the initial one, and the one after a broken connection.
        publisher: The id of the interface that published it; None likewise.
        sequence: Its number among this publisher's updates of the top-level key; None likewise.
        gap: Updates were lost between this one and the last: a connection broke, or one was unreadable.
        missed: How many were lost, None if that is not known.
        origin: Whether it was published, only stored, or found at the beginning or after a loss; or that there is
            silence.
        deleted: Nothing is there any more: `value` is None because of that.
        early: It arrived before the server had it (`RedisInterface(local="early")` of its publisher). If the server
            never gets it, what the server has then is delivered, with `gap`.
        late: For how many seconds an outage delayed it at its publisher (`PublishSpace(outage="newest")`), on that
            one's monotonic clock.
        silent: No update: silence has begun, with `ttl`. `data` and `value` are None.
        arrived: When its notice arrived here, on `time.monotonic()`; with `ttl`, else None.
    """

    path: str
    data: Any
    value: Any
    initial: bool = False
    time: float | None = None
    publisher: str | None = None
    sequence: int | None = None
    gap: bool = False
    missed: int | None = 0
    origin: Origin = Origin.PUBLISHED
    deleted: bool = False
    early: bool = False
    late: float = 0.0
    silent: bool = False
    arrived: float | None = None


class Look(NamedTuple):
    """Command: something was changed; call `look` soon, but not more often than is good for the server."""


class Updated(NamedTuple):
    notice: Notice
    data: Any  # All that is at the followed path; MISSING if nothing is. Not to be changed.
    value: Any  # what was written; the same object as `data` if that is all of it
    missed: int | None  # how many updates were lost since the last event that reported losses, None if unknown


class Skipped(NamedTuple):
    """Event: what a large update wrote cannot be reported, since it was changed before it was read."""

    notice: Notice
    data: Any  # all that is at the followed path
    newest: bool  # no later update of this path is reported in its place


class Stored(NamedTuple):
    """Event: what is there differs from all that was published."""

    path: Path  # the deepest place, below what is followed, that holds all that differs
    data: Any  # all that is at the followed path; MISSING if nothing is
    value: Any  # what is at `path`; MISSING if nothing is


class Snapshot(NamedTuple):
    """Event: what is there, at the beginning or after a loss."""

    data: Any  # all that is at the followed path
    initial: bool  # it was there when following began
    missed: int | None  # how many updates were lost, None if unknown


class Ready(NamedTuple):
    """Event: the copy is that of the server."""


class Failed(NamedTuple):
    """Event: a snapshot could not be taken; the next update, or note, tries again."""

    error: Exception


Output = Step | Look | Updated | Stored | Skipped | Snapshot | Ready | Failed


_UNKNOWN: Any = object()  # a copy of which it is not known what it was


class Report(Enum):
    INITIAL = auto()  # as the value that was there when following began
    GAP = auto()  # as what is there after updates were lost, those in it included
    UPDATES = auto()  # not at all: each update in it is reported


class EventMaker:
    def __init__(self, path: Path, rest: Path, outputs: collections.deque[Output]) -> None:
        self._path = path  # where the copy is, below the top-level key
        self._rest = rest  # what is followed below that
        self._outputs = outputs
        self.report = Report.INITIAL  # how the next snapshot is reported
        self.missed: int | None = 0  # how many updates were lost and not reported yet, None if unknown

    def begin(self, report: Report) -> None:
        """Report the next snapshot like this. After a loss it is not known how many updates the snapshot has."""
        self.report, self.missed = report, None if report is Report.GAP else 0

    def miss(self, heard: Sequence[Heard[Notice]]) -> None:
        """Carry these losses over to the next event."""
        lost = [each.missed for each in heard]
        self.missed = None if self.missed is None or None in lost else self.missed + sum(filter(None, lost))

    def update(self, notice: Notice, tree: Any, written: Any = MISSING) -> None:
        data = value = get(tree, self._rest) if self._rest else tree
        inner = () if self._rest else notice.path[len(self._path) :]
        if written is not MISSING:
            value = written
        elif inner:  # of what was deleted, the next item has the place
            value = None if notice.deleted else get(data, inner)
        # The next event reports losses, whatever it is.
        missed, self.missed = self.missed, 0
        self._outputs.append(Updated(notice, data, value, missed))

    def snapshot(self, before: Any, tree: Any, covered: Sequence[Heard[Notice]], *, stored: bool) -> None:
        """Report the copy from now on, or the updates that it has (`covered`) and what is only stored.

        If `stored`, it is known to differ from what was published only in what is stored.
        """
        report, self.report = self.report, Report.UPDATES
        if report is Report.UPDATES:
            # Where only what is published is followed, the copy may lack what is stored.
            self._updates(before if stored else _UNKNOWN, covered, tree)
            if stored and self.missed == 0:  # else the snapshot is reported
                self._stored(self._expected(before, tree, covered), tree)
        elif report is Report.GAP:
            self.miss(covered)
        data = get(tree, self._rest)
        if report is Report.INITIAL:
            if data is not MISSING:
                self._outputs.append(Snapshot(data, True, 0))
        elif report is Report.GAP or self.missed != 0:
            self.lose(data)

    def lose(self, tree: Any) -> None:
        """Report what is there after a loss, or that it cannot be read: then `tree` takes its place."""
        missed, self.missed = self.missed, 0
        self._outputs.append(Snapshot(tree, False, missed))

    def _updates(self, before: Any, covered: Sequence[Heard[Notice]], tree: Any) -> None:
        """Tell of the updates that a snapshot has; those whose own value later ones in it have changed are skipped.

        `plan/trees.py` says which. What came with its value has that, whatever came later. What was lost may
        have changed any of those announced before. Each is reported with the copy that it led to while that is known,
        and then with the snapshot: no copy is reported after a newer one.
        """
        notices = [each.update if each.update and concerns(each.update, self._path) else None for each in covered]
        newest = {notice.path: notice for notice in notices if notice is not None}
        # The place of the last loss: an update that was announced before it may have been changed by what was lost.
        loss = max([place for place, each in enumerate(covered) if each.missed != 0], default=-1)
        copy, snapshot_reported = before, False
        for place, (heard, notice) in enumerate(zip(covered, notices, strict=True)):
            self.miss([heard])
            last, copy = copy, self._led_to(copy, heard)
            if notice is None:
                continue
            if copy is not _UNKNOWN and not snapshot_reported:
                if not self._rest or last is _UNKNOWN or get(copy, self._rest) is not get(last, self._rest):
                    self.update(notice, copy)
            elif notice.deleted or notice.value is not ANNOUNCED:
                snapshot_reported = True
                self.update(notice, tree, self._written(notice))
            elif place >= loss and is_own(notice.path, [later for later in notices[place + 1 :] if later is not None]):
                snapshot_reported = True
                self.update(notice, tree)
            else:
                self._outputs.append(Skipped(notice, get(tree, self._rest), newest[notice.path] is notice))

    def _led_to(self, copy: Any, heard: Heard[Notice]) -> Any:
        """Return the copy after an update, given the one before; _UNKNOWN if only what was read shows it."""
        notice = heard.update
        if notice is None or not heard.follows:
            return _UNKNOWN
        before = _UNKNOWN if heard.missed != 0 else copy
        if not concerns(notice, self._path):
            return before
        if before is _UNKNOWN:
            if len(notice.path) > len(self._path):
                return _UNKNOWN
            before = MISSING  # all of it is replaced
        if not is_whole(notice, self._path, before):
            return _UNKNOWN
        try:
            return applied(before, notice, self._path)
        except CannotApply:
            return _UNKNOWN

    def _written(self, notice: Notice) -> Any:
        """Return what an update wrote, as far as it is below what is followed; MISSING if the copy says so."""
        if notice.deleted:
            return None
        if self._rest:
            return MISSING
        found = get(notice.value, self._path[len(notice.path) :])
        return None if found is MISSING else found

    def _expected(self, before: Any, tree: Any, covered: Sequence[Heard[Notice]]) -> Any:
        """Return what the copy would be now if nothing but the updates that a snapshot has had changed it.

        Where that is not known, it is what is there: the updates are reported with it.
        """
        expected = before
        for heard in covered:
            notice = heard.update
            if notice is None or not concerns(notice, self._path):
                continue
            inner = notice.path[len(self._path) :]
            try:
                if is_whole(notice, self._path, expected):
                    expected = applied(expected, notice, self._path)
                elif inner and not notice.deleted:  # announced: its value is what is there
                    expected = replaced(expected, inner, get(tree, inner))
                else:
                    expected = tree
            except CannotApply:
                expected = tree
        return expected

    def _stored(self, expected: Any, tree: Any) -> None:
        data = get(tree, self._rest)
        inner = difference(get(expected, self._rest), data)
        if inner is not None:
            self._outputs.append(Stored(inner, data, get(data, inner)))
