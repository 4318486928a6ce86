"""What commands share that keep a server up in the foreground."""

from __future__ import annotations

import os
import select
import signal
from contextlib import suppress
from types import FrameType
from typing import NoReturn

import typer
from rich.console import Console
from rich.text import Text

from reem_async.tools.cli.output import clean

__all__ = ["LOOK_SECONDS", "Stop", "fail", "print_rows"]

LOOK_SECONDS = 0.5
"""Seconds between looks whether the server is still there."""


class Stop:
    """Set by Ctrl-C, by SIGTERM, and when the terminal closes.

    A pipe, not a `threading.Event`: a handler that runs while the main thread is inside of `Event.wait` would
    wait for a lock that this very thread holds.
    """

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        # A handler must not block, not even when nobody reads the pipe any more.
        os.set_blocking(self._writer, False)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._handle)

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        with suppress(BlockingIOError):  # full: told often enough
            os.write(self._writer, b"x")

    def wait(self, seconds: float) -> bool:
        """Return whether it was set, after so long at most."""
        return bool(select.select([self._reader], [], [], seconds)[0])


def print_rows(console: Console, rows: list[tuple[str, str]]) -> None:
    """Print what there is to know, one fact a line."""
    for label, value in rows:
        # soft_wrap: a line to be copied stays one line, however narrow the terminal
        console.print(Text.assemble("  ", (f"{label:10}", "cyan"), clean(value)), soft_wrap=True)


def fail(message: str) -> NoReturn:
    """Say why on standard error and exit with code 1."""
    lines = "\n".join(map(clean, message.split("\n")))
    Console(stderr=True).print(Text.assemble(("reem up: ", "bold red"), lines), soft_wrap=True)
    raise typer.Exit(1)
