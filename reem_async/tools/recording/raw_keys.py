"""Keys of other programs in a recording: each is read when the server says that it was changed.

They are recorded as what is only stored is: several changes in a moment are one.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol

from ...concurrency.queues import Last
from ...errors import BadKey, InterfaceClosed, NotAllowed
from ...plan.paths import Pattern, check_top_key
from ...plan.placeholders import Unfetched, Unreadable
from ...plan.raw import LARGEST
from ...plan.trees import MISSING
from ...pubsub.raw_watch import RawUpdate, RawWatch
from ...session import Session
from .blackbox import BlackBox
from .format import Kind, Role
from .stored import pruned
from .times import Clock
from .writer_thread import Operation, WriterThread

logger = logging.getLogger("reem.recording")

_WAITING = 10_000  # updates that wait for the recorder before the oldest are skipped
_PACE = 0.02  # seconds between two readings
_RATE = 32 << 20  # bytes a second that are read of each key: each picture of a camera of 0.9 MB at 30 Hz


class Owner(Protocol):
    """What is needed of the recorder, which imports this module."""

    session: Session
    writer_thread: WriterThread | BlackBox
    clock: Clock
    patterns: list[Pattern]


class RawRecorder:
    """Records the keys of other programs that the patterns name, if the interface has no namespace."""

    def __init__(self, owner: Owner, tops: Sequence[str]) -> None:
        self._owner = owner
        self.names: dict[str, None] = {}  # the keys that are there
        self._watch = RawWatch(owner.session, tops, Last(_WAITING), LARGEST, pace=_PACE, rate=_RATE, lazy=True)
        self._is_on = bool(tops) and not owner.session.namespace

    async def start(self) -> None:
        """Begin to follow; when this returns, no later change is missed."""
        try:
            if self._is_on:
                await self._watch.listen()
        except NotAllowed as error:  # the recorder has warned that the server does not report changes
            self._is_on = False
            logger.debug("keys of other programs are not recorded: %s", error)

    async def follow(self) -> None:
        """Record what changes, until the end."""
        with suppress(NotAllowed, InterfaceClosed):  # as above: the user may not ask for the types of keys, for example
            while self._is_on:
                self._take(await self._watch.next())
        self._is_on = False

    async def settled(self, seconds: float) -> None:
        """Return when all that was changed before is recorded, or so many seconds are over."""
        if self._is_on:
            await self._watch.caught_up(seconds)

    def look(self, name: str) -> bool:
        """Record a key whose document of REEM was replaced; return whether such keys are recorded."""
        if self._is_on:
            self._watch.look(name)
        return self._is_on

    async def stop(self) -> None:
        await self._watch.close()

    def _take(self, update: RawUpdate) -> None:
        owner, path, value = self._owner, (update.path,), update.value
        try:
            check_top_key(update.path)
        except BadKey:  # a brace: no path of a recording leads there
            return
        size = update.size
        if update.deleted:
            self.names.pop(update.path, None)
            value = MISSING
        else:
            self.names[update.path] = None
            if isinstance(value, Unfetched):
                size = 0
                value = Unreadable(update.path, f"{value.size} bytes: of another program {LARGEST} are recorded")
            value = pruned(value, path, owner.patterns)
        role = Role.STORED if update.origin == "stored" else Role.STATE
        kind = Kind.STORED if role == Role.STORED else Kind.READ
        owner.writer_thread.put(Operation(role, path, value, self._stamp(), kind), size)

    def keyframe(self, number: int) -> None:
        stamp = self._stamp(number)
        for name in self.names:
            self._owner.writer_thread.put(Operation(Role.KEYFRAME, (name,), None, stamp, Kind.READ), 0)

    def _stamp(self, number: int = 0) -> tuple[int, int, int]:
        now = self._owner.clock.stamp()
        return now, now, number
