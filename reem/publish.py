"""Publishing for plain scripts."""

from __future__ import annotations

from typing import Any

from reem_async.store import publish as core

from .accessor import PublishAccessor
from .low_level import Publisher
from .store import KeyValueStore

__all__ = ["PublishSpace", "Publisher"]


class PublishSpace(KeyValueStore):
    """A store that can only be written, and notifies subscribers of every change.

    Written like a `KeyValueStore`. A change and its notice are one transaction; a small value
    travels in the notice, a large one is announced and subscribers fetch the newest.

    In an outage (NotConnected, ConnectionLost or ServerNotReady) `outage` says what becomes of writing, `update` and
    deleting: they raise, or they return at once, until the server answers again.

    - "drop": What is published is dropped, and counted in `dropped`.
    - "newest": The newest update of each place is kept, with the bytes and the time of its call, and sent when the
      server is back, in the order of the calls, each by itself; what a newer one replaces is counted in `dropped`.
      Of more than 256 MB of values, in all, the oldest of a key go first, and are counted.

    Nothing is applied twice: an update that was under way when the connection broke was applied or not, is not sent
    again, and counts as dropped. Dropped updates are reported to subscribers as any lost one is, by `gap`
    and `missed`. `append`, `extend` and arithmetic depend on what is there, so they raise in an outage whatever is
    said; where the server is back they come behind what is kept. What the server refuses is logged and counted, and
    closing the interface drops what is still kept. The beginning and the end of an outage are logged ("reem.publish").

    Args:
        interface: The server: a RedisInterface, a store, or what RedisInterface takes as host.
        outage: What to do in an outage: "raise", "drop" or "newest".
        options: With a host, what else RedisInterface takes.
    """

    _accessor = PublishAccessor

    def __init__(self, interface: Any = None, outage: str = "raise", **options: Any) -> None:
        super().__init__(interface, **options)
        self.outage = outage
        # In place of the one that KeyValueStore has made, which knows no outages; neither has sent anything.
        self._core: core.PublishSpace = core.PublishSpace(self.interface._core, outage)

    @property
    def dropped(self) -> int:
        """How many updates this has not published because of outages, or not for certain."""
        return self._core.dropped

    @property
    def waiting(self) -> int:
        """How many updates are kept until the server is back, or on their way then and not answered yet."""
        return self._core.waiting

    def get(self, path: str, default: Any = None) -> Any:
        """Raise WriteOnly."""
        return self.interface._run(self._core.get(path, default))

    def watch(self, *patterns: str, policy: Any = None, largest: int | None = None) -> Any:
        """Raise WriteOnly."""
        return self._core.watch(*patterns, policy=policy, largest=largest)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, self.outage)
