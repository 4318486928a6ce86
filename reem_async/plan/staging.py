"""Large values that are sent before the transaction that puts them in place.

A transaction under WATCH is given up if anybody writes to the same top-level key between the look and its end. An
array of 8 MB takes longer to arrive than a robot's other programs wait between two writes: as part of the transaction
it would never get through. So it is sent first, under a name that nothing refers to, and the transaction renames it.
Should its sender die in between, the server forgets it after a minute.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from . import Command, Reply
from .sizes import has_large

__all__ = ["KEPT", "STAGED", "Staged", "are_missing", "as_given", "is_large", "looks_at", "stage"]

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
