"""The keys that are recorded, and of each its updates in order, those that are only announced fetched.

While a value is on its way the updates behind it wait (`key_queue.py`), so that what is written is in the order in
which it was published. When the server says that something was changed, the whole is read a moment later: what
differs then from all that was published was only stored.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from ...concurrency.tasks import started
from ...errors import BadData, Conflict, NotAllowed, RedisError, WrongKind
from ...plan import Plan, Reply, wire_commands
from ...plan.keys import Keys
from ...plan.paths import Path, Pattern, show
from ...plan.placeholders import Unreadable
from ...plan.raw import kinds_of
from ...plan.reads import HeldValues, RawRead, read
from ...plan.replies import decoded
from ...plan.trees import MISSING, mapped
from ...pubsub.division import Phase, divided_read
from ...pubsub.feed import KeyFeed, last_note
from ...pubsub.manager import manager_of
from ...pubsub.monitor import ANNOUNCED, Event
from ...pubsub.refresh import BACKGROUND, BACKGROUND_RATE, RefreshTimer, present_keys
from ...session import Session
from ...store.document import opened
from .blackbox import BlackBox
from .format import Kind, Role
from .key_queue import Item, KeyQueue
from .stored import New, Unchanged, pruned
from .times import HURRIED, Arrivals, Clock, published
from .writer_thread import Operation, WriterThread

logger = logging.getLogger("reem.recording")

Wait = Callable[[], Awaitable[None]]
_SUFFIX = "", ".", "["
"""What may begin the names of attachments behind the tag of their key."""


class Fetched(NamedTuple):
    value: Any  # MISSING if nothing is there
    size: int


def size_of(raw_read: RawRead) -> int:
    return sum([len(reply) for reply in raw_read.raw if isinstance(reply, bytes | bytearray)])


async def fetch(session: Session, keys: Keys, path: Path) -> Fetched:
    """Read what is at `path` below a top-level key: one round trip, two where arrays were not known of.

    An `Unreadable` is in the place of what cannot be read. Large values come over the connection for them.
    """
    await session.ships.ready()
    # With a command beside it, a missing value is no error.
    plan = read(keys, path, session.ships, session.cache, (("GET", keys.last),), tolerant=True)
    raw_read: RawRead = await session.run(plan)
    value = await opened(raw_read) if raw_read.slots else raw_read.holder[0]
    manager_of(session).report(raw_read.unreadable)
    return Fetched(value, size_of(raw_read))


class KeyReader:
    """Reads one top-level key by the steps of its feed.

    What is read is touched before over the connection of the notices: the server tells what is changed from then on
    (`changed`). Attachments that were not changed are not read again. They are those of the instant of the rest only
    if no word of a change of theirs comes before a fence behind it.

    Reads of one key come one behind the other. The feed says between which updates a read belongs. It is `tracked` if
    the server reports when what was read last is changed.
    """

    def __init__(self, session: Session, keys: Keys, queue: KeyQueue, fence: Wait, limit: asyncio.Semaphore) -> None:
        self.feed = KeyFeed(keys, queue.division)
        self._session = session
        self._keys = keys
        self._queue = queue
        self._fence = fence
        self._limit = limit

    def changed(self, key: str | None) -> bool:
        """Note that a key was changed, None for every key; return whether to look at the whole."""
        # What was touched before a part was read is not among the attachments that are held.
        is_attachment = key is not None and key.startswith(self._keys.tag) and key[len(self._keys.tag) :][:1] in _SUFFIX
        covered = self.feed.division.phase is Phase.IN_ORDER and self.feed.reads_all
        return self.feed.change(key) or (is_attachment and not covered)

    def forget(self) -> None:
        """Read all again: changes may be unknown, or what was read before is not in the file."""
        self.feed.tracked = False
        self.feed.attachments.values.clear()

    async def whole(self) -> Fetched:
        """Return all of the key once it is known which updates are in it, as `divided_read` does.

        In place of each attachment there is a `New`, or an `Unchanged`.
        """
        await self._session.ships.ready()
        return await divided_read(self._queue.division, self._whole, self._fence)

    async def part(self, path: Path, pause: Wait) -> Fetched:
        """Return what is at a path of the key likewise, after a pause in which it is touched; all of it is read."""
        await self._session.ships.ready()
        touching = asyncio.ensure_future(self._touch(self.feed.arm(self._plan(path, {}), reads_all=False)))
        try:
            await pause()
            return await divided_read(self._queue.division, partial(self._part, path, touching), self._fence)
        except BaseException:
            self.feed.give_up()
            raise
        finally:
            touching.cancel()  # the next one is not to wait for it
            await asyncio.gather(touching, return_exceptions=True)

    async def _whole(self) -> tuple[Fetched, Reply]:
        feed, held = self.feed, self.feed.attachments.values
        plan = self._plan((), held)
        while True:
            async with self._limit:
                # Directly before it is asked for: the server reports one change, and one that came while this waits to
                # read would be in what is read, and the next one not be reported.
                feed.tracked = await self._touch(feed.arm(plan))
                self._queue.asked()
                replies = await self._session.transport.roundtrip(wire_commands(plan), bulk=plan.bulk)
            if held and not feed.division.answered(last_note(replies), fence=True):
                await self._fence()
            outcome: RawRead | Plan = decoded(plan, replies)
            if not isinstance(outcome, Plan):
                return await self._opened(outcome, keeps=feed.tracked)
            plan = outcome

    async def _part(self, path: Path, touching: asyncio.Future[bool]) -> tuple[Fetched, Reply]:
        async with self._limit:
            self._queue.asked()
            # The answer to what was sent on another connection: only then it was touched before it is read.
            is_touched = touching.done() and not touching.exception() and touching.result()
            raw_read: RawRead = await self._session.run(self._plan(path, {}))
        asked = {str(command[1]) for command in raw_read.commands} - {self._keys.last}
        keeps = is_touched and self.feed.tracked and asked <= self.feed.attachments.asked
        return await self._opened(raw_read, keeps=keeps)

    def _plan(self, path: Path, held: HeldValues) -> Plan:
        session = self._session
        noted = (("GET", self._keys.last),)
        return read(self._keys, path, session.ships, session.cache, noted, held, tolerant=True)

    async def _touch(self, names: frozenset[str]) -> bool:
        """Have the server report the next change of some keys; return whether it will."""
        return await manager_of(self._session).touch(self._keys.channel, names, self.feed.touched)

    async def _opened(self, raw_read: RawRead, *, keeps: bool) -> tuple[Fetched, Reply]:
        """Have the ships make values, and keep of which of them nothing else is known."""
        self.feed.attachments.raw = raw_read
        await opened(raw_read)
        manager_of(self._session).report(raw_read.unreadable)
        made = [(slot, slot.container[slot.key]) for slot, ship, _ in raw_read.slots if ship.blob is not None]
        made = [(slot, value) for slot, value in made if type(value) is not Unreadable]
        for slot, _ in made:
            slot.container[slot.key] = Unchanged()
        if keeps:
            self.feed.attachments.opened()
        else:
            self.feed.attachments.raw = None  # what was read is not to stay in memory
        for slot, value in made:
            slot.container[slot.key] = New(value, slot.container[slot.key])
        return Fetched(raw_read.holder[0], size_of(raw_read)), raw_read.also[0]


_PAUSE = 0.1
"""Seconds after a read that failed."""
_LET_PASS = 0.004
"""Seconds, at most, from a large update to reading it. The server is busy with its publisher, others wait behind
that: reading it in the same moment would make them wait twice as long. A recorder has time."""
_STEP = 0.01
"""Seconds: clocks that are only adjusted do not go back by as much."""
_FAST = 20_000_000
"""Nanoseconds between large updates that come so fast that the next one might not find this one fetched."""


class Collector(Protocol):
    """What is needed of the recorder, which imports this module."""

    session: Session
    writer_thread: WriterThread | BlackBox
    clock: Clock
    arrivals: Arrivals
    patterns: list[Pattern]
    fetching: asyncio.Semaphore

    async def fence(self, channels: Sequence[str] | None = None) -> None: ...

    def look_for_losses(self) -> None: ...

    def record_raw(self, name: str) -> bool: ...

    def failed(self, error: Exception) -> None: ...


class KeyRecorder:
    def __init__(self, collector: Collector, name: str) -> None:
        self._collector = collector
        self._name = name
        self._queue = KeyQueue()
        keys = collector.session.keys(name)
        fence = partial(collector.fence, [keys.channel])
        self._reader = KeyReader(collector.session, keys, self._queue, fence, collector.fetching)
        self._known = False
        self._complaint = ""  # why it could not be read the last time
        self._published = 0.0  # the publisher's time of the last update
        self._stepped = False  # that went back, which was reported
        self._last_large = 0  # the log time of the last update that was fetched
        self._whole = any(not pattern.rest and pattern.concerns((name,)) for pattern in collector.patterns)
        self.busy: asyncio.Task[None] | None = None  # the task that fetches
        self.absent = False  # the key is not on the server, as far as is known here
        self.looks = RefreshTimer(self, KeyRecorder._look, BACKGROUND)

    @property
    def is_over(self) -> bool:
        """Whether the key is gone, and nothing of it is left to be read, looked at or written."""
        return self.absent and self.busy is None and not self._queue.items and not self.looks.due

    @property
    def waits_since(self) -> int | None:
        items = self._queue.items
        return items[0].stamp[0] if items else None

    def on_event(self, event: Event) -> None:
        arrived = self._collector.arrivals.of(event.publisher, event.time, event.received)
        stamp = self._collector.clock.stamp(arrived), published(event.time), event.sequence
        self._check_clock(event)
        self.looks.heard += 1
        if event.missed:  # a broken connection is noticed by the recorder, for all keys
            self.lost(event.missed)
        elif not self._known and len(event.path) > 1:
            self.read()
        self._known = self._known or len(event.path) == 1
        self.follow()
        if not self._queue.hear(event):
            return
        if self._whole or any(pattern.concerns(event.path) for pattern in self._collector.patterns):
            role = Role.DELETE if event.deleted else Role.UPDATE
            # What waits to be written must keep no slot from its publisher, which has few for the next frames.
            value = mapped(event.value, _copied) if event.local else event.value
            self._add(Item(role, event.path, value, stamp, self._queue.order, event.size))

    def _check_clock(self, event: Event) -> None:
        """Count where the publisher's time of the key goes back, whoever publishes it."""
        back, self._published = self._published - event.time, event.time
        if back > _STEP:
            counts = self._collector.writer_thread.counts
            counts.clock_steps += 1
            if not self._stepped:
                logger.warning(
                    "%s: the publisher's time went back by %.3f s: its clock was set, or programs with different "
                    "clocks or delays publish it (reported once; `clock_steps` counts)",
                    self._name,
                    back,
                )
            self._stepped = True

    def lost(self, missed: int | None) -> None:
        self._reader.forget()
        self._queue.order += 1
        self._add(self._item(Role.GAP, missed))
        self.read()

    def read(self) -> None:
        """Read the whole key from the server, unless such a read is pending."""
        self._known = True
        self._queue.doubt()
        if not self._queue.will_read(Role.STATE):
            self._add(self._item(Role.STATE, ANNOUNCED))

    def follow(self) -> None:
        """Have the server report changes; what was stored until then is looked for."""
        if not self._reader.feed.tracked and manager_of(self._collector.session).hears_of_changes:
            self.looks.ask()

    def changed(self, key: str | None) -> None:
        if self._reader.changed(key):
            self.looks.ask()

    def _look(self) -> None:
        written = self._collector.writer_thread.stored
        if self._name in written:  # by the last look
            written.discard(self._name)
            self.looks.found()
        if not self._queue.will_read(Role.STATE, Role.STORED):
            now = self._collector.clock.stamp()
            self._add(Item(Role.STORED, (self._name,), ANNOUNCED, (now, now, 0), self._queue.order))

    def keyframe(self, number: int) -> None:
        self._add(self._item(Role.KEYFRAME, None, number))

    def sampled(self, path: Path, value: Any, size: int) -> None:
        """Take what was read at a path: MISSING if there was nothing."""
        now = self._collector.clock.stamp()
        self._add(Item(Role.SAMPLE, path, value, (now, now, 0), self._queue.order, size))

    def _item(self, role: Role, value: Any, number: int = 0) -> Item:
        return Item(role, (self._name,), value, (self._collector.clock.stamp(), 0, number), self._queue.order)

    def _add(self, item: Item) -> None:
        if not self._queue.items and item.value is not ANNOUNCED:
            self._emit(item)
            return
        self._queue.items.append(item)
        if self.busy is None:
            self.busy = started(self._drain(), f"reem record {self._name}")

    def _emit(self, item: Item) -> None:
        role, value = item.role, item.value
        if not self._whole and role in (Role.STATE, Role.STORED, Role.UPDATE, Role.FOUND):
            value = value if value is MISSING else pruned(value, item.path, self._collector.patterns)
        if role in (Role.UPDATE, Role.SAMPLE, Role.FOUND):
            role = Role.DELETE if value is MISSING else Role.UPDATE
        elif role == Role.SKIP:
            self._collector.writer_thread.counts.skip(item.path)
        if role in (Role.STATE, Role.STORED, Role.UPDATE, Role.DELETE) and (role != Role.DELETE or len(item.path) == 1):
            self.absent = role == Role.DELETE or value is MISSING
        kind = Kind.STORED if role == Role.STORED else Kind.READ  # read: its writer is unknown
        kind = Kind.PUBLISHED if item.changes else kind
        if not self._collector.writer_thread.put(Operation(role, item.path, value, item.stamp, kind), item.size):
            self._reader.forget()

    async def _drain(self) -> None:
        """Emit what waits, in order, and fetch values that were only announced."""
        try:
            while self._queue.items:
                for item in self._queue.ready():
                    self._emit(item)
                if self._queue.items and not await self._fetched(self._queue.items[0]):
                    await asyncio.sleep(_PAUSE)
        except Exception as error:  # no call waits for this task: the recording must not go on without it
            self._collector.failed(error)
        finally:
            self.busy = None

    async def _fetched(self, head: Item) -> bool:
        """Fetch what the first item announces, and give it and those that came meanwhile their values.

        Returns whether that worked.
        """
        try:
            found = await self._read(head)
        except (RedisError, OSError, BadData, Conflict) as error:
            self._give_up(head, error)
            return False
        self._complaint = ""
        if head.is_whole:
            self.looks.earliest = asyncio.get_running_loop().time() + found.size / BACKGROUND_RATE
        self._collector.look_for_losses()  # what it has of them was published
        if self._queue.settle(found.value, found.size):
            self.read()
        return True

    async def _read(self, head: Item) -> Fetched:
        if head.role == Role.STATE:
            self._reader.forget()
        if head.is_whole:
            return await self._reader.whole()
        return await self._reader.part(head.path[1:], partial(self._let_pass, head))

    async def _let_pass(self, head: Item) -> None:
        """Wait until the server is done with the publisher of a large update, unless they come fast."""
        collector = self._collector
        since, self._last_large = head.stamp[0] - self._last_large, head.stamp[0]
        if since < _FAST:
            manager_of(collector.session).limit_batch_delay(HURRIED)  # large ones come fast: look more often
        let_pass = min(_LET_PASS, since / 1e9 / 5)  # none should be missed
        await asyncio.sleep(let_pass - collector.clock.since(head.stamp[0]))

    def _give_up(self, head: Item, error: Exception) -> None:
        """Leave out what cannot be fetched; the key is read again later: soon, or at a keyframe if it is no value."""
        if head.is_whole and isinstance(error, WrongKind) and self._collector.record_raw(self._name):
            gone = self._queue.give_up()
            if not self.absent:
                gone.value = MISSING
                self._emit(gone)
            return
        if self._complaint != str(error):
            logger.warning("%s could not be read and is not recorded: %s", show(head.path), error)
        self._complaint = str(error)
        given_up = self._queue.give_up()
        is_there = isinstance(error, BadData | WrongKind | NotAllowed)
        if given_up.role == Role.SKIP:
            self._emit(given_up)
        elif is_there:  # the recording must not go on saying what was there before
            given_up.value = Unreadable(show(head.path), str(error))
            self._emit(given_up)
        if not is_there:
            self._collector.writer_thread.behind.add(self._name)


def _copied(leaf: Any) -> Any:
    return leaf.copy() if isinstance(leaf, np.ndarray) else leaf


class RecordedKeys:
    """One `KeyRecorder` for each key that was met."""

    def __init__(self, collector: Collector) -> None:
        self._collector = collector
        self.tops = list(dict.fromkeys(pattern.top for pattern in collector.patterns))
        self._recorders: dict[str, KeyRecorder] = {}
        self._over: set[str] = set()  # keys that were gone at the last keyframe

    def of(self, name: str) -> KeyRecorder:
        recorder = self._recorders.get(name)
        if recorder is None:
            recorder = self._recorders[name] = KeyRecorder(self._collector, name)
        return recorder

    def concerns(self, name: str) -> bool:
        return any(pattern.concerns((name,)) for pattern in self._collector.patterns)

    async def present(self) -> set[str]:
        """Return the keys there are, of those that are recorded; those that are recorded by name always."""
        session, globs = self._collector.session, {top for top in self.tops if "*" in top or "?" in top}
        # Those of other programs are recorded in another way (raw_keys.py), unless there is a namespace.
        named = {*self.tops} - globs
        others = await session.run(kinds_of(list(named))) if named and not session.namespace else {}
        return (named - others.keys()) | await present_keys(session, globs)

    def changed(self, key: str | None) -> None:
        if key is None:
            for recorder in self._recorders.values():
                recorder.changed(None)
            return
        document = key[1:].partition("}")[0] if key.startswith("{") else key
        name = document.removeprefix(self._collector.session.namespace)
        if name in self._recorders:
            self._recorders[name].changed(key)

    def follow(self, present: set[str]) -> None:
        """Have the server report changes of keys that are there and that it does not report yet."""
        for name in present:
            if self.concerns(name):
                self.of(name).follow()

    def look_at_once(self) -> None:
        for recorder in self._recorders.values():
            recorder.looks.now()

    def lost(self) -> None:
        for recorder in self._recorders.values():
            recorder.lost(None)

    async def settled(self, patience: float) -> None:
        deadline = time.monotonic() + patience
        while (
            busy := [recorder.busy for recorder in self._recorders.values() if recorder.busy]
        ) and time.monotonic() < deadline:
            await asyncio.wait(busy, timeout=deadline - time.monotonic())

    def waiting(self) -> dict[str, int]:
        """Return the keys of which news wait for a value that is on its way, and the log time of the first."""
        found = {name: recorder.waits_since for name, recorder in self._recorders.items()}
        return {name: since for name, since in found.items() if since is not None}

    def cancel(self) -> None:
        for recorder in self._recorders.values():
            recorder.looks.cancel()
            if recorder.busy is not None:
                recorder.busy.cancel()

    def read_silent(self, present: set[str]) -> None:
        """Read the keys that are there, and those that were: no server reports what was stored."""
        for name in present | {name for name, recorder in self._recorders.items() if not recorder.absent}:
            if self.concerns(name):
                self.of(name).read()

    def keyframe(self, number: int) -> None:
        self._let_go()
        for recorder in self._recorders.values():
            recorder.keyframe(number)

    def _let_go(self) -> None:
        """Keep nothing of keys that were gone at the last keyframe, too. One that comes again is a new one.

        Programs may publish under ever new names. Those that were asked for by name stay: they are listed as if they
        were there, and would be read again each time.
        """
        over = {name for name, recorder in self._recorders.items() if recorder.is_over and name not in self.tops}
        for name in over & self._over:
            del self._recorders[name]
            self._collector.writer_thread.stored.discard(name)
        self._over = over
