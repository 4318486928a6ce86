"""Patterns of channels in a cluster, where servers have none: the keys are looked for, and each is followed.

A key that is found a moment after it was made would have been published to already. So publishers
tell all nodes what they publish in their first seconds with a key, by a channel of the old kind, for
which there are patterns; whoever hears of a key this way follows it from then on. A `Handover` for each key
puts in one order what is heard in both ways.
"""

from __future__ import annotations

import asyncio
import logging
import re
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .background import in_background
from .errors import InterfaceClosed, RedisError
from .handover import Handover
from .plan.keys import keys_of
from .plan.notices import Notice
from .plan.scan import documents
from .policy import Mailbox
from .transport import drive
from .transport.wire import Wire

if TYPE_CHECKING:
    from .audience import Listener, Topic
    from .hub import Hub

__all__ = ["Discovery"]

logger = logging.getLogger("reem.subscribe")

_PAUSE = 1.0
"""Seconds between looks for new keys."""
_MOMENT, _MOMENTS = 0.005, 200

_MOST = 10_000
"""Keys of which is remembered who published what: anybody may tell all nodes of any number of them."""

_TAIL = "}:notices"
_ESCAPED = re.compile(r"\\(.)", re.DOTALL)


class Discovery:
    """Follows, for each listener to a pattern, all keys that there are, and those that come to be.

    Args:
        hub: Who follows a key.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._branches: weakref.WeakKeyDictionary[Listener, dict[bytes, _Branch]] = weakref.WeakKeyDictionary()
        self._births: weakref.WeakKeyDictionary[Listener, _Births] = weakref.WeakKeyDictionary()
        self._looking: asyncio.Task[Any] | None = None

    async def follow(self, listener: Listener) -> None:
        """Follow all keys that there are now; those that come to be are found within a second."""
        self._branches[listener] = {}
        try:
            name = literal(_glob(listener))
            if name is not None:  # it need not be there yet
                await self._found(listener, [name.encode()], late=False)
                return
            births = self._births[listener] = _Births(self, listener)
            await self._hub.follow_here(births)
            await self._look(listener, late=False)
        except BaseException:
            await self.unfollow(listener)
            raise
        if self._looking is None or self._looking.done():
            self._looking = in_background(self._go_on_looking(), "reem discovery")

    async def unfollow(self, listener: Listener) -> None:
        """Stop following. Idempotent."""
        for branch in self._branches.pop(listener, {}).values():
            await self._hub.unfollow(branch)
        births = self._births.pop(listener, None)
        if births is not None:
            await self._hub.unfollow_here(births)

    def heard(self, listener: Listener, document: bytes) -> None:
        """Follow a key that was just heard of."""
        births = self._births.get(listener)
        if births is None or document in self._branches.get(listener, {document: None}):
            return
        births.fresh[document] = None
        if not births.following:
            births.following = True
            in_background(self._follow_fresh(listener, births), "reem discovery of new keys")

    async def _follow_fresh(self, listener: Listener, births: _Births) -> None:
        """Follow what was heard of, and all that is heard of meanwhile at once."""
        try:
            while births.fresh:
                found, births.fresh = list(births.fresh), {}
                await self._found(listener, found, late=True)
        except (RedisError, OSError, InterfaceClosed) as error:
            logger.debug("new keys are not followed yet: %s", error)
        finally:
            births.following = False

    async def settled(self) -> None:
        """Return when nothing that has arrived waits for something older, or after a second."""
        for _ in range(_MOMENTS):
            if not any(births.waits for births in list(self._births.values())):
                return
            await asyncio.sleep(_MOMENT)

    async def close(self) -> None:
        """Stop looking."""
        if self._looking is not None:
            self._looking.cancel()

    async def _go_on_looking(self) -> None:
        while True:
            await asyncio.sleep(_PAUSE)
            await self._look_for_all()
            if not self._branches:
                return

    async def _look_for_all(self) -> None:
        for listener in list(self._births):
            try:
                await self._look(listener, late=True)
            except (RedisError, OSError) as error:
                logger.debug("new keys could not be looked for: %s", error)

    async def _look(self, listener: Listener, *, late: bool) -> None:
        """Follow the keys that are not followed yet."""
        glob = _glob(listener)
        for node in await self._hub.transport.nodes():
            cursor: Any = b"0"
            while True:
                cursor, page = await drive(node, documents(glob, cursor))
                await self._found(listener, page, late=late)
                if cursor in (b"0", 0):
                    break

    async def _found(self, listener: Listener, documents: Sequence[bytes], *, late: bool) -> None:
        """Follow those that are not followed yet."""
        branches, births = self._branches.get(listener), self._births.get(listener)
        if branches is None:
            return
        found = {
            name: _Branch(listener, name, births) for name in documents if name not in branches and b"{" not in name
        }
        branches.update(found)
        for branch in found.values():
            if late and births is not None:
                births.handover(branch.topic.name).late = True
        try:
            await self._hub.follow_all(list(found.values()))
        except BaseException:
            for name, branch in found.items():
                if not branch.begun:
                    branches.pop(name, None)
            raise


def _glob(listener: Listener) -> str:
    """Return the pattern of the documents whose channels a listener's pattern names."""
    return listener.topic.name.decode().removeprefix("{").removesuffix(_TAIL)


def literal(glob: str) -> str | None:
    """Return the only name that a pattern of the server names, None if there may be others."""
    plain = _ESCAPED.sub("", glob)
    return None if any(sign in plain for sign in "*?[") else _ESCAPED.sub(r"\1", glob)


class _Branch:
    """One key of a pattern: a listener of the hub that hands everything on.

    Attributes:
        begun: It is followed.
    """

    def __init__(self, listener: Listener, document: bytes, births: _Births | None) -> None:
        from .audience import Topic

        self._listener = weakref.ref(listener)
        self._births = births  # where its first notices came from, or None if only this key is meant
        self.begun = False
        self.topic: Topic = Topic(
            keys_of(document.decode(errors="surrogateescape")).channel.encode(errors="surrogateescape")
        )
        self.note: str | None = None
        self.ready: asyncio.Future[None] | None = None
        self.patience = listener.patience
        self.mailboxes: list[Mailbox] = []

    def start(self, wire: Wire, kind: str) -> None:
        """Begin, and let the listener begin."""
        self.begun = True
        if self._births is not None:
            self._births.begin(wire, kind)
        elif (listener := self._listener()) is not None:
            listener.start(wire, kind)
        if self.ready is not None and not self.ready.done():
            self.ready.set_result(None)

    def lost(self, reason: Exception) -> None:
        """Hand it on, if this had begun."""
        if self.ready is not None:
            if not self.ready.done():
                self.ready.set_exception(reason)
            return
        listener = self._listener()
        if listener is not None:
            listener.lost(reason)

    def doubt(self) -> None:
        """Hand it on."""
        listener = self._listener()
        if listener is not None:
            listener.doubt()

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        """Hand it on, behind what all nodes were told before."""
        if self._births is not None:
            self._births.handover(channel).told_here(notice)
        elif (listener := self._listener()) is not None:
            listener.on_notice(notice, channel)

    def on_note(self, note: bytes | None) -> None:
        """Nothing to compare."""


class _Births:
    """What publishers tell all nodes: a listener of the hub.

    Attributes:
        fresh: The keys that were just heard of, in their order, and
        following: whether they are about to be followed.
    """

    def __init__(self, discovery: Discovery, listener: Listener) -> None:
        self._discovery = discovery
        self._listener = weakref.ref(listener)
        self.topic = listener.topic
        self.note: str | None = None
        self.ready: asyncio.Future[None] | None = None
        self.patience = listener.patience
        self.mailboxes: list[Mailbox] = []
        self.fresh: dict[bytes, None] = {}
        self.following = False
        self._telling = False  # of a gap, in this turn of the event loop
        self._handovers: dict[bytes, Handover] = {}

    @property
    def waits(self) -> bool:
        """Whether something has come and is not handed on yet."""
        return any(each.waits for each in self._handovers.values())

    def handover(self, channel: bytes) -> Handover:
        """Return what puts in order what is heard of a key."""
        found = self._handovers.get(channel)
        if found is None:
            if len(self._handovers) >= _MOST:  # of a key that is forgotten, all is taken as it comes
                del self._handovers[next(iter(self._handovers))]
            found = self._handovers[channel] = Handover(self._listener, channel)
        return found

    def start(self, wire: Wire, kind: str) -> None:
        """Begin, and let the listener begin."""
        self.begin(wire, kind)
        if self.ready is not None and not self.ready.done():
            self.ready.set_result(None)

    def begin(self, wire: Wire, kind: str) -> None:
        """Let the listener begin. One broken connection is one gap, however many keys begin anew over the next."""
        if kind == "gap":
            if self._telling:
                kind = "initial"
            else:
                self._telling = True
                asyncio.get_running_loop().call_soon(self._told)
        if (listener := self._listener()) is not None:
            listener.start(wire, kind)

    def _told(self) -> None:
        self._telling = False

    def lost(self, reason: Exception) -> None:
        """Hand it on, if this had begun."""
        if self.ready is not None:
            if not self.ready.done():
                self.ready.set_exception(reason)
        elif (listener := self._listener()) is not None:
            listener.lost(reason)

    def doubt(self) -> None:
        """Hand it on."""
        if (listener := self._listener()) is not None:
            listener.doubt()

    def on_notice(self, notice: Notice, channel: bytes) -> None:
        """Hand it on, and see to it that the key is followed."""
        if (listener := self._listener()) is None:
            return
        self.handover(channel).told_to_all(notice)
        self._discovery.heard(listener, channel.removeprefix(b"{").removesuffix(_TAIL.encode()))

    def on_note(self, note: bytes | None) -> None:
        """Nothing to compare."""
