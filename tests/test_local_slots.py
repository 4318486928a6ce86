"""Slots and early updates between processes that are killed; `make slots` goes on for longer."""

import pytest
from conftest import assert_ends_well, sized

from reem_async.local.segment import reason_against


@pytest.mark.skipif(bool(reason_against()), reason=f"no shared memory: {reason_against()}")
@pytest.mark.parametrize(
    ("program", "option", "count"),
    [("slots", "--uses", sized(2000, 8000)), ("earlysoak", "--updates", sized(1000, 5000))],
)
def test_nothing_is_torn_and_nothing_is_left_whoever_is_killed(program, option, count):
    assert_ends_well(f"tests/{program}.py", "--seed", 31, option, count)
