"""Monitor: what is published under any number of keys, without fetching what is only announced."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .connection import RedisInterface
from .errors import BadType, InterfaceClosed
from .hub import Hub, Topic
from .plan.notices import ANNOUNCED, Notice
from .plan.paths import Path, show
from .plan.patterns import Pattern, channel_pattern, name_of, parse_pattern
from .policy import Every, Mailbox, Policy
from .stream import Stream
from .transport.wire import Wire

__all__ = ["ANNOUNCED", "Event", "Monitor"]

_MOST_PUBLISHERS = 10_000


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

    @property
    def name(self) -> str:
        """The top-level key."""
        return str(self.path[0])

    @property
    def shown(self) -> str:
        """The path as people write it."""
        return show(self.path)


class Monitor(Stream[Event]):
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
        patience: Seconds that updates may wait here for each other while many come, unless somebody who follows
            something through this interface is in a hurry. Who only notes what happens costs publishers less so:
            he is woken less often.

    A publisher's updates of a key come in their order. In a cluster, those of different keys may overtake each
    other: they come from different nodes. There, whose servers have no patterns for what only one node is told,
    the keys are looked for, and publishers tell all nodes for the first seconds of a key.

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
    ) -> None:
        super().__init__(policy or Every(10_000))
        self._session = interface.session
        if namespaces is not None and (not isinstance(namespaces, str) or "{" in namespaces or "}" in namespaces):
            raise BadType(f"namespaces={namespaces!r} is not a str without braces, such as 'robots/*:'")
        self._namespaces = None if namespaces is None else Pattern(namespaces)
        self.patience = patience
        self.patterns = [parse_pattern(text) for text in patterns] or [Pattern("*")]
        self._ears: list[_Ear] = []
        self._hub: Hub | None = None
        self._sequences: dict[tuple[str, str], int] = {}
        self._gaps: set[str] | None = None  # keys heard of since a loss, which each has a gap once; None for no loss

    @property
    def _following(self) -> bool:
        return self._hub is not None or self._closed

    async def listen(self) -> None:
        """Begin to follow. When this returns, no later update is missed. Idempotent; one round trip a pattern."""
        if self._closed:
            raise InterfaceClosed("this monitor is closed; make a new one")
        if self._hub is not None:
            return
        hub = self._hub = self._session.hub
        try:
            for top in dict.fromkeys(pattern.top for pattern in self.patterns):
                topic = self._topic(Pattern(top))
                ear = _Ear(self, Topic(topic, pattern=True))
                self._ears.append(ear)
                await hub.follow(ear)
        except BaseException:
            self._hub, self._ears = None, []
            raise

    async def close(self) -> None:
        """Stop following and end the loop. Idempotent."""
        await super().close()
        for ear in self._ears:
            if self._hub is not None:
                await self._hub.unfollow(ear)

    def _topic(self, pattern: Pattern) -> bytes:
        """Return the pattern of the channels of the keys that `pattern` names."""
        namespace, database = self._session.namespace, self._session.options.database
        if self._namespaces is None:
            return channel_pattern(pattern, namespace, database)
        return channel_pattern(Pattern(self._namespaces.top + pattern.top), "", database)

    def _split(self, channel: bytes) -> tuple[str, str] | None:
        """Return the namespace and the top-level key that a channel belongs to, None if it is not meant."""
        if self._namespaces is None:
            return self._session.namespace, name_of(channel, self._session.namespace)
        whole = name_of(channel, "")
        for end in range(len(whole)):
            if self._namespaces.concerns((whole[:end],)) and any(
                each.concerns((whole[end:],)) for each in self.patterns
            ):
                return whole[:end], whole[end:]
        return None

    def _lost(self) -> None:
        self._gaps = set()

    def _heard(self, notice: Notice, channel: bytes) -> None:
        place = self._split(channel)
        if place is None:
            return
        namespace, name = place
        whole = namespace + name
        last = self._sequences.get((notice.publisher, whole), notice.sequence - 1)
        if notice.sequence <= last:  # two of the patterns fit, or it came two ways
            return
        if len(self._sequences) >= _MOST_PUBLISHERS:
            self._sequences.clear()
        self._sequences[notice.publisher, whole] = notice.sequence
        missed, path = max(notice.sequence - last - 1, 0), (name, *notice.path)
        gap = missed > 0 or (self._gaps is not None and whole not in self._gaps)
        if self._gaps is not None:
            self._gaps.add(whole)
        if not any(pattern.concerns(path) for pattern in self.patterns):
            return
        self.mailbox.put(
            Event(
                path,
                None if notice.deleted else notice.value,
                notice.deleted,
                notice.size,
                notice.time,
                time.time(),
                notice.publisher,
                notice.sequence,
                missed,
                gap,
                namespace,
            )
        )


class _Ear:
    """One subscription of a monitor: a listener of the hub, which holds it weakly."""

    def __init__(self, monitor: Monitor, topic: Topic) -> None:
        self._monitor = monitor
        self.topic = topic
        self.note: str | None = None
        self.ready: asyncio.Future[None] | None = None
        self.mailboxes: list[Mailbox] = [monitor.mailbox]
        self.patience = monitor.patience

    def start(self, wire: Wire, kind: str) -> None:
        """Begin: there is nothing to fetch."""
        if self.ready is not None and not self.ready.done():
            self.ready.set_result(None)

    def lost(self, reason: Exception) -> None:
        """Remember that updates may be lost. Whoever waits for the beginning gets `reason`."""
        self._monitor._lost()
        if self.ready is not None and not self.ready.done():
            self.ready.set_exception(reason)

    def doubt(self) -> None:
        """Remember that an update was lost."""
        self._monitor._lost()

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        """Hand the update on."""
        self._monitor._heard(notice, channel)

    def on_note(self, note: bytes | None) -> None:
        """Nothing to compare: many keys have one note each."""
