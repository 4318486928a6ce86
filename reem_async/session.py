"""Session: what one interface shares among its stores and subscribers, on one transport."""

from __future__ import annotations

import collections
import contextlib
import math
import os
import secrets
import time
import weakref
from collections.abc import AsyncIterator, Coroutine, Sequence
from operator import attrgetter
from typing import Any

from .concurrency.locks import WeakList
from .concurrency.tasks import Tasks
from .concurrency.timeouts import LONGEST
from .errors import BadKey, ClusterReply, NotAllowed, Refused, is_of_command, turned_down
from .local import LocalPath
from .plan import Plan, Reply
from .plan.arguments import check_number
from .plan.keys import DOCUMENT, Keys, keys_of
from .plan.paths import LONGEST_TOP_KEY, Pattern, check_namespace, check_top_key, escaped
from .plan.shapes import ShapeCache
from .ships.base import SpecialDatatypeShip
from .ships.registry import Ships, default_ships
from .transport import NewTransport, Transport, drive, scanned
from .transport.options import Options, look_nearby
from .transport.protocol import CommandRecorder
from .transport.state import StartupWait

_FRESH = 3.0  # seconds for which the first notices of a publisher about a key go to all nodes of a cluster
_QUIET = 60.0
"""After this silence (seconds) a publisher's notices of a key go to all nodes again: clients may have begun to look for
keys by pattern while the key was gone."""

_KEPT = 10_000  # top-level keys whose last numbers a publisher remembers


class PublisherIdentity:
    """A publisher as subscribers know it: its id, and the number of its last update of each top-level key.

    Of more than 10,000 keys, those that were published longest ago are forgotten. A key that is published again after
    that gets another id and starts from 1: numbers of one id never go back.
    """

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self._begin_numbers()

    def _begin_numbers(self) -> None:
        self._pid = os.getpid()
        self.publisher = secrets.token_hex(6)
        # By channel: id and number, when that update was, and until when the key is fresh.
        self._last: collections.OrderedDict[str, tuple[str, int, float, float]] = collections.OrderedDict()

    def stamp(self, keys: Keys) -> tuple[str, int]:
        """Return the publisher's id, and the number of its next update of a top-level key."""
        if self._pid != os.getpid():  # a forked child is another publisher
            self._begin_numbers()
        channel, now = keys.channel, time.monotonic()
        # No lock between threads: calls on one key come one after the other (`Transport.ordered`), and those on other
        # keys touch other entries.
        publisher, number, before, fresh = self._last.get(channel) or (self.publisher, 0, -math.inf, 0.0)
        if now - before > _QUIET:
            fresh = now + _FRESH
        self._last[channel] = publisher, number + 1, now, fresh
        with contextlib.suppress(KeyError):  # another thread has just forgotten a key
            self._last.move_to_end(channel)
            if len(self._last) > _KEPT:
                self.publisher = secrets.token_hex(6)  # first: a key that comes back must not get the id it had
                self._last.popitem(last=False)
        return publisher, number + 1

    def take_back(self, keys: Keys, stamp: tuple[str, int]) -> None:
        """Make the number of a stamp free again, if it was the last.

        The caller holds the turn of the key, see `Transport.ordered`. If a call out of a `__del__` has published in
        between, the number is never used.
        """
        last = self._last.get(keys.channel)
        if last is not None and last[:2] == stamp:
            self._last[keys.channel] = stamp[0], stamp[1] - 1, -math.inf, last[3]  # nothing was published: still quiet

    def is_fresh(self, keys: Keys) -> bool:
        """Return whether this publisher has just begun with a top-level key of a cluster, which others may not know.

        Notices go to the key's own node. Clients that find keys by pattern do not follow a new key there yet.
        """
        last = self._last.get(keys.channel) if self.transport.sharded else None
        return last is not None and time.monotonic() < last[3]

    def recent(self, seconds: float) -> list[str]:
        since = time.monotonic() - seconds
        if self._pid != os.getpid():  # what is there was published by the parent
            return []
        # A list first: another thread may publish meanwhile.
        return [channel for channel, last in reversed([*self._last.items()]) if last[2] >= since]


class Activities:
    """What a program does, for `RedisInterface.nodes`. Any thread may call."""

    def __init__(self, namespace: str) -> None:
        self._namespace = namespace
        # By process, each name as often as it was added; each step is one of C. A forked child serves nothing.
        self._serves: list[tuple[int, str]] = []
        self.publishers: WeakList[PublisherIdentity] = WeakList()
        self.leases: WeakList[Any] = WeakList()  # of coordination/lease.py

    def add_service(self, name: str) -> None:
        self._serves.append((os.getpid(), name))

    def remove_service(self, name: str) -> None:
        with contextlib.suppress(ValueError):
            self._serves.remove((os.getpid(), name))

    def told(self, seconds: float, most: int) -> dict[str, list[str]]:
        channels = [channel for publisher in self.publishers for channel in publisher.recent(seconds)]
        names = {
            "publishes": [channel[1 : channel.index("}")].removeprefix(self._namespace) for channel in channels],
            "serves": [name for pid, name in list(self._serves) if pid == os.getpid()],
            "owns": [lease.keys.name for lease in self.leases if lease.is_held],
        }
        return {kind: sorted({*found[:most]}) for kind, found in names.items()}


class Session(PublisherIdentity):
    """A server as one interface sees it; the arguments are those of the interface."""

    def __init__(
        self,
        host: Any,
        ships: Sequence[SpecialDatatypeShip] | None,
        namespace: str,
        timeout: float,
        options: dict[str, Any],
        new_transport: NewTransport,
        local: LocalPath,
        wait: float,
    ) -> None:
        check_number("wait", wait, "use seconds, 0 or more")
        self.namespace = check_namespace(namespace)
        # A key on the server has at most 512 bytes, the namespace included.
        self._room = LONGEST_TOP_KEY - len(namespace.encode())
        self.ships = Ships(default_ships() if ships is None else ships, CommandRecorder)
        self.cache = ShapeCache()
        self.options, transport = _transport_to(host, timeout, options, new_transport)
        super().__init__(transport)
        self.transport.states.startup = StartupWait(min(float(wait), LONGEST))
        self.local = local
        self.interface: Any = None  # the interface this belongs to: pickled in its place
        self.activities = Activities(namespace)
        self.activities.publishers.add(self)
        # The subscription manager, made by the first subscriber; see `pubsub.manager.manager_of`.
        self.subscriptions: Any = None
        # The background tasks of publishers, or the blocking front's `Threads`; ended by `close`.
        self.tasks: Any = Tasks()
        # The `Outage`s of its publishers: `finish` is called before this is closed, `close` then.
        self.closing: weakref.WeakSet[Any] = weakref.WeakSet()
        self.closed = False  # whether it is closed, or about to be
        self._raw: Session | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return attrgetter("session"), (self.interface,)

    @property
    def raw(self) -> Session:
        """The same session for what passes pictures on as they are: its ships do not decode them.

        What follows updates through it has a connection of its own.
        """
        if self.ships.raw is self.ships:
            return self
        if self._raw is None:
            self._raw = object.__new__(Session)
            self._raw.__dict__.update(self.__dict__, ships=self.ships.raw, subscriptions=None)
        return self._raw

    def _managers(self) -> list[Any]:
        managers = [self.subscriptions, self._raw and self._raw.subscriptions]
        return [each for each in managers if each is not None]

    def share_with(self, other: Session) -> None:
        """Have both be one interface for its user: one state, and one list of what the program does."""
        self.transport.states = other.transport.states
        other.activities.publishers.add(self)
        self.activities = other.activities

    def keys(self, name: object) -> Keys:
        """Return the server-side names of the top-level key `name`; raises BadKey."""
        return keys_of(check_top_key(name, self._room), self.namespace, self.options.database, self.transport.sharded)

    async def names(self, pattern: Pattern) -> AsyncIterator[str]:
        """Yield the top-level keys that a pattern names, in no order, each once; a round trip for about 1000 keys."""
        seen: set[str] = set()
        async for page in scanned(self.transport, escaped(self.namespace) + pattern.glob, DOCUMENT):
            for document in page:
                name = self._name(document)
                if name is not None and name not in seen:
                    seen.add(name)
                    yield name

    def _name(self, document: bytes) -> str | None:
        try:
            return self.keys(document.decode()[len(self.namespace) :]).name
        except (UnicodeDecodeError, BadKey):
            return None

    def run(self, plan: Plan, at: Transport | None = None) -> Coroutine[Any, Any, Any]:
        """Run a plan and those that follow from its replies, `at` one server or where their keys are."""
        return drive(at or self.transport, plan)

    async def initialize(self) -> None:
        await self.ships.ready()
        # Any key will do: the test is whether the server knows the command and the user may send it.
        await self.run(Plan([("JSON.TYPE", f"{self.namespace}reem")], self._check_server))

    def _check_server(self, replies: Sequence[Reply]) -> None:
        (reply,) = replies
        # A missing right to JSON commands is an error; a missing right to this key is not.
        elsewhere = isinstance(reply, NotAllowed) and not is_of_command(reply)
        if isinstance(reply, Refused | ClusterReply) and not elsewhere:
            raise turned_down(reply).at(self.options.address)

    async def release(self) -> None:
        """End all subscriptions and close all connections of this event loop; another one may go on."""
        managers, self.subscriptions = self._managers(), None
        if self._raw is not None:
            self._raw.subscriptions = None
        # The steps run from the last to the first, each even if another one is cancelled.
        async with contextlib.AsyncExitStack() as steps:
            steps.push_async_callback(self.transport.release)
            steps.push_async_callback(self.tasks.end)
            for each in managers:
                steps.push_async_callback(each.close)
            steps.push_async_callback(self.finish)

    async def finish(self, *, is_exit: bool = False) -> None:
        """Send what publishers have queued, for a limited time; at exit, later updates are sent by their calls."""
        for each in list(self.closing):
            await each.finish(is_exit=is_exit)

    async def close(self) -> None:
        self.closed = True
        async with contextlib.AsyncExitStack() as steps:  # as above
            steps.callback(self.local.close)
            steps.push_async_callback(self.tasks.end)
            for each in list(self.closing):
                steps.callback(each.close)
            # Before the background tasks: their calls end with InterfaceClosed, and `closing` counts kept updates.
            steps.push_async_callback(self.transport.close)
            for each in self._managers():
                steps.push_async_callback(each.close)
            steps.push_async_callback(self.finish)


def _transport_to(
    host: Any, timeout: float, options: dict[str, Any], new_transport: NewTransport
) -> tuple[Options, Transport]:
    """Return how to reach what `host` names, and the transport to it. Nothing is connected yet."""
    url = host if isinstance(host, str) else getattr(host, "url", "")
    # Imported only where an address asks for it: a program for one server starts without it.
    if url.startswith(("redis+cluster://", "rediss+cluster://")):
        from .transport.cluster import ClusterOptions, ClusterTransport

        nodes = ClusterOptions(url, timeout, options)
        return nodes, ClusterTransport(nodes, new_transport)
    if url.startswith(("redis+sentinel://", "rediss+sentinel://")):
        from .transport.sentinel import SentinelOptions, SentinelTransport

        watched = SentinelOptions(url, timeout, options)
        return watched, SentinelTransport(watched, new_transport)
    one = Options(host, timeout, options)
    if one.settings.get("host", "localhost") == "localhost":  # a number means TCP
        look_nearby(one)
    return one, new_transport(one)
