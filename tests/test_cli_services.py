"""`reem call` and `reem services`."""

import io
import json
import os
import signal

import numpy as np
import pytest
from conftest import assert_same, eventually
from rich.console import Console

import reem
from reem_async.tools.cli.top import services_table
from reem_async.tools.recording import open_log


@pytest.fixture
def kvs(cli):
    with reem.RedisInterface(cli.url, namespace=cli.namespace) as interface:
        yield reem.KeyValueStore(interface)


@pytest.fixture
def place(kvs):
    """A service with two servers: named with a dot, and below a key."""

    def act(x=1, nap=False):
        if x < 0:
            raise ValueError("negative")
        return {"twice": 2 * x, "array": np.arange(x)}

    place = kvs["arm.left"]["home"]
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


def test_a_recording_holds_calls(cli, kvs, place, file):
    """With arguments, answer or error, and time; nothing of them stays on the server."""
    with cli.running("record", "nothing", "--services", "-o", str(file)) as process:
        eventually(lambda: place.call(x=2) and "_calls" in kvs)
        place.call(x=3)
        with pytest.raises(reem.RemoteError):
            place.call(x=-1)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=10)
    with open_log(file) as log:
        calls = [value for _, value in log["_calls"]['["arm.left"].home'].values()]
    assert_same(calls[-2]["answer"], {"twice": 6, "array": np.arange(3)})
    assert (calls[-1]["arguments"], calls[-1]["error"]) == ({"x": -1}, "ValueError: negative")
    assert all(0 < call["seconds"] < 5 for call in calls)
    assert "_calls" not in kvs


def test_top_lists_services(cli, place):
    place.call(x=3)
    run = cli("top", "--timeout", "1.5", "--json")
    rows = [json.loads(line) for line in run.stdout.splitlines()]
    assert [(row["service"], row["errors"]) for row in rows] == [('["arm.left"].home', 0)] * 2
    assert sum(row["calls"] for row in rows) == 1
    assert 'service ["arm.left"].home, host ' in cli("top", "--timeout", "1.5").stdout
    screen = io.StringIO()
    Console(file=screen, width=100, color_system=None).print(services_table(rows))
    assert screen.getvalue().count('["arm.left"].home') == 2
