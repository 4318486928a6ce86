"""Commands -> the pieces that go over the wire.

hiredis packs small commands fastest but copies every argument several times; a large buffer (an
array's memory) is sent as it is, between a header and a line end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import hiredis

from ..plan import Command

__all__ = ["Piece", "pack"]

Piece = bytes | memoryview

LARGE = 8192
"""Bytes from which a buffer becomes a piece of its own."""


def pack(commands: Sequence[Command]) -> list[Piece]:
    """Return the bytes of `commands`, small ones joined, large buffers as they are."""
    if len(commands) == 1 and not _has_large(commands[0]):
        return [_packed(commands[0])]
    pieces: list[Piece] = []
    small: list[bytes] = []
    for command in commands:
        if _has_large(command):
            _pack_large(command, pieces, small)
        else:
            small.append(_packed(command))
    if small:
        pieces.append(b"".join(small))
    return pieces


def _packed(command: Command) -> bytes:
    packed: bytes = hiredis.pack_command(command)
    return packed


def _has_large(command: Command) -> bool:
    for word in command:
        kind = type(word)
        if (kind is bytes or kind is memoryview) and len(word) >= LARGE:
            return True
    return False


def _pack_large(command: Command, pieces: list[Piece], small: list[bytes]) -> None:
    """Append `command`, ending the run of small bytes before each large buffer."""
    small.append(b"*%d\r\n" % len(command))
    for word in command:
        data = _encoded(word)
        small.append(b"$%d\r\n" % len(data))
        if len(data) >= LARGE:
            pieces.append(b"".join(small))
            pieces.append(data)
            small.clear()
        else:
            small.append(bytes(data))
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
