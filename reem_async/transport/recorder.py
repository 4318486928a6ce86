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
from .packing import as_text

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
        # Arrays stay views of their memory, not copies: they are sent from there.
        self.commands.append(tuple([flat_buffer(as_text(word)) for word in words]))
        return self
