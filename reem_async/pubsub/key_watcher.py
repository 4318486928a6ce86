"""Patterns of channels in a cluster, where servers have none: the keys are looked for, and each is followed.

A key that is found a moment after it was made would have been published to already. So publishers
tell all nodes what they publish in their first seconds with a key, by a channel of the old kind, for
which there are patterns; a listener that hears of a key this way follows it from then on. A `ReorderBuffer` for each
key puts in one order what is heard in both ways.
"""

from __future__ import annotations

import asyncio
import collections
import logging
import re
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

from ..concurrency.tasks import Tasks
from ..errors import InterfaceClosed, RedisError
from ..plan.keys import DOCUMENT, keys_of
from ..plan.notices import Notice
from ..plan.paths import fits
from ..session import QUIET
from ..transport import Transport, scanned
from ..transport.wire import Wire
from .finder import find_regularly
from .listeners import Beginning, Listener, Topic
from .reorder import ReorderBuffer

logger = logging.getLogger("reem.subscribe")

# Seconds between looks whether a key is settled, and how often: a second in all, twice what a buffer waits.
_MOMENT, _MOMENTS = 0.005, 200

_GONE = QUIET + 30.0
"""Seconds without a key and without an update of it until it is dropped: by then no publisher still assumes that this
process follows the key."""

_MOST = 10_000  # keys whose publishers are remembered, at most: any client may announce any number of keys to all nodes

_TAIL = "}:notices"
_ESCAPED = re.compile(r"\\(.)", re.DOTALL)


class Subscriptions(Protocol):
    """What is needed of the subscription manager, which imports this module."""

    transport: Transport
    tasks: Tasks

    async def follow_here(self, listener: Listener) -> None: ...
    async def follow_all(self, listeners: Sequence[Listener]) -> None: ...
    async def unfollow(self, listener: Listener) -> None: ...
    async def unfollow_here(self, listener: Listener) -> None: ...


class KeyWatcher:
    """Follows, for each listener to a pattern, all keys that there are, and those that come to be."""

    def __init__(self, manager: Subscriptions) -> None:
        self._manager = manager
        self._followed: weakref.WeakKeyDictionary[Listener, dict[bytes, _KeyListener]] = weakref.WeakKeyDictionary()
        self._new_keys: weakref.WeakKeyDictionary[Listener, _NewKeysListener] = weakref.WeakKeyDictionary()
        self._looking: asyncio.Task[Any] | None = None

    async def follow(self, listener: Listener) -> None:
        """Follow all keys that there are now; those that come to be are found within a second."""
        self._followed[listener] = {}
        try:
            name = literal(_glob(listener))
            # A pattern that is a name: nothing has to be looked for.
            if name is not None:  # it need not be there yet
                await self._found(listener, [name.encode()], late=False)
                return
            new_keys = self._new_keys[listener] = _NewKeysListener(self, listener)
            # First the channel to all nodes, then the look: a key that is made in between is heard of.
            await self._manager.follow_here(new_keys)
            await self._look(listener, late=False)
            new_keys.looked()
        except BaseException:
            await self.unfollow(listener)
            raise
        if self._looking is None or self._looking.done():
            self._looking = self._manager.tasks.start(find_regularly(self._look_for_all), "reem discovery")

    def listeners(self) -> list[Listener]:
        """Return the listeners to patterns: the manager itself only has their keys. Any thread may ask."""
        return [listener for each in self._followed.keyrefs() if (listener := each()) is not None]

    async def unfollow(self, listener: Listener) -> None:
        for key_listener in self._followed.pop(listener, {}).values():
            await self._manager.unfollow(key_listener)
        new_keys = self._new_keys.pop(listener, None)
        if new_keys is not None:
            await self._manager.unfollow_here(new_keys)

    def heard(self, listener: Listener, document: bytes) -> None:
        new_keys = self._new_keys.get(listener)
        if new_keys is None or document in self._followed.get(listener, {document: None}):
            return
        # Collected while others are being followed: many keys are made at once, and each subscription is a round trip.
        new_keys.fresh[document] = None
        if not new_keys.following:
            new_keys.following = True
            self._manager.tasks.start(self._follow_fresh(listener, new_keys), "reem discovery of new keys")

    async def _follow_fresh(self, listener: Listener, new_keys: _NewKeysListener) -> None:
        try:
            while new_keys.fresh:
                found, new_keys.fresh = list(new_keys.fresh), {}
                await self._found(listener, found, late=True)
        except (RedisError, OSError, InterfaceClosed) as error:
            logger.debug("new keys are not followed yet: %s", error)
        finally:
            new_keys.following = False

    async def settled(self, channels: Iterable[bytes] | None) -> None:
        """Return when keys are heard of at their own nodes only, where a PING is behind their notices.

        Waits a second at most: for the keys of some channels, which are followed if they were not found yet, or for
        all that are followed.
        """
        for channel in channels or ():
            for listener, new_keys in list(self._new_keys.items()):
                if fits(listener.topic.name, channel):
                    document = _document(channel)
                    new_keys.buffer(channel, here=document in self._followed.get(listener, ()))
                    self.heard(listener, document)
        for _ in range(_MOMENTS):
            if all(new_keys.is_settled(channels) for new_keys in list(self._new_keys.values())):
                return
            await asyncio.sleep(_MOMENT)

    async def _look_for_all(self) -> bool:
        """Search for each listener; return whether any is left. The next one starts this again."""
        failure: Exception | None = None
        for listener in list(self._new_keys):
            try:
                await self._look(listener, late=True)
            except (RedisError, OSError) as error:
                failure = error
        if failure is not None:
            raise failure
        return bool(self._followed)

    async def _look(self, listener: Listener, *, late: bool) -> None:
        """Follow the keys that are not followed yet, and let go of those that are gone."""
        async for page in scanned(self._manager.transport, _glob(listener), DOCUMENT):
            await self._found(listener, page, late=late)
        new_keys, long_ago = self._new_keys.get(listener), time.monotonic() - _GONE
        followed = self._followed.get(listener, {}) if new_keys is not None else {}
        for name in [
            name for name, key_listener in followed.items() if key_listener.begun and key_listener.seen < long_ago
        ]:
            if new_keys is not None and new_keys.forget(followed[name].topic.name):
                key_listener = followed.pop(name)
                key_listener.let_go()
                await self._manager.unfollow_here(key_listener)

    async def _found(self, listener: Listener, documents: Sequence[bytes], *, late: bool) -> None:
        followed, new_keys = self._followed.get(listener), self._new_keys.get(listener)
        if followed is None:
            return
        now = time.monotonic()
        for name in documents:
            if name in followed:
                followed[name].seen = now
        found = {
            name: _KeyListener(listener, name, new_keys)
            for name in documents
            if name not in followed and b"{" not in name
        }
        followed.update(found)
        for key_listener in found.values():
            if new_keys is not None:
                # If it is late, its first updates may have been published before it was found.
                new_keys.buffer(key_listener.topic.name, here=not late)
        try:
            await self._manager.follow_all(list(found.values()))
        except BaseException:
            for name, key_listener in found.items():
                if not key_listener.begun:
                    followed.pop(name, None)
            raise


def _glob(listener: Listener) -> str:
    """Return the pattern of the documents whose channels a listener's pattern names."""
    return listener.topic.name.decode().removeprefix("{").removesuffix(_TAIL)


def _document(channel: bytes) -> bytes:
    return channel.removeprefix(b"{").removesuffix(_TAIL.encode())


def literal(glob: str) -> str | None:
    """Return the only name that a pattern of the server names, None if there may be others."""
    plain = _ESCAPED.sub("", glob)
    return None if any(sign in plain for sign in "*?[") else _ESCAPED.sub(r"\1", glob)


class _Part(Listener):
    """A part of what the listener to a pattern follows. It holds that listener weakly, so that it can be dropped."""

    def __init__(self, listener: Listener, topic: Topic) -> None:
        super().__init__(topic, listener.max_batch_delay)
        self._listener: Callable[[], Listener | None] = weakref.ref(listener)

    def let_go(self) -> None:
        self._listener = _nobody

    def lost(self, reason: Exception) -> None:
        if self.ready is not None:
            super().lost(reason)
        elif (listener := self._listener()) is not None:
            listener.lost(reason)

    def invalidate(self, channel: bytes) -> None:
        if (listener := self._listener()) is not None:
            listener.invalidate(channel)


def _nobody() -> None:
    return None


class _KeyListener(_Part):
    """One key of a pattern: a listener of the subscription manager that hands everything on."""

    def __init__(self, listener: Listener, document: bytes, new_keys: _NewKeysListener | None) -> None:
        channel = keys_of(document.decode(errors="surrogateescape")).channel
        super().__init__(listener, Topic(channel.encode(errors="surrogateescape")))
        self._new_keys = new_keys  # where its first notices came from, or None if only this key is meant
        self.begun = False  # it is followed
        # When the key was there last, something was heard of it, or it began to be followed
        self.seen = time.monotonic()

    def start(self, wire: Wire, beginning: Beginning) -> None:
        self.begun = True
        self.seen = time.monotonic()
        if self._new_keys is not None:
            self._new_keys.buffer(self.topic.name, here=True).begun()
            self._new_keys.begin(wire, beginning)
        elif (listener := self._listener()) is not None:
            listener.start(wire, beginning)
        super().start(wire, beginning)

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        self.seen = time.monotonic()
        if self._new_keys is not None:
            self._new_keys.buffer(channel, here=True).told_here(notice)
        elif (listener := self._listener()) is not None:
            listener.on_notice(notice, channel)

    def invalidate(self, channel: bytes) -> None:
        self.seen = time.monotonic()
        super().invalidate(channel)


class _NewKeysListener(_Part):
    """What publishers tell all nodes: a listener of the subscription manager."""

    def __init__(self, key_watcher: KeyWatcher, listener: Listener) -> None:
        super().__init__(listener, listener.topic)
        self._key_watcher = key_watcher
        self.fresh: dict[bytes, None] = {}  # the keys that were just heard of, in their order
        self.following = False  # they are about to be followed
        self._telling = False  # of a gap, in this turn of the event loop
        self._buffers: dict[bytes, ReorderBuffer] = {}
        # What came before the first look was over; if the look found its key, it was published before that.
        self._early: collections.deque[tuple[Notice, bytes]] | None = collections.deque(maxlen=_MOST)

    def is_settled(self, channels: Iterable[bytes] | None) -> bool:
        """Return whether the keys of some channels, or all, are listened to at their own nodes only."""
        found = self._buffers.values() if channels is None else map(self._buffers.get, channels)
        return all(buffer is None or buffer.here for buffer in found)

    def buffer(self, channel: bytes, *, here: bool = False) -> ReorderBuffer:
        """Return the buffer of a key; a new one as given, so that of a forgotten key all is taken as it comes."""
        found = self._buffers.get(channel)
        if found is None:
            if len(self._buffers) >= _MOST:
                del self._buffers[next(iter(self._buffers))]
            found = self._buffers[channel] = ReorderBuffer(self._listener, channel, here=here)
        return found

    def forget(self, channel: bytes) -> bool:
        """Forget a key; return False if an update of it waits to be handed on."""
        found = self._buffers.get(channel)
        if found is not None and found.waits:
            return False
        self._buffers.pop(channel, None)
        return True

    def start(self, wire: Wire, beginning: Beginning) -> None:
        self.begin(wire, beginning)
        super().start(wire, beginning)

    def begin(self, wire: Wire, beginning: Beginning) -> None:
        """Let the listener begin. One broken connection is one gap, however many keys resynchronise after it."""
        if beginning is Beginning.AFTER_LOSS:
            if self._telling:
                beginning = Beginning.FIRST
            else:
                self._telling = True
                asyncio.get_running_loop().call_soon(self._told)
        if (listener := self._listener()) is not None:
            listener.start(wire, beginning)

    def _told(self) -> None:
        self._telling = False

    def looked(self) -> None:
        """The first look is over: hand on what came of keys that are newer."""
        early, self._early = self._early or (), None
        for notice, channel in early:
            self.on_notice(notice, channel)

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        if (listener := self._listener()) is None:
            return
        if self._early is not None:
            self._early.append((notice, channel))
            return
        self.buffer(channel).told_to_all(notice)
        self._key_watcher.heard(listener, _document(channel))
