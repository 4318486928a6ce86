"""What the nodes of a cluster answer in place of a result, all of which means: nothing was applied."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import redis.crc
import redis.exceptions

from ..plan import Command, Reply

__all__ = [
    "Ask", "Moved", "Unapplied", "is_moved", "is_unapplied", "key_of", "key_slot", "keys_in", "publishes",
    "refusal", "slot_of", "slots_of",
]  # fmt: skip

key_slot: Callable[[bytes], int] = redis.crc.key_slot
"""Return the number of the slot that a key or channel belongs to."""

Moved = redis.exceptions.MovedError
"""Another node has the slot."""

Ask = redis.exceptions.AskError
"""The slot is moving and this key is not here any more, or is nowhere: ask there."""

Unapplied = (
    redis.exceptions.AskError,  # MovedError is one of them
    redis.exceptions.TryAgainError,  # some keys of the slot are here, others there
    redis.exceptions.ClusterDownError,
    redis.exceptions.MasterDownError,
    redis.exceptions.BusyLoadingError,
)
"""Replies of a node that did nothing. The command may be sent again."""

_KEYLESS = frozenset(
    ["SCAN", "PING", "INFO", "TIME", "CONFIG", "ACL", "CLUSTER", "CLIENT", "COMMAND", "DBSIZE", "MODULE", "UNWATCH"]
)
_NO_KEYS_IN_TRANSACTIONS = frozenset(["MULTI", "EXEC", "UNWATCH", "PUBLISH", "SPUBLISH"])


def key_of(command: Command) -> bytes | None:
    """Return the key that decides where a command belongs; None if any node may have it.

    All commands that REEM sends have their key behind their name, and all of a plan have the same hash tag.
    """
    if len(command) < 2 or command[0] in _KEYLESS:
        return None
    word = command[1]
    return word if type(word) is bytes else str(word).encode()


def slot_of(commands: Sequence[Command]) -> int | None:
    """Return the slot that commands of one top-level key belong to; None if any node may have them."""
    first = commands[0]
    return _slot(commands[1] if first[0] == "MULTI" else first)


def _slot(command: Command) -> int | None:
    if len(command) < 2 or command[0] in _KEYLESS:
        return None
    return _slot_of_word(command[1])


@lru_cache(maxsize=4096)
def _slot_of_word(word: str | bytes) -> int:
    return key_slot(word if type(word) is bytes else str(word).encode())


def slots_of(commands: Sequence[Command]) -> list[int | None]:
    """Return the slot of each command."""
    return [_slot(command) for command in commands]


def publishes(commands: Sequence[Command]) -> bool:
    """Return whether this is a transaction with a notice, which is its last command."""
    return bool(commands[-1][0] == "EXEC" and commands[-2][0] == "SPUBLISH")


def keys_in(commands: Sequence[Command]) -> list[bytes]:
    """Return all keys of commands, channels left out, each once."""
    found: dict[bytes, None] = {}
    for command in commands:
        # The only commands of REEM with more than one key.
        if command[0] in ("UNLINK", "RENAME", "WATCH"):
            found.update(dict.fromkeys(word if type(word) is bytes else str(word).encode() for word in command[1:]))
        elif command[0] not in _NO_KEYS_IN_TRANSACTIONS and (key := key_of(command)) is not None:
            found[key] = None
    return list(found)


def refusal(replies: Sequence[Reply]) -> redis.exceptions.RedisError | None:
    """Return the first reply that means that a command was not applied, None if there is none."""
    for reply in replies:
        if isinstance(reply, Exception) and isinstance(reply, Unapplied):  # the first check is the faster one
            return reply
    return None


def is_moved(reply: object) -> bool:
    """Return whether a reply says that another node has the slot."""
    return isinstance(reply, Moved)


def is_unapplied(reply: object) -> bool:
    """Return whether a reply or error means that a node did nothing, and another one, or a later try, may."""
    return isinstance(reply, Unapplied)
