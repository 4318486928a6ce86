"""`reem call` and `reem services`."""

import json
import os

import numpy as np
import pytest

import reem


@pytest.fixture
def place(server_url, key):
    """A service in the namespace of the command line: named with a dot, and below a key."""

    def act(x=1, nap=False):
        if x < 0:
            raise ValueError("negative")
        return {"twice": 2 * x, "array": np.arange(x)}

    with reem.RedisInterface(server_url, namespace=f"{key.prefix}:") as interface:
        place = reem.KeyValueStore(interface)["arm.left"]["home"]
        with place.serve(act), place.serve(act):
            yield place


def test_call_prints_the_answer_and_services_lists_the_servers(cli, place, tmp_path):
    assert json.loads(cli.result("call", '["arm.left"].home', '{"x": 3}')) == {"twice": 6, "array": [0, 1, 2]}
    cli.result("call", '["arm.left"].home', '{"x": 3}', "-o", str(tmp_path / "x.npz"))
    assert np.load(tmp_path / "x.npz")["array"].tolist() == [0, 1, 2]
    assert "ValueError: negative" in cli.error(1, "call", '["arm.left"].home', '{"x": -1}')
    rows = json.loads(cli.result("services", "--json"))
    assert [(row["service"], row["pid"]) for row in rows] == [('["arm.left"].home', os.getpid())] * 2
    assert (sum(row["calls"] for row in rows), sum(row["errors"] for row in rows)) == (3, 1)
    assert cli.result("services").count('["arm.left"].home') == 2


def test_call_says_what_is_wrong(cli, key):
    assert "no program serves" in cli.error(3, "call", "nobody")
    for wrong in ("[1]", "x", '{"timeout": 1}'):
        cli.error(2, "call", "nobody", wrong)
    assert cli.result("services", "--json").strip() == "[]"
