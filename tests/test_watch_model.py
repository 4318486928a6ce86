"""Watchers of all kinds beside random changes by four processes; `make watching` goes on for longer."""

import pytest
from conftest import assert_ends_well, sized


@pytest.mark.parametrize("words", [["--kill"], ["--cluster", "--kill"]], ids=["cut", "cluster"])
def test_whoever_watches_has_what_the_server_has_at_each_pause(words):
    assert_ends_well("-m", "tests.watchmodel", "--seed", 11, "--changes", sized(400, 1200), *words)
