"""A recording at a robot's rates; `make recording` runs the same for ten minutes."""

from conftest import sized
from rates.measure import run


def test_at_a_robot_s_rates_all_is_as_published_or_skipped(tmp_path):
    outcome = run(seed=1, seconds=sized(2.0, 10.0), instants=sized(100, 500), folder=tmp_path)
    assert outcome.faults == []
