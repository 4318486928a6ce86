"""The long measurement of what a recorder costs: its figures from known windows, its page, and a short real run."""

import numpy as np
import pytest

from benchmarks.recorder import Window, judge


def _window(tail: float, steal: float = 0.0) -> Window:
    """A thousand calls of which three in a hundred take `tail`."""
    took = np.full(1000, 1e-4)
    took[:30] = tail
    return Window(took, steal)


def test_pairs_of_which_the_host_took_much_are_told_apart_whichever_half_it_was():
    quiet = (_window(1e-3), _window(1.1e-3))
    found = judge([quiet, (_window(1e-3, 0.05), _window(9e-3)), quiet, (_window(1e-3), _window(9e-3, 0.05))])

    assert found["quiet"]["pairs"] == 2
    assert found["quiet"]["ratio"] == pytest.approx(1.1)
    assert found["all"]["pairs"] == 4
    assert found["all"]["ratio"] > 5
    assert found["all"]["interval"][1] > found["all"]["interval"][0]
