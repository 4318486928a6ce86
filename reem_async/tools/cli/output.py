"""What commands print: lines, columns, JSON, a progress bar; colours only on a terminal."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import typer

from ...plan.paths import suffix
from .. import jsontext

# What moves the cursor, changes colours or breaks lines: keys and values come from anywhere.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
_UNITS = ("B", "kB", "MB", "GB", "TB")


def is_terminal() -> bool:
    return sys.stdout.isatty() and os.environ.get("TERM") != "dumb"


def width() -> int:
    return shutil.get_terminal_size().columns


def styled(text: str, style: str) -> str:
    """Return `text` in a colour such as "cyan", in "bold" or "dim", if the output is a terminal."""
    if not is_terminal() or os.environ.get("NO_COLOR"):
        return text
    if style in ("bold", "dim"):
        return typer.style(text, **{style: True})
    return typer.style(text, fg=style)


def clean(text: str) -> str:
    r"""Return `text` with everything that a terminal would obey written as `\u001b`, as JSON does."""
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def cut(text: str, limit: int) -> str:
    return text if len(text) <= limit else text[: max(limit - 1, 0)] + "…"


def emit(text: str) -> None:
    """Print a line; what stands in it is clean already."""
    sys.stdout.write(text + "\n")


def note(text: str) -> None:
    """Say something that is not the result: a line on standard error."""
    sys.stderr.write(clean(text) + "\n")


def write_over(text: str) -> None:
    """Show how something is getting on: a line on standard error, in place of the last one; only on a terminal."""
    if sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
        # Two columns stay free for the ^C of the terminal: in the next line, it would keep this one from being cleared.
        sys.stderr.write("\r" + clean(cut(text, width() - 3)) + "\x1b[K")
        sys.stderr.flush()


def facts_lines(rows: Iterable[tuple[str, str]]) -> None:
    """Print labels and values, one pair a line. A line to be copied stays one line, however narrow the terminal."""
    for label, value in rows:
        emit(f"  {styled(f'{label:10}', 'cyan')}{clean(value)}")
    sys.stdout.flush()


def json_text(value: Any, *, pretty: bool = False) -> str:
    """Return JSON that a terminal can be sent; `reem_async.tools.jsontext` says how each value is written."""
    return "\n".join(map(clean, jsontext.json_text(value, pretty=pretty).split("\n")))


def figures(status: Any, digits: int) -> dict[str, float]:
    return {name: round(number, digits) for name, number in dataclasses.asdict(status).items()}


def emit_json(value: Any) -> None:
    """Print a value as a line of JSON, at once: a program may wait for it."""
    emit(json_text(value))
    sys.stdout.flush()


def size_text(size: float) -> str:
    """Return bytes for people: `921.6 kB`."""
    for unit in _UNITS[:-1]:
        # So that 999.96 becomes 1.0 of the next unit and not 1000.0 of this one.
        if abs(size) < 999.95:
            return f"{size:.0f} B" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} {_UNITS[-1]}"


def counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def named(names: Sequence[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def typed(path: Sequence[str | int]) -> str:
    """Return a full path as a user can type it, also where the top-level key has a dot: `["a.b"].c`."""
    return clean("".join(map(_element, path)).removeprefix("."))


def _element(key: str | int) -> str:
    # Quoted as JSON if the plain form would show what a terminal obeys.
    text = suffix((key,))
    return text if clean(text) == text or text.startswith("[") else f"[{json.dumps(key)}]"


def columns(
    rows: Iterable[Sequence[str]],
    styles: Sequence[str],
    right: frozenset[int] = frozenset(),
    shrink: Sequence[int] = (0,),
    heads: Sequence[str] = (),
) -> None:
    """Print rows of clean cells: on a terminal aligned, coloured and below their heads, elsewhere separated by tabs.

    Columns in `right` are numbers; those in `shrink` are cut on a narrow terminal, the widest first.
    """
    if not is_terminal():
        for row in rows:
            emit("\t".join(row))
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    for place, style in enumerate(styles):
        table.add_column(style=style, justify="right" if place in right else "left", no_wrap=place not in shrink)
    for row in [heads, *rows] if heads else rows:
        table.add_row(*[Text(cell, no_wrap=True, overflow="ellipsis") for cell in row])
    Console().print(table)


@contextmanager
def progress_bar(after: float = 1.0) -> Iterator[Callable[[str], Callable[[int, int], None]]]:
    """Give what makes, of a word for what is being done, a function to tell how much is done and how much there is.

    The bar begins `after` so many seconds, on a terminal only, and is gone at the end.
    """
    if not sys.stderr.isatty():
        yield lambda _: lambda _, __: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    parts = (TextColumn("{task.description:8}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    begun = time.monotonic()
    with Progress(*parts, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", visible=False)

        def tell(doing: str, done: int, total: int) -> None:
            is_long = time.monotonic() - begun >= after
            bar.update(task, visible=is_long, description=doing, completed=done, total=max(total, 1))

        yield lambda doing: partial(tell, doing)
