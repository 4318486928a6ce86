"""Large values from a publisher to subscribers of the same host and user, through shared memory.

The server still gets every update; its notice also says where the bytes are in the publisher's memory, and a
subscriber that can reach them there need not fetch them. This module is what an interface has of it, `segment.py` the
memory of a publisher, the locks on its slots, and the views of a subscriber. `mailbox.py` has datagrams ahead of the
server. What shares memory is imported only where the system has it.

    publisher                                          subscriber
    segment.put(): lock a slot that no reader has
                   stamp 0, copy, new stamp, unlock
    notice (process, descriptor, slot, stamp)  ---->   reader.view(): open, lock, compare the stamp
                                                       the last view is gone: unlock

Whatever goes wrong on the way, the value is fetched from the server, as if this package were not there.
"""

from __future__ import annotations

import collections
import os
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..concurrency.locks import Descriptor
from ..errors import BadValue
from ..plan.keys import Keys
from ..plan.notices import Slot, starts

if TYPE_CHECKING or hasattr(os, "memfd_create"):  # Linux
    from .mailbox import Subscribers, hosts
    from .segment import HEAD, SLOTS, LocalReader, Segment, host


LEAST = 1 << 16  # bytes from which a value goes through shared memory: below, a fetch from the server takes no longer
MEMORY = 256 << 20  # bytes of shared memory of one interface, unless another number is given

_MODES = ("auto", "off", "early")
_SEGMENTS = 64  # keys of one interface that have a segment at a time; each takes two file descriptors
_ASKED = 1.0  # seconds for which an answer holds of how many processes near by listen to a key
_REFUSED = 60.0  # seconds after which a server is asked again that has refused to say
_IDLE = 10.0  # seconds after which a segment that was not written is given up, with the next large value of any key
_GROWTH = 2  # times the room of the segment before, where a value has outgrown that
_KEYS = 1000  # keys whose local audience is cached


class LocalPath:
    """The shared memory of one interface, `memory` bytes at most. Raises BadValue."""

    def __init__(self, mode: Any = "auto", memory: Any = MEMORY) -> None:
        if mode not in _MODES:
            raise BadValue(f"local={mode!r:.40} is none of {', '.join(map(repr, _MODES))}")
        if type(memory) is not int or memory < 0:
            raise BadValue(f"local_memory={memory!r:.40} is not a number of bytes")
        self.early = mode == "early"  # subscribers on this host are notified before the server has an update
        self._off = mode == "off" or memory == 0
        self._memory = memory  # bytes that it may take in all
        self._pid = os.getpid()
        self._segments: dict[str, Segment] = {}
        self._audiences: collections.OrderedDict[str, tuple[int, float]] = collections.OrderedDict()
        # What is made when first used. Not by functools.cached_property: it has a lock in Python 3.11, which a child
        # that is forked meanwhile would find taken for good.
        self._made: dict[str, Any] = {}

    @property
    def reader(self) -> LocalReader:
        """What looks into the memory of publishers near by; only where there is a `host`."""
        reader: LocalReader = self._made.get("reader") or self._made.setdefault("reader", LocalReader())
        return reader

    @property
    def host(self) -> str:
        """What names the processes near by; empty if this is switched off, or cannot be."""
        if self._off or not hasattr(os, "memfd_create"):
            return ""
        return host()

    def channels(self, keys: Keys) -> list[str]:
        """Return the channels of the subscribers near by; early, other containers that share the mailboxes are near."""
        own = self.host
        return [f"{keys.channel}@{each}" for each in (own, *(hosts() - {own} if self.early else ()))]

    def view(self, slot: Slot, size: int, passed: Descriptor | None = None) -> memoryview | None:
        """Return the first bytes of a slot, so many, read-only; None if they are not to be had, or not near by."""
        host = self.host
        return self.reader.view(slot, size, passed, is_near=slot.host == host) if host else None

    @property
    def subscribers(self) -> Subscribers:
        """The subscribers that are notified early; only where there is a `host`."""
        found: Subscribers = self._made.get("subscribers") or self._made.setdefault("subscribers", Subscribers())
        return found

    def is_to_ask(self, keys: Keys) -> bool:
        """Return whether it is not known any more how many near by listen to a key."""
        if self.early:
            for channel in self.subscribers.take_answers():
                self._audiences.pop(channel.decode(errors="replace"), None)
        _, until = self._audiences.get(keys.channel, (0, 0.0))
        return time.monotonic() > until

    def answered(self, keys: Keys, *counts: object) -> int:
        """Note how many near by listen; anything but a number says that it cannot be known. Returns how many did."""
        was = self.audience(keys)
        self._give_up(before=time.monotonic() - _IDLE)  # once a second is enough
        numbers = [each for each in counts if type(each) is int]
        holds, number = (_ASKED, sum(numbers)) if len(numbers) == len(counts) else (_REFUSED, 0)
        self._audiences[keys.channel] = number, time.monotonic() + holds
        while len(self._audiences) > _KEYS:
            self._audiences.popitem(last=False)
        return was

    def audience(self, keys: Keys) -> int:
        return self._audiences.get(keys.channel, (0, 0.0))[0]

    def put(self, keys: Keys, pieces: Sequence[Any], sizes: Sequence[int]) -> Slot | None:
        """Copy an update of a key into shared memory, one at a time; None if there is no room. See `Segment.put`."""
        try:
            segment = self._segment(keys.channel, starts(sizes)[-1])
            written = None if segment is None else segment.put(pieces, sizes)
        except (OSError, ValueError, MemoryError):  # a limit was met, of descriptors, memory or locks
            return None
        if segment is None or written is None:
            return None
        return Slot(self.host, self._pid, segment.descriptor, segment.inode, *written)

    def notify(self, keys: Keys, notice: bytes, *, is_in_slot: bool) -> None:
        """Send an update to the subscribers near by."""
        segment = self._segments.get(keys.channel) if is_in_slot else None
        self.subscribers.notify(keys.channel.encode(), notice, segment.memory if segment else None)

    def _segment(self, channel: str, room: int) -> Segment | None:
        """Return the segment of a key with so many bytes in each slot, made if need be; None if that is too much.

        Without a lock, which a forked child might find taken: each step stands for itself.
        """
        if self._pid != os.getpid():  # those are the parent's: a forked child has its own
            self._pid, self._segments = os.getpid(), {}
        now = time.monotonic()
        segment = self._segments.get(channel)
        if segment is None or segment.shape.room < room:
            self._give_up(before=now - _IDLE)
            others = [each for each in [*self._segments.values()] if each is not segment]
            left = self._memory - sum(each.shape.size for each in others) - HEAD
            if SLOTS * room > left or len(others) >= _SEGMENTS:
                return None  # smaller values still have the one that is there
            if segment is not None:  # readers keep the old ones for a while: of a map that grows, only a few
                room = max(room, min(_GROWTH * segment.shape.room, left // SLOTS))
            self._segments.pop(channel, None)
            segment = None  # its memory goes before the next one's comes
            segment = self._segments[channel] = Segment(room)
        segment.used = now
        return segment

    def _give_up(self, before: float) -> None:
        for channel, segment in [*self._segments.items()]:
            if segment.used < before:
                self._segments.pop(channel, None)

    def close(self) -> None:
        """Give all memory back; what subscribers look into stays as long as they do."""
        self._off = True
        for each in list(self._made.values()):
            each.close()
        self._segments = {}
