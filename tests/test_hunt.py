"""Random calls on REEM and on a plain dict, for some seconds; `make hunt` goes on for longer."""

import pytest
from conftest import assert_ends_well, sized


@pytest.mark.parametrize(
    ("seed", "steps", "faults", "options"),
    [
        (7, sized(700, 6000), 0.0, []),
        (25, sized(700, 4000), 0.3, []),
        (47, sized(500, 4000), 0.15, ["--plain"]),
        (61, sized(300, 3000), 0.1, ["--secured"]),
    ],
    ids=["whole", "broken off", "without the module", "with TLS and few rights"],
)
def test_random_calls_do_what_a_dict_does(seed, steps, faults, options):
    assert_ends_well("-m", "tests.hunt", "--seed", seed, "--steps", steps, "--faults", faults, *options)
