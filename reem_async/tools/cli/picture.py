"""The live table of `reem top`, `hz`, `bw` and `delay`: a row for each path."""

from __future__ import annotations

import asyncio
import os
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from reem_async.tools.cli.output import cut
from reem_async.tools.cli.windows import ALL

if TYPE_CHECKING:
    from reem_async.tools.cli.board import Board
    from reem_async.tools.cli.windows import Window

__all__ = ["Picture", "ended_by_q"]

# Seconds of silence after which a row is dimmed.
_STALE_SECONDS = 2.0
_SHORTEST_PATH = 12
"""Characters of a path that are kept before columns are left out for it."""
_BETWEEN = 2
"""Blanks between two columns."""


@contextmanager
def ended_by_q() -> Iterator[None]:
    """Cancel this task when `q` is typed, if the terminal is this program's own to read from."""
    if not sys.stdin.isatty() or sys.platform == "win32" or os.tcgetpgrp(fd := sys.stdin.fileno()) != os.getpgrp():
        yield
        return
    import termios
    import tty

    task, loop, before = asyncio.current_task(), asyncio.get_running_loop(), termios.tcgetattr(fd)

    def typed() -> None:
        if b"q" in os.read(fd, 64).lower() and task is not None:
            task.cancel()

    tty.setcbreak(fd)  # keys come at once and are not shown; Ctrl-C stays a signal
    loop.add_reader(fd, typed)
    try:
        yield
    finally:
        loop.remove_reader(fd)
        termios.tcsetattr(fd, termios.TCSADRAIN, before)


class Picture:
    """Draws a board in place, for as long as the block lasts; the last state stays on the screen.

    Args:
        board: What is drawn.
        waiting: What to say while there is nothing.
        console: The terminal; that of the process if not given.
    """

    def __init__(self, board: Board, waiting: str, console: Console | None = None) -> None:
        self._board = board
        self._waiting = waiting
        self._console = console or Console()
        self._live = Live(console=self._console, auto_refresh=False, vertical_overflow="crop")

    def __enter__(self) -> Self:
        self._live.start()
        self.draw()
        return self

    def draw(self) -> None:
        """Draw the board as it is now."""
        self._live.update(self._drawn(), refresh=True)

    def _drawn(self) -> RenderableType:
        if not self._board.windows:
            return Text(f"{self._waiting} (q or Ctrl-C ends)", style="dim")
        rows = sorted(self._board.windows.items(), key=lambda pair: pair[0])
        notes = self._notes()
        # One line is the table's head, and one is left for the cursor: what lies lower is cut off.
        room = self._console.height - 2 - len(notes)
        if len(rows) > room:
            shown = max(room - 1, 1)
            notes.insert(0, _line(f"… {len(rows) - shown} more paths; give a pattern to see them", "dim"))
            rows = rows[:shown]
        return Group(self._table(rows), *notes)

    def _notes(self) -> list[Text]:
        """Return what stands below the table: lines, each of which fits into one of the terminal or is cut."""
        board = self._board
        doubled = board.doubled() if board.measure is ALL else []
        notes = [_line(f"! several publishers, each overwrites the others: {', '.join(doubled)}", "yellow")]
        remark = board.measure.remark
        lines = textwrap.wrap(remark, max(self._console.width, 20))
        if len(lines) > self._console.height // 4:  # the rows come first
            lines = [remark]
        return notes[: bool(doubled)] + [_line(line, "dim") for line in lines]

    def _table(self, rows: list[tuple[str, Window]]) -> Table:
        measure, now = self._board.measure, time.time()
        titles = ["path", *measure.headers, "updates", "lost"]
        cells = [[path, *measure.cells(it), str(it.total), str(it.lost)] for path, it in rows]
        kept, room = self._fitting(titles, cells)
        table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, _BETWEEN, 0, 0))
        table.add_column(titles[0], no_wrap=True, style="bold")
        for place in kept:
            table.add_column(titles[place], justify="right", no_wrap=True)
        for (_, window), row in zip(rows, cells, strict=True):
            texts = [Text(cut(row[0], room)), *(Text(row[place]) for place in kept)]
            if window.lost:
                texts[-1].stylize("red")
            if measure is ALL and window.publishers > 1:
                texts[0].stylize("yellow")
            table.add_row(*texts, style="dim" if now - window.received[-1] > _STALE_SECONDS else "")
        return table

    def _fitting(self, titles: list[str], cells: list[list[str]]) -> tuple[list[int], int]:
        """Return which columns there is room for beside the path (the first ones, and what was lost), and its width."""
        longest, *widths = [max(map(len, column)) for column in zip(titles, *cells, strict=True)]
        kept = list(range(1, len(titles)))
        while True:
            room = self._console.width - sum([widths[place - 1] + _BETWEEN for place in kept])
            if room >= min(longest, _SHORTEST_PATH) or len(kept) <= 2:
                return kept, max(room, 1)
            # The last one, what was lost, stays: it is why people look.
            del kept[-2]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # After an error the screen keeps what was drawn last.
        if kind is None:
            self.draw()
        self._live.stop()


def _line(text: str, style: str) -> Text:
    return Text(text, style=style, no_wrap=True, overflow="ellipsis")
