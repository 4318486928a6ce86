"""Random calls on REEM and on a plain dict, for some seconds; `make hunt` goes on for longer."""

from __future__ import annotations

import subprocess
import sys

import pytest
from conftest import ROOT


@pytest.mark.parametrize(
    ("seed", "steps", "faults"),
    [(7, 6000, 0.0), (25, 4000, 0.3), (31, 4000, 0.15), (47, 3000, 0.3)],
    ids=["whole", "broken off", "some broken off", "broken off, another seed"],
)
def test_random_calls_do_what_a_dict_does(seed, steps, faults):
    """About a minute; also interrupted, cancelled, forked, or have handlers of signals call and close."""
    words = ("--seed", str(seed), "--steps", str(steps), "--faults", str(faults))
    done = subprocess.run(
        [sys.executable, "-m", "tests.hunt", *words],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-6000:]}\n{done.stderr[-3000:]}"
