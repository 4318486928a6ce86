"""Watchers of all kinds beside random changes by four processes; `make watching` goes on for longer."""

import subprocess
import sys

import pytest
from conftest import ROOT, sized


@pytest.mark.parametrize("words", [["--kill"], ["--cluster", "--kill"]], ids=["cut", "cluster"])
def test_whoever_watches_has_what_the_server_has_at_each_pause(words):
    """Whatever was stored, published, or sent by a program without REEM; also where connections are cut."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.watchmodel", "--seed", "11", "--changes", str(sized(400, 1200)), *words],
        cwd=ROOT, capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-6000:]}\n{done.stderr[-3000:]}"
