"""The server's commands that begin and end a subscription: of one server, of patterns, of a cluster's nodes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from functools import partial

from ..plan import Reply, blamed
from ..transport import Transport
from ..transport.wire import Wire
from .listeners import Topic

__all__ = ["Subscribing"]


class Subscribing:
    """Subscribes to topics over connections that the caller chooses.

    Args:
        transport: Whose server it is.
        host: What names this host to publishers that share memory with it; none if that is off.
        confirmed: Called with a topic and the connection when the server has confirmed a subscription.
    """

    def __init__(self, transport: Transport, host: str | None, confirmed: Callable[[Topic, Wire], None]) -> None:
        self._transport = transport
        self._host = host
        self._on_confirmed = confirmed
        self._invited: set[Topic] = set()  # publishers of this host know that somebody listens

    async def subscribe(self, wire: Wire, topics: Iterable[Topic]) -> None:
        """Subscribe and wait until the server has confirmed each topic; raise the first refusal."""
        answers: list[asyncio.Future[None]] = []
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
        """Have publishers of this host know that somebody looks into their memory; a refusal means that they do not."""
        if self._host:
            self._invited.add(topic)
            wire.send([self._command(self._near(topic))], lambda _: None)

    def leave(self, wire: Wire | None, topic: Topic) -> None:
        """Unsubscribe, if there is a connection still."""
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
        """Return what the server's commands for this kind of topic begin with."""
        return "P" if topic.pattern else "S" if self._transport.sharded else ""
