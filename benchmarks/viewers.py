"""What a viewer costs a control loop at 1 kHz: `python -m benchmarks.viewers`, in turns, under six minutes.

The loop's p50, p99, late cycles and longest cycle with each viewer, and p99 and late cycles over those without one. A
cycle counts from when it was due, so waking up late is part of it. It needs websockets, rerun-sdk, foxglove-sdk
and Chromium; a viewer that is not there is left out.
"""

import argparse
import tempfile

import numpy as np
from rich.console import Console
from rich.table import Table

from .measure import Bench, rotated
from .measure_host import VIEWERS, turn
from .process import ContenderError, Workers
from .server import private_server

WITHOUT = "no viewer"
LEFT_OUT = ("page", "datagram")  # measured by `make bench`


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.viewers", description=__doc__)
    parser.add_argument("--rounds", type=int, default=4, help="turns of each way")
    parser.add_argument("--cycles", type=int, default=4000, help="cycles of a turn")
    parser.add_argument("--only", nargs="*", default=[], help="these ways, beside the loop without a viewer")
    return parser.parse_args()


def main() -> None:
    """Measure and print."""
    options, console = arguments(), Console(width=120)
    names = [name for name in VIEWERS if name not in LEFT_OUT]
    if options.only:
        names = [name for name in names if name in (WITHOUT, *options.only)]
    found: dict[str, list[list[float]]] = {name: [] for name in names}
    late = dict.fromkeys(names, 0)
    with private_server() as server, tempfile.TemporaryDirectory(prefix="bench-") as folder:
        bench = Bench(Workers(server, folder), quick=False)
        for number in range(options.rounds):
            for name in rotated(list(found), number):
                console.print(f"round {number + 1} of {options.rounds}: {name}", highlight=False)
                try:
                    reply = turn(bench, VIEWERS[name], options.cycles)
                except ContenderError as error:
                    console.print(f"[yellow]{name} is left out: {error}")
                    del found[name]
                    continue
                found[name].append(reply["cycles"])
                late[name] += reply["missed"]
                server.empty()
    console.print(table(found, late, options.cycles))


def table(found: dict[str, list[list[float]]], late: dict[str, int], cycles: int) -> Table:
    """Each way's figures, and their ratios over the loop without a viewer. p99 is the median of the turns'."""
    shown = Table("viewer", "p50", "p99", "worst turn", "late", "longest", "p99 /", "late /", title="a loop at 1 kHz")
    figures = {name: [np.percentile(each, [50, 99, 100]) * 1e3 for each in turns] for name, turns in found.items()}
    base, base_late = np.median([each[1] for each in figures[WITHOUT]]), max(late[WITHOUT], 1)
    for name, turns in figures.items():
        p50, p99 = (float(np.median([each[place] for each in turns])) for place in (0, 1))
        shown.add_row(
            name,
            f"{p50:.2f} ms",
            f"{p99:.2f} ms",
            f"{max(each[1] for each in turns):.2f} ms",
            f"{late[name]} of {cycles * len(turns)}",
            f"{max(each[2] for each in turns):.1f} ms",
            f"{p99 / base:.2f}",
            f"{late[name] / base_late:.1f}",
        )
    return shown


if __name__ == "__main__":
    main()
