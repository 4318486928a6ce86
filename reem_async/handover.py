"""One order for what is heard of a key in two ways, while a pattern's listener changes from one to the other.

In its first seconds with a key a publisher tells all nodes of a cluster, and whoever looks for keys hears of it
over one connection. From then on the key is followed at its own node, over another connection. Each way brings a
publisher's updates in their order, but either may be behind: nodes pass on what all are told up to 50 ms late. So
what comes at the key's node waits until the other way has brought all that is older, and nothing that is still on
its way is taken for lost. From then on the key's node is the only one listened to.
"""

from __future__ import annotations

import asyncio
import weakref
from typing import TYPE_CHECKING

from .plan.notices import Notice

if TYPE_CHECKING:
    from .audience import Listener

__all__ = ["Handover"]

_PATIENCE = 0.5
"""Seconds to wait for what is older: ten times as long as nodes took to pass it on."""
_MOST_WAITING = 10_000
_MOST_PUBLISHERS = 1000


class _Sender:
    """What was heard of one publisher.

    Attributes:
        last: The number of the last update that was handed on, 0 for none.
        here: The key's node is the only one listened to.
        waiting: What came there and is ahead of the other way.
        timer: Ends the waiting.
    """

    __slots__ = ("here", "last", "timer", "waiting")

    def __init__(self) -> None:
        self.last = 0
        self.here = False
        self.waiting: list[Notice] = []
        self.timer: asyncio.TimerHandle | None = None


class Handover:
    """What one listener hears of one key, in order.

    Args:
        listener: Who is told.
        channel: The key's channel.

    Attributes:
        late: The key was found after the listener had begun, so its first updates may have been missed.
    """

    def __init__(self, listener: weakref.ref[Listener], channel: bytes) -> None:
        self.late = False
        self._listener = listener
        self._channel = channel
        self._senders: dict[str, _Sender] = {}

    @property
    def waits(self) -> bool:
        """Whether something has come and is not handed on yet."""
        return any(sender.waiting for sender in self._senders.values())

    def told_to_all(self, notice: Notice) -> None:
        """Take what all nodes were told."""
        sender = self._sender(notice.publisher)
        if sender.here or notice.sequence <= sender.last:
            return
        if sender.waiting and notice.sequence >= sender.waiting[0].sequence:  # all that is older would be here
            self._settle(sender)
            return
        self._tell(sender, notice)
        if sender.waiting and sender.waiting[0].sequence == sender.last + 1:
            self._settle(sender)

    def told_here(self, notice: Notice) -> None:
        """Take what was told at the key's own node."""
        sender = self._sender(notice.publisher)
        if sender.here:
            if notice.sequence > sender.last:  # the other way may have been ahead
                self._tell(sender, notice)
            return
        sender.waiting.append(notice)
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
        """Wait no longer: what is older was lost."""
        listener = self._listener()
        if listener is not None and not sender.last:  # nobody can tell how much
            listener.doubt()
        self._settle(sender)

    def _settle(self, sender: _Sender) -> None:
        """Hand on what waits, and listen to the key's node only from now on."""
        if sender.timer is not None:
            sender.timer.cancel()
            sender.timer = None
        sender.here = True
        waiting, sender.waiting = sender.waiting, []
        for notice in waiting:
            if notice.sequence > sender.last:
                self._tell(sender, notice)

    def _tell(self, sender: _Sender, notice: Notice) -> None:
        sender.last = notice.sequence
        listener = self._listener()
        if listener is not None:
            listener.on_notice(notice, self._channel)
