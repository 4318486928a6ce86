"""Following keys of other programs by the server's own messages (CLIENT TRACKING in broadcast mode).

Those programs publish nothing. The server names each key with a prefix that any client has changed, also new ones and
those that were deleted or have expired. The key is then read. So several changes in a short time may be one update, and
the last state always arrives. Each node of a cluster has its own connection.
"""

from __future__ import annotations

import asyncio
import logging
import math
import re
import time
import weakref
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, cast

from ..concurrency.queues import BoundedQueue, Policy
from ..concurrency.streams import Stream
from ..errors import InterfaceClosed, NotAllowed, RedisError, ReemError, WrongType, is_of_command
from ..plan import Plan, blamed
from ..plan.keys import DOCUMENT
from ..plan.paths import Pattern
from ..plan.raw import SHORT, RawValue, kinds_of, raw_name, read, read_short
from ..session import Session
from ..transport import Transport, scanned
from ..transport.aio import AsyncTransport
from ..transport.wire import Wire, close_all
from .events import Origin, Update
from .listeners import is_invalidation
from .manager import SubscriptionManager, manager_of

logger = logging.getLogger("reem.subscribe")

_PERIOD = 1.0  # seconds between looks whether a connection is alive, and whether a cluster has new nodes
_PAUSE = 10  # times as long as a search for the first key took, at least, until the next one
_LOOK = 0.005  # seconds between two looks whether it has caught up
_QUICKEST = 0.001  # seconds between two readings; a key that changes at any rate is read 1,000 times a second at most
_LONGEST_PAUSE = 0.5  # seconds between tries to connect
_AT_ONCE = 64  # keys that are read together
_MOST_CHANGED = 48  # of these, keys that were changed, while others that a search has found wait
_SLOW = 1 << 16  # bytes of a value from which its key waits for its next reading, by `rate`
_DOCUMENT_SECONDS = 5.0  # for which a key that held a document of REEM is taken to hold one still
_DOCUMENT_REST = 60.0  # the same, while no other program's key was found
MOST = 10_000  # keys that are read at the beginning
_MOST_KNOWN = 100_000  # keys that are remembered
_CHANNEL = "reem:raw"
"""Nothing is published there. A client that has subscribed has the output limit of subscribers on the server, so one
that stands still is disconnected, and does not fill the server's memory."""


@dataclass(frozen=True, slots=True)
class RawUpdate(Update):
    """One update of a key of another program.

    `path` is the key. `value` and `data` are what is there, an `Unfetched` if it is too large.

    Attributes:
        kind: The Redis type, such as "string" or "hash"; "none" if the key has gone.
        size: Bytes: of a string its length, of others the memory that they take on the server.
        changes: How often the server has named the key since the update before.
    """

    kind: str = "none"
    size: int = 0
    changes: int = 1


class RawWatch(Stream[RawUpdate]):
    """Yields an update for each change of keys of other programs: an async iterator.

    What is there when following begins comes first (`initial`), of 10,000 keys at most. A connection that breaks is
    made again, and then all is read again, with `gap`.

    Args:
        session: The server.
        patterns: Globs of whole names, all keys if there is none; or the one `name`.
        policy: What to keep for a loop that is slower than the updates.
        largest: Bytes that a key may take to be fetched.
        name: The only key that is followed, in place of the patterns.
        pace: Seconds between two readings.
        rate: Bytes a second that are read of each key.
        lazy: Search for keys each second, and have the server name changes once there is one: it would name those of
            REEM's keys, too.
    """

    def __init__(
        self,
        session: Session,
        patterns: Sequence[str],
        policy: Policy,
        largest: float,
        *,
        name: str | None = None,
        pace: float = _QUICKEST,
        rate: float = math.inf,
        lazy: bool = False,
    ) -> None:
        super().__init__(policy)
        self._session = session
        self._manager: SubscriptionManager | None = None
        self._task: asyncio.Task[None] | None = None
        self._follower: _Follower | None = None
        globs = [Pattern(text) for text in patterns or ("*",)] if name is None else []
        self._make = partial(_Follower, session, self.queue, globs, name, largest, pace, rate, lazy)

    @property
    def is_begun(self) -> bool:
        """Whether it follows: it has begun in this process and event loop."""
        return self._manager is not None and self._manager.is_here

    @property
    def _following(self) -> bool:
        return self.is_begun or self._closed

    @property
    def is_partial(self) -> bool:
        """Whether there were more keys than are read at the beginning: the others are reported when they change."""
        return self._follower is not None and self._follower.is_partial

    def limit_rate(self, rate: float) -> None:
        """Have at most so many bytes a second read of each key from now on, once it has begun."""
        if self._follower is not None:
            self._follower.rate = rate

    def look(self, name: str) -> None:
        """Read a key at once: its document of REEM was replaced."""
        if self._follower is not None:
            self._follower.look(name)

    async def caught_up(self, seconds: float) -> None:
        """Return when what was changed before now is read and taken, or so many seconds are over."""
        follower = self._follower
        if follower is None:
            return
        turn = follower.turns + follower.waiting // (_AT_ONCE - _MOST_CHANGED) + 2
        for _ in range(int(seconds / _LOOK)):
            if self.queue.is_empty and (not follower.waiting or follower.turns >= turn):
                return
            await asyncio.sleep(_LOOK)

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later change is missed. Idempotent.

        Three round trips for each node, and one for about 1000 keys of the server.

        Raises:
            NotConnected: No server listens there.
            NotAllowed: The user lacks a right; says which.
        """
        if self._closed:
            raise InterfaceClosed("this watch is closed; make a new one")
        if self.is_begun:
            return
        manager = manager_of(self._session)
        follower = self._make()
        try:
            await self._session.run(Plan([("PING",)], lambda _: None))  # waits for a server that is not up yet
            await follower.connect()
        except BaseException:
            await follower.end()
            raise
        self._manager, self._follower = manager, follower
        self._task = manager.tasks.start(_following(follower, weakref.ref(self)), "reem watch of other programs' keys")

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await super().close()
        if self._task is not None and self.is_begun:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)


async def _following(follower: _Follower, watch: weakref.ref[RawWatch]) -> None:
    """Follow until the watch is dropped or the interface is closed."""
    pause = 0.05
    try:
        while watch() is not None:
            try:
                await follower.step()
                pause = 0.05
            except InterfaceClosed:
                return
            except NotAllowed as error:  # to use a command: the loop gets it
                follower.queue.close(error)
                return
            except (ReemError, RedisError, OSError) as error:
                logger.debug("keys of other programs are not followed at the moment: %s", error)
                await asyncio.sleep(pause)
                pause = min(2 * pause, _LONGEST_PAUSE)
    finally:
        follower.queue.close()
        await follower.end()


class _Follower:
    """The connections of one watch, and the keys that are to be read."""

    def __init__(
        self,
        session: Session,
        queue: BoundedQueue,
        globs: Sequence[Pattern],
        name: str | None,
        largest: float,
        pace: float,
        rate: float,
        lazy: bool,
    ) -> None:
        self.queue = queue
        self._session, self._globs, self._name = session, globs, name
        self._largest, self._pace, self.rate = largest, pace, rate
        self._is_waiting = lazy  # for the first key
        self._wires: dict[Transport, Wire] = {}
        self._news = asyncio.Event()
        # Keys that are to be read, and how often the server has named them: 0 if only a search has found them
        self._dirty: dict[str, int] = {}
        # Of these, those that a search has found, and whether that was the first search
        self._found: dict[str, bool] = {}
        self._rests: dict[str, float] = {}  # when a key with a large value may be read again
        # Keys that were there when they were last read, and whether each was a short string
        self._known: dict[str, bool] = {}
        self._documents: dict[str, float] = {}  # keys with documents of REEM, and when that was found
        self._doubtful: set[str] = set()  # of these, keys that changed since: another program may have replaced them
        self._next_look = 0.0
        self._is_first = True
        self.turns = 0  # how often keys were read
        self.is_partial = False  # there are more keys than are read at the beginning
        self._reading = 0
        self._warned: set[str] = set()

    @property
    def waiting(self) -> int:
        """How many keys are to be read, or are being read."""
        return len(self._dirty) + self._reading

    # Connections.

    async def connect(self) -> None:
        """Make the connections that are missing, and have all keys read after that."""
        transport, made, began = self._session.transport, False, time.monotonic()
        transport.check()
        if self._is_waiting and not await self._any():
            self._next_look += _PAUSE * (time.monotonic() - began)
            return
        self._is_waiting = False
        nodes = await transport.nodes()
        for node in nodes:
            wire = self._wires.get(node)
            if wire is None or not wire.alive:
                await self._open(node)
                made = True
            else:
                wire.send([("PING",)], lambda _: None)  # a connection that is dead breaks by that
        if made:
            await self._search()
        # Such as that of a primary that is a replica now.
        left = [self._wires.pop(node) for node in self._wires.keys() - {*nodes}]
        await close_all(left)

    async def _any(self) -> bool:
        """Return whether another program has stored a key that is meant."""
        for glob in self._globs:
            async for page in scanned(self._session.transport, glob.glob):
                names = [name for name in map(raw_name, page) if name is not None and self._meant(name)]
                since = time.monotonic() - _DOCUMENT_REST
                new = [name for name in names if self._documents.get(name, -math.inf) < since]
                if new and await self._session.run(kinds_of(new)):
                    return True
                self._remember(new)
        return False

    async def _open(self, node: Transport) -> None:
        wire = await cast("AsyncTransport", node).listen(self._take, self._lost)
        try:
            prefixes = [word for prefix in _prefixes(self._globs, self._name) for word in ("PREFIX", prefix)]
            command = ("CLIENT", "TRACKING", "ON", "BCAST", *prefixes)
            _, tracked = await wire.roundtrip([("SUBSCRIBE", _CHANNEL), command])
            if isinstance(tracked, Exception):
                raise blamed(tracked, command)
        except BaseException:
            await close_all([wire])
            raise
        wire.pace = self._pace if self._pace > _QUICKEST else 0.0
        self._wires[node] = wire

    async def _search(self) -> None:
        """Have all keys that there are read: after the server names changes, so that none is missed in between."""
        is_first, self._is_first = self._is_first, False
        self._rests.clear()
        if self._name is not None:
            self._mark([self._name], is_first)
            return
        self._mark(list(self._known), is_first)
        found = 0
        for glob in self._globs:
            async for page in scanned(self._session.transport, glob.glob):
                names = [name for name in map(raw_name, page) if name is not None and self._meant(name)]
                self._mark(names, is_first)
                found += len(names)
                if found > MOST:
                    self.is_partial = True
                    self._warn(
                        f"{glob.top} names more than {MOST} keys of other programs: the others are reported when they "
                        "change; a narrower pattern reports all of its keys"
                    )
                    return

    async def end(self) -> None:
        wires, self._wires = self._wires, {}
        await close_all(list(wires.values()))

    def _lost(self, wire: Wire, reason: Exception) -> None:
        self._next_look = 0.0
        self._news.set()

    # What the server tells.

    def _take(self, message: list[Any]) -> None:
        if not is_invalidation(message):
            return
        if message[1] is None:  # all keys were removed
            self._mark(list(self._known))
            return
        names = [name for data in message[1] if (name := raw_name(data)) is not None and self._meant(name)]
        since = time.monotonic() - _DOCUMENT_SECONDS
        documents = {name for name in names if self._documents.get(name, -math.inf) >= since}
        self._doubtful |= documents
        self._mark(name for name in names if name not in documents)

    def _look_at_doubtful(self) -> None:
        """Read changed keys again whose documents were found over `_DOCUMENT_SECONDS` ago."""
        since = time.monotonic() - _DOCUMENT_SECONDS
        names = [name for name in self._doubtful if self._documents.get(name, -math.inf) < since]
        self._doubtful.difference_update(names)
        self._mark(names)

    def look(self, name: str) -> None:
        """Read a key at once that held a document until now."""
        if self._documents.pop(name, None) is not None:
            self._mark([name])

    def _meant(self, name: str) -> bool:
        if self._name is not None:
            return name == self._name
        return any(glob.concerns((name,)) for glob in self._globs)

    def _mark(self, names: Iterable[str], is_first: bool | None = None) -> None:
        for name in names:
            if len(self._dirty) >= _MOST_KNOWN:
                self._warn(f"over {_MOST_KNOWN} keys wait to be read, and further changes are not reported")
                break
            self._dirty[name] = self._dirty.get(name, 0) + (is_first is None)
            if is_first is not None:
                self._found[name] = is_first
        self._news.set()

    # Reading.

    async def step(self) -> None:
        """Read keys that were changed, if there are any; else wait for them, or for the next look."""
        loop = asyncio.get_running_loop()
        if loop.time() >= self._next_look:
            self._next_look = loop.time() + _PERIOD
            await self.connect()
            self._look_at_doubtful()
        now = loop.time()
        # Keys that were changed do not wait for those that a search has found, of which there may be thousands.
        changed = self._due(_AT_ONCE, is_changed=True)
        found = self._due(_AT_ONCE - min(len(changed), _MOST_CHANGED), is_changed=False)
        names = changed[: _AT_ONCE - len(found)] + found
        if names:
            self._reading = len(names)
            try:
                await self._read(names)
            finally:
                self._reading = 0
                self.turns += 1
            await asyncio.sleep(self._pace if changed else min(self._pace, loop.time() - now))
            return
        self._news.clear()
        wake = min([self._next_look, *(self._rests.get(name, 0.0) for name in self._dirty)])
        with suppress(TimeoutError):
            async with asyncio.timeout_at(wake):
                await self._news.wait()

    def _due(self, most: int, *, is_changed: bool) -> list[str]:
        """Return keys that may be read now: such as the server has named, or such as only a search has found."""
        now = asyncio.get_running_loop().time()
        wanted = (it for it, count in self._dirty.items() if bool(count) is is_changed)
        return list(islice((name for name in wanted if self._rests.get(name, 0.0) <= now), most))

    async def _read(self, names: list[str]) -> None:
        counts = {name: self._dirty.pop(name) for name in names}  # first: what changes from now on is read again
        run = self._session.run
        plans = [(read_short if self._known.get(name) else read)(name, self._largest) for name in names]
        found = await asyncio.gather(*[run(each) for each in plans], return_exceptions=True)
        failure: BaseException | None = None
        for name, it in zip(names, found, strict=True):
            if isinstance(it, RawValue):
                self._report(name, it, counts[name])
            elif isinstance(it, WrongType | NotAllowed) and not is_of_command(it):
                self._found.pop(name, None)
                self._warn(str(it))
            else:
                failure = it
                self._dirty[name] = self._dirty.get(name, 0) + counts[name]
        if failure is not None:
            raise failure

    def _report(self, name: str, it: RawValue, changes: int) -> None:
        is_first = self._found.pop(name, None)
        if it.kind == DOCUMENT:
            self._remember([name])
            self._known.pop(name, None)
            return
        is_gone, was_known = it.kind == "none", name in self._known
        if is_gone:
            self._known.pop(name, None)
            self._rests.pop(name, None)
            if not was_known:
                return
        elif was_known or len(self._known) < _MOST_KNOWN:
            self._known[name] = it.kind == "string" and it.size < SHORT
        if it.size >= _SLOW:
            self._rests[name] = asyncio.get_running_loop().time() + it.size / self.rate
        gap = is_first is False
        update = RawUpdate(
            name,
            it.value,
            it.value,
            initial=bool(is_first),
            gap=gap,
            missed=None if gap else 0,
            origin=Origin.STORED if is_first is None else Origin.FOUND,
            deleted=is_gone,
            kind=it.kind,
            size=it.size,
            changes=max(changes, 1),
        )
        self.queue.put(update)

    def _remember(self, documents: Iterable[str]) -> None:
        """Note keys with documents of REEM, for some seconds."""
        now = time.monotonic()
        if len(self._documents) >= _MOST_KNOWN:
            self._documents.clear()
        self._documents.update(dict.fromkeys(documents, now))

    def _warn(self, text: str) -> None:
        if text not in self._warned and len(self._warned) < _AT_ONCE:
            self._warned.add(text)
            logger.warning("%s", text)


def _prefixes(globs: Iterable[Pattern], name: str | None) -> list[str]:
    """Return what the names begin with that are meant; the server refuses one that begins with another one."""
    kept: list[str] = []
    for prefix in sorted({re.split(r"[*?]", glob.top)[0] for glob in globs} if name is None else {name}):
        if not any(prefix.startswith(each) for each in kept):
            kept.append(prefix)
    return kept
