"""The command."""

from __future__ import annotations

import argparse
import logging
import secrets
import sys
import time
import warnings

from .hunter import Difference, Hunter


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.hunt", description="Random calls on REEM and on a dict.")
    parser.add_argument("--seed", type=int, default=None, help="what all chance comes from")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--steps", type=int, default=0, help="so many steps, in place of a time")
    parser.add_argument("--faults", type=float, default=0.15, help="the share of steps that are broken off")
    parser.add_argument("--plain", action="store_true", help="without the JSON module")
    parser.add_argument("--secured", action="store_true", help="with TLS, as a user with few rights")
    given = parser.parse_args()
    seed = secrets.randbelow(10**6) if given.seed is None else given.seed
    # What is broken off leaves coroutines that have not begun, and exceptions in finalizers, of which Python tells.
    warnings.filterwarnings("ignore", "coroutine .* was never awaited")
    warnings.filterwarnings("ignore", "This process .* is multi-threaded")
    sys.unraisablehook = lambda it: None
    logging.disable(logging.WARNING)
    print(f"seed {seed}", flush=True)
    hunter, begun, wrong = Hunter(seed, given.faults, secured=given.secured, plain=given.plain), time.monotonic(), ""
    try:
        hunter.run(given.minutes * 60, given.steps)
    except Difference as difference:
        wrong = str(difference)
    seconds = time.monotonic() - begun
    counts = ", ".join(f"{name} {count}" for name, count in sorted(hunter.counts.items()))
    print(f"seed {seed}: {hunter.steps} steps in {seconds:.0f} s, {hunter.steps / seconds:.0f} a second\n{counts}")
    if wrong:
        again = f"python -m tests.hunt --seed {seed} --steps {hunter.steps} --faults {given.faults}"
        again += " --secured" * given.secured + " --plain" * given.plain
        print(f"DIFFERENCE at step {hunter.steps}: {wrong}\nagain: {again}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
