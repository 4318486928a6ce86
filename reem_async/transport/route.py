"""The way of one call through a cluster: which node is next, until it is applied or time is over."""

from __future__ import annotations

import random
import time
from collections.abc import Sequence
from contextlib import AbstractAsyncContextManager
from typing import Any, Protocol

from ..errors import ConnectionLost, NotConnected, TlsRefused
from ..plan import Command, Reply
from . import Held, Transport
from .redirects import Ask, Moved, keys_in, publishes, refusal, slot_of

__all__ = ["HeldAcross", "Layout", "Route", "asked_of", "places_refused", "watched"]

_ASKING: Command = ("ASKING",)
_UNWATCH: Command = ("UNWATCH",)
_PAUSES = (0.0, 0.0, 0.005, 0.01, 0.02, 0.05)
"""Seconds to wait before each further try; redirections are followed at once, twice."""


class Layout(Protocol):
    """Who has which slots."""

    @property
    def timeout(self) -> float:
        """Seconds for which a call made now is tried."""
        ...

    async def owner_of(self, slot: int, *, anew: bool = False) -> Transport:
        """Return the node that has `slot`; `anew` if what is known of the cluster is in doubt."""
        ...

    async def nodes(self) -> Sequence[Transport]:
        """Return the primaries."""
        ...

    def moved(self, problem: Any, asked: Transport) -> Transport:
        """Note what a redirection says, and return the node it names."""
        ...

    async def pause(self, seconds: float) -> None:
        """Wait."""
        ...


class Route:
    """The way of one call: which node is next, until the call's time is over.

    Attributes:
        asking: The node does not have the slot yet, and must be told that this is known.
    """

    def __init__(self, cluster: Layout, slot: int | None, asked: Transport | None = None) -> None:
        self._cluster = cluster
        self._slot = slot
        self._node = asked
        self._deadline = 0.0
        self._tries = 0
        self.asking = False

    async def node(self) -> Transport:
        """Return where to send next."""
        if self._node is None:
            if self._slot is not None:
                self._node = await self._cluster.owner_of(self._slot, anew=self._tries > 0)
            else:
                self._node = random.choice(await self._cluster.nodes())  # noqa: S311
        return self._node

    async def contended(self) -> None:
        """Try once more at once: somebody else wrote to the same key; raise NotConnected if time is over."""
        self._check_time("other programs kept writing to the same key", NotConnected)

    async def refused(self, problem: Exception) -> None:
        """Note why nothing was applied, and wait if need be; raise NotConnected if time is over."""
        # A node that is about to start may refuse TLS too, so there is another try; but it is said which it was.
        self._check_time(_reason(problem), TlsRefused if isinstance(problem, TlsRefused) else NotConnected)
        asked, self._node, self.asking = self._node, None, False
        pause = _PAUSES[min(self._tries, len(_PAUSES) - 1)]
        self._tries += 1
        if isinstance(problem, Ask) and asked is not None:
            self._node, self.asking = self._cluster.moved(problem, asked), not isinstance(problem, Moved)
        else:
            pause = max(pause, 0.005)
        if pause:
            await self._cluster.pause(pause)

    def _check_time(self, reason: str, kind: type[NotConnected]) -> None:
        now = time.monotonic()
        if not self._deadline:
            self._deadline = now + self._cluster.timeout
        if now > self._deadline:
            raise kind(
                f"the cluster did not take the call within {self._cluster.timeout:g} s ({reason}); "
                "nothing was applied: call again, or give it longer with timeout="
            )


def _reason(problem: Exception) -> str:
    if isinstance(problem, Ask):
        return f"slot {problem.slot_id} is said to be at {problem.host}:{problem.port}, and the nodes may not agree"
    return str(problem)


class HeldAcross:
    """A connection to the node that has what is watched; each WATCH may find it elsewhere."""

    def __init__(self, cluster: Layout) -> None:
        self._cluster = cluster
        self._node: Transport | None = None
        self._lent: AbstractAsyncContextManager[Held] | None = None
        self._held: Held | None = None
        self._asking = False
        self._giving_up: Route | None = None

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        """Send `commands`, which begin with a WATCH or belong to what is watched."""
        if self._held is None or commands[0][0] == "WATCH":
            return await self._begin(commands, bulk)
        if commands[-1][0] == "EXEC":
            return await self._end(commands, bulk)
        return await asked_of(self._held, commands, self._asking, bulk)

    async def _begin(self, commands: Sequence[Command], bulk: bool) -> list[Reply]:
        route = Route(self._cluster, slot_of(commands))
        while True:
            problem: Exception | None
            try:
                held = await self._on(await route.node())
                self._asking = route.asking
                replies = await asked_of(held, commands, route.asking, bulk)
                problem = refusal(replies)
                if problem is None:
                    return replies
                await held.roundtrip([_UNWATCH])
            except NotConnected as error:
                problem = error
            await route.refused(problem)

    async def _end(self, commands: Sequence[Command], bulk: bool) -> list[Reply]:
        """Send a transaction. If its keys are moving it is given up, as after a change of what is watched."""
        assert self._held is not None
        problem = (await watched(self._held, keys_in(commands), self._asking))[0] if publishes(commands) else None
        if problem is None:
            replies = await asked_of(self._held, commands, self._asking, bulk)
            problem = refusal(replies)
            if problem is None:
                return replies
        if self._giving_up is None:
            self._giving_up = Route(self._cluster, slot_of(commands))
        await self._giving_up.refused(problem)
        return [None] * len(commands)

    async def _on(self, node: Transport) -> Held:
        if self._node is not node or self._held is None:
            await self.leave()
            lent = node.hold()
            self._held = await lent.__aenter__()
            self._node, self._lent = node, lent
        return self._held

    async def leave(self, error: BaseException | None = None) -> None:
        """Give the connection back; after an error it is closed."""
        lent, self._lent, self._held = self._lent, None, None
        if lent is None:
            return
        try:
            await lent.__aexit__(type(error) if error else None, error, None)
        except BaseException as again:
            if again is not error:
                raise


async def asked_of(to: Held, commands: Sequence[Command], asking: bool, bulk: bool) -> list[Reply]:
    """Send `commands`, each with the word that one knows that its slot is on its way there, if `asking`."""
    if not asking:
        return await to.roundtrip(commands, bulk=bulk)
    if commands[-1][0] == "EXEC":  # the word holds for all of a transaction
        return (await to.roundtrip([_ASKING, *commands], bulk=bulk))[1:]
    # Of several keys in one command the node would want to have all; of one it does not mind.
    single = [_one_by_one(command) for command in commands]
    got = await to.roundtrip([word for each in single for command in each for word in (_ASKING, command)], bulk=bulk)
    replies, answers = iter(got[1::2]), []
    for each in single:
        parts = [next(replies) for _ in each]
        answers.append(refusal(parts) or parts[-1])
    return answers


def _one_by_one(command: Command) -> list[Command]:
    return [(command[0], key) for key in command[1:]] if command[0] == "WATCH" else [command]


async def watched(
    held: Held, keys: Sequence[bytes], asking: bool, looks: Sequence[Command] = ()
) -> tuple[Exception | None, list[Reply]]:
    """Watch all keys, so that none can leave unnoticed; return why that does not help, or None, and what `looks` see.

    Raises:
        NotConnected: The connection broke, before anything was sent that matters.
        redis.exceptions.RedisError: This user may not.
    """
    try:
        reply, *seen = replies = await asked_of(held, [("WATCH", *keys), *looks], asking, bulk=False)
    except ConnectionLost as error:
        raise NotConnected(f"{error}; nothing was sent but a look at the keys, so nothing was applied") from error
    problem = refusal(replies)
    if problem is None and isinstance(reply, Exception):
        raise reply
    if problem is not None:
        await held.roundtrip([_UNWATCH])
    return problem, seen


def places_refused(answers: Sequence[Reply]) -> list[int]:
    """Return the places of what was not applied."""
    return [place for place, reply in enumerate(answers) if refusal((reply,)) is not None]
