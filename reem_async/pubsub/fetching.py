"""Reading aside, beside updates that go on coming: the driver of a `Division`."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeVar

from ..errors import Conflict
from ..plan import Reply
from .division import Division, Phase, U

__all__ = ["divided_read"]

T = TypeVar("T")

_TRIES = 10
"""Reads until one gives up: somebody publishes all the time of whom nothing is heard."""


async def divided_read(
    division: Division[U], read: Callable[[], Awaitable[tuple[T, Reply]]], fence: Callable[[], Awaitable[None]]
) -> T:
    """Return what was read once it is known which updates are in it: `division.take()` has them then.

    One read, a fence if the last update that is in it has not been heard of, and both again in the rare case that
    nobody can know. If it raises or is cancelled, the division is as if nothing had been asked for.

    Args:
        division: Who is told of the updates meanwhile.
        read: Reads a value and, in the same transaction, the note of the last update; calls `division.asked` before.
            It may ask the division itself whether a fence has to pass, and wait for it.
        fence: Returns when all that was published before has been heard of.

    Raises:
        Conflict: Updates came all the time that were never heard of.
    """
    try:
        for _ in range(_TRIES):
            found, note = await read()
            has_fenced = division.phase is Phase.FENCING
            if not has_fenced and not division.answered(note):
                await fence()
            if division.divide(note):
                return found
        raise Conflict("updates came all the time that were never heard of")
    except BaseException:
        division.give_up()
        raise
