"""The live table of `reem hz`, `reem bw` and `reem delay`: a row for each path."""

from __future__ import annotations

import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from reem_async.cli.rates import Board

__all__ = ["Picture"]

_STALE_SECONDS = 2.0
_NARROW = 72


class Picture:
    """Draws a board in place, for as long as the block lasts; the last state stays on the screen.

    Args:
        board: What is drawn.
        waiting: What to say while there is nothing.
    """

    def __init__(self, board: Board, waiting: str) -> None:
        self._board = board
        self._waiting = waiting
        self._console = Console()
        self._live = Live(console=self._console, auto_refresh=False, vertical_overflow="crop")

    def __enter__(self) -> Self:
        self._live.start()
        self.draw()
        return self

    def draw(self) -> None:
        """Draw the board as it is now."""
        self._live.update(self._drawn(), refresh=True)

    def _drawn(self) -> RenderableType:
        board = self._board
        if not board.windows:
            return Text(f"{self._waiting} (Ctrl-C ends)", style="dim")
        narrow = self._console.width < _NARROW
        headers = board.measure.headers[: 2 if narrow else None]
        table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
        table.add_column("path", no_wrap=True, overflow="ellipsis", style="bold", ratio=1 if narrow else None)
        for header in (*headers, *(() if narrow else ("updates",)), "lost"):
            table.add_column(header, justify="right", no_wrap=True)
        rows = sorted(board.windows.items(), key=lambda pair: pair[0])
        room = max(self._console.height - 4, 3)
        now = time.time()
        for path, window in rows[:room]:
            cells = board.measure.cells(window)[: len(headers)]
            stale = "dim" if now - window.received[-1] > _STALE_SECONDS else ""
            lost = Text(str(window.lost), style="red" if window.lost else "")
            table.add_row(Text(path), *cells, *(() if narrow else (str(window.total),)), lost, style=stale)
        left = len(rows) - room
        parts: list[RenderableType] = [table]
        if left > 0:
            parts.append(Text(f"… {left} more paths; give a pattern to see them", style="dim"))
        if board.measure.remark:
            parts.append(Text(board.measure.remark, style="dim"))
        return Group(*parts)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.draw()
        self._live.stop()
