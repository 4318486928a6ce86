"""One order for what is heard of a key in two ways, while a pattern's listener changes from one to the other.

In its first seconds with a key a publisher notifies all nodes of a cluster, and a listener that searches for keys hears
of it over one connection. From then on the key is followed at its own node, over another connection. Each way brings
the updates in the server's order, but either may be behind: nodes pass on what is sent to all up to 50 ms late. So
what comes at the key's node waits until the other way has brought all that is older, and nothing that is still on
its way is taken for lost. From then on the key's node is the only one listened to.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..plan.notices import Notice

if TYPE_CHECKING:
    from .gaps import Stamp
    from .listeners import Listener

_PATIENCE = 0.5  # seconds to wait for what is older: ten times as long as nodes took to pass it on
_REMEMBERED = 5.0
"""Seconds for which is remembered what all nodes were told, once the key's own node is listened to: it may be late."""
_MOST = 10_000  # updates that wait or are remembered: anybody may publish under made-up names


class ReorderBuffer:
    """What one listener hears of one key, in order.

    Args:
        listener: Returns the listener, None if it was dropped.
        channel: The key's channel.
        here: The key's node is the only one listened to: it brings all that the listener must hear.

    Attributes:
        here: As above, by now.
    """

    def __init__(self, listener: Callable[[], Listener | None], channel: bytes, *, here: bool = False) -> None:
        self.here = here
        self._listener = listener
        self._channel = channel
        self._told: dict[Stamp, None] = {}  # what all nodes were told: it comes at the key's node too
        self._ahead: dict[str, tuple[int, float]] = {}  # of these the highest number of each publisher, with its time
        self._waiting: list[Notice] = []  # what came at the key's node and may be ahead of the other way
        self._first: dict[str, int] = {}  # of these the first number of each publisher
        self._timer: asyncio.TimerHandle | None = None  # ends the waiting, and later the remembering

    @property
    def waits(self) -> bool:
        """Whether an update has come and is not handed on yet."""
        return bool(self._waiting)

    def told_to_all(self, notice: Notice) -> None:
        """Take an update that its publisher sent to all nodes."""
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
        """Take an update that came at the key's own node."""
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
