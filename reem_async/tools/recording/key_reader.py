"""Reading a top-level key again and again while it is recorded: of its attachments only what was changed since."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, NamedTuple

from ...plan import Plan, Reply, wire_commands
from ...plan.keys import Keys
from ...plan.paths import Path
from ...plan.placeholders import Unreadable
from ...plan.reads import HeldValues, RawRead, read
from ...plan.replies import decoded
from ...pubsub.division import Phase, divided_read
from ...pubsub.feed import KeyFeed, last_note
from ...pubsub.manager import manager_of
from ...session import Session
from ...store.document import opened
from .key_queue import KeyQueue
from .stored import New, Unchanged

Wait = Callable[[], Awaitable[None]]
_SUFFIX = "", ".", "["
"""What may begin the names of attachments behind the tag of their key."""


class Fetched(NamedTuple):
    value: Any  # MISSING if nothing is there
    size: int
    note: Reply  # the server's note of the last update that is in it


def size_of(raw_read: RawRead) -> int:
    return sum([len(reply) for reply in raw_read.raw if isinstance(reply, bytes | bytearray)])


async def fetch(session: Session, keys: Keys, path: Path) -> Fetched:
    """Read what is at `path` below a top-level key: one round trip, two where arrays were not known of.

    An `Unreadable` is in the place of what cannot be read. Large values come over the connection for them.
    """
    await session.ships.ready()
    plan = read(keys, path, session.ships, session.cache, (("GET", keys.last),), tolerant=True)
    raw_read: RawRead = await session.run(plan)
    size = size_of(raw_read)
    value = await opened(raw_read) if raw_read.slots else raw_read.holder[0]
    manager_of(session).report(raw_read.unreadable)
    return Fetched(value, size, raw_read.also[0])


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
        return Fetched(raw_read.holder[0], size_of(raw_read), raw_read.also[0]), raw_read.also[0]
