"""The pure middle: what to send, and what the replies mean.

Nothing in this package does I/O. A function here turns a call into a `Plan`: the commands of one round trip and a
`decode` that turns their replies into the result or into the next `Plan`. A transport drives it, blocking or not, so
both fronts run the same plans.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..errors import BadData, ClusterReply, PartialWrite, Refused, turned_down

Command = tuple[Any, ...]  # one server command: its words as str, bytes, int, float or a flat buffer

Reply = Any  # a reply of the server: bytes, int, None, a container of these, or an exception object

_MULTI: Command = ("MULTI",)
_EXEC: Command = ("EXEC",)
_READS = frozenset(["GET", "JSON.GET", "SMEMBERS", "TYPE"])
"""Commands that REEM's transactions read with. Any other, such as one of a user's ship, may have changed something."""


class Plan(NamedTuple):
    """One round trip, and what to make of its replies."""

    commands: Sequence[Command]  # what to send, in order
    # Takes one reply per command; returns the result, or the next plan. If a watched key changed, so that the
    # transaction was not executed, it gets None instead.
    decode: Callable[[Any], Any]
    atomic: bool = False  # send the commands as one MULTI/EXEC
    held: bool = False  # keep the connection to this plan and its successors (WATCH belongs to a connection)
    bulk: bool = False  # the replies are large: use a connection on which no other call waits
    # Earlier plans were applied and this one failed: makes the error to raise from that of this plan.
    unfinished: Callable[[Exception], Exception] | None = None
    # Called if the user lacks the right to some commands, so that nothing was executed: takes a reply per command,
    # and returns the plan for the rest; None if there is none.
    without_refused: Callable[[Sequence[Any]], Plan | None] | None = None


def wire_commands(plan: Plan) -> Sequence[Command]:
    return (_MULTI, *plan.commands, _EXEC) if plan.atomic else plan.commands


def unwrap(plan: Plan, replies: list[Reply]) -> list[Reply] | None:
    """Return one reply per command of `plan`, or None if a watched key had changed.

    Raises:
        redis.exceptions.RedisError: The server refused the whole transaction; nothing was applied.
        PartialWrite: It refused MULTI only, and executed the commands one by one.
        BadData: The reply is not that of a transaction.
    """
    if not plan.atomic:
        return replies
    outcome = replies[-1]
    if isinstance(outcome, Exception):
        # EXECABORT only says that something was wrong; the reason was the reply to one of the commands.
        pairs = list(zip(replies, wire_commands(plan), strict=True))
        reason = next((blamed(reply, command) for reply, command in pairs if isinstance(reply, Exception)), outcome)
        raise _apart(reason, pairs[1:-1]) if isinstance(replies[0], Exception) else reason
    # EXEC answers nil only where a watched key has changed.
    if outcome is None and plan.held:
        return None
    if type(outcome) is not list or len(outcome) != len(plan.commands):
        raise BadData(f"the server answered a transaction of {len(plan.commands)} commands with {outcome!r:.60}")
    return outcome


def _apart(reason: Exception, pairs: Sequence[tuple[Reply, Command]]) -> Exception:
    """Return the error to raise if MULTI was refused: each command behind it was then executed by itself."""
    done = [
        command[:2]
        for reply, command in pairs
        if reply is not None and not isinstance(reply, Exception) and command[0] not in _READS
    ]
    if not done:
        return reason
    shown = ", ".join(" ".join(str(word) for word in command) for command in done)
    return PartialWrite(f"{reason}; MULTI was refused, so these commands were executed separately: {shown:.300}")


def raise_refused(replies: Sequence[Reply], commands: Sequence[Command]) -> None:
    """Raise the first error among replies, with the command that it is about."""
    for reply, command in zip(replies, commands, strict=True):
        if isinstance(reply, Exception):
            raise blamed(reply, command)


def blamed(error: Exception, command: Command) -> Exception:
    """Return `error` with the command in its message, if the server refused it without naming a key."""
    if not isinstance(error, Refused | ClusterReply):
        return error
    words = [word.decode(errors="replace") if isinstance(word, bytes) else str(word) for word in command[:2]]
    return turned_down(error).at(f"{' '.join(words):.120}")
