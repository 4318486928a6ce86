"""Where a plan's JSON commands meet a server that has no JSON module: see `reem_async.plain`.

Which kind of server it is, each connection knows: HELLO lists the modules. Only where no JSON is among them is one
question more asked, once for each connection, since some servers have JSON without a module.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, NamedTuple
from zlib import crc32

from ..concurrency.timeouts import time_limit
from ..errors import ConnectionLost, NoJsonSupport, NotConnected
from ..plain.translation import Known, Steps, Watched, after_look, concerns, directly, is_json, looked_at, translated
from ..plan import Command, Reply
from ..plan.sizes import KEPT, Staged, as_given, stage
from . import Contention, Held
from .protocol import error_of

PROBE: Command = ("JSON.GET",)
"""Refused by every server: for its number of words by one that knows the command, else as an unknown one."""

_AT_A_TIME = 8
"""Changes below the top that one interface has under way at the same time, each over a connection of its own."""
_AS_LONG = 0.9
"""Fraction of the time limit after which a failure counts as "server down" for queued calls: uploads fail early."""

_MODULES = (b"ReJSON", "ReJSON", b"json", "json")  # what HELLO calls the modules of Redis and of Valkey


def lists_json(greeting: Any) -> bool:
    if not isinstance(greeting, dict):
        return False
    modules = greeting.get(b"modules") or greeting.get("modules") or ()
    return any(isinstance(each, dict) and (each.get(b"name") or each.get("name")) in _MODULES for each in modules)


def is_plain(reply: Reply) -> bool:
    return isinstance(reply, NoJsonSupport)


Send = Callable[..., Awaitable[list[Reply]]]  # sends commands that any server takes: `send(commands, bulk=...)`


class Text:
    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self.known = Known()
        # By turn: the last one whose holder lost the server.
        self._lost: dict[str, _Lost] = {}

    async def roundtrip(self, send: Send, lending: Any, commands: Sequence[Command], bulk: bool) -> list[Reply]:
        """Do as `Transport.roundtrip`: `send` sends, and `lending` has that transport's `hold` and `ordered`."""
        keys = looked_at(commands, self.known)
        if keys:
            return await self._after_look(lending, keys, commands, bulk)
        if not concerns(commands):
            return await send(commands, bulk=bulk)
        replies = await _carried_out(send, directly(commands, self.known, error_of), bulk)
        assert replies is not None
        return replies

    async def _after_look(
        self, lending: Any, keys: Sequence[bytes], commands: Sequence[Command], bulk: bool
    ) -> list[Reply]:
        """Look, then change; retry if another client wrote in between. Two round trips. Raises Contended.

        Callers of one transport go one after the other for each key, since they would only be in each other's way, and
        no more than a few at a time, since each has a connection. Cancelled, or broken off, it was applied once or not
        at all; the connection is closed.
        """
        # Locks by a few numbers rather than by key, which bounds the connections as well. All keys of a plan are of one
        # document; of another batch, the lock of the first has to do.
        turn = f"documents {crc32(keys[0]) % _AT_A_TIME}"
        contention, attempt = Contention(time_limit(self.timeout)), _Attempt(keys, commands)
        while True:
            # Each attempt waits for its turn: a caller that keeps losing must not block writers of other keys.
            came = time.monotonic()
            async with lending.ordered(turn):
                self._check_reached(turn, came)
                begun = time.monotonic()
                try:
                    async with lending.hold() as held:
                        replies = await attempt.made(held, bulk)
                except (ConnectionLost, NotConnected) as error:
                    now = time.monotonic()
                    self._lost[turn] = _Lost(now, now - begun, str(error))
                    raise
            contention.waited(begun - came)
            if replies is not None:
                return replies
            contention.given_up(commands)
            attempt.send_ahead()

    def _check_reached(self, turn: str, came: float) -> None:
        """Raise NotConnected if the server was lost while a call waited for its turn, after as much time as it has.

        Else each waiting call would have a time limit of its own, one after the other.
        """
        lost = self._lost.get(turn)
        # A connection that breaks at once says nothing of the server: the next one may be made.
        if lost is not None and lost.time > came and lost.took >= _AS_LONG * time_limit(self.timeout):
            raise NotConnected(
                "the call ahead of this one lost the server, so this one was not sent and nothing was applied: "
                f"call again (of that one it was said: {lost.error})"
            )


class HeldText:
    def __init__(self, held: Held, text: Text) -> None:
        self._held = held
        self._known = text.known
        self._timeout = text.timeout
        self._watched = Watched()

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        """Send `commands` and return their replies; a change of what was not read before takes two round trips.

        Raises Contended if others were first each time; then nothing was applied.
        """
        contention: Contention | None = None
        while True:
            steps = translated(commands, self._known, error_of, self._watched)
            replies = await _carried_out(self._held.roundtrip, steps, bulk)
            if replies is not None:
                return replies
            contention = contention or Contention(time_limit(self._timeout))
            contention.given_up(commands)

    async def attempt(self, keys: Sequence[bytes], commands: Sequence[Command], bulk: bool) -> list[Reply] | None:
        """Look at `keys` and change them where nothing is watched before; return None if another client was first."""
        return await _carried_out(self._held.roundtrip, after_look(commands, keys, self._known, error_of, None), bulk)


class _Lost(NamedTuple):
    time: float
    took: float  # for how many seconds it had tried
    error: str  # what it raised, in words: the error itself would keep what its caller had


class _Attempt:
    """A batch that is retried until no other client writes in between."""

    def __init__(self, keys: Sequence[bytes], commands: Sequence[Command]) -> None:
        self._keys = keys
        self.given = self._commands = commands  # the batch, which concerns the documents of `keys`
        self._coming: list[Staged] = []
        self._sent = -float(KEPT)

    def send_ahead(self) -> None:
        """From now on, send large values before their transaction: others are first while they are on their way."""
        if not self._coming and self.given[-1][0] == "EXEC":
            tag = f"{{{self._keys[0].decode(errors='surrogateescape')}}}"
            self._commands, self._coming = stage(self.given, tag, secrets.token_hex(5))

    async def made(self, held: Held, bulk: bool) -> list[Reply] | None:
        if not isinstance(held, HeldText):  # the server was replaced meanwhile by one that has JSON
            return await held.roundtrip(self.given, bulk=bulk)
        # Sent again well before the server forgets it.
        if self._coming and time.monotonic() - self._sent > KEPT / 2:
            self._sent = time.monotonic()
            refused = await self._upload(held)
            if refused is not None:
                return refused
        replies = await held.attempt(self._keys, self._commands, bulk)
        return None if replies is None else as_given(self._commands, self._coming, replies)

    async def _upload(self, held: HeldText) -> list[Reply] | None:
        replies = await held.roundtrip([each.upload for each in self._coming])
        reason = next((reply for reply in replies if isinstance(reply, Exception)), None)
        return None if reason is None else [reason] * (len(self._commands) - len(self._coming))


async def _carried_out(send: Send, steps: Steps, bulk: bool) -> list[Reply] | None:
    """Send what a translation yields, until it returns."""
    commands = next(steps)
    while True:
        replies = await send(commands, bulk=bulk)
        try:
            commands = steps.send(replies)
        except StopIteration as end:
            found: list[Reply] | None = end.value
            return found


def over_wire(
    commands: Sequence[Command], done: Callable[[list[Reply] | Exception], None]
) -> tuple[Sequence[Command], Callable[[list[Reply] | Exception], None]]:
    """Return what to send in place of `commands`, which only read, and what to call with the replies."""
    if not any(map(is_json, commands)):
        return commands, done
    steps = directly(commands, Known(), error_of)

    def answered(outcome: list[Reply] | Exception) -> None:
        if isinstance(outcome, list):
            try:
                steps.send(outcome)
            except StopIteration as end:
                outcome = end.value
        done(outcome)

    return next(steps), answered
