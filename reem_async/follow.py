"""Following updates: one `Follower` per subscriber, all on the subscription connection of the `Hub`.

Notices and replies share that connection (RESP3), so all a follower learns is in one order: what
came before a snapshot is in it, what comes after is newer. There is no arithmetic and no race.

A large snapshot goes another way: servers close a subscribed connection that owes over 32 MB, and
small updates should not wait behind an image. Such a snapshot says which notice was the last when it
was taken, and so which of those that came meanwhile it has. If that one has not arrived yet, a PING
on the subscribed connection fences it: once the PONG is there, it has.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from .background import in_background
from .errors import MissingKey, RedisError
from .hub import Topic
from .plan import Plan, Reply, wire_commands
from .plan.copies import applied, concerns, is_whole
from .plan.keys import Keys
from .plan.memory import Memory
from .plan.notices import Notice, note_of
from .plan.paths import Path, show
from .plan.reads import Sealed, interpret, read
from .plan.replies import decoded
from .plan.trees import MISSING, CannotApply, copied, get
from .policy import Mailbox
from .sequences import Sequences
from .ships.registry import Ships
from .transport import Transport
from .transport.wire import Wire

__all__ = ["Follower", "Update"]

logger = logging.getLogger("reem.subscribe")


@dataclass(frozen=True, slots=True)
class Update:
    """One update of what a subscriber follows.

    Attributes:
        path: What was updated, such as "callback_channel.number".
        data: The whole structure below the channel after the update, None if it is gone; the
            containers are the receiver's own, arrays are read-only.
        value: What was written: the value at `path`, or the part of it below the channel (`data` itself, if
            that is all of it); None if it was deleted.
        initial: This is the value that was there when following began.
        time: When it was published, in seconds since 1970 on the publisher's clock; None for a value
            that was read and not published: the initial one, and the one after a broken connection.
        publisher: The id of the interface that published it; None likewise.
        sequence: Its number among this publisher's updates of the top-level key; None likewise.
        gap: Updates were lost between this one and the last: a connection broke, or one was unreadable.
        missed: How many were lost, None if that is not known.
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


class Follower:
    """Keeps a local copy of one path equal to the server's, and hands out each update.

    All methods but `value` are called on the event loop.

    Attributes:
        keys: The top-level key's names.
        topic: What it subscribes to.
        note: Where the server keeps a note of the last update.
        path: What is kept, below the top-level key: what is followed, up to the first index that counts
            from the end (the server takes one that is too negative for the first item).
        rest: What is followed below `path`.
        tree: The local copy, never changed in place.
        mailboxes: Where each update goes.
        ready: Done when the first snapshot is there.
        patience: Seconds that updates may wait for each other: none.
    """

    def __init__(self, keys: Keys, path: Path, ships: Ships, memory: Memory, transport: Transport) -> None:
        self.keys = keys
        self.topic = Topic(keys.channel.encode())
        self.note: str | None = keys.last
        end = next((place for place, key in enumerate(path) if isinstance(key, int) and key < 0), len(path))
        self.path, self.rest = path[:end], path[end:]
        self.tree: Any = MISSING
        self.mailboxes: list[Mailbox] = []
        self.ready: asyncio.Future[None] | None = None
        self.patience = 0.0
        self._ships = ships
        self._memory = memory
        self._transport = transport
        self._wire: Wire | None = None
        self._reading = 0  # the number of the snapshot on its way, 0 for none
        self._last_reading = 0
        self._settling = False  # the snapshot is here and ships are opening it
        self._behind = False  # an update could not be applied: only a snapshot helps
        self._unread = False  # the server would not let itself be read: ask again before long
        self._covered: list[Notice] = []  # arrived while a snapshot was on its way: it has them
        self._doubtful: list[Notice] = []  # arrived while a large one was: it has the first of them
        self._later: list[tuple[Notice, str]] = []  # arrived after a snapshot that ships are still opening
        self._heard = Sequences()
        self._losses: dict[tuple[str, int], int | None] = {}  # before notices that were not told of yet
        self._kind = "initial"

    def start(self, wire: Wire, kind: str) -> None:
        """Take a snapshot over `wire`; `kind` is "initial", or "gap" after a broken connection."""
        self._wire, self._kind = wire, kind
        self._heard.begin(broken=kind == "gap")
        self._covered.clear()
        self._doubtful.clear()
        self._later.clear()
        self._losses.clear()
        self._read()

    def lost(self, reason: Exception) -> None:
        """Stop applying: the connection is gone. Whoever waits for the first snapshot gets `reason`."""
        self._wire, self._reading, self._settling = None, 0, False
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(reason)

    def doubt(self) -> None:
        """Take a snapshot: something was published that could not be read."""
        self._heard.lose(None)
        self._behind = True
        if self._wire is not None and not self._reading:
            self._read()

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        """Apply one update, or note that a snapshot on its way has it."""
        self._take(notice, self._heard.count(notice.publisher, notice.sequence))

    def on_note(self, note: bytes | None) -> None:
        """Compare with the server's note of the last update, asked for in order with notices."""
        if self._wire is None or self._reading or self._settling:
            return
        if self._heard.lacks(note) or self._unread:
            self._behind = True
            self._read()

    def _take(self, notice: Notice, order: str) -> None:
        if order == "again" or self._wire is None:
            return
        if self._losses:
            self._recall(notice)
        if self._settling:
            self._defer(notice)
            self._later.append((notice, order))
        elif not concerns(notice, self.path):
            pass
        elif self._reading:
            self._defer(notice)
            self._covered.append(notice)
        elif self._behind or order == "late" or not is_whole(notice, self.path, self.tree):
            self._fetch(notice)
        else:
            self._apply(notice)

    def _apply(self, notice: Notice) -> None:
        before = self.at() if self.rest else None
        try:
            self.tree = applied(self.tree, notice, self.path)
        except CannotApply:  # the server has refused it too, or this copy is behind: look
            self._fetch(notice)
            return
        if not self.rest or self.at() is not before:  # what did not change is shared with the old tree
            self._emit(notice)

    def _fetch(self, notice: Notice) -> None:
        self._defer(notice)
        self._covered.append(notice)
        self._read()

    def _defer(self, notice: Notice) -> None:
        """Keep what was lost before a notice with it: others, that came before the loss, are told of first."""
        lost, missed = self._heard.lost()
        if lost:
            self._losses[notice.publisher, notice.sequence] = missed

    def _recall(self, notice: Notice) -> None:
        """Count what was lost before a notice as lost before what is told of next."""
        self._heard.lose(self._losses.pop((notice.publisher, notice.sequence), 0))

    def _read(self) -> None:
        self._last_reading += 1
        self._reading, self._settling = self._last_reading, False
        self._send(read(self.keys, self.path, self._ships, self._memory, (("GET", self.keys.last),)))

    def _send(self, plan: Plan) -> None:
        number, wire = self._reading, self._wire
        if wire is None:
            return
        self._covered += self._doubtful  # what is sent now is newer than all of them
        self._doubtful = []
        if plan.bulk:
            in_background(self._send_large(plan, number, wire), f"reem fetch {self.keys.name}")
        else:
            wire.send(wire_commands(plan), lambda outcome: self._on_replies(plan, number, outcome))

    async def _send_large(self, plan: Plan, number: int, wire: Wire) -> None:
        """Read over the connection for large values, then wait for the fence."""
        before = len(self._covered)
        outcome: list[Reply] | Exception
        try:
            outcome = await self._transport.roundtrip(wire_commands(plan), bulk=True)
        except Exception as error:
            outcome = error

        def fenced(_: list[Reply] | Exception) -> None:
            if number == self._reading:
                self._doubtful = self._covered[before:]
                del self._covered[before:]
            self._on_replies(plan, number, outcome)

        if self._kind == "" and self._has_heard(outcome):
            fenced([])
        else:
            wire.send([("PING",)], fenced)

    def _has_heard(self, outcome: list[Reply] | Exception) -> bool:
        """Return whether the notice that a snapshot says was the last has arrived: then so have those before."""
        note = outcome[-1][-1] if isinstance(outcome, list) and isinstance(outcome[-1], list) else None
        return self._heard.has(note)

    def _on_replies(self, plan: Plan, number: int, outcome: list[Reply] | Exception) -> None:
        """Go on with a read: called in order with notices, so what has arrived until now is older."""
        if number != self._reading:
            return
        try:
            if isinstance(outcome, Exception):
                raise outcome
            result = decoded(plan, outcome)
        except MissingKey:
            self._divide(())
            self._settle(MISSING)
        except Exception as error:
            self._failed(error)
        else:
            if isinstance(result, Plan):
                self._send(result)
            else:
                self._divide(result.also)
                self._heard.snapshot(result.also[0] if result.also else None)
                self._open(result)

    def _divide(self, also: tuple[Reply, ...]) -> None:
        """Tell the updates that a snapshot has from those it has not, by the note of the last one it has."""
        doubtful, self._doubtful = self._doubtful, []
        notes = [note_of(notice.publisher, notice.sequence).encode() for notice in doubtful]
        known = notes.index(also[0]) + 1 if also and also[0] in notes else 0
        self._covered += doubtful[:known]
        self._later += [(notice, "next") for notice in doubtful[known:]]

    def _open(self, sealed: Sealed) -> None:
        """Have the ships make values of their replies; those that must be awaited get a task."""
        waiting: list[tuple[Any, Any, Any]] = []
        try:
            for crate, ship, reply in sealed.crates:
                value = interpret(sealed.name, crate, ship, reply)
                if inspect.isawaitable(value):
                    waiting.append((crate.container, crate.key, value))
                else:
                    crate.container[crate.key] = value
        except Exception as error:
            self._failed(error)
            return
        if not waiting:
            self._settle(sealed.holder[0])
            return
        self._settling = True
        in_background(self._await_ships(sealed, waiting, self._reading), f"reem ships {self.keys.name}")

    async def _await_ships(self, sealed: Sealed, waiting: Iterable[tuple[Any, Any, Any]], number: int) -> None:
        try:
            for container, key, value in waiting:
                container[key] = await value
        except Exception as error:
            if number == self._reading:
                self._failed(error)
        else:
            if number == self._reading:
                self._settle(sealed.holder[0])

    def _failed(self, error: Exception) -> None:
        """Report a snapshot that could not be taken; the next update or heartbeat tries again."""
        self._reading, self._settling, self._behind = 0, False, True
        self._unread = isinstance(error, RedisError)
        self._covered.clear()
        self._doubtful.clear()
        later, self._later = self._later, []
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(error)
        elif self._wire is not None and self._wire.alive:
            where = show((self.keys.name, *self.path))
            logger.warning("%s: an update could not be read and is skipped: %s", where, error)
        if later:
            self._fetch(later[-1][0])

    def _settle(self, tree: Any) -> None:
        """Take a snapshot as the local copy; tell of the updates it has, then apply what came later."""
        covered, self._covered = self._covered, []
        later, self._later = self._later, []
        kind, self._kind = ("gap" if self._behind and not self._kind else self._kind), ""
        self.tree = tree
        self._reading, self._settling, self._behind, self._unread = 0, False, False, False
        if kind == "gap" or (kind == "initial" and self.at() is not MISSING):
            self._emit_snapshot(initial=kind == "initial")
        if not kind:
            self._emit_covered(covered)
        if self.ready is not None and not self.ready.done():
            self.ready.set_result(None)
        for notice, order in later:
            self._take(notice, order)

    def _emit_covered(self, covered: list[Notice]) -> None:
        """Tell of the newest update of each path that a snapshot holds; the older ones are skipped."""
        newest = {notice.path: notice for notice in covered}
        for notice in covered:
            if newest[notice.path] is notice:
                self._emit(notice)
                continue
            self._recall(notice)
            for mailbox in self.mailboxes:
                mailbox.skip()

    def _emit_snapshot(self, *, initial: bool) -> None:
        for kept in self._losses.values():
            self._heard.lose(kept)
        self._losses.clear()
        missed = 0 if initial else self._heard.lost()[1]
        for mailbox in self.mailboxes:
            data, path = self.value(), show((self.keys.name, *self.path, *self.rest))
            mailbox.put(Update(path, data, data, initial=initial, gap=not initial, missed=missed))

    def _emit(self, notice: Notice) -> None:
        if self._losses:
            self._recall(notice)
        path, (gap, missed) = show((self.keys.name, *notice.path)), self._heard.lost()
        stamp = notice.time, notice.publisher, notice.sequence
        inner = () if self.rest else notice.path[len(self.path) :]
        for mailbox in self.mailboxes:
            data = self.value()
            value = self.value(inner) if inner else data
            mailbox.put(Update(path, data, value, False, *stamp, gap, missed))

    def value(self, inner: Path = ()) -> Any:
        """Return a copy of what is at `inner` below what is followed, None if nothing is. Any thread may."""
        found = self.at(inner)
        return None if found is MISSING else copied(found)

    def at(self, inner: Path = ()) -> Any:
        """Return what is at `inner` below what is followed, or MISSING; not to be changed. Any thread may."""
        return get(self.tree, (*self.rest, *inner))
