"""Publishing: a write and its notice in one transaction."""

from __future__ import annotations

import builtins
import time
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Any, NoReturn

from ..errors import ConnectionLost, Contended, NotConnected, WriteOnly
from ..local.path import LEAST
from ..plan import Command
from ..plan.changes import EncodedAttachment, Telling
from ..plan.keys import Keys
from ..plan.notices import announce, in_slot, published, sizes_of_parts, told_at, with_value
from ..plan.paths import Path, counts_from_end, show
from ..plan.slots import Slot
from ..session import Session
from .accessor import _NOTHING, Accessor
from .document import DocumentWriter
from .low_level import Writer
from .outage import Outage
from .store import KeyValueStore

__all__ = ["PublishAccessor", "PublishSpace", "Publisher"]


_Stamp = tuple[str, int]
"""Who publishes, and the number of the update."""


class UpdateNotifier:
    """Tells the subscribers of one top-level key.

    Updates of one interface to one top-level key are numbered and arrive in this order, so such
    calls wait for each other; those to different keys do not.

    Args:
        session: The server.
        keys: The names of the key.
    """

    # So no large array lets small calls pass it: subscribers get updates in the order of the calls.
    keeps_order = True

    def __init__(self, session: Session, keys: Keys) -> None:
        self.session = session
        self.keys = keys

    def turn(self) -> _Turn:
        """Wait until all that was published before is told."""
        return _Turn(self)


class _Turn:
    """The turn of one call, and the numbers that are reserved for it; what it has not used is given back."""

    __slots__ = ("_notifier", "_order", "_tellings", "time")

    def __init__(self, notifier: UpdateNotifier) -> None:
        self.time: float | None = None
        self._notifier = notifier
        # Belongs to the interface, not to this object: other stores, and threads, may publish to the same key.
        self._order = notifier.session.transport.ordered(notifier.keys.channel)
        self._tellings: list[_Telling] = []

    async def __aenter__(self) -> _Turn:
        await self._order.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, Contended):
            self.not_sent(len(self._tellings))
        # Before the next call's turn begins: it takes the numbers from where this one has left them.
        self.settle()
        await self._order.__aexit__(kind, error, trace)

    def with_value(self, text: bytes, attachments: tuple[EncodedAttachment, ...]) -> Telling:
        """Return what tells of a value that is set; a small value travels with it."""
        telling = _Setting(self._notifier, self.time, text, attachments)
        self._tellings.append(telling)
        return telling

    def without_value(self, *, deleted: bool = False) -> Telling:
        """Return what tells of any other change."""
        telling = _Telling(self._notifier, self.time, deleted)
        self._tellings.append(telling)
        return telling

    async def share(self, telling: Telling, path: Path) -> None:
        """Put a large value that is about to be set where subscribers of the same host find it, if there are any."""
        if isinstance(telling, _Setting):
            await telling.share(path)

    def not_sent(self, count: int) -> None:
        """Note that the last `count` changes were not applied: their numbers are free from now on."""
        for telling in reversed(self._tellings[-count:]):
            telling.not_sent()

    def settle(self) -> None:
        """Note that nothing is to come any more of the changes so far: give back numbers that they have not used."""
        # The last reserved number goes back first, as they are only taken back from the end.
        while self._tellings:
            self._tellings.pop().end()


class _Telling:
    """What tells of one change, without the value."""

    __slots__ = ("_deleted", "_everywhere", "_made", "_notifier", "_reserved", "_time")

    def __init__(self, notifier: UpdateNotifier, time: float | None, deleted: bool = False) -> None:
        self._notifier = notifier
        self._time = time
        self._deleted = deleted
        # States of a number: reserved -> made (in a plan) -> told, when the plan was applied; from reserved, or by
        # `take_back` and `not_sent` from made, it goes back to the session.
        self._reserved: list[_Stamp] = [notifier.session.stamp(notifier.keys)]
        self._made: _Stamp = self._reserved[0]
        # In a cluster, those who look for keys by pattern hear of a new key on all nodes for its first seconds.
        self._everywhere = notifier.session.is_fresh(notifier.keys)

    def make(self, path: Path) -> list[Command]:
        return self._numbered(path, self._payload)

    def take_back(self) -> None:
        self._reserved.append(self._made)

    def retract(self, path: Path) -> Sequence[Command]:
        return ()

    def not_sent(self) -> None:
        """Note that the change was not applied after all."""
        self._reserved = [self._made]
        self.end()

    def end(self) -> None:
        """Give back a number that was not used."""
        while self._reserved:
            self._notifier.session.take_back(self._notifier.keys, self._reserved.pop())

    def _numbered(self, path: Path, payload: Callable[[_Stamp, Path], bytes]) -> list[Command]:
        # The reserved number; a further one where the replies say that what was told is to be told anew.
        it = self._notifier
        self._made = stamp = self._reserved.pop() if self._reserved else it.session.stamp(it.keys)
        place = told_at(path)
        # Told as a change of the place above: what is there is looked at.
        text = payload(stamp, path) if place is path else announce(*stamp, self._time or time.time(), place)
        return published(it.keys, *stamp, text, everywhere=self._everywhere)

    def _payload(self, stamp: _Stamp, path: Path) -> bytes:
        return announce(*stamp, self._time or time.time(), path, deleted=self._deleted)


class _Setting(_Telling):
    """What tells of a value that is set; if the server refuses it, subscribers are told to look at what is there."""

    __slots__ = ("_attachments", "_slot", "_text")

    def __init__(
        self, notifier: UpdateNotifier, time: float | None, text: bytes, attachments: tuple[EncodedAttachment, ...]
    ) -> None:
        super().__init__(notifier, time)
        self._text = text
        self._attachments = attachments
        self._slot: Slot | None = None

    async def share(self, path: Path) -> None:
        """Put the value into shared memory if it is large and somebody near by listens; in early mode, tell him now.

        One round trip more for each early update, and else for one update a second.
        """
        sizes = sizes_of_parts(self._text, self._attachments)
        if sum(sizes) < LEAST or any(each.blob is None for each in self._attachments) or told_at(path) is not path:
            return
        it, local = self._notifier, self._notifier.session.local
        if not local.host:
            return
        if local.is_to_ask(it.keys):
            await self._tell_near(b"")
        if not local.has_audience(it.keys):
            return
        pieces = [self._text, *(piece for each in self._attachments for piece in each.blob or ())]
        self._slot = local.put(it.keys, pieces, sizes)
        # Which item an index from the end names is known once the server has the update: it is told then.
        if self._slot is not None and local.early and not counts_from_end(path):
            await self._tell_near(self._payload(self._reserved[0], path))

    async def _tell_near(self, payload: bytes) -> None:
        """Send something to those near by; how many they are is known from then on.

        Raises:
            NotConnected: The update itself was not sent.
        """
        it = self._notifier
        channel = it.session.local.channel(it.keys)
        try:
            (count,) = await it.session.transport.roundtrip([(it.keys.publish, channel, payload)])
        except ConnectionLost as error:
            raise NotConnected(f"{error}; the update itself was not sent, so nothing was applied") from error
        it.session.local.answered(it.keys, count)

    def retract(self, path: Path) -> Sequence[Command]:
        # A notice with the value has told of something that is not there. One without has subscribers read what is.
        return self._numbered(path, super()._payload)

    def _payload(self, stamp: _Stamp, path: Path) -> bytes:
        moment = self._time or time.time()
        if self._slot is not None:
            return in_slot(*stamp, moment, path, self._slot, self._text, self._attachments)
        return with_value(*stamp, moment, path, self._text, self._attachments)


class DocumentPublisher(DocumentWriter):
    """Writes one top-level key and tells its subscribers, in the same transaction.

    Args:
        session: The server.
        name: The key.
        outages: What is done in an outage; None if calls raise.
    """

    def __init__(self, session: Session, name: object, outages: Outage | None = None) -> None:
        super().__init__(session, name, UpdateNotifier(session, session.keys(name)), outages)
        self._policy = "raise" if outages is None else outages.policy

    def maker(self) -> Callable[[Session, object], DocumentWriter]:
        """Return what makes another one, which can be pickled."""
        return partial(publisher, policy=self._policy)


def publisher(session: Session, name: object, policy: str) -> DocumentPublisher:
    """Return a publisher of its own of one top-level key, with a policy for outages."""
    return DocumentPublisher(session, name, Outage.chosen(session, policy))


def _cannot_read(path: Path) -> str:
    return (
        f"{show(path)}: a PublishSpace can only be written; read through KeyValueStore(interface), "
        "or follow it with a subscriber"
    )


class PublishAccessor(Accessor):
    """One place of a PublishSpace: as `Accessor`, but what would read raises WriteOnly."""

    __slots__ = ()
    _how_to_read = "a KeyValueStore"

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

    async def read(self) -> Any:
        """Raise WriteOnly."""
        self._refuse()

    async def get(self, *default: Any, default_value: Any = _NOTHING) -> Any:
        """Raise WriteOnly."""
        self._refuse()

    async def length(self) -> int:
        """Raise WriteOnly."""
        self._refuse()

    async def type(self) -> builtins.type:
        """Raise WriteOnly."""
        self._refuse()

    async def contains(self, key: str) -> bool:
        """Raise WriteOnly."""
        self._refuse()

    async def keys(self) -> list[str]:
        """Raise WriteOnly."""
        self._refuse()

    async def outline(self) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()

    async def _take(self, *default: Any) -> Any:
        self._refuse()

    async def _read_or_put(self, default: Any) -> Any:
        self._refuse()

    def edit(self) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()

    def mirror(self, *, max_age: float | None = None, largest: int | None = None) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()

    def watch(self, policy: Any = None, *, stored: bool = True) -> NoReturn:
        """Raise WriteOnly."""
        self._refuse()


class Publisher(Writer):
    """Writes one top-level key and tells its subscribers, in the same transaction.

    Args:
        top_key_name: The key.
        interface: The server.
    """

    _kind = DocumentPublisher


class PublishSpace(KeyValueStore):
    """A store that can only be written, and whose subscribers are told of every change.

    Written like a `KeyValueStore`. A change and its notice are one transaction; a small value
    travels in the notice, a large one is announced and subscribers fetch the newest.

    In an outage (NotConnected, ConnectionLost or ServerNotReady) `outage` says what becomes of `write`, `update` and
    `delete`: they raise, or they return at once, until the server answers again.

    - "drop": What is published is dropped, and counted in `dropped`.
    - "newest": The newest update of each place is kept, with the bytes and the time of its call, and sent when the
      server is back, in the order of the calls, each by itself; what a newer one replaces is counted in `dropped`.
      Removals of list items are all kept, since an index names another item after each of them.
      Of more than 256 MB of values, in all, the oldest of a key go first, and are counted.

    Nothing is applied twice: an update that was under way when the connection broke was applied or not, is not sent
    again, and counts as dropped. Subscribers are told of updates that were dropped as of any that was lost, by `gap`
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

    async def get(self, path: str, default: Any = None) -> Any:
        """Raise WriteOnly."""
        await self.at(path).read()

    def watch(self, *patterns: str, policy: Any = None, largest: int | None = None) -> NoReturn:
        """Raise WriteOnly."""
        raise WriteOnly(_cannot_read(patterns or ("*",)))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, self.outage)
