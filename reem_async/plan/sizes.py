"""What counts as large: it goes over a connection of its own, and ahead of transactions that are watched.

And what is too large: upon that a server closes the connection, without a word.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from ..errors import BadValue
from . import Command, Plan, Reply

LARGE = 1 << 16
"""Bytes from which others should not have to wait behind a value, in either direction."""


class Limits(NamedTuple):
    """What a server takes.

    Attributes:
        argument: Bytes that one argument of a command may have, and so an array, or the text of a document.
        call: Bytes that all commands of a transaction may have together.
    """

    argument: int
    call: int


USUAL = Limits(512 << 20, 1 << 30)
"""As servers come: proto-max-bulk-len and client-query-buffer-limit."""

_WORDS = 1 << 16
"""Bytes of a call for what else is in it, and what the server has read ahead."""


def has_large(commands: Sequence[Command]) -> bool:
    """Return whether any argument of `commands` is so large that others should not wait behind it."""
    for command in commands:
        for word in command:
            # A str is a name or a number here; what is large comes as bytes, a memoryview, or a tuple of pieces.
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
    """Return the bytes of each argument that is not a str."""
    return [_size(word) for command in commands for word in command if type(word) is not str]


def limits() -> Plan:
    """Plan to ask a server for its limits; the result is `USUAL` if the user may not."""
    names = ("proto-max-bulk-len", "client-query-buffer-limit")

    def decode(replies: Sequence[Reply]) -> Limits:
        found = replies[0] if isinstance(replies[0], dict) else {}
        own = [found.get(name.encode(), b"") for name in names]
        return Limits(*[int(text) if text.isdigit() else usual for text, usual in zip(own, USUAL, strict=True)])

    return Plan([("CONFIG", "GET", *names)], decode)


def check_sizes(sizes: Sequence[tuple[str, int]], most: Limits) -> None:
    """Raise BadValue if a server with these limits would not take a call, given its places and the bytes for each."""
    # The largest is named, also where only the sum is too much: it is what is worth storing apart.
    where, size = max(sizes, key=lambda it: it[1])
    if size > most.argument:
        raise BadValue(
            f"{where}: {size} bytes are more than the server takes in one value, {most.argument} (its setting "
            "proto-max-bulk-len); store it in parts"
        )
    total = sum([size for _, size in sizes])
    if total > most.call - _WORDS:
        raise BadValue(
            f"{where}: {total} bytes in one call are more than the server takes at once, {most.call - _WORDS} (its "
            "setting client-query-buffer-limit, less 64 KB); store them in several calls"
        )


# Large values that are sent before the transaction that puts them in place.
#
# A transaction under WATCH is given up if anybody writes to the same top-level key between the look and its end. An
# array of 8 MB takes longer to arrive than a robot's other programs wait between two writes: as part of the transaction
# it would never get through. So it is sent first, under a name that nothing refers to, and the transaction renames it.
# Should its sender die in between, the server forgets it after a minute.


STAGED = ":staged:"
"""Follows the tag of a top-level key in the names of what was sent and not yet put in place."""

KEPT = 60
"""Seconds for which a server keeps what was not put in place."""


class Staged(NamedTuple):
    """A value on its way.

    Attributes:
        name: Where it waits.
        upload: What sends it there.
    """

    name: str
    upload: Command


def stage(commands: Sequence[Command], tag: str, unique: str) -> tuple[list[Command], list[Staged]]:
    """Return commands that put large values in place by renaming, and what has to be sent before.

    Args:
        commands: Those that would send the values themselves.
        tag: Of the top-level key.
        unique: Makes the names of what is on its way.
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
    """Return the replies to a transaction as it was given to `stage`: a large SET became two commands of `moved`."""
    names = {each.name for each in coming}
    extra = {place for place, command in enumerate(moved) if command[0] == "PERSIST" and command[1] in names}
    answers, outcome = list(replies), replies[-1]
    if isinstance(outcome, list):
        answers[-1] = [reply for place, reply in enumerate(outcome, 1) if place not in extra]
    for place in extra:
        if isinstance(answers[place], Exception):  # it is why the transaction was refused
            answers[place + 1] = answers[place]
    return [reply for place, reply in enumerate(answers) if place not in extra]


def is_large(command: Command) -> bool:
    """Return whether a command stores a value that takes long to arrive."""
    return len(command) == 3 and command[0] == "SET" and has_large((command,))


def looks_at(coming: Sequence[Staged]) -> list[Command]:
    """Return the commands that tell, once the names are watched, whether all that was sent is there."""
    return [("TYPE", each.name) for each in coming]


def are_missing(replies: Sequence[Reply]) -> bool:
    """Return whether replies to `looks_at` say that something must be sent again: it was forgotten, or left behind."""
    return b"none" in replies
