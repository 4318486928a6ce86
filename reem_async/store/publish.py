"""Publishing: a write and its notice in one transaction."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Self

from ..errors import ConnectionLost, Contended, LeaseLost, NotConnected
from ..local import LEAST
from ..plan import Command
from ..plan.changes import Announcement
from ..plan.keys import Keys
from ..plan.leases import HeldLease
from ..plan.notices import (
    LARGEST_INLINE,
    NO_EXTRAS,
    Extras,
    Slot,
    announce,
    in_slot,
    notify_path,
    published,
    sizes_of_parts,
    with_value,
)
from ..plan.paths import Path, counts_from_end
from ..session import PublisherIdentity, Session
from .document import Attachments, CallTime, DocumentWriter, Turn
from .send_queue import outages

_ANSWERS, _ANSWER = 5, 0.001
"""How often an early publisher looks for the answers of new subscribers on this host, and seconds between two looks."""

_PROMPT = 0.01
"""Seconds between a call and its sending from which a notice says that it is late; `wait=False` takes less."""

_Stamp = tuple[str, int]  # publisher and number of an update


class PublishTurn(Turn):
    """The turn of one call that publishes, and the numbers that are reserved for its changes.

    Updates of one interface to one top-level key are numbered and arrive in this order, so such calls wait for each
    other.
    """

    __slots__ = ("_announcements", "_identity", "_keys", "_lease", "_order", "_session", "announced", "called")

    def __init__(
        self,
        session: Session,
        keys: Keys,
        identity: PublisherIdentity | None = None,
        lease: Callable[[], HeldLease] | None = None,
    ) -> None:
        self.called: CallTime | None = None
        self.announced: list[UpdateAnnouncement] = []
        self._identity = identity or session
        self._lease = lease  # returns the owner's lease, which each change renews, or raises LeaseLost
        self._session = session
        self._keys = keys
        # Shared by the interface: other stores, and threads, may publish to the same key.
        self._order = session.transport.ordered(keys.channel)
        self._announcements: list[UpdateAnnouncement] = []

    async def __aenter__(self) -> Self:
        await self._order.__aenter__()
        return self

    async def __aexit__(self, *error: Any) -> None:
        # An update that the server refused, or that found no server, keeps its number: subscribers report a gap.
        if isinstance(error[1], Contended | LeaseLost):
            self.not_applied(len(self._announcements))
        # Before the next call's turn begins, which continues with the next number.
        self.release()
        await self._order.__aexit__(*error)

    def reserve(
        self, text: bytes | None = None, attachments: Attachments = (), *, deleted: bool = False
    ) -> UpdateAnnouncement:
        if self.announced:
            return self.announced.pop(0)
        made = UpdateAnnouncement(self, deleted) if text is None else ValueAnnouncement(self, text, attachments)
        self._announcements.append(made)
        return made

    def not_applied(self, count: int) -> None:
        for announcement in reversed(self._announcements[-count:]):
            announcement.not_applied()

    def release(self) -> None:
        # The last reserved number first: the session accepts only its newest number.
        while self._announcements:
            self._announcements.pop().release()


class UpdateAnnouncement(Announcement):
    """Notifies subscribers of one change, without the value."""

    __slots__ = ("_began", "_deleted", "_everywhere", "_keys", "_made", "_reserved", "_session", "_time", "lease")

    def __init__(self, turn: PublishTurn, deleted: bool = False) -> None:
        # The owner's, which is renewed with the change; first, since it raises LeaseLost if there is none.
        self.lease = None if turn._lease is None else turn._lease()
        self._session, self._keys = turn._session, turn._keys
        self._time = None if turn.called is None else turn.called.wall
        self._began = None if turn.called is None else turn.called.monotonic
        self._deleted = deleted
        # A number is first reserved, then in a plan (made), then used. `release` gives back a reserved number, `unsent`
        # and `not_applied` one of a plan that was not applied.
        self._reserved: list[_Stamp] = [turn._identity.stamp(self._keys)]
        self._made: _Stamp = self._reserved[0]
        # In a cluster, clients that find keys by pattern get the first notices of a key on any node.
        self._everywhere = turn._identity.is_fresh(self._keys)

    def commands(self, path: Path) -> list[Command]:
        notices = self._numbered(path, self._payload)
        return notices if self.lease is None else [self.lease.renewal, *notices]

    def unsent(self) -> None:
        self._reserved.append(self._made)

    def again(self) -> None:
        self._reserved = [self._made]

    def not_applied(self) -> None:
        self.again()
        self.release()

    def release(self) -> None:
        while self._reserved:
            self._session.take_back(self._keys, self._reserved.pop())

    def _numbered(self, path: Path, payload: Callable[[_Stamp, Path], bytes]) -> list[Command]:
        # The reserved number; another one for a correction.
        self._made = stamp = self._reserved.pop() if self._reserved else self._session.stamp(self._keys)
        place = notify_path(path)
        # A change at a path that is too long is announced at a place above, without the value.
        if place is path:
            text = payload(stamp, path)
        else:
            moment, extras = self._when()
            text = announce(*stamp, moment, place, extras=extras)
        return published(self._keys, *stamp, text, everywhere=self._everywhere)

    def _payload(self, stamp: _Stamp, path: Path) -> bytes:
        moment, extras = self._when()
        return announce(*stamp, moment, path, deleted=self._deleted, extras=extras)

    def _when(self) -> tuple[float, Extras]:
        """Return the time of the call, in seconds since 1970, and what else the notice has to say.

        That is how late it is sent, if an outage was in between, and the owner's fencing number.
        """
        if self.lease is not None:
            return self._time or time.time(), self.lease.extras
        late = 0.0 if self._began is None else time.monotonic() - self._began
        return self._time or time.time(), Extras(late=late) if late >= _PROMPT else NO_EXTRAS


class ValueAnnouncement(UpdateAnnouncement):
    """Notifies subscribers of a value that is set; the notice carries a small one.

    If the server refuses the value, another notice has subscribers read the stored one.
    """

    __slots__ = ("_attachments", "_early", "_is_shared", "_slot", "_text")

    def __init__(self, turn: PublishTurn, text: bytes, attachments: Attachments) -> None:
        super().__init__(turn)
        self._text, self._attachments = text, attachments
        self._slot: Slot | None = None
        self._is_shared = False  # with subscribers on this host, in early mode
        self._early: tuple[_Stamp, bytes] | None = None  # the notice that subscribers near by have, with its number

    async def share(self, path: Path) -> None:
        """Put the value into shared memory if it is large and there is a subscriber on this host.

        In early mode, notify the subscribers on this host now. One more round trip for one update a second.
        """
        await self._share(path, is_to_ask=True)

    async def share_early(self, path: Path) -> None:
        """In early mode, share with the subscribers on this host that are known; nothing is waited for."""
        if self._session.local.early:
            await self._share(path, is_to_ask=False)

    async def _share(self, path: Path, *, is_to_ask: bool) -> None:
        local, sizes = self._session.local, sizes_of_parts(self._text, self._attachments)
        is_large = sum(sizes) >= LEAST
        # An index from the end is resolved by the server, so such an update cannot be early. Nor can an owner's: the
        # server alone knows whether it still is one.
        is_early = local.early and self.lease is None and not counts_from_end(path)
        if not (is_large or is_early) or not local.host or notify_path(path) is not path:
            return
        if any(each.blob is None for each in self._attachments):
            return
        if is_to_ask and local.is_to_ask(self._keys):
            await self._ask_host()
        if self._is_shared:  # by the call, which has queued the update
            return
        if is_large and local.audience(self._keys):
            pieces = [self._text, *(piece for each in self._attachments for piece in each.blob or ())]
            # Two threads must not write to the memory of a key at a time: one may queue, another one send.
            async with self._session.transport.ordered(f"{self._keys.channel} memory"):
                self._slot = local.put(self._keys, pieces, sizes)
        if is_early and (self._slot is not None or not is_large):
            self._is_shared = self._notify_early(self._reserved[0], path)

    async def _ask_host(self) -> None:
        session, keys, local = self._session, self._keys, self._session.local
        channel = keys.channel.encode()
        address = local.subscribers.ask(channel) if local.early else b""
        try:
            asked: list[Command] = [(keys.publish, each, address) for each in local.channels(keys)]
            counts = await session.transport.roundtrip(asked)
        except ConnectionLost as error:
            raise NotConnected(f"{error}; the update itself was not sent, so nothing was applied") from error
        before = local.answered(keys, *counts)
        # A new subscriber has to be notified early of this update. Those of older versions of REEM do not answer.
        for _ in range(_ANSWERS if address and local.audience(keys) != before else 0):
            local.subscribers.take_answers()
            if local.subscribers.count(channel) >= local.audience(keys):
                break
            await session.transport.pause(_ANSWER)

    def _notify_early(self, stamp: _Stamp, path: Path) -> bool:
        local = self._session.local
        if not local.subscribers.count(self._keys.channel.encode()):
            return False
        self._time = self._time or time.time()  # the update itself has the same, which identifies it
        if self._slot is None:
            moment, extras = self._when()
            payload = with_value(*stamp, moment, path, self._text, self._attachments, extras, largest=LEAST)
        else:
            payload = self._payload(stamp, path)
        if len(payload) <= LARGEST_INLINE:
            self._early = stamp, payload
        local.notify(self._keys, payload, is_in_slot=self._slot is not None)
        return True

    def retract(self, path: Path) -> Sequence[Command]:
        # Without a value, so that subscribers read the stored one.
        return self._numbered(path, super()._payload)

    def _payload(self, stamp: _Stamp, path: Path) -> bytes:
        moment, extras = self._when()
        if self._early is not None and self._early[0] == stamp and not extras.late:
            return self._early[1]
        if self._slot is not None:
            return in_slot(*stamp, moment, path, self._slot, self._text, self._attachments, extras)
        return with_value(*stamp, moment, path, self._text, self._attachments, extras)


class DocumentPublisher(DocumentWriter):
    keeps_order = True

    def turn(self, identity: PublisherIdentity | None = None) -> PublishTurn:
        return PublishTurn(self.session, self.keys, identity)

    def maker(self) -> Callable[[Session, object], DocumentWriter]:
        return partial(publisher, **({"policy": "raise"} if self._outages is None else self._outages.chosen))


def publisher(session: Session, name: object, policy: str, **chosen: Any) -> DocumentPublisher:
    return DocumentPublisher(session, name, outages(session, policy, **chosen))
