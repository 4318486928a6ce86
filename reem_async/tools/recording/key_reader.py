"""Reading a top-level key again and again while it is recorded: of its attachments only what was changed since."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from functools import partial

from ...plan import Plan, Reply, wire_commands
from ...plan.keys import Keys
from ...plan.paths import Path
from ...plan.placeholders import Unreadable
from ...plan.reads import HeldValues, RawRead, read
from ...plan.replies import decoded
from ...pubsub.attachments import HeldAttachments
from ...pubsub.division import divided_read
from ...pubsub.manager import manager_of
from ...session import Session
from ...store.reader import opened
from .fetch import Fetched, size_of
from .key_queue import KeyQueue
from .stored import New, Unchanged

__all__ = ["KeyReader"]

Wait = Callable[[], Awaitable[None]]


class KeyReader:
    """Reads one top-level key.

    What is read is touched before over the connection of the notices: the server tells what is changed from then on
    (`changed`). Attachments that were not changed are not read again. They are those of the instant of the rest only
    if no word of a change of theirs comes before a fence behind it.

    Reads of one key come one behind the other.

    Args:
        session: The server.
        keys: The key's names.
        queue: What waits to be written, of which a read tells.
        fence: Returns when all that was published before has been heard of.
        limit: How many may read at once.

    Attributes:
        told: The server tells when what was read last is changed.
    """

    def __init__(self, session: Session, keys: Keys, queue: KeyQueue, fence: Wait, limit: asyncio.Semaphore) -> None:
        self.told = False
        self._session = session
        self._keys = keys
        self._queue = queue
        self._fence = fence
        self._limit = limit
        self._attachments = HeldAttachments(keys)
        self._touching = False  # what is told before that is done was changed before
        self._reads_all = False  # and is in what is read

    def changed(self, key: str | None) -> bool:
        """Take the server's word that a key was changed, None for every key; return whether to look at the whole."""
        is_ours = self._attachments.change(key, covered=self._touching) or self._is_attachment(key)
        return is_ours and not (self._touching and self._reads_all)

    def _is_attachment(self, key: str | None) -> bool:
        """Return whether it is one of this key: what was touched before a part was is not among what is held."""
        return key is not None and key.startswith(self._keys.tag) and key[len(self._keys.tag) :][:1] in ("", ".", "[")

    def forget(self) -> None:
        """Read all anew: nobody knows what was changed, or what was read before is not in the file."""
        self.told = False
        self._attachments.values.clear()

    async def whole(self) -> Fetched:
        """Return all of the key once it is known which updates are in it, as `divided_read` does.

        In place of each attachment there is a `New`, or an `Unchanged`.
        """
        await self._session.ships.ready()
        return await divided_read(self._queue.division, self._whole, self._fence)

    async def part(self, path: Path, pause: Wait) -> Fetched:
        """Return what is at a path of the key likewise, after a pause in which it is touched; all of it is read."""
        await self._session.ships.ready()
        touching = asyncio.ensure_future(self._touch(self._plan(path, {})))
        try:
            await pause()
            return await divided_read(self._queue.division, partial(self._part, path, touching), self._fence)
        finally:
            touching.cancel()  # the next one is not to wait for it
            await asyncio.gather(touching, return_exceptions=True)

    async def _whole(self) -> tuple[Fetched, Reply]:
        held, division = self._attachments.values, self._queue.division
        plan = self._plan((), held)
        self._reads_all = True
        try:
            while True:
                async with self._limit:
                    # Directly before it is asked for: the server tells of one change, and one that came while this
                    # waits to read would be in what is read, with nobody told of the next.
                    self.told = await self._touch(plan)
                    self._queue.asked()
                    replies = await self._session.transport.roundtrip(wire_commands(plan), bulk=plan.bulk)
                if held and not division.answered(_note(replies), fence=True):
                    await self._fence()
                outcome: RawRead | Plan = decoded(plan, replies)
                if not isinstance(outcome, Plan):
                    return await self._opened(outcome, keeps=self.told)
                plan = outcome
        finally:
            self._reads_all = False

    async def _part(self, path: Path, touching: asyncio.Future[bool]) -> tuple[Fetched, Reply]:
        async with self._limit:
            self._queue.asked()
            # The answer to what was sent on another connection: only then it was touched before it is read.
            is_touched = touching.done() and not touching.exception() and touching.result()
            raw_read: RawRead = await self._session.run(self._plan(path, {}))
        asked = {str(command[1]) for command in raw_read.commands} - {self._keys.last}
        return await self._opened(raw_read, keeps=is_touched and self.told and asked <= self._attachments.asked)

    def _plan(self, path: Path, held: HeldValues) -> Plan:
        session = self._session
        noted = (("GET", self._keys.last),)
        return read(self._keys, path, session.ships, session.cache, noted, held, tolerant=True)

    async def _touch(self, plan: Plan) -> bool:
        """Have the server tell of the next change of what a plan reads; return whether it will."""
        self._attachments.ask(plan)
        self._touching = True
        try:
            return await manager_of(self._session).touch(self._keys.channel, self._attachments.asked, self._touched)
        finally:
            self._touched()

    def _touched(self) -> None:
        self._touching = False

    async def _opened(self, raw_read: RawRead, *, keeps: bool) -> tuple[Fetched, Reply]:
        """Have the ships make values, and keep of which of them nothing else is known."""
        self._attachments.opening(raw_read)
        await opened(raw_read)
        manager_of(self._session).report(raw_read.unreadable)
        made = [(slot, slot.container[slot.key]) for slot, ship, _ in raw_read.slots if ship.blob is not None]
        made = [(slot, value) for slot, value in made if type(value) is not Unreadable]
        for slot, _ in made:
            slot.container[slot.key] = Unchanged()
        if keeps:
            self._attachments.opened()
        else:
            self._attachments.failed()  # what was read is not to stay in memory
        for slot, value in made:
            slot.container[slot.key] = New(value, slot.container[slot.key])
        return Fetched(raw_read.holder[0], size_of(raw_read), raw_read.also[0]), raw_read.also[0]


def _note(replies: Sequence[Reply]) -> Reply:
    """Return the note that comes last in a transaction."""
    last = replies[-1]
    return last[-1] if isinstance(last, list) and last else None
