"""Slots and early updates between processes that are killed; `make slots` goes on for longer."""

import subprocess
import sys

import pytest
from conftest import ROOT, sized

from reem_async.local.segment import reason_against

pytestmark = pytest.mark.skipif(bool(reason_against()), reason=f"no shared memory: {reason_against()}")


@pytest.mark.parametrize(
    ("program", "option", "count"),
    [("slots", "--uses", sized(2000, 8000)), ("earlysoak", "--updates", sized(1000, 5000))],
)
def test_nothing_is_torn_and_nothing_is_left_whoever_is_killed(program, option, count):
    words = "--seed", "31", option, str(count)
    done = subprocess.run(
        [sys.executable, str(ROOT / f"tests/{program}.py"), *words],
        cwd=ROOT, capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-6000:]}\n{done.stderr[-3000:]}"
