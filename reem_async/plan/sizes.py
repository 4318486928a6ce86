"""Sizes: large values have a connection of their own and are staged ahead of watched transactions.

Values that are too large are refused here: a server would close the connection without an error.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from ..errors import BadValue
from . import Command, Reply

LARGE = 1 << 16  # bytes from which other calls should not wait behind a value, in either direction


LONGEST, LONGEST_CALL = 512 << 20, 1 << 30
"""Bytes of one value, and of a call: servers' defaults of proto-max-bulk-len and client-query-buffer-limit."""
_WORDS = 1 << 16  # bytes of a call for its other words, and for what the server has read ahead


def has_large(commands: Sequence[Command]) -> bool:
    for command in commands:
        for word in command:
            # A str is a name or a number; large values are bytes, a memoryview, or a tuple of pieces.
            if type(word) is not str and _size(word) >= LARGE:
                return True
    return False


def _size(word: Any) -> int:
    kind = type(word)
    if kind is bytes:
        return len(word)
    if kind is memoryview:
        return int(word.nbytes)
    return sum(map(len, word)) if kind is tuple else 0


def sizes_of(commands: Iterable[Command]) -> list[int]:
    return [_size(word) for command in commands for word in command if type(word) is not str]


def check_sizes(sizes: Sequence[tuple[str, int]]) -> None:
    """Raise BadValue if a call is too large for a server, given its paths and the bytes of each."""
    # Names the largest, also if only the sum is too much: that value should be stored in another call.
    where, size = max(sizes, key=lambda it: it[1])
    if size > LONGEST:
        raise BadValue(f"{where}: {size} bytes are more than a server takes in one value, {LONGEST}; store it in parts")
    total = sum([size for _, size in sizes])
    if total > LONGEST_CALL - _WORDS:
        raise BadValue(
            f"{where}: {total} bytes in one call are more than a server takes at once, {LONGEST_CALL - _WORDS}; store "
            "them in several calls"
        )


# Staging: large values are sent before the transaction that puts them in place.
#
# A transaction under WATCH fails if another client writes to the same top-level key before its end. An array of 8 MB
# takes longer to arrive than the pause between two writes of a robot's other programs: such a transaction would never
# succeed. So the array is sent first, under a key that nothing refers to, and the transaction renames that key. If the
# sender dies in between, the key expires after a minute.


STAGED = ":staged:"  # follows the tag of a top-level key in the names of staged values
KEPT = 60  # seconds until a staged value expires


class Staged(NamedTuple):
    name: str
    upload: Command


def stage(commands: Sequence[Command], tag: str, unique: str) -> tuple[list[Command], list[Staged]]:
    """Return commands that put the large values of `commands` in place by renaming, and the values to stage before.

    The names of their keys are made of the top-level key's `tag` and something `unique`.
    """
    coming: list[Staged] = []
    moving: list[Command] = []
    for command in commands:
        if is_large(command):
            _, key, blob = command
            name = f"{tag}{STAGED}{unique}.{len(coming)}"
            coming.append(Staged(name, ("SET", name, blob, "EX", KEPT)))
            # PERSIST first: RENAME keeps the time to live, and the array would be gone after a minute.
            moving += [("PERSIST", name), ("RENAME", name, key)]
        else:
            moving.append(command)
    return moving, coming


def as_given(moved: Sequence[Command], coming: Sequence[Staged], replies: Sequence[Reply]) -> list[Reply]:
    """Return the replies as `stage` got the commands: a large SET became two commands of `moved`."""
    names = {each.name for each in coming}
    extra = {place for place, command in enumerate(moved) if command[0] == "PERSIST" and command[1] in names}
    answers, outcome = list(replies), replies[-1]
    if isinstance(outcome, list):
        answers[-1] = [reply for place, reply in enumerate(outcome, 1) if place not in extra]
    for place in extra:
        if isinstance(answers[place], Exception):  # the reason why the transaction was refused
            answers[place + 1] = answers[place]
    return [reply for place, reply in enumerate(answers) if place not in extra]


def is_large(command: Command) -> bool:
    return len(command) == 3 and command[0] == "SET" and has_large((command,))


def looks_at(coming: Sequence[Staged]) -> list[Command]:
    """Return the commands whose replies `are_missing` reads."""
    return [("TYPE", each.name) for each in coming]


def are_missing(replies: Sequence[Reply]) -> bool:
    """Return whether a staged value must be sent again: it has expired, or is on the node that the slot has left."""
    return b"none" in replies
