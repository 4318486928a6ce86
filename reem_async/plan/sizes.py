"""What counts as large: it goes over a connection of its own, and ahead of transactions that are watched."""

from __future__ import annotations

from collections.abc import Sequence

from . import Command

__all__ = ["LARGE", "has_large"]

LARGE = 1 << 16
"""Bytes from which others should not have to wait behind a value, in either direction."""


def has_large(commands: Sequence[Command]) -> bool:
    """Return whether any argument of `commands` is so large that others should not wait behind it."""
    for command in commands:
        for word in command:
            kind = type(word)
            if kind is str:
                continue
            size = 0
            if kind is bytes:
                size = len(word)
            elif kind is memoryview:
                size = word.nbytes
            elif kind is tuple:
                size = sum(map(len, word))
            if size >= LARGE:
                return True
    return False
