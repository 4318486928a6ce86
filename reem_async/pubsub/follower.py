"""A listener that follows a path: drives a `Replica`, and puts its events into bounded queues.

Notices and replies share the subscription connection (RESP3), so all a replica learns is in one order.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import math
import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from ..concurrency.tasks import is_being_cancelled
from ..errors import BadData, ClusterNode, NotAllowed, Stale, is_of_command
from ..plan import Reply, wire_commands
from ..plan.arguments import check_number
from ..plan.keys import Keys
from ..plan.leases import FenceFilter
from ..plan.notices import Notice
from ..plan.paths import Path, show
from ..plan.placeholders import PlaceholderSlot
from ..plan.reads import awaited, interpreted
from ..plan.shapes import ShapeCache
from ..plan.trees import MISSING, copied
from ..ships.registry import Ships
from ..transport.route import is_unapplied
from ..transport.wire import Wire
from .events import Origin, Update
from .listeners import Beginning, Listener, Topic, contained
from .manager import SubscriptionManager
from .refresh import LIVE, Pace, RefreshTimer
from .replica import Arm, Failed, Fence, Look, Open, Output, Read, Ready, Replica, Skipped, Snapshot, Stored, Updated

logger = logging.getLogger("reem.subscribe")

_PROBE_PERIOD = 1.0  # seconds between probes of a document for a listener that needs no more of them


class Follower(Listener):
    """Keeps a local copy of one path equal to the server's, and hands out each update.

    All methods but `value` and `at` are called on the event loop.
    """

    def __init__(
        self,
        keys: Keys,
        path: Path,
        ships: Ships,
        cache: ShapeCache,
        manager: SubscriptionManager,
        *,
        stored: bool = False,
        largest: float = math.inf,
        heartbeat: float = math.inf,
        ttl: float | None = None,
        pace: Pace = LIVE,
    ) -> None:
        super().__init__(Topic(keys.channel.encode()))
        self.keys = keys
        self.note = keys.last
        self.stored = stored
        self.local = largest == math.inf  # else it wants no large values
        self.heartbeat = heartbeat
        # With a ttl it notes when updates arrive, except those that are ignored while there is an owner
        self._owners = None if ttl is None else FenceFilter(ttl)
        # With a ttl: since when the newest update of the copy counts, on the monotonic clock; -inf if the copy was
        # found, or is not of the owner
        self.live_since = -math.inf
        self._manager = manager
        self._transport, self._tasks = manager.transport, manager.tasks
        self._replica = Replica(keys, path, ships, cache, largest)
        self._wire: Wire | None = None
        self._loop = asyncio.get_running_loop()
        self._looks = RefreshTimer(self, Follower._look, pace)
        self._asked = 0.0  # when a read was sent last
        self._valid_at = -math.inf  # the server had what is in the copy then, or later
        self._probe_due = 0.0
        self._may_be_gone = True  # the last read, or the probe after it, may have found no document at all
        self._reads_for_probe = False  # the next read is to see what a probe has shown
        self._probe_refusal: Exception | None = None
        # If nothing was there a moment ago, what was heard of it until it is followed; else None
        self.born: list[Notice] | None = None
        self.failure: Exception | None = None
        self.down = True  # there is no connection, or it is new and what is there was not read yet
        # Called with each state of the copy in order, and with the present one after each step, if `stored`
        self.on_state: Callable[[Any], None] = unnoticed

    @contained
    def start(self, wire: Wire, beginning: Beginning) -> None:
        self._wire = wire
        # Before a copy that is found takes the place of a live one: other threads ask.
        self.live_since = -math.inf
        born, first, tracked = self.born, beginning is Beginning.FIRST, self.stored and bool(wire.tracked)
        self.born = None
        self._replica.begin(initial=first and born is None, tracked=tracked, born=first and born is not None)
        for notice in born or ():  # what is read now has it
            self._replica.on_notice(notice)
        self._perform()
        # In order behind it, so what it names has been heard of by then, or was there before.
        wire.send([("GET", self.keys.last)], self._begin_with)

    @contained
    def _begin_with(self, outcome: list[Reply] | Exception) -> None:
        if isinstance(outcome, list) and isinstance(outcome[0], bytes | None):
            self._replica.begin_with(outcome[0])

    @contained
    def lost(self, reason: Exception) -> None:
        self._wire, self.down = None, True
        self._replica.lost()
        self._looks.cancel()
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(reason)
        self.on_state(self._replica.at())

    @contained
    def invalidate(self, channel: bytes) -> None:
        self._replica.unreadable()
        self._perform()

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        self._looks.heard += 1
        self._replica.on_notice(self._judged(notice, time.monotonic()))
        if self._replica.outputs:
            self._perform()

    def _judged(self, notice: Notice, now: float) -> Notice:
        counts = self._owners is not None and self._owners.admits(notice.lease, now)
        return notice._replace(arrived=now) if counts else notice

    @contained
    def on_early(self, notice: Notice) -> None:
        now = time.monotonic()
        self._replica.on_early(self._judged(notice, now), now)
        self._perform()

    @contained
    def changed(self, key: str | None) -> None:
        self._replica.changed(key)
        self._perform()

    @contained
    def on_note(self, note: bytes | None) -> None:
        self._replica.on_note(note)
        self._perform()

    def probe(self, now: float) -> str | None:
        if self._wire is None or not self.stored or not self._wire.tracked or now < self._probe_due:
            return None
        self._probe_due = now + min(self.heartbeat, _PROBE_PERIOD)
        return self.keys.document

    @contained
    def on_probe(self, kind: Reply, sent: float) -> None:
        self._probe_refusal = kind if isinstance(kind, Exception) else None
        if self._probe_refusal is not None or not self._replica.is_current:
            return
        gone, has_value = kind == b"none", self._replica.tree is not MISSING
        # No server reports SWAPDB, and none reports an expiry before something accesses the key.
        unreported = has_value if gone else self._may_be_gone and not has_value
        self._may_be_gone = gone
        if unreported:
            self._reads_for_probe = True
            self.changed(None)
        else:
            self._valid_at = max(self._valid_at, sent)

    def fail(self, error: Exception) -> None:
        if self.failure is None:
            self.failure = error
            super().fail(error)
            self._tasks.start(self._manager.unfollow_here(self), f"reem unfollow {self.keys.name}")

    def value(self) -> Any:
        """Return a copy of what is followed, None if nothing is there. Any thread may."""
        return own(self.at())

    def age(self) -> float:
        """Return the seconds for which the server may have had something else than the copy. Any thread may.

        Counts from when the last question was sent whose answer confirmed the copy: replies are in order with notices
        and invalidation messages. If the server does not report what is only stored, only a read confirms the copy.
        """
        return time.monotonic() - min(self._valid_at, self._replica.unconfirmed_since)

    @property
    def untrusted(self) -> str:
        """Return why the age of the copy does not stay small; nothing if there is no such reason."""
        wire = self._wire
        if wire is not None and not wire.tracked:
            return "the server does not report what is only stored; the user needs the right +client|tracking"
        if self._probe_refusal is not None:
            return f"the server refused TYPE: {self._probe_refusal}"
        return ""

    @property
    def gone(self) -> bool:
        return self._replica.is_current and self._replica.at() is MISSING

    def at(self, inner: Path = ()) -> Any:
        """Return what is at `inner`, or MISSING; not to be changed. Any thread may; raises Stale after an exception."""
        if self.failure is not None:
            where = show((self.keys.name, *self._replica.path))
            raise Stale(
                f"{where}: following has ended over an error: {self.failure!r}; follow it again"
            ) from self.failure
        return self._replica.at(inner)

    # --- what the replica asks for

    def _perform(self) -> None:
        outputs = self._replica.outputs
        while outputs:
            output = outputs.popleft()
            if isinstance(output, Updated):
                self._tell(output)
            else:
                self._do(output)
            if self.stored and isinstance(output, Updated | Stored | Snapshot):
                self.on_state(output.data)
        if self.stored:
            if self._replica.is_current:
                self._valid_at = max(self._valid_at, self._asked)  # it is from the last read, or newer
            self.on_state(self._replica.at())

    def _do(self, output: Output) -> None:
        if isinstance(output, Read):
            self._read(output)
        elif isinstance(output, Fence):
            if self._wire is not None:
                self._wire.send([("PING",)], partial(self._fenced, output.number))
        elif isinstance(output, Look):
            self._looks.ask()
        elif isinstance(output, Arm):
            if self._wire is not None:
                self._wire.send([("TYPE", key) for key in output.keys], partial(self._armed, output.number))
        elif isinstance(output, Stored):
            self._looks.found()
            self._tell_state(output.path, output.data, output.value, Origin.STORED)
        elif isinstance(output, Open):
            self._open(output)
        elif isinstance(output, Skipped):
            self._skip(output)
        elif isinstance(output, Snapshot):
            data, initial = output.data, output.initial
            self.live_since = -math.inf
            self._tell_state((), data, data, Origin.FOUND, initial=initial, gap=not initial, missed=output.missed)
        elif isinstance(output, Ready):
            self.down = False
            if self.ready is not None and not self.ready.done():
                self.ready.set_result(None)
        elif isinstance(output, Failed):
            self._report(output)

    @contained
    def _look(self) -> None:
        self._replica.look()
        self._perform()

    @contained
    def _armed(self, number: int, outcome: list[Reply] | Exception) -> None:
        refusals = [outcome] if isinstance(outcome, Exception) else [it for it in outcome if isinstance(it, Exception)]
        # Of a slot that moves, its new node is asked: the listener resynchronises there.
        refusal = next((it for it in refusals if not is_unapplied(it)), None)
        if isinstance(refusal, NotAllowed) and not is_of_command(refusal):
            refusal = None  # the read finds out which of the keys the user may not read
        if self._wire is not None and refusal is not None and is_of_command(refusal):
            self._manager.invalidations.may_not_touch(self._wire, refusal)
            self._replica.untracked(number)
        else:
            self._replica.armed(number, refusal)
        self._perform()

    def _read(self, command: Read) -> None:
        wire = self._wire
        if wire is None:
            return
        self._asked = self._loop.time()
        self._may_be_gone |= not self._reads_for_probe
        self._reads_for_probe = False
        if command.plan.bulk:
            self._tasks.start(self._read_large(command), f"reem fetch {self.keys.name}")
        else:
            wire.send(wire_commands(command.plan), partial(self._bring, command.number))

    async def _read_large(self, command: Read) -> None:
        outcome: list[Reply] | Exception
        try:
            outcome = await self._transport.roundtrip(wire_commands(command.plan), bulk=True)
        except Exception as error:
            outcome = error
        self._bring(command.number, outcome)

    @contained
    def _bring(self, number: int, outcome: list[Reply] | Exception) -> None:
        now = self._loop.time()
        self._looks.earliest = now + max(LIVE.quickest, now - self._asked)  # large values leave time for others
        self._replica.replies(number, outcome)
        self._perform()

    @contained
    def _fenced(self, number: int, outcome: list[Reply] | Exception) -> None:
        self._replica.fenced(number, outcome if isinstance(outcome, Exception) else None)
        self._perform()

    def _open(self, command: Open) -> None:
        """Have the ships make values of their replies; those that must be awaited get a task."""
        raw_read, waiting = command.raw_read, []
        for slot, ship, reply in raw_read.slots:
            value = interpreted(raw_read, slot, ship, reply)
            if inspect.isawaitable(value):
                waiting.append((slot, value))
            else:
                slot.container[slot.key] = value
        if waiting:
            self._tasks.start(self._await_ships(command, waiting), f"reem ships {self.keys.name}")
        else:
            self._opened(command)

    async def _await_ships(self, command: Open, waiting: list[tuple[PlaceholderSlot, Awaitable[Any]]]) -> None:
        for slot, value in waiting:
            try:
                slot.container[slot.key] = await awaited(command.raw_read, slot, value)
            except asyncio.CancelledError as error:
                if is_being_cancelled():
                    raise
                # Of something that was cancelled, and whose result a ship has asked for.
                slot.container[slot.key] = command.raw_read.give_up(slot, BadData(f"a ship was cancelled: {error!r}"))
        self._opened(command)

    @contained
    def _opened(self, command: Open) -> None:
        self._manager.report(command.raw_read.unreadable)
        self._replica.opened(command.number, command.raw_read.holder[0])
        self._perform()

    # --- what the replica tells

    def _tell(self, event: Updated) -> None:
        notice, tree, written, missed = event
        publisher, sequence, time, inner = notice[:4]
        path = show((self.keys.name, *inner))
        late, arrived = self._heard(notice)
        for queue in self.queues:
            data = own(tree)
            value = data if written is tree else own(written)
            gone = notice.deleted or tree is MISSING
            how = Origin.PUBLISHED, gone, notice.early
            stamp = time, publisher, sequence, missed != 0, missed
            queue.put(Update(path, data, value, False, *stamp, *how, late, False, arrived))

    def _heard(self, notice: Notice) -> tuple[float, float | None]:
        """Note since when an update counts; return how late it was, and when it arrived if it counts with a `ttl`."""
        self.live_since = -math.inf if notice.arrived is None else notice.arrived - notice.late
        return notice.late, notice.arrived

    def _tell_state(self, inner: Path, tree: Any, value: Any, origin: Origin, **how: Any) -> None:
        path = self._path(inner)
        for queue in self.queues:
            data = own(tree)
            own_value = data if value is tree else own(value)
            queue.put(Update(path, data, own_value, origin=origin, deleted=value is MISSING, **how))

    def _path(self, inner: Path) -> str:
        return show((self.keys.name, *self._replica.path, *self._replica.rest, *inner))

    def _skip(self, event: Skipped) -> None:
        notice = event.notice
        path, stamp = show((self.keys.name, *notice.path)), (notice.time, notice.publisher, notice.sequence)
        late, arrived = self._heard(notice)
        for queue in self.queues:
            queue.overtaken(
                Update(path, own(event.data), None, False, *stamp, late=late, arrived=arrived) if event.newest else None
            )

    def _report(self, event: Failed) -> None:
        error = event.error
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(error)
        elif self._wire is not None and self._wire.alive:
            where = show((self.keys.name, *self._replica.path))
            fact = error.fact if isinstance(error, ClusterNode) and self._transport.sharded else error
            logger.warning("%s: an update could not be read and is skipped: %s", where, fact)


def checked_largest(largest: float | None) -> float:
    if largest is None:
        return math.inf
    check_number("largest", largest, "use a number of bytes, or None for no limit")
    return largest


def unnoticed(tree: Any) -> None:
    pass


def own(tree: Any) -> Any:
    """Return a tree for a user to keep: it has its own containers, and None if nothing is there."""
    return None if tree is MISSING else copied(tree)
