"""What ships are given as their client: redis-py's own command methods, recording instead of sending."""

from __future__ import annotations

from typing import Any

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

from ..plan import Command
from ..ships.numpy import flat_buffer

__all__ = ["CommandRecorder"]


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
        self.commands.append(tuple([_as_text(word) for word in words]))
        return self


def _as_text(word: Any) -> Any:
    """Return a word as it is sent; numbers as text, since hiredis crashes if Ctrl-C comes while it formats one."""
    return repr(word) if type(word) in (int, float) else flat_buffer(word)
