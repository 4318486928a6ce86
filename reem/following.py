"""What begins and ends to follow, for plain scripts, and loops over what the core's streams yield."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

from reem_async.concurrency.queues import EMPTY, Ended
from reem_async.concurrency.streams import next_on_thread
from reem_async.coordination.presence import NodeWatch as NodeWatchCore
from reem_async.errors import InterfaceClosed
from reem_async.pubsub import subscribers as core
from reem_async.pubsub.join import Join as JoinCore
from reem_async.transport.state import StateChanges

from ._twin import documented_by, shares, waits


class Following:
    """What begins to follow in `listen` and ends in `close`; `with` calls both."""

    listen: Callable[[], None]
    close: Callable[[], None]

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@documented_by(core.Watch)
class Watch(Following):
    """Follows one path and yields its updates, one by one: an iterator."""

    def __init__(self, interface: Any, watch: Any) -> None:
        self._interface = interface
        self._core = watch

    dropped = shares(core.Watch.dropped)
    listen = waits(core.Watch.listen)

    def close(self) -> None:
        """Stop following and end the loop."""
        try:
            self._interface._wait(self._core.close())
        except InterfaceClosed:  # the event loop that would do it has ended, or is too busy for that
            self._core.queue.close()

    def next(self, timeout: float | None = None) -> Any:
        """Return the next update: as the loop does, but with a time limit."""
        if not self._core._following:
            self.listen()
        return next_on_thread(self._core.queue, timeout)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Any:
        # On the caller's thread: the loop puts updates into the queue and knows nothing of its readers.
        queue = self._core.queue
        try:
            if (update := queue.take()) is EMPTY:
                # A loop need not be told to begin; `listen` has no update missed that is published after it.
                if not self._core._following:
                    self.listen()
                update = queue.take_waiting()
            return update
        except Ended:
            raise StopIteration from None


@documented_by(JoinCore)
class Join(Watch):
    """Yields the time of each update of a first path, and the nearest values of all: an iterator."""

    skipped = shares(JoinCore.skipped)
    paths = property(lambda self: self._core.paths, doc="The paths, the first one first.")


@documented_by(StateChanges)
class StateIterator(Watch):
    """Yields the state as it is, then each change: an iterator; ends when the interface is closed."""


@documented_by(NodeWatchCore)
class NodeWatch(Watch):
    """Yields an event for each program that joins or leaves: an iterator."""
