"""Rows, their figures, and how they are run: each in a process of its own, under a time limit."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

COMPLAINTS = ("never retrieved", "never awaited", "Exception ignored", "Traceback (most", "was destroyed but it is")
"""What Python writes to stderr about a program that is not clean. Such a row has failed."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the scoreboard."""

    number: int
    what: str
    target: str  # for people; the bounds themselves are in the row's function
    function: Callable[[Run], None]
    limit: float  # seconds after which it hangs


ROWS: dict[int, Row] = {}


def row(number: int, what: str, target: str, limit: float = 300) -> Callable[[Callable[[Run], None]], Any]:
    """Enter a function into the scoreboard."""

    def enter(function: Callable[[Run], None]) -> Callable[[Run], None]:
        ROWS[number] = Row(number, what, target, function, limit)
        return function

    return enter


class NotBuilt(Exception):
    """What the row would test does not exist yet: it is not run, and not passed either."""


class Run:
    """One run of a row: how much to do, with which seed, and what came out.

    At full size, or a small part for every `make test-all`. What misses its bound is among the failures too.
    """

    def __init__(self, scale: str, seed: int) -> None:
        self.full = scale == "full"
        self.rng = random.Random(seed)
        self.figures: list[str] = []
        self.failures: list[str] = []

    def size(self, full: Any, quick: Any) -> Any:
        return full if self.full else quick

    def at_most(self, what: str, figure: float, bound: float, unit: str = "") -> None:
        """Note a figure that must not exceed `bound`."""
        self._note(what, figure, figure <= bound, f"at most {_shown(bound)}", unit)

    def at_least(self, what: str, figure: float, bound: float, unit: str = "") -> None:
        """Note a figure that must reach `bound`: mostly that the load was real."""
        self._note(what, figure, figure >= bound, f"at least {_shown(bound)}", unit)

    def none(self, what: str, problems: list[Any] | int) -> None:
        """Note how many problems of a kind there were: none, or the row has failed, and the first is shown."""
        count = problems if isinstance(problems, int) else len(problems)
        self.figures.append(f"{_shown(count)} {what}")
        for problem in [] if isinstance(problems, int) else problems[:20]:
            tell(f"{what}: {problem!r:.500}")
        if count:
            first = "" if isinstance(problems, int) else f", the first: {problems[0]!r:.500}"
            self.failures.append(f"{_shown(count)} {what}{first}")

    def _note(self, what: str, figure: float, good: bool, bound: str, unit: str) -> None:
        text = f"{_shown(figure)}{unit and ' '}{unit} {what}"
        self.figures.append(text)
        if not good:
            self.failures.append(f"{text}, not {bound}")


def _shown(number: float) -> str:
    return f"{number:,.3g}" if isinstance(number, float) and number < 1000 else f"{number:,.0f}"


def tell(text: str) -> None:
    print(text, flush=True)


# --- one row, in this process ----------------------------------------------------------------------


def perform(number: int, scale: str, seed: int) -> dict[str, Any]:
    """Run one row here; returns its figures."""
    it = Run(scale, seed)
    status = ""
    try:
        ROWS[number].function(it)
    except NotBuilt as reason:
        status = "NOT RUN"
        it.figures.append(str(reason))
    except Exception as error:
        import traceback

        traceback.print_exc(file=sys.stdout)
        it.failures.append(f"{type(error).__name__}: {error!s:.500}")
    if not it.figures and not it.failures:
        it.failures.append("the row has measured nothing")
    return {
        "status": status or ("FAIL" if it.failures else "PASS"),
        "figures": it.figures,
        "failures": it.failures,
    }


# --- one row, in another process -------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Outcome:
    row: Row
    status: str
    figures: list[str]
    failures: list[str]
    seconds: float
    output: str
    replay: str


def run(number: int, scale: str, seed: int) -> Outcome:
    """Run one row in a process of its own, with warnings as errors, and end it when its time is up."""
    it = ROWS[number]
    command = ["-m", "tests.chaos", "--rows", str(number), "--scale", scale, "--seed", str(seed)]
    with tempfile.TemporaryDirectory(prefix="reem-chaos-", ignore_cleanup_errors=True) as folder:
        report = Path(folder) / "report"
        with (Path(folder) / "output").open("w+b") as output:
            begun = time.monotonic()
            environment = os.environ | {"REEM_CHAOS_REPORT": str(report), "PYTHONUNBUFFERED": "1", "TMPDIR": folder}
            process = subprocess.Popen(
                [sys.executable, "-W", "error", *command],
                cwd=ROOT,
                env=environment,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
            try:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(it.limit)
            finally:
                with contextlib.suppress(ProcessLookupError):  # what is left of it, and what it has started
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            seconds = time.monotonic() - begun
            output.seek(0)
            text = output.read().decode(errors="replace")
        found = json.loads(report.read_text()) if report.exists() else None
    replay = "python " + " ".join(command)
    if found is None:
        reason = f"hung: ended after {it.limit:.0f} s" if seconds >= it.limit else f"ended with {process.returncode}"
        return Outcome(it, "FAIL", [], [reason], seconds, text, replay)
    complaints = [line for line in text.splitlines() if any(words in line for words in COMPLAINTS)]
    failures = found["failures"] + [f"on stderr: {line}" for line in complaints[:3]]
    status = "FAIL" if failures else found["status"]
    return Outcome(it, status, found["figures"], failures, seconds, text, replay)
