"""Random calls on REEM and on a plain dict, for some seconds; `make hunt` goes on for longer."""

import subprocess
import sys

import pytest
from conftest import ROOT, sized


@pytest.mark.parametrize(
    ("seed", "steps", "faults", "options"),
    [
        (7, sized(700, 6000), 0.0, []),
        (25, sized(700, 4000), 0.3, []),
        (47, sized(500, 4000), 0.15, ["--plain"]),
        (61, sized(300, 3000), 0.1, ["--secured"]),
    ],
    ids=["whole", "broken off", "without the module", "with TLS and few rights"],
)
def test_random_calls_do_what_a_dict_does(seed, steps, faults, options):
    """Also interrupted, cancelled, cut off, forked, or with handlers of signals that call and close."""
    words = ("--seed", str(seed), "--steps", str(steps), "--faults", str(faults), *options)
    done = subprocess.run(
        [sys.executable, "-m", "tests.hunt", *words],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-6000:]}\n{done.stderr[-3000:]}"
