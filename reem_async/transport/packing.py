"""Commands: recorded from the calls of a ship, and packed into the pieces that go over the wire.

hiredis packs small commands fastest but copies every argument several times; a large buffer (an
array's memory) is sent as it is, between a header and a line end. A word that is a tuple is one
argument in several pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import hiredis
from redis.commands.core import (
    BasicKeyCommands,
    GeoCommands,
    HashCommands,
    HyperlogCommands,
    ListCommands,
    SetCommands,
    SortedSetCommands,
    StreamCommands,
)
from redis.connection import HiredisRespSerializer

from ..plan import Command
from ..plan.sizes import LARGE, has_large
from ..ships.numpy import flat_buffer

Piece = bytes | memoryview

SLOW = 1 << 13  # bytes that may take longer on a slow link than a call has: as long as they move, it is not given up


def pack(commands: Sequence[Command]) -> list[Piece]:
    """Return the bytes of `commands`, small ones joined, large buffers as they are."""
    # The hot path: one join for all commands of a small call.
    if not has_large(commands):
        return [_joined(commands)]
    pieces: list[Piece] = []
    small: list[bytes] = []
    for command in commands:
        if has_large((command,)):
            _pack_large(command, pieces, small)
        else:
            small.append(_joined((command,)))
    if small:
        pieces.append(b"".join(small))
    return pieces


def as_text(word: Any) -> Any:
    """Return a word as it is sent; numbers as text: hiredis crashes if a signal's handler raises as it formats one."""
    return str(word) if isinstance(word, int | float) else word


class Packer(HiredisRespSerializer):
    """redis-py's way of packing what it sends itself, with numbers as text, such as that of the protocol in HELLO."""

    def pack(self, *words: Any) -> Any:
        return super().pack(*map(as_text, words))


def _joined(commands: Sequence[Command]) -> bytes:
    try:
        return b"".join(map(hiredis.pack_command, commands))
    except TypeError:  # an argument in several pieces
        return b"".join([hiredis.pack_command(tuple(map(_whole, command))) for command in commands])


def _whole(word: Any) -> Any:
    return b"".join(word) if type(word) is tuple else word


def _pack_large(command: Command, pieces: list[Piece], small: list[bytes]) -> None:
    """Append `command`, ending the run of small bytes before each large buffer."""
    small.append(b"*%d\r\n" % len(command))
    for word in command:
        parts = tuple(map(_encoded, word)) if type(word) is tuple else (_encoded(word),)
        small.append(b"$%d\r\n" % sum(map(len, parts)))
        for part in parts:
            if len(part) >= LARGE:
                pieces.append(b"".join(small))
                pieces.append(part)
                small.clear()
            else:
                small.append(bytes(part))
        small.append(b"\r\n")


def _encoded(word: Any) -> Piece:
    if isinstance(word, bytes):
        return word
    if isinstance(word, memoryview):
        # len() of any other view is not its size, and what follows would be read as commands.
        if word.ndim != 1 or word.itemsize != 1 or len(word) != word.nbytes:
            raise TypeError("an outgoing buffer must be flat bytes")
        return word
    return str(word).encode()


class CommandRecorder(
    BasicKeyCommands,
    HashCommands,
    ListCommands,
    SetCommands,
    SortedSetCommands,
    StreamCommands,
    GeoCommands,
    HyperlogCommands,
):
    """Offers redis-py's methods (`hset`, `set`, `rpush`, ...) and keeps their commands in `commands`."""

    def __init__(self) -> None:
        self.commands: list[Command] = []

    def execute_command(self, *words: Any, **_: Any) -> CommandRecorder:
        """Record one command; returns the recorder, as pipelines do."""
        # Arrays stay views of their memory, not copies: they are sent from there.
        self.commands.append(tuple([flat_buffer(as_text(word)) for word in words]))
        return self
