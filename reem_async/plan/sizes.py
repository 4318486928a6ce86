"""What counts as large: it goes over a connection of its own, and ahead of transactions that are watched.

And what is too large: upon that a server closes the connection, without a word.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from ..errors import BadValue
from . import Command, Plan, Reply

__all__ = ["LARGE", "USUAL", "Limits", "check_sizes", "has_large", "limits", "sizes_of"]

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
