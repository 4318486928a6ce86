"""The command: runs rows one after the other, shows progress, and one table at the end."""

from __future__ import annotations

import argparse
import json
import os
import secrets
import sys
import time
from pathlib import Path

from . import rows  # noqa: F401 - enters every row
from .scoreboard import ROWS, Outcome, perform, run, tell


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__)
    parser.add_argument("--rows", default="", help="numbers of rows, such as 1,2,9; all if not given")
    parser.add_argument("--seed", type=int, default=None, help="what all chance comes from; printed, to replay a run")
    parser.add_argument("--scale", choices=["full", "quick"], default="full")
    given = parser.parse_args()
    numbers = [int(number) for number in given.rows.split(",") if number] or sorted(ROWS)
    if unknown := set(numbers) - set(ROWS):
        parser.error(f"there are no rows {sorted(unknown)}; there are {sorted(ROWS)}")
    seed = secrets.randbelow(10**9) if given.seed is None else given.seed
    if report := os.environ.get("REEM_CHAOS_REPORT"):  # this is the process of one row
        Path(report).write_text(json.dumps(perform(numbers[0], given.scale, seed)))
        return 0
    return _run_all(numbers, given.scale, seed)


def _run_all(numbers: list[int], scale: str, seed: int) -> int:
    tell(f"seed {seed}, scale {scale}")
    outcomes: list[Outcome] = []
    begun = time.monotonic()
    for number in numbers:
        tell(f"{number:>3}  {ROWS[number].what} ...")
        outcome = run(number, scale, seed)
        outcomes.append(outcome)
        tell(f"     {outcome.status} after {outcome.seconds:.1f} s: {'; '.join(outcome.figures)}")
        for failure in outcome.failures:
            tell(f"     ! {failure}")
        if outcome.status == "FAIL":
            tell(f"     again: {outcome.replay}")
            tell("     | " + "\n     | ".join(outcome.output.splitlines()[-40:]))
    _show(outcomes, time.monotonic() - begun)
    return int(any(outcome.status == "FAIL" for outcome in outcomes))


def _show(outcomes: list[Outcome], seconds: float) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else 180)
    table = Table(box=box.SIMPLE_HEAD, show_lines=False)
    for name in ("row", "what", "target", "figure", "", "s"):
        table.add_column(name, justify="right" if name in ("row", "s") else "left")
    colours = {"PASS": "green", "FAIL": "red"}
    for it in outcomes:
        status = f"[{colours.get(it.status, 'yellow')}]{it.status}[/]"
        figures = "; ".join(it.figures or it.failures)
        table.add_row(
            str(it.row.number), _plain(it.row.what), _plain(it.row.target), _plain(figures), status, f"{it.seconds:.0f}"
        )
    console.print(table)
    counts = {word: sum(it.status == word for it in outcomes) for word in ("PASS", "FAIL", "NOT RUN")}
    console.print(", ".join(f"{count} {word}" for word, count in counts.items()) + f" in {seconds:.0f} s")


def _plain(text: str) -> str:
    return text.replace("[", "\\[")


if __name__ == "__main__":
    sys.exit(main())
