"""Monitor: what is published under any number of keys, without fetching what is only announced."""

from __future__ import annotations

import asyncio
import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from ..concurrency.queues import Every, Policy, chosen, noop
from ..concurrency.streams import Stream
from ..connection import RedisInterface
from ..errors import BadType, InterfaceClosed
from ..plan.arguments import check_number
from ..plan.notices import ANNOUNCED, Notice
from ..plan.paths import Path, Pattern, channel_pattern, fits, is_namespace, name_of, parse_patterns, show
from ..session import Session
from ..transport.wire import Wire
from .division import Numbers
from .listeners import Beginning, Listener, Topic, contained
from .manager import SubscriptionManager, manager_of

__all__ = ["ANNOUNCED", "Event", "Monitor"]

Item = TypeVar("Item")

# Keys. Beyond that every key is taken to have a gap, once.
_MOST_OWED = 10_000
_MOST_GAPS = 100_000  # keys that are heard of after a loss; what comes then is taken for new


@dataclass(frozen=True, slots=True)
class Event:
    """One update, as its publisher announced it.

    Attributes:
        path: What was updated, top-level key first.
        value: What was written, if it travelled with the announcement; else ANNOUNCED. None if deleted.
        deleted: What was at `path` is gone.
        size: Bytes of the value; 0 where only the server knows (arithmetic, appending).
        time: When it was published, in seconds since 1970 on the publisher's clock.
        received: When it was received here, in seconds since 1970 on this machine's clock.
        publisher: The id of the interface that published it.
        sequence: Its number among this publisher's updates of the top-level key.
        missed: How many updates of this publisher and key were lost directly before.
        gap: Something was lost before: `missed` are known, or the connection broke, or a message was unreadable.
        namespace: Where the top-level key is: the interface's namespace, or the one of many that it was found in.
        stored: It was not published: it was found to be stored, at `time`, which is that of `received`. A `Monitor`
            yields none of these; commands that also follow the store do.
        local: Programs of the publisher's user and host can take the value from its memory.
        raw: The Redis type of a key of another program, else empty. A `Monitor` tells of no such keys either.
        changes: How many changes it stands for: of such a key several in a moment are one.
    """

    path: Path
    value: Any
    deleted: bool
    size: int
    time: float
    received: float
    publisher: str
    sequence: int
    missed: int = 0
    gap: bool = False
    namespace: str = ""
    stored: bool = False
    local: bool = False
    raw: str = ""
    changes: int = 1

    @property
    def name(self) -> str:
        """The top-level key."""
        return str(self.path[0])

    @property
    def shown(self) -> str:
        """The path as people write it."""
        return show(self.path)


class PatternStream(Stream[Item]):
    """Subscribes to the channels of all keys that some patterns name."""

    def __init__(self, session: Session, patterns: Sequence[Pattern], policy: Policy) -> None:
        super().__init__(policy)
        self.patterns = list(patterns) or [Pattern("*")]
        self.tops = list(dict.fromkeys(pattern.top for pattern in self.patterns))  # globs of top-level keys
        self._session = session
        self._listeners: list[Listener] = []
        self._manager: SubscriptionManager | None = None

    @property
    def _begun(self) -> bool:
        return self._manager is not None and self._manager.is_here

    @property
    def _following(self) -> bool:
        return self._begun or self._closed

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later change is missed. Idempotent.

        One round trip for each pattern, and a few for each key that a watch of patterns follows.
        """
        if self._closed:
            raise InterfaceClosed(f"this {type(self).__name__} is closed; make a new one")
        if self._begun:
            return
        await self._leave()  # what was begun in another event loop or process
        manager = self._manager = manager_of(self._session)
        try:
            for top in self.tops:
                listener = self._listener(Topic(self._channels(Pattern(top)), pattern=True))
                self._listeners.append(listener)
                await manager.follow(listener)
            await self._begin(manager)
        except BaseException:
            for listener in self._listeners:
                listener.queues = []  # the stream goes on: listen() may be called again
            await self._leave()
            self._manager = None
            raise

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await super().close()
        await self._leave()

    async def _leave(self) -> None:
        leaving, self._listeners = self._leaving(), []
        for listener in leaving:
            if self._manager is not None and self._begun:
                self._manager.unwatch(listener)
                await self._manager.unfollow(listener)

    def _leaving(self) -> list[Listener]:
        """Return all listeners that must be unsubscribed."""
        return self._listeners

    def _channels(self, pattern: Pattern) -> bytes:
        return channel_pattern(pattern, self._session.namespace, self._session.options.database)

    @abstractmethod
    def _listener(self, topic: Topic) -> Listener:
        """Return a new listener to one pattern of channels."""

    async def _begin(self, manager: SubscriptionManager) -> None:
        """Do what follows on the subscriptions."""


class Monitor(PatternStream[Event]):
    """Yields an `Event` for every update published under some patterns of paths: an async iterator.

    Sees what is published with a PublishSpace, not what a KeyValueStore writes. Nothing is fetched:
    small values come with the event, large ones only with their size. Reconnects for ever; what was
    lost shows as `gap`.

    Args:
        interface: The server.
        patterns: Globs such as "arm", "cam_*" or "robot.*.battery"; all keys if there is none.
        policy: What to keep for a loop that is slower than the updates; `Every(10_000)` if not given.
        namespaces: A glob of namespaces to watch at once, such as "robots/*:", in place of the interface's own.
            `event.namespace` says which it was: the shortest that fits.
        patience: Seconds that updates may wait here for each other while many come, unless another subscriber of this
            interface waits for its updates. That costs publishers less.
        raw: Pictures are not decoded: `Jpeg` and `Png` in place of arrays.
        local: Large values of publishers of the same user and host come with their events, from shared memory.

    Attributes:
        invalidated: Called with a top-level key of which a message could not be read.
        broken: Called when updates of any key may be lost: a connection broke.
        resynchronised: Called when it is followed again after a loss, once for each connection.
        changed: Called with each key that the server says was changed, None for all, after `watch_changes`.

    A publisher's updates of a key come in their order. In a cluster, those of different keys may overtake each other.

    Raises:
        BadKey: Not a pattern.
        BadType: Not a glob of namespaces.
    """

    def __init__(
        self,
        interface: RedisInterface,
        patterns: Sequence[str] = ("*",),
        policy: Policy | None = None,
        *,
        namespaces: str | None = None,
        patience: float = 0.0,
        raw: bool = False,
        local: bool = False,
    ) -> None:
        if namespaces is not None and (not isinstance(namespaces, str) or "{" in namespaces or "}" in namespaces):
            raise BadType(f"namespaces={namespaces!r} is not a str without braces, such as 'robots/*:'")
        session = interface.session.raw if raw else interface.session
        super().__init__(session, parse_patterns(patterns), chosen(policy, Every(10_000)))
        self._namespaces = None if namespaces is None else Pattern(namespaces)
        check_number("patience", patience, "use seconds, 0 or more")
        self.patience = patience
        self.local = local
        self._numbers = Numbers()
        self._gaps: set[str] | None = None  # keys heard of since a loss, which each has a gap once; None for no loss
        self._owed: dict[str, int] = {}  # keys with a gap to be told, and how many updates are known to be lost there
        self.invalidated: Callable[[str], None] = lambda name: None
        self.broken: Callable[[], None] = noop
        self.resynchronised: Callable[[], None] = noop
        self.changed: Callable[[str | None], None] = lambda key: None
        self._resynchronising = False  # that it resynchronises, in this turn of the event loop

    def _listener(self, topic: Topic) -> Listener:
        return _PatternListener(self, topic)

    async def watch_changes(self) -> None:
        """Have `changed` called for keys that were read over a connection of notices and then changed."""
        assert self._manager is not None
        await self._manager.watch(self._listeners[0])

    @property
    def connected(self) -> bool:
        """Whether all that it follows is subscribed to, as far as is known."""
        return all(wire is not None for wire in self._wires)

    @property
    def batches_messages(self) -> bool:
        """Whether no listener waits for the notices."""
        return any(wire is not None and wire.batches_messages for wire in self._wires)

    @property
    def _wires(self) -> list[Wire | None]:
        return [listener.wire for listener in self._listeners if isinstance(listener, _PatternListener)]

    def _channels(self, pattern: Pattern) -> bytes:
        if self._namespaces is None:
            return super()._channels(pattern)
        return channel_pattern(Pattern(self._namespaces.top + pattern.top), "", self._session.options.database)

    def _split(self, channel: bytes) -> tuple[str, str] | None:
        """Return the namespace and the top-level key that a channel belongs to, None if it is not meant."""
        if self._namespaces is None:
            name = name_of(channel, self._session.namespace)
            return (self._session.namespace, name) if name else None
        whole = name_of(channel, "")
        # Nothing in the name tells where the namespace ends: the shortest that fits is taken.
        for end in range(len(whole)):
            if (
                is_namespace(whole[:end])
                and self._namespaces.concerns((whole[:end],))
                and any(each.concerns((whole[end:],)) for each in self.patterns)
            ):
                return whole[:end], whole[end:]
        return None

    def _lost(self) -> None:
        self._gaps = set()
        self.broken()

    def _resynchronised(self) -> None:
        if not self._resynchronising:  # all patterns of one connection begin in the same turn
            self._resynchronising = True
            asyncio.get_running_loop().call_soon(setattr, self, "_resynchronising", False)
            self.resynchronised()

    def _doubt(self, channel: bytes) -> None:
        place = self._split(channel)
        if place is None:
            return
        self._owe("".join(place), 0)
        self.invalidated(place[1])

    def _owe(self, whole: str, missed: int) -> None:
        """Have the next event of a key report a loss."""
        if len(self._owed) >= _MOST_OWED:
            self._owed.clear()
            self._lost()
        self._owed[whole] = self._owed.get(whole, 0) + missed

    def _heard(self, notice: Notice, channel: bytes) -> None:
        place = self._split(channel)
        if place is None:
            return
        namespace, name = place
        whole = namespace + name
        # By publisher and key, since a publisher numbers each key's updates by themselves.
        missed, path = self._numbers.take((notice.publisher, whole), notice.sequence), (name, *notice.path)
        if not any(pattern.concerns(path) for pattern in self.patterns):
            if missed != 0:  # what was lost may have been at a place that one does
                self._owe(whole, max(missed, 0))
            return
        gap = missed != 0 or whole in self._owed or (self._gaps is not None and whole not in self._gaps)
        lost = max(missed, 0) + self._owed.pop(whole, 0)
        if self._gaps is not None:
            self._gaps.add(whole)
            if len(self._gaps) > _MOST_GAPS:
                self._gaps = None
        self.queue.put(
            Event(
                path,
                None if notice.deleted else notice.value,
                notice.deleted,
                notice.size,
                notice.time,
                time.time(),
                notice.publisher,
                notice.sequence,
                lost,
                gap,
                namespace,
                local=notice.slot is not None,
            )
        )


class _PatternListener(Listener):
    """One subscription of a monitor: a listener of the subscription manager, which holds it weakly."""

    def __init__(self, monitor: Monitor, topic: Topic) -> None:
        super().__init__(topic, monitor.patience, [monitor.queue])
        self.local = monitor.local
        self._monitor = monitor
        self.wire: Wire | None = None

    @contained
    def start(self, wire: Wire, beginning: Beginning) -> None:
        self.wire = wire
        if beginning is Beginning.AFTER_LOSS:
            self._monitor._resynchronised()
        super().start(wire, beginning)

    @contained
    def lost(self, reason: Exception) -> None:
        self.wire = None
        self._monitor._lost()
        super().lost(reason)

    @contained
    def changed(self, key: str | None) -> None:
        self._monitor.changed(key)

    @contained
    def invalidate(self, channel: bytes) -> None:
        if not self._is_others(channel):
            self._monitor._doubt(channel)

    @contained
    def on_notice(self, notice: Notice, channel: bytes) -> None:
        """Hand the update on, if it is not another subscription's, which brings it too."""
        if not self._is_others(channel):
            self._monitor._heard(notice, channel)

    def _is_others(self, channel: bytes) -> bool:
        for listener in self._monitor._listeners:
            if listener is self:
                return False
            if fits(listener.topic.name, channel):
                return True
        return True
