"""A transaction that publishes through a cluster: what is large first, then, its keys being watched, the rest."""

from __future__ import annotations

import secrets
from collections.abc import Sequence

from ..errors import ConnectionLost, NotConnected
from ..plan import Command, Reply
from ..plan.sizes import are_missing, as_given, is_large, looks_at, stage
from . import Held, Transport
from .redirects import Ask, Moved, keys_in, refusal
from .route import Route, asked_of, watched

__all__ = ["Publication"]

Outcome = tuple[Exception | None, list[Reply] | None]
"""Why nothing was applied, to be tried elsewhere or later; or the replies; or neither: to be tried at once."""


class Publication:
    """One transaction with a notice, on its way to the node that has its keys.

    Args:
        commands: MULTI, what it does, the notice, EXEC.
    """

    def __init__(self, commands: Sequence[Command]) -> None:
        multi, *body, execute = commands
        channel: str = body[-1][1]
        tag = channel[: channel.index("}") + 1]
        moving, self._coming = stage(body, tag, secrets.token_hex(5))
        self._document = tag[1:-1].encode()
        self._given = commands
        self._commands: Sequence[Command] = [multi, *moving, execute]
        self._there: Transport | None = None

    async def send_ahead(self, node: Transport, asking: bool) -> Outcome:
        """Send to `node` what is large, unless that has it already."""
        if asking:
            self._keep_together()
        if not self._coming or self._there is node:
            return None, None
        try:
            replies = await asked_of(node, [each.upload for each in self._coming], asking, bulk=True)
        except ConnectionLost as error:
            raise NotConnected(f"{error}; what was sent is not in its place, so nothing was applied") from error
        problem = refusal(replies)
        # The slot moves away. What is large would be staged on one node, and the keys to be changed be on the other.
        if isinstance(problem, Ask) and not isinstance(problem, Moved):
            self._keep_together()
            return None, None
        if problem is None and any(isinstance(reply, Exception) for reply in replies):
            return None, self._refused(replies)
        self._there = node if problem is None else None
        return problem, None

    def _keep_together(self) -> None:
        """Send all as it is given: the slot moves, and what is nowhere yet would not be where the other keys are."""
        self._coming, self._commands = [], self._given

    def _refused(self, replies: list[Reply]) -> list[Reply]:
        """Return what a server says to a transaction one of whose commands it does not take."""
        answers: list[Reply] = [None] * len(self._given)
        for place, reply in zip([at for at, each in enumerate(self._given) if is_large(each)], replies, strict=True):
            answers[place] = reply
        answers[-1] = next(reply for reply in replies if isinstance(reply, Exception))
        return answers

    async def publish(self, held: Held, route: Route, bulk: bool) -> Outcome:
        """Do the rest over a connection to the same node."""
        # Where a slot moves, its document tells where its keys may be made: see `transport.route`.
        keys = list(dict.fromkeys([self._document, *keys_in(self._commands)]))
        problem, looks = await watched(held, keys, route, looks_at(self._coming))
        # Forgotten after a minute, or left behind on another node: it is sent again.
        if problem is None and are_missing(looks):
            self._there = None
            await held.roundtrip([("UNWATCH",)])
            return None, None
        if problem is not None:
            return problem, None
        replies = await asked_of(held, self._commands, route.asking, bulk)
        problem = refusal(replies)
        if problem is not None or replies[-1] is None:
            return problem, None
        return None, as_given(self._commands, self._coming, replies)
