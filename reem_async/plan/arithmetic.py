"""Plans that calculate on the server: one atomic command, checked against Python's arithmetic.

RedisJSON wraps integers around without a word when they leave 64 bits. So the server calculates only
where the number was seen to be far from that; everything else is read, calculated here and written
back under WATCH. Still the old value is read in the same transaction and the result compared with
what it has to be: somebody else may have made the number large, and then the old one is put back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from ..errors import BadType, Overflow
from . import Command, Plan, Reply
from .documents import encode
from .keys import Keys
from .memory import Memory
from .paths import Path, show, to_jsonpath
from .placeholders import find
from .reads import get_command, present
from .replies import checked, full, loads

__all__ = ["calculate", "compute"]

Operation = Callable[[Any, Any], Any]
Notices = Callable[[], Sequence[Command]]
"""Makes the commands that tell subscribers, anew for each transaction: notices are numbered."""

_LOWEST, _HIGHEST = -(2**63), 2**63 - 1
"""The server calculates with signed 64-bit integers, though it stores unsigned ones too."""

_FAR = 2**62
"""Results that ought to be below this are left to the server."""


def calculate(
    keys: Keys,
    path: Path,
    command: str,
    operation: Operation,
    operand: float,
    text: bytes,
    notices: Notices,
    memory: Memory,
) -> Plan:
    """Plan `command` (JSON.NUMINCRBY, JSON.NUMMULTBY) with `operand`, in one transaction; returns the new number.

    Raises (in decode):
        MissingKey: Nothing is there.
        BadType: Not a number.
        Overflow: The result is out of range; the old value stays.
    """
    known = memory.number(keys.document, path)
    if known is None or not -_FAR < operation(known, operand) < _FAR:
        return compute(keys, path, lambda number: operation(number, operand), notices, memory)
    place = to_jsonpath(path)
    commands = [
        get_command(keys, path),
        (command, keys.document, place, text),
        get_command(keys, path),
        *notices(),
    ]

    def decode(replies: Sequence[Reply]) -> Any:
        old = _number(present(replies[0], keys, path), keys, path)
        if replies[1] == [None]:  # a float that is stored as text
            return compute(keys, path, lambda number: operation(number, operand), notices, memory)
        if isinstance(replies[1], Exception) and "not a number" in str(replies[1]):
            raise _overflow(keys, path, old)
        checked(replies[1], keys, path)
        text = present(replies[2], keys, path)
        new, due = loads(text, keys)[0], operation(old, operand)
        if type(new) is type(due) and new == due:
            memory.saw_number(keys.document, path, new)
            return new
        return _put_right(keys, path, text, old, due, notices)

    return Plan(commands, decode, atomic=True)


def compute(keys: Keys, path: Path, function: Callable[[Any], Any], notices: Notices, memory: Memory) -> Plan:
    """Plan to replace the number at `path` by `function` of it; repeats until nobody interferes."""

    def look(replies: Sequence[Reply]) -> Any:
        old = _number(present(replies[1], keys, path), keys, path)
        new = _in_range(function(old), keys, path, old)
        return _guarded(keys, path, new, notices, again, lambda: finish(new))

    def again(notices: Notices) -> Plan:
        return compute(keys, path, function, notices, memory)

    def finish(new: Any) -> Any:
        memory.saw_number(keys.document, path, new)
        return new

    return Plan([("WATCH", keys.document), get_command(keys, path)], look, held=True)


def _put_right(keys: Keys, path: Path, wrong: bytes, old: Any, due: Any, notices: Notices) -> Plan:
    """Plan to replace a wrapped result by the right one, or by the old value if that is out of range."""
    fits = _fits(due)

    def look(replies: Sequence[Reply]) -> Any:
        if present(replies[1], keys, path) != wrong:
            raise Overflow(
                f"{show(full(keys, path))}: the result left the range of 64 bits and was wrapped around by the server; "
                "somebody else changed it before it could be put right: write it again"
            )
        return _guarded(keys, path, due if fits else old, notices, again, finish)

    def again(notices: Notices) -> Plan:
        return _put_right(keys, path, wrong, old, due, notices)

    def finish() -> Any:
        if not fits:
            raise _overflow(keys, path, old)
        return due

    return Plan([("WATCH", keys.document), get_command(keys, path)], look, held=True)


def _guarded(
    keys: Keys,
    path: Path,
    value: Any,
    notices: Notices,
    again: Callable[[Notices], Plan],
    then: Callable[[], Any],
) -> Plan:
    """Plan to set a number on the watched connection; `again` is what to do if somebody else was faster."""
    told = notices()
    text = encode(value, full(keys, path), lambda _: None, lambda _: "").text

    def decode(replies: Sequence[Reply] | None) -> Any:
        if replies is None:
            return again(lambda: told)  # nobody has seen these yet, so their numbers are not used up
        checked(replies[0], keys, path)
        return then()

    return Plan([("JSON.SET", keys.document, to_jsonpath(path), text), *told], decode, atomic=True, held=True)


def _number(text: bytes, keys: Keys, path: Path) -> Any:
    holder = loads(text, keys)
    crates = find(holder, keys.name)
    number = holder[0]
    if crates or isinstance(number, bool) or not isinstance(number, int | float):
        what = crates[0].placeholder.label if crates else type(number).__name__
        raise BadType(
            f"{show(full(keys, path))} is of type {what}, not a number; read it, calculate, and write it back"
        )
    return number


def _fits(number: Any) -> bool:
    return math.isfinite(number) if isinstance(number, float) else _LOWEST <= number <= _HIGHEST


def _in_range(number: Any, keys: Keys, path: Path, old: Any) -> Any:
    if not _fits(number):
        raise _overflow(keys, path, old)
    return number


def _overflow(keys: Keys, path: Path, old: Any) -> Overflow:
    return Overflow(
        f"{show(full(keys, path))}: the result is out of range of 64-bit numbers; the old value {old!r} stays"
    )
