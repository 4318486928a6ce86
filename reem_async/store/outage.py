"""What a publisher does in an outage: drop updates, or keep the newest of each place and send it afterwards.

                 a call finds no server, or loses it             it answers, and has taken what was kept
    within reach ----------------------------------> out of reach ---------------------------------> within reach

Out of reach, calls do not ask the server: what they publish is dropped or kept at once. One background task asks, with
growing pauses, and then sends what was kept, in the order of the calls.

A key is out of reach while it is in `_out`. It gets there, and away again, in its turn (`DocumentWriter.in_turn`) only:
so what is kept is sent before anything later, and nothing is kept that nobody would send.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
import weakref
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, NamedTuple

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
from .document import Assignment, DocumentWriter, Turn

logger = logging.getLogger("reem.publish")

_POLICIES = ("raise", "drop", "newest")

_PAUSES = (0.02, 0.05, 0.1, 0.2, 0.25)
"""Seconds between questions whether the server is back; the last one from then on."""

_MOST = 256 << 20
"""Bytes of values that are kept, of all keys together."""

_OVERHEAD = 500
"""Bytes of what belongs to a kept value besides, about."""

_AWAY = (NotConnected, ConnectionLost, ServerNotReady)
"""What a call raises in an outage; but for TlsRefused, a NotConnected that no waiting mends."""


_Place = tuple[Path, int]
"""A path, and how many items had been removed from its outermost list before."""


class _Kept(NamedTuple):
    """An assignment that is sent later.

    Attributes:
        assignment: With bytes of its own.
        size: Its bytes.
        time: When it was published, in seconds since 1970.
    """

    assignment: Assignment
    size: int
    time: float


class _Out:
    """A top-level key that is out of reach, and what is kept of it, in the order of the calls.

    A newer value of a place replaces older ones of the same place and inside it. An index of a list names another item
    after an item was removed. So a removal of an item is never replaced by another one, and what was kept of the
    list's items before it is not replaced by what comes after it. Only a new list, or what is around it, replaces both.

    Attributes:
        sending: How many are on their way and not among those kept.
    """

    def __init__(self, writer: DocumentWriter) -> None:
        self.writer = writer
        self.kept: dict[_Place, _Kept] = {}
        self.size = 0
        self.sending = 0
        self._removals: dict[Path, int] = {}  # of items, by the outermost list

    def put(self, it: _Kept) -> int:
        """Keep an assignment in place of those that it replaces; returns how many these are."""
        path = it.assignment.path
        outermost = _outermost_list(path)
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
        """Keep it again, before all others."""
        self.kept = {place: it, **self.kept}
        self.size += it.size


def _outermost_list(path: Path) -> Path | None:
    """Return the path of the outermost list that a path names an item of, None if there is none."""
    return next((path[:place] for place, key in enumerate(path) if isinstance(key, int)), None)


class Outage:
    """The outages of one PublishSpace.

    Args:
        session: The server.
        policy: "drop" or "newest".

    Attributes:
        policy: The same.
    """

    def __init__(self, session: Session, policy: str) -> None:
        self.policy = policy
        self._session = session
        self.forget()
        session.closing.add(self)
        _every.add(self)

    def forget(self) -> None:
        """Know of no outage, as a forked child does: what is kept is for its parent to send."""
        self._out: dict[str, _Out] = {}  # by document
        self._dropped: dict[str, int] = {}  # likewise: counted in a key's turn, so that threads lose no count
        self._is_closed = False
        self._told = 0  # how many were dropped when the last outage began
        self._asking: asyncio.AbstractEventLoop | bool = (
            False  # a task asks whether the server is back, in this event loop
        )
        self._away = False  # the server has not answered since it was last called or asked

    @classmethod
    def chosen(cls, session: Session, policy: str) -> Outage | None:
        """Return what does as a policy says; None for "raise". Raises BadValue."""
        if policy not in _POLICIES:
            raise BadValue(f"outage={policy!r:.40}: say 'raise', 'drop' or 'newest'")
        return None if policy == "raise" else cls(session, policy)

    @property
    def dropped(self) -> int:
        """How many updates were not published, or not for certain."""
        return sum(list(self._dropped.values()))

    @property
    def waiting(self) -> int:
        """How many updates are kept to be sent, or on their way and not answered yet."""
        return sum([len(out.kept) + out.sending for out in list(self._out.values())])

    # Calls.

    async def put(self, writer: DocumentWriter, assignments: Sequence[Assignment]) -> None:
        """Send the updates of one call; in an outage do as the policy says."""
        called = time.time()  # before it waits for its turn, and for a server that does not answer
        try:
            await writer.in_turn(self._put, writer, assignments, called)
        except _AWAY as error:
            if isinstance(error, TlsRefused):
                raise

    async def demand(self, writer: DocumentWriter, send: Callable[..., Awaitable[Any]], what: tuple[Any, ...]) -> Any:
        """Send what depends on what is there, behind what is kept; raises in an outage."""
        return await writer.in_turn(self._demand, writer, send, what)

    async def _put(self, turn: Turn, writer: DocumentWriter, assignments: Sequence[Assignment], called: float) -> None:
        if self._is_out(writer.keys):
            self._take(writer, assignments, called)
            self._have_asked()
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
        # One server has all keys, and is not waited for once for each of them; of a cluster, other nodes may answer.
        # Once it answers, a key whose turn has come stays within reach while others wait for theirs.
        return keys.document in self._out or (self._away and not self._session.transport.sharded)

    def _begin(
        self, turn: Turn, writer: DocumentWriter, assignments: Sequence[Assignment], called: float, error: ReemError
    ) -> None:
        """Note that a key is out of reach, and do with the updates that met this as the policy says."""
        is_first = not self._out
        self._away = True
        self._out.setdefault(writer.keys.document, _Out(writer))
        if is_first:  # noted before it is logged: a log handler may publish, too
            self._told = self.dropped
            what = "dropped" if self.policy == "drop" else "kept, the newest of each place,"
            logger.warning("what is published is %s until the server is back: %s", what, error)
        if isinstance(error, ConnectionLost):  # it was applied or not: sent again, it could be applied twice
            self._count(writer.keys, len(assignments))
        else:
            turn.not_applied(len(assignments))
            self._take(writer, assignments, called)
        self._have_asked()

    def _take(self, writer: DocumentWriter, assignments: Sequence[Assignment], called: float) -> None:
        """Drop updates, or keep them in place of older ones."""
        out = self._out.setdefault(writer.keys.document, _Out(writer))
        if self.policy == "drop":
            self._drop(writer.keys, len(assignments))
            return
        for it in assignments:
            own = _owned(it)
            self._drop(writer.keys, out.put(_Kept(own, _size(own), called)))
        while out.kept and sum([each.size for each in list(self._out.values())]) > _MOST:
            out.pop(next(iter(out.kept)))
            self._drop(writer.keys, 1)

    def _drop(self, keys: Keys, count: int) -> None:
        """Count updates that are not published, and use up their numbers, so that subscribers are told of a gap."""
        self._count(keys, count)
        for _ in range(count):
            self._session.stamp(keys)

    def _count(self, keys: Keys, count: int) -> None:
        if count:
            self._dropped[keys.document] = self._dropped.get(keys.document, 0) + count

    # The way back.

    def _have_asked(self) -> None:
        """Have a task ask whether the server is back, if none does."""
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
            if self._asking is asking:  # else a closed event loop ended this, and the next one has a task of its own
                self._asking = False
        if self._out:  # a call has come just before
            self._have_asked()
        if self._out or self._is_closed:
            return
        logger.warning("the server answers again; %d updates were dropped", self.dropped - self._told)

    async def _all_sent(self) -> bool:
        """Send what is kept of each key; return whether all of it was taken."""
        every = True
        for out in list(self._out.values()):
            if not (await self._answers(out) and await self._sent(out)):
                every = False
                if not self._session.transport.sharded:
                    break
        return every

    async def _answers(self, out: _Out) -> bool:
        """Ask the server of a key whether it is back; not in the key's turn, which callers would wait for."""
        try:
            await self._session.run(exists(out.writer.keys))
        except InterfaceClosed:
            raise
        except (ReemError, RedisError) as error:  # any other answer, of what this user may not for example, is one
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
        """Send what is kept of a key, in its turn. If that is broken off, what is left stays."""
        keys = out.writer.keys
        while out.kept:
            out.sending = 1
            place = next(iter(out.kept))
            it = out.pop(place)  # first: whatever happens now, it is not sent twice
            turn.time = it.time
            try:
                await out.writer.send(turn, [it.assignment])
            except MissingKey:  # it was to be removed, and is not there any more
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
        turn.time = None
        self._out.pop(keys.document, None)

    def close(self) -> None:
        """Give up what is kept."""
        self._is_closed = True
        left, self._out = self._out, {}
        for out in left.values():
            self._count(out.writer.keys, len(out.kept))
        count = sum([len(out.kept) for out in left.values()])
        if count:
            logger.warning("closed in an outage: %d kept updates were not sent", count)


_every: weakref.WeakSet[Outage] = weakref.WeakSet()


def _forget_all() -> None:
    for each in list(_every):
        each.forget()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_all)


def _owned(it: Assignment) -> Assignment:
    """Return it with bytes of its own: the caller may change his arrays."""
    return it._replace(attachments=tuple([_copied(each) for each in it.attachments]))


def _copied(it: EncodedAttachment) -> EncodedAttachment:
    made: dict[int, Any] = {}  # the bytes of an array stand in its command and in its blob: they are copied once

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
