"""A transaction that publishes through a cluster: what is large first, then, its keys being watched, the rest."""

from __future__ import annotations

import secrets
from collections.abc import Sequence

from ..errors import ConnectionLost, NotConnected
from ..plan import Command, Reply
from ..plan.staging import are_missing, is_large, looks_at, stage
from . import Held, Transport
from .redirects import Ask, Moved, keys_in, refusal
from .route import asked_of, watched

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
        moving, self._coming = stage(body, channel[: channel.index("}") + 1], secrets.token_hex(5))
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

    async def publish(self, held: Held, asking: bool, bulk: bool) -> Outcome:
        """Do the rest over a connection to the same node."""
        problem, looks = await watched(held, keys_in(self._commands), asking, looks_at(self._coming))
        if problem is None and are_missing(looks):
            self._there = None
            await held.roundtrip([("UNWATCH",)])
            return None, None
        if problem is not None:
            return problem, None
        replies = await asked_of(held, self._commands, asking, bulk)
        problem = refusal(replies)
        return problem, self._as_given(replies) if problem is None and replies[-1] is not None else None

    def _as_given(self, replies: list[Reply]) -> list[Reply]:
        """Return one reply to each of the commands that were given; a large SET became two."""
        names = {each.name for each in self._coming}
        extra = [
            place for place, command in enumerate(self._commands) if command[0] == "PERSIST" and command[1] in names
        ]
        replies, outcome = list(replies), replies[-1]
        if isinstance(outcome, list):
            replies[-1] = [reply for place, reply in enumerate(outcome, 1) if place not in extra]
        for place in extra:
            if isinstance(replies[place], Exception):  # it is why the transaction was refused
                replies[place + 1] = replies[place]
        return [reply for place, reply in enumerate(replies) if place not in extra]
