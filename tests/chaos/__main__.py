"""The command: runs rows one after the other, and says what came of each."""

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
        tell(f"{number:>3}  {ROWS[number].what}: {ROWS[number].target} ...")
        outcome = run(number, scale, seed)
        outcomes.append(outcome)
        tell(f"     {outcome.status} after {outcome.seconds:.1f} s: {'; '.join(outcome.figures)}")
        for failure in outcome.failures:
            tell(f"     ! {failure}")
        if outcome.status == "FAIL":
            tell(f"     again: {outcome.replay}")
            tell("     | " + "\n     | ".join(outcome.output.splitlines()[-40:]))
    counts = {word: sum(it.status == word for it in outcomes) for word in ("PASS", "FAIL")}
    tell(", ".join(f"{count} {word}" for word, count in counts.items()) + f" in {time.monotonic() - begun:.0f} s")
    return int(any(outcome.status == "FAIL" for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
