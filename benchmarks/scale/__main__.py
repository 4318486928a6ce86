"""Measure, compute and write: `python -m benchmarks.scale [--quick | --draw]`, under four minutes."""

from __future__ import annotations

import argparse
import datetime
import time

from rich.console import Console

from .. import environment
from . import figures, page, results
from .full import ARMS, run_arms
from .measure import QUICK, WHOLE, measure
from .replay import replay
from .servers import all_running, on_one_core


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="about a minute, coarse figures, kept in out/ only")
    parser.add_argument("--draw", action="store_true", help="write tables and plots anew from the last whole run")
    return parser.parse_args()


def run(quick: bool, console: Console) -> dict[str, object]:
    """Measure all settings, and run fleets on them."""
    begin, effort = time.monotonic(), QUICK if quick else WHOLE
    with console.status("operations"), on_one_core(), all_running() as servers:
        found, version = measure(servers, effort), servers["one"].version
    with console.status("fleets"), all_running() as servers:
        for setting, each in servers.items():
            found[setting]["replay"] = replay(each, effort.seconds)
            found[setting]["arms"] = [run_arms(each, arms, effort.seconds) for arms in ARMS]
    return {
        "mode": "quick" if quick else "full",
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "environment": environment.line(version),
        "seconds": time.monotonic() - begin,
        "rounds": effort.rounds,
        "settings": found,
    }


def main() -> None:
    """Measure, keep, write the page, draw."""
    options, console = arguments(), Console()
    kept = results.load() if options.draw else results.save(run(options.quick, console), quick=options.quick)
    for table in page.TABLES.values():
        console.print(table(kept), markup=False, highlight=False)
    if kept["mode"] == "full":
        page.rewrite(kept)
        figures.draw(kept)
        console.print(f"written: {page.PAGE}", highlight=False)


if __name__ == "__main__":
    main()
