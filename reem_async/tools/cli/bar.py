"""A bar on standard error for what takes long."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

__all__ = ["progress_bar"]


@contextmanager
def progress_bar(after: float = 1.0) -> Iterator[Callable[[str], Callable[[int, int], None]]]:
    """Give what makes, of a word for what is being done, a function to tell how much is done and how much there is.

    The bar begins `after` so many seconds, on a terminal only, and is gone at the end.
    """
    begun = time.monotonic()
    with ExitStack() as stack:
        # None until it takes so long that a bar is worth showing; then one.
        bars: list[tuple[Any, Any]] = []

        def tell(doing: str, done: int, total: int) -> None:
            if not bars and time.monotonic() - begun >= after and sys.stderr.isatty():
                bars.append(_begin(stack))
            for bar, task in bars:
                bar.update(task, description=doing, completed=done, total=max(total, 1))

        yield lambda doing: lambda done, total: tell(doing, done, total)


def _begin(stack: ExitStack) -> tuple[Any, Any]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    parts = (TextColumn("{task.description:8}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    bar = stack.enter_context(Progress(*parts, console=Console(stderr=True), transient=True))
    return bar, bar.add_task("")
