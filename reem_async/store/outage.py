"""Outages of a publisher: drop updates, or keep the newest of each place and send it afterwards.

                 a call finds no server, or loses it             it answers, and has stored the kept updates
    within reach ----------------------------------> out of reach ---------------------------------> within reach

While a key is out of reach, calls do not ask the server: their updates are dropped or kept at once. One background task
asks, with growing pauses, and then sends the kept updates in the order of the calls.

A key is out of reach while it is in `_out`. It is added and removed only in its turn (`DocumentWriter.in_turn`), so
kept updates are sent before any later one, and every kept update is sent.
"""

from __future__ import annotations

import asyncio
import collections
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager
from itertools import islice
from typing import Any, NamedTuple

from ..concurrency.locks import Inherited
from ..concurrency.timeouts import LONGEST, check_timeout
from ..errors import (
    ConnectionLost,
    InterfaceClosed,
    MissingKey,
    NotConnected,
    RedisError,
    ReemError,
    ServerNotReady,
    TlsRefused,
)
from ..plan.changes import Announcement, EncodedAttachment
from ..plan.keys import Keys
from ..plan.paths import below, has_index, show
from ..plan.reads import exists
from ..plan.sizes import sizes_of
from ..session import Session
from .document import Assignment, CallTime, DocumentWriter, Turn

logger = logging.getLogger("reem.publish")

_PAUSES = (0.02, 0.05, 0.1, 0.2, 0.25)  # seconds between two attempts to reach the server; the last one repeats
_LOOK = 0.001  # seconds between two looks of `flush` at what is unsent
_MOST = 256 << 20  # bytes of kept values, of all keys together
_MOST_SHARED, _LARGEST_SHARED = 32, 1 << 14  # calls in one transaction, and their bytes
_OVERHEAD = 500  # bytes that a kept value needs besides its content, about
_AWAY = (NotConnected, ConnectionLost, ServerNotReady)
"""Errors of an outage; except TlsRefused, a NotConnected that does not end by waiting."""
_CUT = (ConnectionLost, InterfaceClosed)  # errors that do not tell whether an update was stored


class Kept(NamedTuple):
    """The assignments of one call, sent later in one transaction."""

    assignments: tuple[Assignment, ...]  # with bytes of their own
    size: int  # bytes
    called: CallTime  # when it was published
    announcements: tuple[Announcement, ...] = ()  # if they have their numbers already
    removals: int = 0  # how many items had been removed from lists before, if the path leads through one

    @property
    def can_share(self) -> bool:
        """Whether it can be sent in one transaction with other calls: small values at places that no list moves."""
        return bool(self.announcements) and all(
            it.text is not None and not it.attachments and not has_index(it.path) for it in self.assignments
        )

    def replaces(self, older: Kept, in_list: bool) -> bool:
        """Return whether nothing of an older update is left after this one; `in_list` if its path leads through one."""
        return (not in_list or older.removals == self.removals) and all(
            any(below(old.path, new.path) for new in self.assignments) for old in older.assignments
        )


class UnsentUpdates:
    """The unsent updates of a top-level key, in the order of the calls. One thread sends, others may put and drop.

    A newer value of a place replaces older ones of the same place and inside it. An index of a list names another item
    after a removal. So a removal is never replaced by another one, and updates of items before it are not replaced by
    those after it. Only a value of the whole list, or of a place above, replaces both.

    Attributes:
        away: The server did not answer the last update or question.
        sending: How many updates are being sent and are not among those kept.
        last: The number of the last call.
        done: The number of the last call that is stored or dropped.
    """

    def __init__(self, writer: DocumentWriter, *, away: bool = True) -> None:
        self.writer = writer
        self.kept: collections.OrderedDict[int, Kept] = collections.OrderedDict()
        self.away = away
        self.sending = self.last = self.done = 0
        self._removals = 0  # of items of lists

    @property
    def size(self) -> int:
        return sum([it.size for it in list(self.kept.values())])

    def put(self, it: Kept, *, merge: bool = True) -> int:
        """Keep the assignments of a call; return how many older ones they replaced, none without `merge`."""
        first = it.assignments[0]
        # Several assignments are entries of one dict, so they have the lists on their paths in common.
        in_list = has_index(first.path)
        if in_list:
            it = it._replace(removals=self._removals)
            self._removals += first.text is None and isinstance(first.path[-1], int)
        self.last += 1
        number = self.last
        self.kept[number] = it  # one step, so an interrupted call has put all or nothing
        if not merge:
            return 0
        older = [each for each, old in list(self.kept.items()) if each != number and it.replaces(old, in_list)]
        return sum([self._drop(each) for each in older])

    def drop_first(self) -> int:
        return self._drop(next(iter(list(self.kept)), 0))

    def drop_all(self) -> int:
        numbers = list(self.kept)
        count = sum([self._drop(number) for number in numbers])
        self.done = max(self.done, *numbers, 0)
        return count

    def _drop(self, number: int) -> int:
        it = self.kept.pop(number, None)  # None: it is being sent
        return 0 if it is None else len(it.assignments)

    def take(self) -> list[tuple[int, Kept]]:
        """Take the oldest call, and those after it that can share its transaction; they count as being sent."""
        self.sending, size, taken = 1, 0, list[tuple[int, Kept]]()
        for number, it in list(islice(self.kept.items(), _MOST_SHARED)):
            size += it.size
            if taken and not (it.can_share and taken[0][1].can_share and size <= _LARGEST_SHARED):
                break
            if self.kept.pop(number, None) is not None:
                taken.append((number, it))
        self.sending = sum([len(it.assignments) for _, it in taken])
        return taken

    def put_back(self, number: int, it: Kept) -> None:
        self.kept[number] = it
        self.kept.move_to_end(number, last=False)

    @property
    def count(self) -> int:
        return sum([len(it.assignments) for it in list(self.kept.values())]) + self.sending


class Outage:
    """The outages of one PublishSpace, with the policy "drop" or "newest"."""

    _task_name = "reem outage"
    _rest = 0.0  # seconds after everything was sent until more is

    def __init__(self, session: Session, policy: str) -> None:
        self.policy = policy
        self.chosen: dict[str, Any] = {"policy": policy}  # of the PublishSpace
        self._session = session
        self.forget()
        session.closing.add(self)
        _every.add(self)

    def forget(self) -> None:
        """Reset the state, also in a forked child: the parent sends the kept updates."""
        self._out: dict[str, UnsentUpdates] = {}  # by document
        self._dropped: dict[str, int] = {}  # likewise; counted in a key's turn, so threads lose no count
        self._is_closed = self._is_outage = False
        self._dropped_before = 0  # how many were dropped when the last outage began
        self._reached: object = None  # where the server has answered: the process and the event loop, if any
        # The task that asks whether the server is back; True for a thread of the blocking front.
        self._asking: asyncio.Task[Any] | bool = False
        self._away = False  # the server did not answer the last call or question
        self._reason: Exception = NotConnected("not yet connected")  # why it did not

    @property
    def dropped(self) -> int:
        return sum(list(self._dropped.values()))

    @property
    def waiting(self) -> int:
        return sum([out.count for out in list(self._out.values())])

    async def put(self, writer: DocumentWriter, assignments: Sequence[Assignment]) -> None:
        # Before it waits for its turn, and for a server that does not answer.
        called = CallTime(time.time(), time.monotonic())
        try:
            await writer.in_turn(self._put, writer, assignments, called)
        except _AWAY as error:
            if isinstance(error, TlsRefused):
                raise

    async def demand(self, writer: DocumentWriter, send: Callable[..., Awaitable[Any]], what: tuple[Any, ...]) -> Any:
        return await writer.in_turn(self._demand, writer, send, what)

    async def _put(
        self, turn: Turn, writer: DocumentWriter, assignments: Sequence[Assignment], called: CallTime
    ) -> None:
        if self._is_out(writer.keys):
            self._take(writer, assignments, called)
            self._start_asking()
            return
        try:
            await writer.send(turn, assignments)
        except _AWAY as error:
            if not isinstance(error, TlsRefused):
                self._begin(turn, writer, assignments, called, error)
            raise

    async def _demand(
        self, turn: Turn, writer: DocumentWriter, send: Callable[..., Awaitable[Any]], what: tuple[Any, ...]
    ) -> Any:
        out = self._out.get(writer.keys.document) if self._out else None
        if out is not None and out.kept:
            await self._flush(turn, out)
        return await send(turn, *what)

    def _is_out(self, keys: Keys) -> bool:
        if not self._out:
            return False
        # A single server has all keys, so one call that times out is enough; of a cluster, other nodes may answer. Once
        # the server answers, a key whose turn has come is within reach while others still wait.
        return keys.document in self._out or (self._away and not self._session.transport.sharded)

    def _begin(
        self, turn: Turn, writer: DocumentWriter, assignments: Sequence[Assignment], called: CallTime, error: ReemError
    ) -> None:
        """Note that a key is out of reach, and apply the policy to the updates of this call."""
        self._away = True
        self._out.setdefault(writer.keys.document, UnsentUpdates(writer))
        self._note_outage(error, self.dropped)
        if isinstance(error, ConnectionLost):  # it was applied or not: sent again, it could be applied twice
            self._count(writer.keys, len(assignments))
        else:
            turn.not_applied(len(assignments))
            self._take(writer, assignments, called)
        self._start_asking()

    def _note_outage(self, error: Exception, dropped: int) -> None:
        if self._is_outage:
            return
        self._is_outage, self._dropped_before = True, dropped  # first: a log handler may publish too
        what = "kept, the newest of each place," if self.policy == "newest" else "dropped"
        logger.warning("updates are %s until the server is back: %s", what, error)

    def _note_end(self) -> None:
        if self._is_outage and not self._is_closed:
            self._is_outage = False
            logger.warning("the server answers again; %d updates were dropped", self.dropped - self._dropped_before)

    def _take(self, writer: DocumentWriter, assignments: Sequence[Assignment], called: CallTime) -> None:
        out = self._out.setdefault(writer.keys.document, UnsentUpdates(writer))
        if self.policy == "drop":
            self._drop(writer.keys, len(assignments))
            return
        own = own_copies(assignments)
        self._drop(writer.keys, out.put(Kept(own, size_of(own), called)))
        while out.kept and self._is_full:
            self._drop(writer.keys, out.drop_first())

    @property
    def _is_full(self) -> bool:
        return sum([each.size for each in list(self._out.values())]) > _MOST

    def _drop(self, keys: Keys, count: int) -> None:
        """Count updates that are not published, and use up their numbers, so that subscribers see a gap."""
        self._count(keys, count)
        for _ in range(count):
            self._session.stamp(keys)

    def _count(self, keys: Keys, count: int) -> None:
        if count:
            self._dropped[keys.document] = self._dropped.get(keys.document, 0) + count

    @property
    def _is_asking(self) -> bool:
        task = self._asking
        return task if isinstance(task, bool) else not (task.done() or task.get_loop().is_closed())

    def _start_asking(self) -> None:
        if not self._out or self._is_asking:
            return
        self._asking = True  # before it begins
        try:
            task = self._session.tasks.start(self._until_back(), self._task_name)
        except BaseException:
            self._asking = False
            raise
        if task is not None:  # else it is a thread
            self._asking = task

    async def _until_back(self) -> None:
        tries, asking = 0, self._asking
        try:
            while self._out or self._has_more():
                if await self._all_sent():
                    tries = 0
                    if self._rest:
                        await self._session.transport.pause(self._rest)
                    continue
                await self._session.transport.pause(_PAUSES[min(tries, len(_PAUSES) - 1)])
                tries += 1
        except InterfaceClosed:  # `close` counts what was kept
            return
        finally:
            if self._asking is asking:  # else a closed event loop ended this, and the next one has its own task
                self._asking = False
        if self._out:  # added by a call just now
            self._start_asking()
        else:
            self._note_end()

    def _has_more(self) -> bool:
        """Return whether to go on though nothing is kept."""
        return False

    async def _all_sent(self) -> bool:
        """Send the kept updates of each key; return whether all were stored."""
        before, every = self.dropped, True
        for out in list(self._out.values()):
            if not (await self._answers(out) and await self._sent(out)):
                every = False
                if not self._session.transport.sharded:
                    break
        if not every:
            self._note_outage(self._reason, before)
        else:
            self._note_end()
        return every

    async def _answers(self, out: UnsentUpdates) -> bool:
        """Ask the server of a key whether it is back; not in the key's turn, for which callers would wait."""
        if not out.away:
            return True
        try:
            await self._session.run(exists(out.writer.keys))
        except InterfaceClosed:
            raise
        except (ReemError, RedisError) as error:  # any other error, such as a missing right, is an answer
            self._away, self._reason = isinstance(error, _AWAY), error
        else:
            self._away = False
        out.away = self._away
        if not out.away:
            self._reached = self._session.tasks.place
        return not out.away

    async def _sent(self, out: UnsentUpdates) -> bool:
        try:
            await out.writer.in_turn(self._flush, out)
        except _AWAY as error:
            self._away, self._reason, out.away = True, error, True
            return False
        return True

    async def _flush(self, turn: Turn, out: UnsentUpdates) -> None:
        """Send the kept updates of a key, in its turn. If that is interrupted, the rest stays."""
        last = out.last  # not those that come meanwhile: others wait for this turn
        while out.done < last and await self._send_next(turn, out):
            pass
        async with self._calls(out.writer.keys):
            if not out.kept:
                self._out.pop(out.writer.keys.document, None)

    def _calls(self, keys: Keys) -> AbstractAsyncContextManager[None]:
        """Return the lock for putting and taking updates of a key; nothing inside waits."""
        return self._session.transport.ordered(f"{keys.channel} queue")

    async def _send_next(self, turn: Turn, out: UnsentUpdates) -> bool:
        """Send the oldest kept call of a key, in its turn, and those that share its transaction; False for none."""
        async with self._calls(out.writer.keys):  # not before the call has shared it with subscribers on this host
            taken = out.take()  # first, so that none is ever sent twice
        if not taken:
            return False
        keys, calls = out.writer.keys, [it for _, it in taken]
        turn.called, turn.announced = calls[0].called, [each for it in calls for each in it.announcements]
        is_over = True
        try:
            for it, error in await _sent_together(out.writer, turn, calls):
                self._not_stored(keys, it, error, is_refused=True)
        except (NotConnected, ServerNotReady):
            is_over = False
            for number, it in reversed(taken):
                turn.not_applied(len(it.assignments))
                for each in it.announcements:
                    each.again()
                out.put_back(number, it)
            raise
        except BaseException as error:
            is_refused = isinstance(error, RedisError | ReemError) and not isinstance(error, _CUT)
            for it in calls:
                self._not_stored(keys, it, error, is_refused)
            if not is_refused:
                raise
        finally:
            turn.called, turn.announced = None, []
            if is_over:
                out.done = taken[-1][0]
            out.sending = 0
            turn.release()
        return True

    def _not_stored(self, keys: Keys, it: Kept, error: BaseException, is_refused: bool) -> None:
        if isinstance(error, MissingKey):  # a deletion of a value that is gone
            return
        self._count(keys, len(it.assignments))
        if is_refused:
            logger.warning("%s: kept in an outage, and refused now: %s", place_of(keys, it), error)

    async def flush(self, timeout: float | None) -> None:  # noqa: ASYNC109
        """Wait until the updates of all calls so far are stored or dropped. Raises TimeoutError."""
        if timeout is not None:
            check_timeout(timeout)
        if not await self._is_sent_within(LONGEST if timeout is None else timeout):
            raise TimeoutError(f"{self.waiting} updates were not sent within {timeout:g} s; they are still kept")

    async def _is_sent_within(self, seconds: float) -> bool:
        await self._wake()
        deadline = time.monotonic() + seconds
        for document, out, last in [(document, out, out.last) for document, out in list(self._out.items())]:
            while out.done < last and self._out.get(document) is out:
                if time.monotonic() >= deadline:
                    return False
                await self._session.transport.pause(_LOOK)
        return True

    async def _wake(self) -> None:
        """Have what is kept sent soon."""
        self._start_asking()

    async def finish(self, *, is_exit: bool) -> None:
        """Prepare for the end of the interface, or of the program."""

    def close(self) -> None:
        self._is_closed = True
        left, self._out = self._out, {}
        counts = [(out.writer.keys, out.drop_all()) for out in left.values()]
        for keys, count in counts:
            self._count(keys, count)
        if total := sum([count for _, count in counts]):
            logger.warning("closed: %d kept updates were not sent", total)


_every = Inherited[Outage](lambda outage: outage.forget())


async def _sent_together(writer: DocumentWriter, turn: Turn, calls: Sequence[Kept]) -> list[tuple[Kept, Exception]]:
    """Send calls in one transaction; return those of several that the server refused. Raises what refuses all."""
    if len(calls) == 1:
        await writer.send(turn, calls[0].assignments)
        return []
    errors = iter(await writer.send_each(turn, [each for it in calls for each in it.assignments]))
    found = [(it, next(filter(None, [next(errors) for _ in it.assignments]), None)) for it in calls]
    return [(it, error) for it, error in found if error is not None]


def own_copies(assignments: Sequence[Assignment]) -> tuple[Assignment, ...]:
    """Return assignments with bytes of their own: the caller may change the arrays."""
    return tuple(
        [
            it._replace(attachments=tuple([_copied(each) for each in it.attachments])) if it.attachments else it
            for it in assignments
        ]
    )


def _copied(it: EncodedAttachment) -> EncodedAttachment:
    made: dict[int, Any] = {}  # the bytes of an array are in its command and in its blob, but are copied once

    def own(word: Any) -> Any:
        if type(word) is tuple:
            return tuple(map(own, word))
        if not isinstance(word, memoryview | bytearray):
            return word
        if id(word) not in made:
            made[id(word)] = bytes(word)
        return made[id(word)]

    return it._replace(commands=tuple([tuple(map(own, each)) for each in it.commands]), blob=own(it.blob))


def size_of(assignments: Sequence[Assignment]) -> int:
    return sum(
        [
            _OVERHEAD + len(it.text or b"") + sum([sum(sizes_of(each.commands)) for each in it.attachments])
            for it in assignments
        ]
    )


def place_of(keys: Keys, it: Kept) -> str:
    return show((keys.name, *it.assignments[0].path))
