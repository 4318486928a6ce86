"""Filling the rolling buffer: every published update, and what the server says was only stored.

Each key has a feed, as a subscriber's and a recording's. Its document is read, without the arrays, a moment after the
server has said that it was changed, or an update was only announced. Arrays that were changed are read in turn.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any

from ...concurrency.queues import Last
from ...concurrency.streams import arrived
from ...connection import RedisInterface
from ...errors import BadData, Conflict, NotAllowed, RedisError, ReemError, WrongKind
from ...plan import wire_commands
from ...plan.paths import Path, below
from ...plan.placeholders import Unfetched, Unreadable, marked
from ...plan.reads import RawRead, read
from ...plan.trees import MISSING, changed, get, walk
from ...pubsub.division import Division, GapDetector, Heard
from ...pubsub.feed import Arm, Fence, KeyFeed, Open, Read, Step
from ...pubsub.manager import manager_of
from ...pubsub.monitor import ANNOUNCED, Event, Monitor
from ...pubsub.refresh import BACKGROUND, BACKGROUND_RATE, RefreshTimer, find_regularly, present_keys
from ...store.document import opened
from ..recording.times import PATIENCE, Arrivals
from .history import LARGEST_TEXT, History
from .source import Loss
from .timeline import PENDING
from .trees import framed, is_kept, same, weight

_WAITING = 50_000  # updates that wait for this program before the oldest are skipped
# The part of BACKGROUND_RATE at which arrays are read for the slider while no page is open: one picture a second.
# With a page it is four a second each of two cameras.
UNSEEN = 1 / 8
_RECENT = 16  # updates that are known again if they come twice, where there may be thousands of keys

# Documents that are asked for at the same time.
_BATCH = 100
_REST = 4  # how many times as long as reading took none are read: others ask the server, and this program, too
_LONGEST_REST = 1.0  # seconds of such a rest: a read over a dead link takes long, and is no work for the server
_PAUSE = 0.1  # seconds after a read that failed
_SHARE = 4  # a key may take one in so many of the bytes that are read


Attachment = tuple[str, str]
"""The label and the suffix of an attachment."""


class Allowance:
    """So many bytes a second (`rate`), saved up to a limit."""

    def __init__(self, rate: float, most: float) -> None:
        self.most = most  # bytes that can be saved up
        self.rate, self._saved, self._then = rate, min(rate, most), time.monotonic()

    def take(self, size: int) -> bool:
        """Take so many bytes if they are there; else nothing, and return False."""
        if self.wait(size) > 0:
            return False
        self._saved -= size
        return True

    def wait(self, size: int) -> float:
        """Return the seconds until so many bytes are there; infinite if there never are so many."""
        now = time.monotonic()
        self._saved = min(self._saved + (now - self._then) * self.rate, self.most)
        self._then = now
        return math.inf if size > self.most else max((size - self._saved) / self.rate, 0.0)


def _rest(took: float) -> float:
    return min(_REST * took, _LONGEST_REST)


class FollowedKey:
    """One top-level key: its feed, and what the buffer lacks of it."""

    def __init__(self, follower: Follower, name: str) -> None:
        self.name = name
        self._follower = follower
        self._session = follower.session
        self._history = follower.history
        self._keys = self._session.keys(name)
        self.feed: KeyFeed[Event] = KeyFeed(self._keys, Division(GapDetector(_RECENT)), aside=True)
        self.looks = RefreshTimer(self, FollowedKey._look, BACKGROUND)
        self.announced: set[Path] = set()  # where updates were only announced
        # The arrays that were changed and not read yet, by label and suffix
        self.owed: dict[Attachment, Unfetched] = {}
        self._answers: set[Attachment] = set()  # of these, the buffer has already that they were changed
        self._unchanged: set[Attachment] = set()  # these were there when following began, and were not changed since
        self.busy = False

    def _look(self) -> None:
        self._follower.read_soon([self.name])

    @property
    def is_settled(self) -> bool:
        """Whether the buffer has all that is known to have changed, and the server reports the next change."""
        return self.feed.tracked and not (self.feed.dirty or self.owed or self.announced)

    def hear(self, event: Event) -> None:
        self.looks.heard += 1
        division = self.feed.division
        if division.gaps.count(event) is not None:
            division.hear(Heard(event, None if event.gap else 0))
        if event.gap:
            self.doubt()
        if event.value is ANNOUNCED:
            self.announced.add(event.path)
            self.looks.found()
            self.looks.ask()
        elif not self.feed.tracked:
            self.looks.ask()

    def doubt(self) -> None:
        """Note that any change may be unknown."""
        self.feed.change(None)
        self.looks.ask()

    def owing(self, most: float) -> dict[Attachment, Unfetched]:
        """Return the arrays to be read, the smallest first, as many as have no more than so many bytes."""
        chosen, size = {}, 0
        for place, it in sorted(self.owed.items(), key=lambda item: item[1].size):
            size += it.size
            if size <= most:
                chosen[place] = it
        return chosen

    async def read(self, most: float = -1) -> int:
        """Read the key, put what differs from the buffer into it, and return how many bytes the document has.

        Args:
            most: Arrays that are owed are read as long as they have no more than so many bytes; -1 for none.
        """
        self.busy = True
        held = self.feed.attachments.values
        for place in self.owing(most):
            held.pop(place, None)
        try:
            raw_read = await self._read(most)
            await opened(raw_read)
            manager_of(self._session).report(raw_read.unreadable)
            for slot, _, _ in raw_read.slots:
                slot.container[slot.key] = await asyncio.to_thread(framed, slot.container[slot.key])
            self._recognize(raw_read)
            text = bytes(raw_read.raw[0] or b"")[1:-1] or None
            found = {slot.placeholder[:2]: slot.container[slot.key] for slot, _, _ in raw_read.slots}
            self._compare(raw_read.holder[0], text, {**raw_read.left, **found}, self.feed.take()[1])
        except (WrongKind, NotAllowed):
            self._compare(MISSING, None, {}, self.feed.give_up()[1])
            return 0
        except BadData as error:  # what was there before is not there any more
            self._compare(Unreadable(self.name, str(error)), None, {}, self.feed.give_up()[1])
            return 0
        except BaseException:
            self.feed.give_up()
            self.feed.tracked = False  # it may not have come to touch the keys: it is read again
            raise
        finally:
            self.busy = False
        return len(text or b"")

    async def _read(self, most: float) -> RawRead:
        session, feed, noted = self._session, self.feed, (("GET", self._keys.last),)
        await session.ships.ready()
        held = feed.attachments.values
        feed.tracked = True
        step: Step | None = feed.read(
            read(self._keys, (), session.ships, session.cache, noted, held, most, tolerant=True)
        )
        while not isinstance(step, Open):
            if isinstance(step, Arm):
                feed.tracked = await manager_of(session).touch(self._keys.channel, step.keys, feed.touched)
                step = feed.armed()
            elif isinstance(step, Read):
                replies = await session.transport.roundtrip(wire_commands(step.plan), bulk=step.plan.bulk)
                step = feed.answered(replies)
            elif isinstance(step, Fence):
                await self._follower.fence(self._keys.channel)
                step = feed.fenced()
            else:
                raise Conflict(f"{self.name}: updates came that were never heard of")
        return step.raw_read

    def _recognize(self, raw_read: RawRead) -> None:
        """Put what the buffer has in the place of arrays that are bit by bit the same."""
        fetched = {id(slot.container[slot.key]): slot for slot, _, _ in raw_read.slots}
        before = self._history.tree((self.name,), self._history.clock.now()) if fetched else MISSING
        for path, it in walk(raw_read.holder[0], ()) if fetched else ():
            if (slot := fetched.get(id(it))) is not None and is_kept(old := get(before, path), it):
                slot.container[slot.key] = old

    def _compare(
        self, tree: Any, text: bytes | None, found: Mapping[Attachment, Any], heard: Sequence[Heard[Event]]
    ) -> None:
        """Put what was read into the buffer, as far as it differs.

        Args:
            tree: What is at the key.
            text: Its document's text, None if there is none.
            found: What is in the tree for the arrays that were changed: a frame, or that it was not fetched.
            heard: The updates in the buffer that are not in the tree.
        """
        history, name, follower = self._history, self.name, self._follower
        when, first = history.clock.now(), name in follower.unread
        if text is not None and not history.knows(name):
            history.begin(name, text if first else None)
        later = [each.update for each in heard if each.update is not None]
        for event in later:
            if event.value is not ANNOUNCED:
                tree = changed(tree, event.path[1:], MISSING if event.deleted else event.value)
        # First the answers to what was announced, then what differs from all that is known.
        lacking = {event.path for event in later if event.value is ANNOUNCED}
        noted = list(self.announced - lacking)
        self.announced &= lacking
        for path in noted:
            history.add_read(path, get(tree, path[1:]), when, answer=True)
        place = history.difference(name, tree, None if later else text, when)
        if place is not None:
            noted.append(place)
            self.looks.found()
            value = get(tree, place[1:])
            if (size := weight(value)) <= LARGEST_TEXT or follower.texts.take(size):
                history.add_read(place, value, when)
            else:
                history.add(place, PENDING, 0, when)
        if found or self.owed or (text is not None and marked(text)):
            self._compare_arrays(tree, found, noted, when)
        if not later:
            history.remember(name, text)
        follower.unread.discard(name)
        follower.was_read(self, gone=tree is MISSING)

    def _compare_arrays(self, tree: Any, found: Mapping[Attachment, Any], noted: Sequence[Path], when: float) -> None:
        """Put the arrays that were read into the buffer, and note which others are to be read.

        Those of a key that was never seen to change are not read: the buffer has what the document says of them.
        """
        first, owed, answers = self.name in self._follower.unread and not self.looks.heard, self.owed, self._answers
        places = {id(it): place for place, it in {**self.feed.attachments.values, **found}.items()}
        before = self._history.tree((self.name,), when)
        if first:
            self._unchanged.update(found)
        else:
            self._unchanged.difference_update(place for place, it in found.items() if isinstance(it, Unfetched))
        self.owed = {}
        for path, it in walk(tree, (self.name,)):
            place, is_unreadable = places.get(id(it)), type(it) is Unreadable
            if place is None and not is_unreadable:
                continue
            is_noted, old = any(below(path, each) for each in noted), get(before, path[1:])
            is_news = not same(it, old) if is_unreadable else place in found and it is not old
            if isinstance(it, Unfetched) and place is not None:
                if not (is_noted or place in owed or (self.feed.tracked and not first)):
                    continue  # as far as is known it is as it was
                if it.size <= self._follower.arrays.most:
                    self.owed[place], is_news = it, False
            if is_noted and place is not None:
                answers.add(place)
            elif is_news and place in self._unchanged and not is_unreadable:
                self._history.frames.add(path, it, when)
            elif is_news:
                self._history.add_read(path, it, when, answer=place in answers)
        answers.intersection_update(self.owed)


class Follower:
    def __init__(self, interface: RedisInterface, history: History) -> None:
        self._interface = interface
        self.session = interface.session.raw  # pictures are shown as they are
        self.history = history
        # Bytes of long documents that may be kept
        self.texts = Allowance(0.5 * history.budget / history.seconds, history.budget / 4)
        self.arrays = Allowance(BACKGROUND_RATE * UNSEEN, history.budget / 2)  # bytes of arrays that may be read
        self.monitor = Monitor(interface, policy=Last(_WAITING), raw=True, patience=PATIENCE)
        self._arrivals = Arrivals(PATIENCE)
        self.monitor.invalidated = lambda name: self.key(name).doubt()
        self.monitor.broken, self.monitor.changed = self._broken, self._changed
        self.monitor.resynchronised = self._read_again
        self._tasks: list[asyncio.Task[None]] = []
        self._keys: dict[str, FollowedKey] = {}
        self._due: dict[str, None] = {}  # documents to be read
        self._owing: dict[str, None] = {}  # keys with arrays to be read
        self._news, self._owes = asyncio.Event(), asyncio.Event()
        self.names: set[str] = set()  # the top-level keys
        # Keys that were there when following began and were not read yet: what they hold is no change
        self.unread: set[str] = set()
        self.lost = ""  # why the server cannot be read at the moment; empty if all is well

    async def start(self) -> None:
        if self._tasks:
            return
        await self._interface.initialize()
        await self.monitor.listen()
        await self.monitor.watch_changes()
        self.names = await self._present()
        self.unread.update(self.names)
        self.read_soon(self.names)
        for work in (self._follow(), self._read_documents(), self._read_arrays(), find_regularly(self._search)):
            self._tasks.append(asyncio.create_task(work))

    async def close(self) -> None:
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for key in self._keys.values():
            key.looks.cancel()
        await self.monitor.close()

    def shown_on(self, pages: int) -> None:
        self.arrays.rate = BACKGROUND_RATE * (1 if pages else UNSEEN)
        self._owes.set()  # what waits for it may be due sooner

    @property
    def hears_of_changes(self) -> bool:
        """Whether no server has refused to report which keys are changed."""
        return manager_of(self.session).hears_of_changes

    def is_settled(self, name: str) -> bool:
        """Return whether the buffer has all changes of a key and its arrays, as far as is known."""
        return name in self._keys and self._keys[name].is_settled

    def key(self, name: str) -> FollowedKey:
        if name not in self._keys:
            self._keys[name] = FollowedKey(self, name)
        return self._keys[name]

    # --- what is published

    async def _follow(self) -> None:
        async for event in self.monitor:
            self._take(event)

    async def fence(self, channel: str) -> None:
        """Take all updates that were published to a key before now."""
        await manager_of(self.session).fence([channel])
        self._pump()

    def _pump(self) -> None:
        for event in arrived(self.monitor):
            self._take(event)

    def _take(self, event: Event) -> None:
        name = event.name
        if len(event.path) == 1 and event.deleted:
            self.names.discard(name)
        elif len(event.path) == 1 or name not in self.history.names:
            self.names.add(name)
            if not self.history.knows(name) and name not in self.unread:
                self.history.begin(name, None)
        # Not before what was read meanwhile, which the updates that waited here come after.
        arrived = self._arrivals.of(event.publisher, event.time, event.received)
        when = max(self.history.clock.of(arrived), self.history.newest)
        if event.gap:
            since = self.history.last([(name,)], when).get((name,), when)
            self.history.losses.add(name, Loss(since, when, event.missed or None))
        value = MISSING if event.deleted else PENDING if event.value is ANNOUNCED else event.value
        self.history.add(event.path, value, 0 if value is PENDING else event.size, when)
        self.key(name).hear(event)

    # --- what the server says was changed

    def _changed(self, server_key: str | None) -> None:
        self._pump()  # a notice that came before is of an earlier change
        if server_key is None:
            self._lost()
            self.read_soon(self.history.names)
            return
        tagged = server_key[1:].partition("}")[0] if server_key.startswith("{") else server_key
        name = tagged.removeprefix(self.session.namespace)
        if name in self._keys or server_key == self.session.namespace + name:
            key = self.key(name)
            if key.feed.change(server_key):
                key.looks.ask()

    def _broken(self) -> None:
        self.history.losses.begin(self.history.clock.now())
        self._lost()

    def _lost(self) -> None:
        """Note that changes may be unknown: the connection that reports them is lost."""
        for key in self._keys.values():
            key.feed.change(None)
            key.feed.tracked = False

    def _read_again(self) -> None:
        """Read all keys: they are followed again after a loss.

        `_lost` is not called for a connection that breaks before its topics are subscribed, though keys may have been
        touched over it. The next search may be seconds away: it waits ten times as long as the last one took.
        """
        self.history.losses.finish(self.history.clock.now())
        self._lost()
        self.read_soon(self.names | self._keys.keys())

    # --- what is read

    def read_soon(self, names: Iterable[str]) -> None:
        self._due.update(dict.fromkeys(names))
        self._news.set()

    def was_read(self, key: FollowedKey, *, gone: bool) -> None:
        """Note that arrays are to be read; keep nothing of a key that is gone: if it comes again, it is found."""
        if key.owed:
            self._owing.setdefault(key.name)
            self._owes.set()
        elif gone and not key.looks.due:
            self._keys.pop(key.name, None)

    async def _read_documents(self) -> None:
        while True:
            await self._news.wait()
            self._news.clear()
            while batch := list(islice(self._due, _BATCH)):
                for name in batch:
                    del self._due[name]
                began = time.monotonic()
                sizes = await asyncio.gather(*[self._read(self.key(name)) for name in batch])
                if None in sizes:
                    self.read_soon(name for name, size in zip(batch, sizes, strict=True) if size is None)
                    await asyncio.sleep(_PAUSE)
                took, size = time.monotonic() - began, sum(filter(None, sizes))
                # At the beginning the page waits for it; what it asks for goes first.
                await asyncio.sleep(0.002 if self.unread else max(_rest(took), size / BACKGROUND_RATE))

    async def _read(self, key: FollowedKey) -> int | None:
        """Read a document; return how many bytes it has, None if that failed."""
        if key.busy:
            key.looks.ask()
            return 0
        try:
            size = await key.read()
        except (RedisError, ReemError, OSError):
            return None
        key.looks.earliest = asyncio.get_running_loop().time() + _SHARE * size / BACKGROUND_RATE
        return size

    async def _read_arrays(self) -> None:
        """Read the arrays of one key after the other, so that of each there is one now and then."""
        rested = 0.0
        while True:
            self._owes.clear()
            key = next((self.key(name) for name in self._owing if not self.key(name).busy), None)
            size = 0 if key is None else sum([it.size for it in key.owing(self.arrays.most).values()])
            wait = max(self.arrays.wait(size), rested - time.monotonic(), 0.0) if key is not None else None
            if key is None or wait:
                with suppress(TimeoutError):
                    # wait_for of Python 3.11 loses a cancellation that comes with news
                    async with asyncio.timeout(wait or (_PAUSE if self._owing else None)):
                        await self._owes.wait()
                continue
            del self._owing[key.name]
            self.arrays.take(size)
            began = time.monotonic()
            try:
                await key.read(self.arrays.most)
            except (RedisError, ReemError, OSError):
                key.doubt()
                await asyncio.sleep(_PAUSE)
            rested = time.monotonic() + _rest(time.monotonic() - began)

    # --- which keys there are

    async def _search(self) -> bool:
        try:
            await self._find()
        except (RedisError, ReemError, OSError) as error:
            self.lost = str(error)
            raise
        self.lost = self._ended()
        return True

    async def _present(self) -> set[str]:
        return await present_keys(self.session, ["*"])

    def _ended(self) -> str:
        """Return why following ended, if it did: what is shown would no longer be news."""
        ended = [task for task in self._tasks if task.done() and not task.cancelled()]
        return f"following ended: {ended[0].exception()!r}" if ended else ""

    async def _find(self) -> None:
        """List the keys; read those that the server does not report, and those that are gone."""
        before = set(self.names)
        present = await self._present()
        # The list may be older than what was heard meanwhile.
        present.update(self.names - before)
        self.names = present
        self.read_soon(name for name in self.names if name not in self._keys or not self._keys[name].feed.tracked)
        self.read_soon(before - present)
