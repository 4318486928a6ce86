"""Plans that calculate on the server: one atomic command, checked against Python's arithmetic.

RedisJSON wraps integers around silently when they leave 64 bits. So the server calculates only if the number was seen
to be far from that; else the number is read, calculated here, and written back under WATCH. Another client may have
made the number large in between, so the transaction also reads the old value, and the result is compared with Python's;
if it is wrong, it is corrected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from ..errors import MissingKey, Overflow, PartialWrite, WrongType
from . import Plan, Reply
from .attachments import permitted
from .changes import Announcement
from .documents import encode
from .keys import Keys
from .paths import Path, counts_from_end, show, to_jsonpath
from .placeholders import find
from .reads import get_command, present
from .replies import checked, from_front, full, lengths, loads
from .shapes import ShapeCache

Operation = Callable[[Any, Any], Any]

_LOWEST, _HIGHEST = -(2**63), 2**63 - 1
"""The server calculates with signed 64-bit integers, though it stores unsigned ones too."""

_FAR = 2**62  # the server calculates results that should be below this


def calculate(
    keys: Keys,
    path: Path,
    command: str,
    operation: Operation,
    operand: float,
    text: bytes,
    announcement: Announcement,
    cache: ShapeCache,
) -> Plan:
    """Plan `command` (JSON.NUMINCRBY, JSON.NUMMULTBY) with `operand`, in one transaction; returns the new number.

    Raises (in decode):
        MissingKey: Nothing is there.
        WrongType: Not a number.
        Overflow: The result is out of range; the old value stays.
    """

    def attempt(known: Any) -> Plan:
        # A number seen before tells how near the ends of 64 bits the result will be. It is only a guess: the
        # transaction reads the number before and after.
        if known is None or counts_from_end(path) or not -_FAR < operation(known, operand) < _FAR:
            return computed()
        server_command = (command, keys.document, to_jsonpath(path), text)
        read = get_command(keys, path)
        return Plan([read, server_command, read, *announcement.commands(path)], decode, atomic=True)

    def decode(replies: Sequence[Reply]) -> Any:
        old = _number(present(replies[0], keys, path), keys, path)
        if replies[1] == [None]:  # a float that is stored as text
            return computed()
        # RedisJSON's message for an infinite result; the old value stays.
        if isinstance(replies[1], Exception) and "not a number" in str(replies[1]):
            raise _overflow(keys, path, old)
        checked(replies[1], keys, path)
        result = present(replies[2], keys, path)
        new, due = loads(result, keys)[0], operation(old, operand)
        if type(new) is type(due) and new == due:
            cache.of(keys.document).saw_number(path, new)
            return new
        return _corrected(keys, path, result, old, due, announcement)

    def computed() -> Plan:
        # If another client wrote in between, the number that was read is such a guess for the next attempt.
        return compute(keys, path, lambda number: operation(number, operand), announcement, cache, attempt)

    return attempt(cache.of(keys.document).number(path))


def compute(
    keys: Keys,
    path: Path,
    function: Callable[[Any], Any],
    announcement: Announcement,
    cache: ShapeCache,
    otherwise: Callable[[Any], Plan] | None = None,
) -> Plan:
    """Plan to replace the number at `path` by `function` of it, again if another client wrote in between.

    Then `otherwise`, if given, makes the next plan from the number that was read.
    """

    def look(replies: Sequence[Reply]) -> Any:
        permitted(replies[0], keys.document)
        old = _number(present(replies[1], keys, path), keys, path)
        new = function(old)
        if not _fits(new):
            raise _overflow(keys, path, old)
        place = from_front(replies[2:], keys, path, MissingKey)
        return _guarded(keys, place, new, announcement, lambda: again(old), lambda: finish(new))

    def again(old: Any) -> Plan:
        return compute(keys, path, function, announcement, cache) if otherwise is None else otherwise(old)

    def finish(new: Any) -> Any:
        cache.of(keys.document).saw_number(path, new)
        return new

    return Plan([("WATCH", keys.document), get_command(keys, path), *lengths(keys, path)], look, held=True)


def _corrected(keys: Keys, path: Path, wrong: bytes, old: Any, due: Any, announcement: Announcement) -> Plan:
    """Plan to replace a wrapped result by the right one, or by the old value if that is out of range."""
    fits = _fits(due)

    def look(replies: Sequence[Reply]) -> Any:
        permitted(replies[0], keys.document)
        # Another value by now: its writer may have calculated with the wrong one, or replaced it.
        if present(replies[1], keys, path) != wrong:
            raise Overflow(
                f"{show(full(keys, path))}: the result left the range of 64 bits and was wrapped around by the server; "
                "another client changed it before it could be corrected: write it again"
            )
        return _guarded(keys, path, due if fits else old, announcement, again, finish, unfinished)

    def again() -> Plan:
        return _corrected(keys, path, wrong, old, due, announcement)

    def finish() -> Any:
        if not fits:
            raise _overflow(keys, path, old)
        return due

    def unfinished(error: Exception) -> PartialWrite:
        return PartialWrite(
            f"{show(full(keys, path))}: the result left the range of 64 bits, was wrapped around by the server, and "
            f"could not be corrected: {error}; write it again (it was {old!r})"
        )

    return Plan([("WATCH", keys.document), get_command(keys, path)], look, held=True, unfinished=unfinished)


def _guarded(
    keys: Keys,
    path: Path,
    value: Any,
    announcement: Announcement,
    again: Callable[[], Plan],
    then: Callable[[], Any],
    unfinished: Callable[[Exception], Exception] | None = None,
) -> Plan:
    """Plan to set a number on the watched connection; `again` makes the next plan if the document has changed."""
    text = encode(value, full(keys, path), lambda _: None, lambda _: "").text
    commands = [("JSON.SET", keys.document, to_jsonpath(path), text), *announcement.commands(path)]

    def decode(replies: Sequence[Reply] | None) -> Any:
        if replies is None:
            announcement.unsent()
            return again()
        checked(replies[0], keys, path)
        return then()

    return Plan(commands, decode, atomic=True, held=True, unfinished=unfinished)


def _number(text: bytes, keys: Keys, path: Path) -> Any:
    holder = loads(text, keys)
    slots = find(holder, keys.name)
    number = holder[0]
    if slots or isinstance(number, bool) or not isinstance(number, int | float):
        what = slots[0].placeholder.label if slots else type(number).__name__
        raise WrongType(
            f"{show(full(keys, path))} is of type {what}, not a number; read it, calculate, and write it back"
        )
    return number


def _fits(number: Any) -> bool:
    return math.isfinite(number) if isinstance(number, float) else _LOWEST <= number <= _HIGHEST


def _overflow(keys: Keys, path: Path, old: Any) -> Overflow:
    return Overflow(
        f"{show(full(keys, path))}: the result is out of range of signed 64-bit numbers, which servers calculate with; "
        f"the old value {old!r} stays"
    )
