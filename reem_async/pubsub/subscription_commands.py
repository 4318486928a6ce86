"""What is sent over a subscription connection: SUBSCRIBE, CLIENT TRACKING, and TYPE to touch keys."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from ..errors import ServerNotReady, is_of_command
from ..plan import Reply, blamed
from ..transport import Transport
from ..transport.wire import Wire
from .listeners import Topic

logger = logging.getLogger("reem.subscribe")

_TRACK = ("CLIENT", "TRACKING", "ON")  # not BCAST: the server would compare each write with the prefixes of all


class Subscribing:
    def __init__(
        self,
        transport: Transport,
        host: str | None,  # what names this host to publishers that share memory with it; none if that is off
        confirmed: Callable[[Topic, Wire], None],  # called when the server has confirmed a subscription
        joined: Callable[[bytes], None],  # called with a channel of which publishers here can count the listeners now
    ) -> None:
        self._transport = transport
        self._host = host
        self._on_confirmed = confirmed
        self._on_joined = joined
        self._invited: set[Topic] = set()  # publishers of this host know of a listener

    async def subscribe(self, wire: Wire, topics: Sequence[Topic]) -> None:
        """Subscribe and wait until the server has confirmed each topic; raise the first refusal."""
        answers: list[asyncio.Future[None]] = []
        if len(topics) > 1:
            wire.send([("PING",)], lambda _: None)  # what is sent behind it in this turn is confirmed in one turn, too
        for topic in topics:
            answer = asyncio.get_running_loop().create_future()
            answers.append(answer)
            # Noted in order with what is pushed: the word that the slot has moved may come right behind.
            wire.send([self._command(topic)], partial(self._confirmed, topic, wire, answer))
        outcomes = await asyncio.gather(*answers, return_exceptions=True)
        for outcome in outcomes:
            if outcome is not None:
                raise outcome

    def _confirmed(
        self, topic: Topic, wire: Wire, answer: asyncio.Future[None], replies: list[Reply] | Exception
    ) -> None:
        refusal = replies if isinstance(replies, Exception) else replies[0]
        if not isinstance(refusal, Exception):
            self._on_confirmed(topic, wire)
        if answer.done():  # cancelled
            return
        if isinstance(refusal, Exception):
            answer.set_exception(refusal if self._transport.sharded else blamed(refusal, self._command(topic)))
        else:
            answer.set_result(None)

    def invite(self, wire: Wire, topic: Topic) -> None:
        """Have publishers of this host know that a listener reads their memory; a refusal means that they do not."""
        if self._host:
            self._invited.add(topic)
            wire.send([self._command(self._near(topic))], lambda _: self._on_joined(topic.name))

    def leave(self, wire: Wire | None, topic: Topic) -> None:
        left = [topic, self._near(topic)] if topic in self._invited else [topic]
        self._invited.discard(topic)
        if wire is None or not wire.alive:
            return
        for each in left:
            if self._prefix(each) == "S":
                wire.leave(each.name)
            else:
                wire.send([(f"{self._prefix(each)}UNSUBSCRIBE", each.name)], lambda _: None)

    def _near(self, topic: Topic) -> Topic:
        return Topic(topic.name + f"@{self._host}".encode(), topic.pattern)

    def _command(self, topic: Topic) -> tuple[str, bytes]:
        return f"{self._prefix(topic)}SUBSCRIBE", topic.name

    def _prefix(self, topic: Topic) -> str:
        return "P" if topic.pattern else "S" if self._transport.sharded else ""


class Invalidations:
    """Turns the server's messages on; a user without the right is warned, once for each interface."""

    def __init__(self) -> None:
        self._warned = False

    async def turn_on(self, wire: Wire) -> None:
        """Have the server tell of changes of what is read over a connection; at most one round trip."""
        if wire.tracked is not None:
            return
        (reply,) = await wire.roundtrip([_TRACK])
        if isinstance(reply, ServerNotReady):
            raise blamed(reply, _TRACK)
        if isinstance(reply, Exception):
            self._refused(wire, blamed(reply, _TRACK), "+client|tracking")
        else:
            wire.tracked = True

    async def touch(self, wire: Wire, names: Iterable[str], touched: Callable[[], None]) -> bool:
        if not wire.alive or not wire.tracked:
            return False
        answered = asyncio.get_running_loop().create_future()

        def done(outcome: list[Reply] | Exception) -> None:
            touched()
            if not answered.done():  # cancelled
                answered.set_result(outcome)

        wire.send([("TYPE", name) for name in names], done)
        outcome = await answered
        if isinstance(outcome, Exception):
            raise outcome
        refused = [reply for reply in outcome if isinstance(reply, Exception)]
        if any(is_of_command(reply) for reply in refused):
            self.may_not_touch(wire, refused[0])
        return not refused

    def may_not_touch(self, wire: Wire, refusal: Exception) -> None:
        self._refused(wire, blamed(refusal, ("TYPE",)), "+type")

    def _refused(self, wire: Wire, reason: Exception, right: str) -> None:
        wire.tracked = False
        if not self._warned:
            self._warned = True
            logger.warning(
                "the server does not report what is stored without publishing: only published updates are delivered; "
                "recordings read the rest at keyframes, and the page every second: %s "
                "(the user needs the right %s, as in deploy/users.acl)",
                reason,
                right,
            )
