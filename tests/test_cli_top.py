"""reem top, and what all commands have in common: files, NaN, one report at the end."""

import io
import json
import time

import numpy as np
import pytest
from clikit import finished
from conftest import repeated
from rich.console import Console

import reem as blocking
from reem_async.pubsub.monitor import Event
from reem_async.tools.cli.output import json_text
from reem_async.tools.cli.top import ALL, Board, Window, table
from reem_async.tools.cli.values import preview


@pytest.fixture
def robot(cli):
    with (
        blocking.RedisInterface(cli.url, namespace=cli.namespace) as one,
        blocking.RedisInterface(cli.url, namespace=cli.namespace) as two,
    ):
        spaces = blocking.PublishSpace(one), blocking.PublishSpace(two)

        def publish(_):
            spaces[0].update(arm={"x": 1}, cam={"n": 1})
            spaces[1]["arm"] = {"x": 2}

        with repeated(publish, 0.02):
            yield


def test_top_shows_keys_and_points_out_two_publishers(cli, robot):
    run = cli("top", "--timeout", "1.5", "--json")
    assert run.returncode == 0
    rows = {row["path"]: row for row in map(json.loads, run.stdout.splitlines())}
    assert len(rows) == len(run.stdout.splitlines()) == 2
    assert (rows["arm"]["publishers"], rows["cam"]["publishers"]) == (2, 1)
    assert rows["arm"]["hz"] > rows["cam"]["hz"] > 1
    assert rows["cam"]["age_s"] < 1
    assert "warning: arm is published by 2 interfaces at once" in run.stderr


def test_doctor_points_out_two_publishers(cli, robot):
    run = cli("doctor", "--no-write", "--json")
    (row,) = [row for row in map(json.loads, run.stdout.splitlines()) if row["check"] == "publishers"]
    assert row["status"] == "warn"
    assert "arm is published by 2" in row["message"]


def test_who_takes_over_is_one_publisher():
    """A program that was started anew publishes under another id; one that is heard again is a second one."""
    window = Window(10)
    for moment, publisher, expected in [(1, "a", 1), (2, "a", 1), (3, "b", 1), (4, "b", 1), (5, "a", 2), (30, "b", 1)]:
        window.add(Event(("x",), 1, False, 1, moment, moment, publisher, 1))
        assert window.publishers == expected, moment


@pytest.mark.parametrize(
    ("columns", "lines", "titles"),
    [
        (100, 30, "path Hz bytes/s delay ms age s publishers shared updates lost"),
        (60, 12, "path Hz bytes/s delay ms age s lost"),
        (40, 8, "path Hz bytes/s lost"),
    ],
)
def test_the_table_fits_any_terminal(columns, lines, titles):
    board = Board(ALL, 100)
    for number in range(25 * 4):
        publisher = "b" if number % 8 == 3 else "a"  # key 03 has two
        name = f"sensor_with_a_rather_long_name_{number % 25:02}" if number % 25 != 3 else "k03"
        now = time.time() + number / 1000
        board.take(Event((name, "x"), 1, False, 25_000, now, now, publisher, 1))
    board.take(Event(("k03",), 1, False, 25_000, now, now, "b", 2))
    board.take(Event(("k03",), 1, False, 25_000, now, now, "a", 2))
    screen = io.StringIO()
    console = Console(file=screen, width=columns, height=lines, color_system=None)
    console.print(table(board, "", columns, lines))
    shown = screen.getvalue().rstrip("\n").split("\n")
    assert " ".join(shown[0].split()) == titles
    assert len(shown) < lines
    assert max(map(len, shown)) <= columns
    assert "MB/s" in shown[1]
    assert any(line.startswith("! several publishers, each") for line in shown)
    assert any(line.startswith("… ") for line in shown) == (lines < 28)
    whole = " ".join(ALL.remark.split()) in " ".join(" ".join(shown).split())
    assert whole == (columns > 40), "what the columns mean is cut off only where rows need its place"


def test_nan_is_called_by_its_name(cli):
    assert json_text({"a": [1.5, float("nan")], "b": None}) == '{"a":[1.5,NaN],"b":null}'
    assert json_text(np.array([np.inf, -np.inf])) == "[Infinity,-Infinity]"
    assert json_text({"a": "\u00e9", "b": None}) == '{"a":"\u00e9","b":null}'
    said = preview(np.array([1.0, np.nan, 3.0, np.inf]), 80)
    assert "min 1.0, max 3.0, mean 2, 2 of 4 are NaN or infinite" in said
    assert "2 of 2 are NaN" in preview(np.full(2, np.nan), 80)


def test_a_recording_of_nothing_warns(cli, tmp_path):
    run = cli.process("record", "nothing*", "--duration", "0.2", "-o", str(tmp_path / "x.mcap"))  # it is made nicer
    assert run.returncode == 0
    assert "nothing was recorded" in run.stderr
    assert "reem top" in run.stderr


def test_a_server_on_the_port_is_named(cli, server_url):
    port = str(blocking.RedisInterface(server_url).client.connection_pool.connection_kwargs.get("port"))
    run = finished("up", "--port", port)
    assert run.returncode == 1
    assert f"connect to redis://localhost:{port}" in run.stderr


def test_q_ends_top_and_gives_the_terminal_back(cli, robot):
    shown, code = cli.in_terminal("top", keys=[(b"cam", b"x"), (b"cam", b"q")])
    assert code == 0
    assert "updates of 2 paths" in shown
