"""One order for what is heard of a key in two ways, while a pattern's listener changes from one to the other.

In its first seconds with a key a publisher notifies all nodes of a cluster, and a listener that searches for keys hears
of it over one connection. From then on the key is followed at its own node, over another connection. Each way brings a
publisher's updates in their order, but either may be behind: nodes pass on what is sent to all up to 50 ms late. So
what comes at the key's node waits until the other way has brought all that is older, and nothing that is still on
its way is taken for lost. From then on the key's node is the only one listened to.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..plan.notices import Notice

if TYPE_CHECKING:
    from .listeners import Listener

_PATIENCE = 0.5
"""Seconds to wait for what is older: ten times as long as nodes took to pass it on."""
_REMEMBERED = 5.0
"""Seconds for which is remembered what all nodes were told, once the key's own node is listened to: it may be late."""
# Bounds, in updates and in publishers: anybody may publish under made-up names.
_MOST_WAITING = 10_000
_MOST_PUBLISHERS = 1000


class _Sender:
    """What was heard of one publisher.

    Attributes:
        last: The number of the last update that was handed on, 0 for none.
        told: What was handed on because all nodes were told, by number and time: it comes at the key's node too.
        ahead: The one of these with the highest number.
        here: The key's node is the only one listened to.
        waiting: What came there and is ahead of the other way.
        timer: Ends the waiting, and later the remembering.
    """

    __slots__ = ("ahead", "here", "last", "timer", "told", "waiting")

    def __init__(self) -> None:
        self.last = 0
        self.told: dict[tuple[int, float], None] = {}
        self.ahead = 0, 0.0
        self.here = False
        self.waiting: list[Notice] = []
        self.timer: asyncio.TimerHandle | None = None

    def note(self, stamp: tuple[int, float]) -> None:
        if len(self.told) >= _MOST_WAITING:
            del self.told[next(iter(self.told))]
        self.told[stamp] = None
        self.ahead = max(self.ahead, stamp)

    def forget(self) -> None:
        self.told.clear()
        self.ahead = 0, 0.0

    def is_past(self, stamp: tuple[int, float]) -> bool:
        """Return whether what came at the key's node was handed on before, or what is newer was.

        A number far ahead, or of an earlier time, is one that a stranger made up: it must not hide what is lower.
        """
        number, time = self.ahead
        return stamp in self.told or (stamp[0] < number <= stamp[0] + _MOST_WAITING and stamp[1] <= time)


class ReorderBuffer:
    """What one listener hears of one key, in order.

    Args:
        listener: Returns the listener, None if it was dropped.
        channel: The key's channel.

    Attributes:
        late: The key was found after the listener had begun, so its first updates may have been missed.
    """

    def __init__(self, listener: Callable[[], Listener | None], channel: bytes) -> None:
        self.late = False
        self._listener = listener
        self._channel = channel
        self._senders: dict[str, _Sender] = {}

    @property
    def waits(self) -> bool:
        """Whether an update has come and is not handed on yet."""
        return any(sender.waiting for sender in self._senders.values())

    def told_to_all(self, notice: Notice) -> None:
        """Take an update that its publisher sent to all nodes."""
        sender = self._sender(notice.publisher)
        if sender.here or (notice.sequence, notice.time) in sender.told:
            return
        # This way has caught up with what came at the key's node first.
        if sender.waiting and notice.sequence >= sender.waiting[0].sequence:  # all that is older would be here
            self._settle(sender)
            return
        sender.note((notice.sequence, notice.time))
        self._tell(sender, notice)
        if sender.waiting and sender.waiting[0].sequence == sender.last + 1:
            self._settle(sender)

    def told_here(self, notice: Notice) -> None:
        """Take an update that came at the key's own node."""
        sender = self._sender(notice.publisher)
        if sender.here:
            self._tell_once(sender, notice)  # the other way may have been ahead
            return
        sender.waiting.append(notice)
        # Nothing older is missing: it follows what was handed on, or is the first word of a key that was there before.
        begins = notice.sequence <= sender.last + 1 or not (sender.last or self.late)
        if begins or len(sender.waiting) >= _MOST_WAITING:
            self._settle(sender)
        elif sender.timer is None:
            sender.timer = asyncio.get_running_loop().call_later(_PATIENCE, self._give_up, sender)

    def _sender(self, publisher: str) -> _Sender:
        sender = self._senders.get(publisher)
        if sender is None:
            if len(self._senders) >= _MOST_PUBLISHERS:  # what is forgotten is taken as it comes
                self._senders.clear()
                self.late = False
            sender = self._senders[publisher] = _Sender()
        return sender

    def _give_up(self, sender: _Sender) -> None:
        """Wait no longer: older updates were lost."""
        listener = self._listener()
        if listener is not None and not sender.last:  # how much is unknown
            listener.invalidate(self._channel)
        self._settle(sender)

    def _settle(self, sender: _Sender) -> None:
        """Hand on what waits, and listen to the key's own node only from now on."""
        if sender.timer is not None:
            sender.timer.cancel()
        sender.here = True
        waiting, sender.waiting = sender.waiting, []
        for notice in waiting:
            self._tell_once(sender, notice)
        sender.timer = asyncio.get_running_loop().call_later(_REMEMBERED, sender.forget) if sender.told else None

    def _tell_once(self, sender: _Sender, notice: Notice) -> None:
        if not sender.is_past((notice.sequence, notice.time)):
            self._tell(sender, notice)

    def _tell(self, sender: _Sender, notice: Notice) -> None:
        sender.last = notice.sequence
        listener = self._listener()
        if listener is not None:
            listener.on_notice(notice, self._channel)
