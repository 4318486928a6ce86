"""PublishSpace: a store that can only be written, its places, and the low-level Publisher."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NoReturn

from ..errors import WriteOnly
from ..plan.paths import Path, show
from .accessor import Accessor, Writer
from .publish import DocumentPublisher
from .reader import DocumentReader
from .send_queue import outages
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

    @property
    def writer(self) -> Publisher:
        """The publisher of the top-level key."""
        return Publisher(self._reader.name, self._reader.session.interface)

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        """Raise WriteOnly."""
        raise WriteOnly(_cannot_read(self.full_path))

    reader = property(_refuse)
    edit = mirror = outline = parameter = watch = _refuse


class Publisher(Writer):
    """Writes one top-level key and notifies its subscribers, in the same transaction."""

    _kind = DocumentPublisher


class PublishSpace(KeyValueStore):
    """A store that can only be written, and that notifies subscribers of every change.

    Written like a `KeyValueStore`. A change and its notice are one transaction. The notice carries a small value; a
    large one is announced, and subscribers fetch the newest.

    `outage` is the policy for `write`, `update` and `delete` in an outage (NotConnected, ConnectionLost or
    ServerNotReady). They raise, or return at once until the server answers again: "drop" drops the updates. "newest"
    keeps the newest update of each place, up to 256 MB in all, and sends these when the server is back, in the order of
    the calls, with the bytes and the time of the call. Nothing is applied twice. What is not published, or not for
    certain, is counted in `dropped`, and subscribers see it by `gap` and `missed`. `append`, `extend` and arithmetic
    depend on the stored value, so they always raise in an outage. Promise 14 of docs/guarantees.md has the details.

    With `wait=False`, `write`, `update` and `delete` encode and queue their updates and return. A background task sends
    them in the order of the calls. Bad input raises in the call. Errors of the server go to `on_error`, or the next
    call raises the first of them and queues nothing. If 32 calls of a key wait, a further one replaces those of the
    same place. A read may not see an update yet: `flush` waits until it is stored. Closing the interface, and the end
    of the program, send what is queued for up to a second. Promise 25 has the details.

    Args:
        interface: The server: a RedisInterface, a store, or what RedisInterface takes as host.
        outage: What to do in an outage: "raise", "drop" or "newest".
        wait: Whether a call waits until the server has stored the update.
        on_error: With `wait=False`, called with each error, in the background task; it must not block.
        options: With a host, what else RedisInterface takes.
    """

    _accessor = PublishAccessor

    def __init__(
        self,
        interface: Any = None,
        outage: str = "raise",
        wait: bool = True,
        on_error: Callable[[Exception], object] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(interface, **options)
        self.outage = outage
        self._chosen = outage, wait, on_error
        self._outages = outages(self.interface.session, *self._chosen)
        self._writer = partial(DocumentPublisher, outages=self._outages)

    async def flush(self, timeout: float | None = None) -> None:  # noqa: ASYNC109
        """Wait until the updates of all calls so far are stored or dropped.

        Args:
            timeout: Seconds to wait at most; as long as it takes if not given.

        Raises:
            TimeoutError: Some are not; they are still queued, or kept for the end of the outage.
            redis.exceptions.RedisError: With `wait=False` and without `on_error`: the first error of earlier updates.
        """
        if self._outages is not None:
            await self._outages.flush(timeout)

    @property
    def dropped(self) -> int:
        """How many updates this has not published, or not for certain: because of outages, or of `wait=False`."""
        return 0 if self._outages is None else self._outages.dropped

    @property
    def waiting(self) -> int:
        """How many updates are queued, or kept until the server is back, or on their way and not answered yet."""
        return 0 if self._outages is None else self._outages.waiting

    def watch(self, *patterns: str, policy: Any = None, largest: int | None = None) -> NoReturn:
        """Raise WriteOnly."""
        raise WriteOnly(_cannot_read(patterns or ("*",)))

    def join(self, *paths: str, slop: float, policy: Any = None) -> NoReturn:
        """Raise WriteOnly."""
        raise WriteOnly(_cannot_read(paths or ("*",)))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, *self._chosen)
