"""What is known of the rates of all paths, and its reports as lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from reem_async.tools.cli.following import Ending
from reem_async.tools.cli.output import emit, emit_json, typed
from reem_async.tools.cli.windows import Measure, Window

if TYPE_CHECKING:
    from reem_async.plan.paths import Path
    from reem_async.pubsub.monitor import Event

__all__ = ["Board"]

# Paths that are kept: a program that publishes under ever new names must not fill the memory.
_MOST_PATHS = 10_000


class Board:
    """The windows of all paths that were heard of.

    Args:
        measure: What is shown of them.
        length: How many updates of a path count.
        place: Which path an update is counted under; its own if not given.

    Attributes:
        windows: By path.
        unlisted: Updates of paths for which there was no more room.
    """

    def __init__(self, measure: Measure, length: int, place: Callable[[Path], Path] = lambda path: path) -> None:
        self.measure = measure
        self.windows: dict[str, Window] = {}
        self.unlisted = 0
        self._length = length
        self._place = place
        self._reported: dict[str, int] = {}

    def take(self, event: Event, _: Ending) -> None:
        """Enter an update."""
        path = typed(self._place(event.path)) + " (stored)" * event.stored
        window = self.windows.get(path)
        if window is None:
            if len(self.windows) >= _MOST_PATHS:
                self.unlisted += 1
                return
            window = self.windows[path] = Window(self._length)
        window.add(event)

    def report(self, *, final: bool = False) -> None:
        """Print a line for each path with new updates; at the end, for each."""
        for path, window in self._due(final):
            emit(f"{path}: {self.measure.line(window)}, window {len(window.received)}, lost {window.lost}")
        sys.stdout.flush()

    def report_json(self, *, final: bool = False) -> None:
        """As `report`, for programs."""
        for path, window in self._due(final):
            numbers = {"updates": window.total, "window": len(window.received), "lost": window.lost}
            emit_json({"path": path, **self.measure.data(window), **numbers, "time": time.time(), "final": final})

    def doubled(self) -> dict[str, int]:
        """Return the paths that several programs publish at the same time, and how many they are."""
        return {path: it.publishers for path, it in sorted(self.windows.items()) if it.publishers > 1}

    def warnings(self) -> list[str]:
        """Return a line for each path of `doubled`."""
        return [
            f"{path} is published by {count} interfaces at once: each overwrites what the others wrote"
            for path, count in self.doubled().items()
        ]

    def _due(self, final: bool) -> list[tuple[str, Window]]:
        # Between reports only paths that were heard again; at the end all, also those that have gone silent.
        due = [(path, it) for path, it in self.windows.items() if final or self._reported.get(path) != it.total]
        self._reported = {path: it.total for path, it in self.windows.items()}
        return sorted(due, key=lambda pair: pair[0])
