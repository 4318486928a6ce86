"""What begins and ends to follow, for plain scripts, and loops over what the core's streams yield."""

from __future__ import annotations

from typing import Any, Self

from reem_async.concurrency.queues import EMPTY, Ended
from reem_async.concurrency.streams import next_on_thread
from reem_async.coordination.presence import NodeWatch as NodeWatchCore
from reem_async.errors import InterfaceClosed
from reem_async.pubsub import subscribers as core

from ._twin import documented_by, shares, waits


class Following:
    """What begins to follow in `listen` and ends in `close`; `with` calls both."""

    def listen(self) -> None:
        """Begin to follow."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop following."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@documented_by(core.Watch)
class Watch(Following):
    """Follows one path and yields its updates, one by one: an iterator.

    Follows from the first `for` or `with` on. The first update is the value that is already there,
    if any (`initial`). Leaving a loop with `break` keeps following until the watch is closed or
    dropped.

    Args:
        interface: The server.
        watch: The core's, which lives on the background loop.
    """

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


@documented_by(NodeWatchCore)
class NodeWatch(Watch):
    """Yields an event for each program that joins or leaves: an iterator.

    Those that are there come first (`initial`). A program that closes its interface, ends, is killed, stands still or
    loses its network has left within a second. One that comes back joins again, with the same `id` if it is the same
    process.

    Args:
        interface: The server.
    """

    def __init__(self, interface: Any) -> None:
        super().__init__(interface, NodeWatchCore(interface._followers.session))
