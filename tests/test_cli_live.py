"""echo, hz, bw, delay and top: what is heard, what is counted, and how they end."""

import contextlib
import io
import json
import re
import select
import signal
import time

import numpy as np
import pytest
from clikit import finished
from conftest import RawCluster, eventually, repeated, subscribed, subscriptions
from rich.console import Console

import reem as blocking
from reem_async.connection import RedisInterface
from reem_async.plan.keys import keys_of
from reem_async.plan.notices import announce, published
from reem_async.pubsub.monitor import Event
from reem_async.tools.cli import following, top
from reem_async.tools.cli.following import Ending, follow
from reem_async.tools.cli.output import json_text
from reem_async.tools.cli.top import ALL, BANDWIDTH, DELAY, RATE, Board, Window, spread, table
from reem_async.tools.cli.values import preview


@pytest.fixture
def space(cli):
    with blocking.RedisInterface(cli.url, namespace=cli.namespace) as interface:
        yield blocking.PublishSpace(interface)


@pytest.fixture
def listening(cli, raw):
    """Starts a live command and waits until it is subscribed to so many patterns, or keys of a cluster."""

    @contextlib.contextmanager
    def start(*arguments, topics=1):
        before = subscriptions(raw)
        with cli.running(*arguments) as process:
            eventually(lambda: subscriptions(raw) >= before + topics)
            yield process

    return start


@pytest.fixture
def announced(cli, raw):
    """Publishes notices with numbers, times and sizes of the test's choice, as a new publisher does."""
    sharded = isinstance(raw, RawCluster)
    database = 0 if sharded else raw.connection_pool.connection_kwargs.get("db", 0)

    def publish(name, sequence, *, age=0.0, size=0, path=()):
        keys = keys_of(name, cli.namespace, database, sharded)
        notice = announce("a-test", sequence, time.time() - age, path, size=size)
        for command in published(keys, "a-test", sequence, notice, everywhere=sharded):
            raw.execute_command(*command)

    return publish


def ended(process, number=signal.SIGINT):
    process.send_signal(number)
    said, errors = process.communicate(timeout=10)
    assert "Traceback" not in errors
    return process.returncode, said, errors


# --- echo -------------------------------------------------


def test_echo_for_people(space, listening, announced):
    with listening("echo", "foo", "bar.*.x", topics=2) as process:

        def line():
            moment, path, what = process.stdout.readline().rstrip("\n").split("  ")
            assert len(moment) == len("12:34:56.123456")
            return path, what

        space["foo"] = {"number": 1, "small": np.arange(3), "raw": b"ab", "evil": "\x1b[31m\x9b"}
        assert line() == (
            "foo",
            '{"number":1,"small":"int64[3] [0 1 2]","raw":"<bytes, 2 B>","evil":"\\u001b[31m\\u009b"}',
        )
        space["foo"]["image"] = np.zeros(50_000)
        assert line() == ("foo.image", "<float64[50000], 400.2 kB, not fetched>")
        space["foo"]["number"] += 1
        assert line() == ("foo.number", "<changed, not fetched>")
        space["bar"] = {"left": {"x": 1, "y": 2}}
        assert line() == ("bar", '{"left":{"x":1,"y":2}}')
        space["bar"]["left"]["y"] = 3  # nothing that was asked for
        space["bar"]["left"]["x"] = 4
        assert line() == ("bar.left.x", "4")
        del space["foo"]["raw"]
        assert line() == ("foo.raw", "deleted")
        announced("foo", 1)
        announced("foo", 5)
        assert line()[0] == "foo"
        assert process.stdout.readline() == "# 3 updates were lost before the next line\n"
        assert line()[0] == "foo"
        code, rest, errors = ended(process)
    assert (code, rest) == (0, "")
    assert "8 updates in " in errors
    assert errors.endswith(" s, 3 lost\n")


def test_echo_for_programs(space, listening):
    with listening("echo", "foo", "--json", "--count", "3") as process:
        before = time.time()
        space["foo"] = {"image": np.arange(2.0)}
        space["foo"]["big"] = "x" * 20_000
        del space["foo"]["image"]
        said, errors = process.communicate(timeout=10)
    assert process.returncode == 0
    assert "3 updates in" in errors
    first, second, third = map(json.loads, said.splitlines())
    assert first["value"] == {"image": [0.0, 1.0]}
    assert before <= first["time"] <= first["received"] + 0.001 <= time.time() + 0.001
    assert (first["sequence"], second["sequence"], third["sequence"]) == (1, 2, 3)
    assert "value" not in second
    assert second["size"] == 20_002
    assert third["deleted"] is True
    assert [each[name] for each in (first, second, third) for name in ("missed", "gap", "skipped")] == [0, False, 0] * 3


def test_echo_goes_on_after_a_broken_connection(space, listening, raw):
    with listening("echo", "foo") as process:
        space["foo"] = 1
        assert process.stdout.readline().endswith("foo  1\n")
        for connection in subscribed(raw):
            raw.client_kill_filter(_id=connection)
        assert "waiting for it" in process.stderr.readline()
        assert "reconnecting" in process.stderr.readline()
        # To the notices of all keys, or of a key of a cluster; the channel of stored changes may come before or after.
        eventually(lambda: any(int(row["psub"]) or int(row.get("ssub", 0)) for row in raw.client_list()))
        space["foo"] = 2
        assert process.stdout.readline() == "# a gap: the connection broke, or an update was unreadable\n"
        assert process.stdout.readline().endswith("foo  2\n")
        code, _, errors = ended(process, signal.SIGTERM)
    assert code == 0
    assert "0 lost, 1 gaps of unknown length" in errors


def test_echo_shows_what_is_only_stored_and_marks_it(cli, space, listening):
    store = blocking.KeyValueStore(space.interface)
    store["imu"] = {"temp": 20, "acc": [1, 2]}
    with listening("echo", "imu.temp", "cam") as process:

        def line():
            return process.stdout.readline().rstrip("\n").split("  ")[1:]

        def heard(change):
            """What is printed of a change: the command may follow the store a moment later than it subscribes."""
            for number in range(100):
                change(number)
                if select.select([process.stdout], [], [], 0.2)[0]:
                    return line()
            raise AssertionError("nothing was printed")

        path, _, mark = heard(lambda number: store["imu"].update({"temp": 100 + number}))
        assert (path, mark) == ("imu.temp", "(stored)")
        space["imu"] = {"temp": 7, "acc": [3, 4]}
        assert line() == ["imu.temp", "7"]
        store["cam"] = {"image": np.zeros((480, 640, 3), np.uint8), "n": 1}
        assert line() == ["cam", '{"image":"<uint8[480,640,3], 921.6 kB>","n":1}', "(stored)"]
        del store["cam"]
        assert line() == ["cam", "deleted", "(stored)"]
        ended(process)


def test_stored_changes_are_counted_and_told_in_json(cli, space):
    store = blocking.KeyValueStore(space.interface)
    store["foo"] = {"n": 0}
    with repeated(lambda number: store["foo"]["n"].write(number), 0.02):
        entry = json.loads(cli.result("echo", "foo", "--json", "--count", "1"))
        assert (entry["path"], entry["stored"], entry["publisher"]) == ("foo.n", True, "")
        entry = json.loads(cli.result("hz", "foo", "--json", "--count", "3"))
        assert (entry["path"], entry["updates"]) == ("foo.n (stored)", 3)


def test_waiting_in_vain(cli):
    run = cli("echo", "foo", "--timeout", "0.2")
    assert (run.returncode, run.stdout) == (4, "")
    assert "0 updates in" in run.stderr


async def test_how_waiting_ends(cli, space):
    async with RedisInterface(cli.url, namespace=cli.namespace) as interface:
        for count, code in ((None, 0), (1, 0), (2, 4)):
            tick = once(lambda: space["foo"].write(1))
            ending = await follow(interface, ("foo",), lambda *_: None, count=count, seconds=0.5, every=0.05, tick=tick)
            assert (ending.taken, ending.tell()) == (1, code)


async def test_what_comes_too_fast_is_counted(cli, space, monkeypatch):
    monkeypatch.setattr(following, "_WAITING", 3)
    seen = []

    async def slow(event, ending):
        if not seen:
            for number in range(20):  # blocks the event loop: all of these arrive at once
                space["foo"] = number
        seen.append((event.value, ending.skipped))

    async with RedisInterface(cli.url, namespace=cli.namespace) as interface:
        tick = once(lambda: space["foo"].write(-1))
        ending = await follow(interface, ("foo",), slow, seconds=0.5, every=0.05, tick=tick)
    assert seen[0] == (-1, 0)
    assert ending.skipped == 21 - ending.taken > 0
    assert seen[-1] == (19, ending.skipped)
    assert not ending.timed_out


def once(function):
    left = [function]

    def call(_):
        if left:
            left.pop()()

    return call


# --- hz, bw, delay -------------------------------------------------


def test_delay_is_by_both_clocks(listening, announced):
    with listening("delay", "cam", "--count", "2") as process:
        announced("cam", 1, age=5.0)
        announced("cam", 2, age=-5.0)  # a publisher whose clock is ahead
        said, errors = process.communicate(timeout=10)
    found = re.fullmatch(r"cam: mean ms (\S+), min ms (\S+), max ms (\S+), std ms (\S+), updates 2, lost 0\n", said)
    assert list(map(float, found.groups()[1:])) == pytest.approx([-5000, 5000, 5000], abs=2500)
    assert "difference of their clocks" in errors


def test_hz_reports_as_it_goes_and_at_the_end(listening, announced):
    with listening("hz", "cam_*") as process:
        for sequence in (1, 2, 4):
            announced("cam_left", sequence)
        announced("cam_right", 1, path=("x", 0))
        announced("foo", 1)
        heard = ""
        while "cam_right.x[0]: Hz -, mean ms -" not in heard or "updates 3, lost 1" not in heard:
            line = process.stdout.readline()
            assert line
            heard += line
        code, rest, errors = ended(process)
    assert code == 0
    final = rest.splitlines()[-2:]
    number = r"\d+\.\d\d"
    numbers = f"Hz {number}, mean ms {number}, min ms {number}, max ms {number}, std ms {number}"
    assert re.fullmatch(f"cam_left: {numbers}, updates 3, lost 1", final[0])
    assert final[1] == "cam_right.x[0]: Hz -, mean ms -, min ms -, max ms -, std ms -, updates 1, lost 0"
    assert errors.startswith("4 updates in ")
    assert "foo" not in heard + rest


def event(received, *, sent=0.0, size=0, missed=0):
    return Event(("p",), None, False, size, sent, received, "publisher", 1, missed)


def test_what_a_window_says(monkeypatch):
    monkeypatch.setattr(top, "_WINDOW", 4)
    at_once = Window()
    for _ in range(2):
        at_once.add(event(5.0))
    assert (at_once.rate(), at_once.bandwidth(), RATE.cells(at_once)[0]) == (None, None, "-")
    window = Window()
    assert (window.rate(), window.bandwidth(), spread(window.intervals())) == (None, None, None)
    for number, received in enumerate((0.0, 10.0, 10.1, 10.3, 10.6)):
        window.add(event(received, sent=received - 0.002 * number, size=100 * number, missed=number == 2))
    assert (window.total, window.lost) == (5, 1)
    assert window.rate() == pytest.approx(3 / 0.6)
    assert window.bandwidth() == pytest.approx((200 + 300 + 400) / 0.6)
    assert window.intervals() == pytest.approx([0.1, 0.2, 0.3])
    expected = {"mean": 0.005, "min": 0.002, "max": 0.008, "std": 0.002236}
    assert spread(window.delays) == pytest.approx(expected, abs=1e-5)
    assert RATE.cells(window) == ("5.00", "200.00", "100.00", "300.00", "81.65")
    assert BANDWIDTH.cells(window) == ("1.5 kB/s", "250 B", "100 B", "400 B", "112 B")
    assert DELAY.cells(window)[:3] == ("5.00", "2.00", "8.00")


def test_the_last_line(capsys):
    ending = Ending(taken=2, lost=1, skipped=3, gaps=1, seconds=1.25, timed_out=True)
    assert ending.tell() == 4
    said = capsys.readouterr().err
    assert said == ("2 updates in 1.2 s, 1 lost, 1 gaps of unknown length, 3 skipped here, since they came too fast\n")


def test_echo_of_what_is_not_there_yet_says_so(cli, space, listening):
    with listening("echo", "later", "robot.*", topics=2) as process:
        assert process.stderr.readline() == "nothing is stored at later yet: waiting for it\n"
        assert process.stderr.readline() == "nothing is stored at robot.* yet: waiting for it\n"
        space["later"] = {"frame": 1, "rgb": np.zeros((100, 100, 3), np.uint8)}
        what = process.stdout.readline().rstrip("\n").split("  ")[2]
        assert what == '<{"frame":1,"rgb":"<uint8[100,100,3], 30.0 kB>"}, 30.2 kB, not fetched>'


# --- reem top, and what all commands have in common: files, NaN, one report at the end


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
    run = cli("doctor", "--json")
    (row,) = [row for row in map(json.loads, run.stdout.splitlines()) if row["check"] == "publishers"]
    assert row["status"] == "warn"
    assert "arm is published by 2" in row["message"]


def test_who_takes_over_is_one_publisher():
    """A program that was started anew publishes under another id; one that is heard again is a second one."""
    window = Window()
    for moment, publisher, expected in [(1, "a", 1), (2, "a", 1), (3, "b", 1), (4, "b", 1), (5, "a", 2), (30, "b", 1)]:
        window.add(Event(("x",), 1, False, 1, moment, moment, publisher, 1))
        assert window.publishers == expected, moment


@pytest.mark.parametrize(("columns", "lines"), [(100, 32), (80, 12)])
def test_the_table_fits_any_terminal(columns, lines):
    board = Board(ALL)
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
    assert " ".join(shown[0].split()) == "path Hz bytes/s delay ms age s publishers shared lost"
    assert len(shown) < lines
    assert max(map(len, shown)) <= columns
    assert "MB/s" in shown[1]
    assert any(line.startswith("! several publishers, each") for line in shown)
    assert any(line.startswith("… ") for line in shown) == (lines == 12)
    assert " ".join(ALL.remark.split()) in " ".join(" ".join(shown).split())


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
    assert " updates in " in shown
