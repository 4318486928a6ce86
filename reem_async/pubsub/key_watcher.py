"""Patterns of channels in a cluster, where servers have none: the keys are looked for, and each is followed.

In its first seconds with a key a publisher notifies all nodes by a channel of the old kind, for which there are
patterns. A listener that hears of a key this way follows it at its own node from then on, over another connection.

Each way brings the updates in the server's order, but either may be behind: nodes pass on what is sent to all up to
50 ms late. So what comes at the key's node waits in a `ReorderBuffer` until the other way has brought all that is
older. From then on the key's node is the only one listened to.
"""

from __future__ import annotations

import asyncio
import collections
import logging
import re
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from ..errors import InterfaceClosed, RedisError
from ..plan.keys import DOCUMENT, keys_of
from ..plan.notices import Notice
from ..plan.paths import fits
from ..transport import scanned
from ..transport.wire import Wire
from .division import Stamp
from .listeners import Beginning, Listener, Topic
from .refresh import find_regularly

logger = logging.getLogger("reem.subscribe")

# Seconds between looks whether a key is settled, and how often: a second in all, twice what a buffer waits.
_MOMENT, _MOMENTS = 0.005, 200

_MOST = 10_000  # keys, and updates of a key, that are remembered: any client may announce any number to all nodes

_TAIL = "}:notices"
_ESCAPED = re.compile(r"\\(.)", re.DOTALL)


_PATIENCE = 0.5  # seconds to wait for what is older: ten times as long as nodes took to pass it on
_REMEMBERED = 5.0  # seconds for which it is remembered what came of all nodes, once the key's own is listened to


class KeyWatcher:
    """Follows, for each listener to a pattern, all keys that there are, and those that come to be."""

    def __init__(self, manager: Any) -> None:
        self._manager = manager  # the subscription manager, which imports this module
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
        for listener in list(self._new_keys):
            await self._look(listener, late=True)
        return bool(self._followed)

    async def _look(self, listener: Listener, *, late: bool) -> None:
        async for page in scanned(self._manager.transport, _glob(listener), DOCUMENT):
            await self._found(listener, page, late=late)

    async def _found(self, listener: Listener, documents: Sequence[bytes], *, late: bool) -> None:
        followed, new_keys = self._followed.get(listener), self._new_keys.get(listener)
        if followed is None:
            return
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

    def lost(self, reason: Exception) -> None:
        if self.ready is not None:
            super().lost(reason)
        elif (listener := self._listener()) is not None:
            listener.lost(reason)

    def invalidate(self, channel: bytes) -> None:
        if (listener := self._listener()) is not None:
            listener.invalidate(channel)


class _KeyListener(_Part):
    """One key of a pattern: a listener of the subscription manager that hands everything on."""

    def __init__(self, listener: Listener, document: bytes, new_keys: _NewKeysListener | None) -> None:
        channel = keys_of(document.decode(errors="surrogateescape")).channel
        super().__init__(listener, Topic(channel.encode(errors="surrogateescape")))
        self.local = listener.local
        self._new_keys = new_keys  # where its first notices came from, or None if only this key is meant
        self.begun = False  # it is followed

    def start(self, wire: Wire, beginning: Beginning) -> None:
        self.begun = True
        if self._new_keys is not None:
            self._new_keys.buffer(self.topic.name, here=True).begun()
            self._new_keys.begin(wire, beginning)
        elif (listener := self._listener()) is not None:
            listener.start(wire, beginning)
        super().start(wire, beginning)

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        if self._new_keys is not None:
            self._new_keys.buffer(channel, here=True).told_here(notice)
        elif (listener := self._listener()) is not None:
            listener.on_notice(notice, channel)


class _NewKeysListener(_Part):
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
        found = self._buffers.values() if channels is None else map(self._buffers.get, channels)
        return all(buffer is None or buffer.here for buffer in found)

    def buffer(self, channel: bytes, *, here: bool = False) -> ReorderBuffer:
        found = self._buffers.get(channel)
        if found is None:
            if len(self._buffers) >= _MOST:
                del self._buffers[next(iter(self._buffers))]
            found = self._buffers[channel] = ReorderBuffer(self._listener, channel, here=here)
        return found

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
                asyncio.get_running_loop().call_soon(setattr, self, "_telling", False)
        if (listener := self._listener()) is not None:
            listener.start(wire, beginning)

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


class ReorderBuffer:
    """What one listener hears of one key, in order."""

    def __init__(self, listener: Callable[[], Listener | None], channel: bytes, *, here: bool = False) -> None:
        self.here = here  # the key's node is the only one listened to, from the beginning or by now
        self._listener = listener
        self._channel = channel
        self._told: dict[Stamp, None] = {}  # what all nodes were told: it comes at the key's node too
        self._ahead: dict[str, tuple[int, float]] = {}  # of these the highest number of each publisher, with its time
        self._waiting: list[Notice] = []  # what came at the key's node and may be ahead of the other way
        self._first: dict[str, int] = {}  # of these the first number of each publisher
        self._timer: asyncio.TimerHandle | None = None  # ends the waiting, and later the remembering

    @property
    def waits(self) -> bool:
        return bool(self._waiting)

    def told_to_all(self, notice: Notice) -> None:
        stamp = notice.publisher, notice.sequence, notice.time
        if self.here or stamp in self._told:
            return
        first = self._first.get(notice.publisher)
        if first is not None and notice.sequence >= first:  # this way has caught up: all that is older was told
            self._settle()
            return
        if len(self._told) >= _MOST:
            self._forget()
        self._told[stamp] = None
        self._ahead[notice.publisher] = max(self._ahead.get(notice.publisher, (0, 0.0)), stamp[1:])
        self._tell(notice)

    def begun(self) -> None:
        """The key is followed at its own node: what is published from now on comes there."""
        if not self.here and self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(_PATIENCE, self._give_up)

    def told_here(self, notice: Notice) -> None:
        if self.here:
            self._tell_once(notice)
            return
        self.begun()
        self._waiting.append(notice)
        self._first.setdefault(notice.publisher, notice.sequence)
        is_told = (notice.publisher, notice.sequence, notice.time) in self._told  # then all that is older was, too
        if is_told or len(self._waiting) >= _MOST:
            self._settle()

    def _give_up(self) -> None:
        """Wait no longer: older updates were lost, if there were any."""
        listener = self._listener()
        if listener is not None and any(
            number > 1 and publisher not in self._ahead for publisher, number in self._first.items()
        ):  # how many is unknown
            listener.invalidate(self._channel)
        self._settle()

    def _settle(self) -> None:
        """Hand on what waits, and listen to the key's own node only from now on."""
        if self._timer is not None:
            self._timer.cancel()
        self.here = True
        waiting, self._waiting, self._first = self._waiting, [], {}
        for notice in waiting:
            self._tell_once(notice)
        self._timer = asyncio.get_running_loop().call_later(_REMEMBERED, self._forget) if self._told else None

    def _forget(self) -> None:
        self._told.clear()
        self._ahead.clear()

    def _tell_once(self, notice: Notice) -> None:
        """Hand on what came at the key's node, unless that was done before, or what is newer was handed on.

        A number far ahead, or of an earlier time, is one that a stranger made up: it must not hide what is lower.
        """
        number, time = self._ahead.get(notice.publisher, (0, 0.0))
        is_older = notice.sequence < number <= notice.sequence + _MOST and notice.time <= time
        if not is_older and (notice.publisher, notice.sequence, notice.time) not in self._told:
            self._tell(notice)

    def _tell(self, notice: Notice) -> None:
        listener = self._listener()
        if listener is not None:
            listener.on_notice(notice, self._channel)
