"""A few events of a robot's week; `make week` goes on for an hour."""

import subprocess
import sys

import pytest
from conftest import ROOT


@pytest.mark.long
def test_all_have_what_the_server_has_whatever_fails():
    """Mirrors, watchers, the page and recordings, beside programs, links and a server that are killed and stopped."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "tests/robotweek.py"), "--events", "20", "--seed", "3"],
        cwd=ROOT, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-6000:]}\n{done.stderr[-3000:]}"
