"""A few events of a robot's week; `make week` goes on for an hour."""

import pytest
from conftest import assert_ends_well


@pytest.mark.long
def test_all_have_what_the_server_has_whatever_fails():
    assert_ends_well("tests/robotweek.py", "--events", 20, "--seed", 3, timeout=600)
