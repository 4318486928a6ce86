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
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, NamedTuple

from ..concurrency.locks import Inherited
from ..errors import (
    BadValue,
    ConnectionLost,
    InterfaceClosed,
    MissingKey,
    NotConnected,
    RedisError,
    ReemError,
    ServerNotReady,
    TlsRefused,
)
from ..plan.changes import EncodedAttachment
from ..plan.keys import Keys
from ..plan.paths import Path, below, show
from ..plan.reads import exists
from ..plan.sizes import sizes_of
from ..session import Session
from .document import Assignment, CallTime, DocumentWriter, Turn

logger = logging.getLogger("reem.publish")

_POLICIES = ("raise", "drop", "newest")

_PAUSES = (0.02, 0.05, 0.1, 0.2, 0.25)  # seconds between two attempts to reach the server; the last one repeats
_MOST = 256 << 20  # bytes of kept values, of all keys together
_OVERHEAD = 500  # bytes that a kept value needs besides its content, about
_AWAY = (NotConnected, ConnectionLost, ServerNotReady)
"""Errors of an outage; except TlsRefused, a NotConnected that does not end by waiting."""

_Place = tuple[Path, int]  # a path, and how many items had been removed from its outermost list before


class _Kept(NamedTuple):
    """An assignment that is sent later."""

    assignment: Assignment  # with bytes of its own
    size: int  # bytes
    called: CallTime  # when it was published


class _Out:
    """A top-level key that is out of reach, and its kept updates in the order of the calls.

    A newer value of a place replaces older ones of the same place and inside it. An index of a list names another item
    after a removal. So a removal is never replaced by another one, and updates of items before it are not replaced by
    those after it. Only a value of the whole list, or of a place above, replaces both.
    """

    def __init__(self, writer: DocumentWriter) -> None:
        self.writer = writer
        self.kept: dict[_Place, _Kept] = {}
        self.size = 0
        self.sending = 0  # how many are being sent and not among those kept
        self._removals: dict[Path, int] = {}  # of items, by the outermost list

    def put(self, it: _Kept) -> int:
        """Keep an assignment in place of those that it replaces; return their number."""
        path = it.assignment.path
        # The outermost list on the path.
        outermost = next((path[:place] for place, key in enumerate(path) if isinstance(key, int)), None)
        place = path, self._removals.get(outermost, 0) if outermost is not None else 0
        replaced = [each for each in self.kept if below(each[0], path) and (outermost is None or each[1] == place[1])]
        for each in replaced:
            self.pop(each)
        self.kept[place] = it
        self.size += it.size
        if outermost is not None and it.assignment.text is None and isinstance(path[-1], int):
            self._removals[outermost] = place[1] + 1
        return len(replaced)

    def pop(self, place: _Place) -> _Kept:
        it = self.kept.pop(place)
        self.size -= it.size
        return it

    def put_back(self, place: _Place, it: _Kept) -> None:
        self.kept = {place: it, **self.kept}
        self.size += it.size


class Outage:
    """The outages of one PublishSpace, with the policy "drop" or "newest"."""

    def __init__(self, session: Session, policy: str) -> None:
        self.policy = policy
        self._session = session
        self.forget()
        session.closing.add(self)
        _every.add(self)

    def forget(self) -> None:
        """Reset the state, also in a forked child: the parent sends the kept updates."""
        self._out: dict[str, _Out] = {}  # by document
        self._dropped: dict[str, int] = {}  # likewise; counted in a key's turn, so threads lose no count
        self._is_closed = False
        self._dropped_before = 0  # how many were dropped when the last outage began
        # A task asks whether the server is back, in this event loop; True in the blocking front.
        self._asking: asyncio.AbstractEventLoop | bool = False
        self._away = False  # the server did not answer the last call or question

    @classmethod
    def chosen(cls, session: Session, policy: str) -> Outage | None:
        """Return the outages with a policy; None for "raise". Raises BadValue."""
        if policy not in _POLICIES:
            raise BadValue(f"outage={policy!r:.40}: say 'raise', 'drop' or 'newest'")
        return None if policy == "raise" else cls(session, policy)

    @property
    def dropped(self) -> int:
        return sum(list(self._dropped.values()))

    @property
    def waiting(self) -> int:
        return sum([len(out.kept) + out.sending for out in list(self._out.values())])

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
        is_first = not self._out
        self._away = True
        self._out.setdefault(writer.keys.document, _Out(writer))
        if is_first:  # noted before it is logged: a log handler may publish too
            self._dropped_before = self.dropped
            what = "dropped" if self.policy == "drop" else "kept, the newest of each place,"
            logger.warning("updates are %s until the server is back: %s", what, error)
        if isinstance(error, ConnectionLost):  # it was applied or not: sent again, it could be applied twice
            self._count(writer.keys, len(assignments))
        else:
            turn.not_applied(len(assignments))
            self._take(writer, assignments, called)
        self._start_asking()

    def _take(self, writer: DocumentWriter, assignments: Sequence[Assignment], called: CallTime) -> None:
        out = self._out.setdefault(writer.keys.document, _Out(writer))
        if self.policy == "drop":
            self._drop(writer.keys, len(assignments))
            return
        for it in assignments:
            # With bytes of its own: the caller may change the arrays.
            own = it._replace(attachments=tuple([_copied(each) for each in it.attachments]))
            self._drop(writer.keys, out.put(_Kept(own, _size(own), called)))
        while out.kept and sum([each.size for each in list(self._out.values())]) > _MOST:
            out.pop(next(iter(out.kept)))
            self._drop(writer.keys, 1)

    def _drop(self, keys: Keys, count: int) -> None:
        """Count updates that are not published, and use up their numbers, so that subscribers see a gap."""
        self._count(keys, count)
        for _ in range(count):
            self._session.stamp(keys)

    def _count(self, keys: Keys, count: int) -> None:
        if count:
            self._dropped[keys.document] = self._dropped.get(keys.document, 0) + count

    def _start_asking(self) -> None:
        """Start a task that asks whether the server is back, if there is none."""
        if not self._out:
            return
        if self._asking is True or (self._asking and not self._asking.is_closed()):
            return
        try:
            self._asking = asyncio.get_running_loop()
        except RuntimeError:  # in the blocking front
            self._asking = True
        try:
            self._session.tasks.start(self._until_back(), "reem outage")
        except BaseException:
            self._asking = False
            raise

    async def _until_back(self) -> None:
        tries, asking = 0, self._asking
        try:
            while self._out and not await self._all_sent():
                await self._session.transport.pause(_PAUSES[min(tries, len(_PAUSES) - 1)])
                tries += 1
        except InterfaceClosed:  # `close` counts what was kept
            return
        finally:
            if self._asking is asking:  # else a closed event loop ended this, and the next one has its own task
                self._asking = False
        if self._out:  # added by a call just now
            self._start_asking()
        if self._out or self._is_closed:
            return
        logger.warning("the server answers again; %d updates were dropped", self.dropped - self._dropped_before)

    async def _all_sent(self) -> bool:
        """Send the kept updates of each key; return whether all were stored."""
        every = True
        for out in list(self._out.values()):
            if not (await self._answers(out) and await self._sent(out)):
                every = False
                if not self._session.transport.sharded:
                    break
        return every

    async def _answers(self, out: _Out) -> bool:
        """Ask the server of a key whether it is back; not in the key's turn, for which callers would wait."""
        try:
            await self._session.run(exists(out.writer.keys))
        except InterfaceClosed:
            raise
        except (ReemError, RedisError) as error:  # any other error, such as a missing right, is an answer
            self._away = isinstance(error, _AWAY)
        else:
            self._away = False
        return not self._away

    async def _sent(self, out: _Out) -> bool:
        try:
            await out.writer.in_turn(self._flush, out)
        except _AWAY:
            self._away = True
            return False
        return True

    async def _flush(self, turn: Turn, out: _Out) -> None:
        """Send the kept updates of a key, in its turn. If that is interrupted, the rest stays."""
        keys = out.writer.keys
        while out.kept:
            out.sending = 1
            place = next(iter(out.kept))
            it = out.pop(place)  # first, so that it is never sent twice
            turn.called = it.called
            try:
                await out.writer.send(turn, [it.assignment])
            except MissingKey:  # a deletion of a value that is gone
                continue
            except (NotConnected, ServerNotReady):
                turn.not_applied(1)
                out.put_back(place, it)
                raise
            except BaseException as error:
                self._count(keys, 1)
                if not isinstance(error, RedisError | ReemError) or isinstance(error, ConnectionLost | InterfaceClosed):
                    raise
                where = show((keys.name, *it.assignment.path))
                logger.warning("%s: kept in an outage, and refused now: %s", where, error)
            finally:
                out.sending = 0
                turn.release()
        turn.called = None
        self._out.pop(keys.document, None)

    def close(self) -> None:
        """Drop the kept updates."""
        self._is_closed = True
        left, self._out = self._out, {}
        for out in left.values():
            self._count(out.writer.keys, len(out.kept))
        count = sum([len(out.kept) for out in left.values()])
        if count:
            logger.warning("closed in an outage: %d kept updates were not sent", count)


_every = Inherited(Outage.forget)


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


def _size(it: Assignment) -> int:
    return _OVERHEAD + len(it.text or b"") + sum([sum(sizes_of(each.commands)) for each in it.attachments])
