"""Record publishers at a robot's rates, compare, play, and print what was found; 1 if anything is wrong."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from .measure import run


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.rates", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="to record (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of what is published (default: %(default)s)")
    parser.add_argument("--instants", type=int, default=3000, help="to compare of each key (default: %(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        outcome = run(options.seed, options.seconds, options.instants, Path(folder))
    print(outcome.said)
    for name, each in outcome.keys.items():
        print(
            f"{name:8} {each.published} published, {each.recorded} recorded, {each.skipped} skipped, "
            f"{each.missing} lost, {each.instants} instants compared"
        )
    print(
        f"{outcome.played} updates played, {outcome.refused} refused; memory in MB:",
        *[f"{each:.0f}" for each in outcome.memory[::30]],
    )
    print(*outcome.faults[:20], f"{len(outcome.faults)} faults", sep="\n")
    return bool(outcome.faults)


if __name__ == "__main__":
    sys.exit(main())
