"""The scoreboard at a small scale: each row in a process of its own, with real faults on a private server.

`python -m tests.chaos` runs it at full size.
"""

import os
import time

import pytest
from chaos import rows  # noqa: F401 - enters every row
from chaos.scoreboard import ROWS, run

SEED = int(os.environ.get("REEM_TEST_SEED", time.time_ns() % 10**9))


@pytest.mark.alone
@pytest.mark.parametrize("number", sorted(ROWS), ids=lambda number: f"row {number}")
def test_a_row_of_the_scoreboard(number):
    """Every figure is within its bound, and the load was real."""
    outcome = run(number, "quick", SEED)
    if outcome.status == "NOT RUN":
        pytest.skip("; ".join(outcome.figures))
    said = "\n".join([*outcome.failures, *outcome.figures, f"again: {outcome.replay}", outcome.output[-4000:]])
    assert outcome.status == "PASS", said
