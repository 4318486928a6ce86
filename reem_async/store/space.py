"""PublishSpace: a store that can only be written, its places, and the low-level Publisher."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal, NoReturn

from ..errors import WriteOnly
from ..plan.paths import Path, show
from .accessor import Accessor, Writer
from .outage import Outage
from .publish import DocumentPublisher
from .reader import DocumentReader
from .store import KeyValueStore


def _cannot_read(path: Path) -> str:
    return (
        f"{show(path)}: a PublishSpace can only be written; read through KeyValueStore(interface), "
        "or follow it with a subscriber"
    )


class WriteOnlyReader(DocumentReader):
    """Reads nothing: each call raises WriteOnly."""

    def _refuse(self, path: Path, *_: Any) -> NoReturn:
        raise WriteOnly(_cannot_read((self.name, *path)))

    raw_read = contains_at = keys_at = type_at = length_at = _refuse  # type: ignore[assignment]


class PublishAccessor(Accessor):
    """One place of a PublishSpace: as `Accessor`, but reading raises WriteOnly."""

    __slots__ = ()
    _how_to_read = "a KeyValueStore"
    _reads = WriteOnlyReader

    def _refuse(self) -> NoReturn:
        raise WriteOnly(_cannot_read(self.full_path))

    @property
    def reader(self) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()

    @property
    def writer(self) -> Publisher:
        """The publisher of the top-level key."""
        return Publisher(self._reader.name, self._reader.session.interface)

    async def outline(self) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()

    def edit(self) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()

    def mirror(
        self,
        *,
        max_age: float | None = None,
        largest: int | None = None,
        stale: Literal["raise", "keep"] = "raise",
        ttl: float | None = None,
    ) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()

    async def parameter(self, name: str, default: Any, **specification: Any) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()

    def watch(self, policy: Any = None, *, stored: bool = True, ttl: float | None = None) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()


class Publisher(Writer):
    """Writes one top-level key and notifies its subscribers, in the same transaction.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    _kind = DocumentPublisher


class PublishSpace(KeyValueStore):
    """A store that can only be written, and that notifies subscribers of every change.

    Written like a `KeyValueStore`. A change and its notice are one transaction. The notice carries a small value; a
    large one is announced, and subscribers fetch the newest.

    `outage` is the policy for `write`, `update` and `delete` in an outage (NotConnected, ConnectionLost or
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
        self._outages = Outage.chosen(self.interface.session, outage)
        self._writer = partial(DocumentPublisher, outages=self._outages)

    @property
    def dropped(self) -> int:
        """How many updates this has not published because of outages, or not for certain."""
        return 0 if self._outages is None else self._outages.dropped

    @property
    def waiting(self) -> int:
        """How many updates are kept until the server is back, or on their way then and not answered yet."""
        return 0 if self._outages is None else self._outages.waiting

    def watch(self, *patterns: str, policy: Any = None, largest: int | None = None) -> NoReturn:
        """Raise WriteOnly."""
        raise WriteOnly(_cannot_read(patterns or ("*",)))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, self.outage)
