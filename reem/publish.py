"""Publishing for plain scripts."""

from __future__ import annotations

from typing import Any

from reem_async.store import publish as core

from .accessor import PublishAccessor, Publisher
from .store import KeyValueStore

__all__ = ["PublishSpace", "Publisher"]


class PublishSpace(KeyValueStore):
    """A store that can only be written, and that notifies subscribers of every change.

    Written like a `KeyValueStore`. A change and its notice are one transaction. The notice carries a small value; a
    large one is announced, and subscribers fetch the newest.

    `outage` is the policy for writing, `update` and deleting in an outage (NotConnected, ConnectionLost or
    ServerNotReady). They raise, or return at once until the server answers again:

    - "drop": Updates are dropped, and counted in `dropped`.
    - "newest": The newest update of each place is kept, with the bytes and the time of its call, and sent when the
      server is back, in the order of the calls, each by itself. A replaced update is counted in `dropped`. Removals of
      list items are all kept, since an index names another item after each of them. Over 256 MB of values, in all, the
      oldest of a key are dropped, and counted.

    Nothing is applied twice: an update in progress when the connection broke was applied or not, is not sent again, and
    counts as dropped. Subscribers see dropped updates like lost ones, by `gap` and `missed`. `append`, `extend` and
    arithmetic depend on the stored value, so they always raise in an outage; once the server is back they come after
    the kept updates. A kept update that the server refuses is logged and counted, and closing the interface drops the
    rest. The beginning and the end of an outage are logged ("reem.publish").

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
