"""What a recorder costs the writers beside it: `python -m benchmarks.recorder [--beside WHOM]`.

The row of `make bench` has ten seconds for it, in which one bad moment of the machine decides. Here windows with and
without a recorder follow each other for as long as it takes to know: pairs, each next to its other half, every second
pair the other way round. The kernel counts what a virtual machine's host takes of the processors (steal): pairs in
which it took much are told apart, since then it is the host that is measured, and it goes on until enough were quiet.
"""

import argparse
import dataclasses
import datetime
import json
import pathlib
import re
import tempfile
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from . import environment
from .measure_recorder import LEAST, SETTLED, WRITERS, beside, writers
from .results import SCRATCH
from .server import Server, private_server

KEPT = environment.FOLDER / "results" / "recorder.json"
PAGE = environment.FOLDER.parent / "docs" / "lab" / "performance.md"
WHOLE = 30
"""Quiet pairs from which a run replaces what is kept."""
MUCH = 0.03
"""The share of all processors' time that the host may take from a pair that still counts as quiet."""
DRAWN = 1000
"""Times that pairs are drawn anew, with repetition, to see how far the figure depends on which came."""
_TABLE = re.compile(r"<!-- recorder -->\n.*?<!-- end of recorder -->\n", re.DOTALL)


@dataclasses.dataclass(frozen=True)
class Span:
    """When a window was, by the clock of the writers, and the share of the processors that the host took meanwhile."""

    begin: float
    end: float
    steal: float


@dataclasses.dataclass(frozen=True)
class Window:
    """One stretch of time, and what one writer's calls took in it.

    Attributes:
        took: Seconds of each call.
        steal: The share of the processors that the host took.
    """

    took: np.ndarray
    steal: float


Pair = tuple[Window, Window]
"""Without and with a recorder."""


def measure(
    server: Server, whom: str, wanted: int, minutes: float, seconds: float, progress: Progress
) -> dict[str, list[Pair]]:
    """Return each writer's windows, of as many pairs as it took until `wanted` were quiet or the time was over."""
    spans: list[tuple[Span, Span]] = []
    quiet = 0
    task = progress.add_task("quiet pairs of windows", total=wanted)
    with tempfile.TemporaryDirectory() as folder:
        with writers(server.url, folder):
            last = time.monotonic() + minutes * 60
            while quiet < wanted and time.monotonic() < last:
                pair = _pair(server.url, whom, folder, seconds, backwards=len(spans) % 2 == 1)
                spans.append(pair)
                quiet += max(span.steal for span in pair) <= MUCH
                progress.update(task, completed=quiet)
        calls = {what: np.fromfile(f"{folder}/{what}").reshape(-1, 2).T for what in WRITERS}
    return {
        what: [(_window(calls_of, alone), _window(calls_of, recorded)) for alone, recorded in spans]
        for what, calls_of in calls.items()
    }


def _pair(url: str, whom: str, folder: str, seconds: float, *, backwards: bool) -> tuple[Span, Span]:
    found = {}
    for name in (whom, "nobody") if backwards else ("nobody", whom):
        with beside(name, url, folder):
            time.sleep(SETTLED)
            found[name] = _span(seconds)
    return found["nobody"], found[whom]


def _window(calls: np.ndarray, span: Span) -> Window:
    begun, took = calls
    return Window(took[(begun >= span.begin) & (begun < span.end)], span.steal)


def _span(seconds: float) -> Span:
    before, begin = _processors(), time.perf_counter()
    time.sleep(seconds)
    end, ticks = time.perf_counter(), _processors() - before
    return Span(begin, end, float(ticks[7] / max(1, ticks.sum())))


def _processors() -> np.ndarray:
    """Ticks of all processors: user, nice, system, idle, waiting, interrupts, soft interrupts, steal."""
    first = pathlib.Path("/proc/stat").read_text().partition("\n")[0]
    return np.array(first.split()[1:9], dtype=np.int64)


def judge(pairs: list[Pair], much: float = MUCH) -> dict[str, Any]:
    """Return the 99th percentiles of all calls, their ratio and its 95 % interval, for all pairs and the quiet ones."""
    quiet = [pair for pair in pairs if max(window.steal for window in pair) <= much]
    return {name: _figures(chosen) for name, chosen in (("quiet", quiet), ("all", pairs))}


def _figures(pairs: list[Pair]) -> dict[str, Any]:
    if not pairs:
        return {"pairs": 0}
    numbers = np.random.default_rng(0).integers(0, len(pairs), (DRAWN, len(pairs)))
    low, high = np.percentile([_ratio([pairs[number] for number in drawn]) for drawn in numbers], [2.5, 97.5])
    alone, recorded = _tails(pairs)
    each = [_ratio([pair]) for pair in pairs]
    return {
        "pairs": len(pairs),
        "alone": alone,
        "recorded": recorded,
        "ratio": recorded / alone,
        "interval": [float(low), float(high)],
        "median of pairs": float(np.median(each)),
    }


def _tails(pairs: list[Pair]) -> tuple[float, float]:
    alone, recorded = (np.concatenate([window.took for window in each]) for each in zip(*pairs, strict=True))
    return float(np.percentile(alone, 99)), float(np.percentile(recorded, 99))


def _ratio(pairs: list[Pair]) -> float:
    alone, recorded = _tails(pairs)
    return recorded / alone


def lines(kept: dict[str, Any]) -> list[list[str]]:
    """The table's rows, its head first."""
    head = ["writer", "pairs", "alone, ms", "recorded, ms", "ratio", "95 %", "median of pairs"]
    rows = [
        [
            what,
            f"{found['pairs']} {name}",
            f"{found['alone'] * 1e3:.2f}",
            f"{found['recorded'] * 1e3:.2f}",
            f"{found['ratio']:.2f}",
            "{:.2f} to {:.2f}".format(*found["interval"]),
            f"{found['median of pairs']:.2f}",
        ]
        for what, both in kept["writers"].items()
        for name, found in both.items()
        if found["pairs"]
    ]
    return [head, *rows]


def rewrite(kept: dict[str, Any], page: pathlib.Path = PAGE) -> None:
    """Put the table, and the line on where it was measured, into the page."""
    head, *rows = lines(kept)
    drawn = [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]
    told = f"Measured {kept['started'][:10]}, windows of {kept['seconds']:g} s: {kept['environment']}."
    block = "\n".join(["<!-- recorder -->", told, "", *drawn, "<!-- end of recorder -->", ""])
    page.write_text(_TABLE.sub(lambda _: block, page.read_text()))


def run(whom: str, pairs: int, minutes: float, seconds: float, console: Console) -> dict[str, Any]:
    """Measure on a private server, by TCP as all of `make bench`."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    with private_server() as server, Progress(*columns, console=console) as progress:
        found = measure(server, whom, pairs, minutes, seconds, progress)
        version = server.version()
    return {
        "started": started,
        "environment": environment.line(version),
        "seconds": seconds,
        "much": MUCH,
        "writers": {what: judge(each) for what, each in found.items()},
    }


def _is_whole(kept: dict[str, Any]) -> bool:
    return all(found["quiet"]["pairs"] >= WHOLE for found in kept["writers"].values())


def main() -> None:
    """Measure, keep, write the page, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recorder", description=__doc__)
    whom = ("recorder", *LEAST)
    parser.add_argument("--beside", choices=whom, default=whom[0], help="the recorder, or the least that one does")
    parser.add_argument("--pairs", type=int, default=WHOLE, help="quiet ones to wait for (default: %(default)s)")
    parser.add_argument("--minutes", type=float, default=40.0, help="at most (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=12.0, help="of one window (default: %(default)s)")
    options, console = parser.parse_args(), Console()
    kept = run(options.beside, options.pairs, options.minutes, options.seconds, console)
    path = KEPT if options.beside == "recorder" and _is_whole(kept) else SCRATCH / KEPT.name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(kept, indent=1) + "\n")
    head, *rows = lines(kept)
    table = Table(
        *head, caption=f"99th percentiles of all calls; quiet: the host took at most {MUCH:.0%} from both windows"
    )
    for row in rows:
        table.add_row(*row)
    console.print(table)
    if path == KEPT:
        rewrite(kept)
    console.print(f"kept in {path}", highlight=False)


if __name__ == "__main__":
    main()
