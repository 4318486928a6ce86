"""Tools show, plot and record keys of programs without REEM, without an option, and only read them."""

import asyncio
import html
import json
import re
import shutil
import signal
import subprocess
import time

import numpy as np
import pytest
import redis
from browserkit import client_of, live, served
from clikit import CommandLine, said_until
from conftest import PATIENCE, ROOT, assert_same, eventually, url_of_user

import reem
from reem.errors import BadValue
from reem_async import KeyValueStore, RedisInterface
from reem_async.recording import Recorder, open_log
from reem_async.tools.browser.raw import hint_of, numbers_of
from reem_async.tools.cli import raw as cli_raw

IMAGE = np.arange(40 * 60 * 3, dtype=np.uint8).reshape(40, 60, 3)
JPEG = b"\xff\xd8\xff\xe0" + bytes(100)


@pytest.fixture
def lab(server):
    """A server that other programs have filled, and that REEM uses too; tools may only look."""
    with redis.Redis.from_url(server.url) as robot:
        robot.execute_command("ACL", "SETUSER", "looker", "on", ">pw", "~*", "&*", "+@all", "-@write")
        robot.set("sai::q", "[0.1, 0.2]")
        robot.set("sai::force", "0.5, 1.5, -2e1")
        robot.set("camera::rgb", b"headhead" + IMAGE.tobytes())
        robot.hset("battery", mapping={"volts": "24.5", "state": "ok"})
        robot.xadd("imu", {"ax": "1.5"})
        robot.set("a.b", "dotted")
        with reem.RedisInterface(server) as interface:
            reem.KeyValueStore(interface)["mine"] = {"image": IMAGE, "n": 1}
        robot.url = url_of_user(server.url, "looker", "pw")
        yield robot


@pytest.fixture
def look(lab):
    return lambda *words, **options: CommandLine(lab.url, "")(*words, **options)


def test_ls_tree_and_get_show_keys_of_other_programs_with_their_type(look):
    listed = [line.split("\t") for line in look("ls").stdout.splitlines()]
    assert [row[:2] for row in listed] == [
        ["mine", "dict"],
        ['["a.b"]', "raw string"],
        ["battery", "raw hash"],
        ["camera::rgb", "raw string"],
        ["imu", "raw stream"],
        ["sai::force", "raw string"],
        ["sai::q", "raw string"],
    ]
    assert listed[3][2:] == ["bytes", "7.2 kB"]
    assert look("ls").stderr == "6 keys of other programs, marked raw\n"
    assert "battery  2 keys" in (tree := look("tree").stdout)
    assert "(raw hash)\n├── " in tree
    row = json.loads(look("ls", "sai::q", "--json").stdout)
    assert (row["path"], row["raw"], row["length"]) == ("sai::q", "string", 2)
    for path, printed in (
        ("sai::q", "[0.1,0.2]\n"),
        ("sai::q[1]", "0.2\n"),
        ("battery.volts", "24.5\n"),
        ("a.b", '"dotted"\n'),
        ("imu", '{"ax":1.5}\n'),
    ):
        assert look("get", path, "--json").stdout == printed, path
    assert look("get", "a.b", "--raw").stdout == "dotted\n"
    assert look("get", "camera::rgb").stdout.startswith("7208 bytes\n")
    for path in ("battery.nothing", "missing"):
        assert (done := look("get", path)).returncode == 3
        assert "remove" not in done.stderr
    wrong = look("set", "sai::q.x", "1").stderr
    assert "kvs.raw['sai::q']" in wrong or "may not" in wrong


def test_with_a_namespace_none_are_shown(lab):
    done = CommandLine(lab.url, "robot:")("ls")
    assert (done.returncode, done.stdout) == (3, "")


def test_more_than_are_shown_are_named(look, monkeypatch):
    monkeypatch.setattr(cli_raw, "MOST", 3)
    done = look("ls", "*")
    assert sum("raw " in line for line in done.stdout.splitlines()) == 3
    assert "only 3 keys of other programs are shown" in done.stderr
    assert "over 3 keys of programs without REEM" in look("doctor").stdout


def test_doctor_counts_them(look):
    rows = {row["check"]: row for row in map(json.loads, look("doctor", "--json").stdout.splitlines())}
    found = rows["raw keys"]["message"]
    assert found.startswith("6 keys of programs without REEM (1 hash, 1 stream, 4 string)")
    assert rows["raw keys"]["status"] == "ok"


def test_echo_and_top_show_changes(lab):
    cli = CommandLine(lab.url, "")
    with cli.running("echo", "sai::*", "battery", "--count", "2", "--json") as process:
        eventually(lambda: [row for row in lab.client_list() if "B" in row["flags"]])
        time.sleep(0.3)
        lab.set("unmeant", "1")
        lab.set("sai::q", "[3]")
        lines = [json.loads(process.stdout.readline())]
        lab.hset("battery", "volts", "1")
        lines.append(json.loads(process.stdout.readline()))
    assert [(row["path"], row["value"], row["raw"]) for row in lines] == [
        ("sai::q", [3], "string"),
        ("battery", {"volts": 1, "state": "ok"}, "hash"),
    ]
    with cli.running("top", "--json") as process:
        eventually(lambda: [row for row in lab.client_list() if "B" in row["flags"]])
        time.sleep(0.3)
        for number in range(50):
            lab.set("sai::q", f"[{number}]")
            time.sleep(0.002)
        row = json.loads(said_until(process, "{").splitlines()[-1])
    assert (row["path"], 0 < row["updates"] <= 50) == ("sai::q (raw string)", True)


def test_echo_prints_messages_of_a_plain_channel(lab):
    with CommandLine(lab.url, "").running("echo", "--channel", "events", "--count", "2") as process:
        eventually(lambda: lab.publish("events", '{"a": 1}'))
        lab.publish("events", b"\xff\x00")
        assert 'events  {"a":1}' in process.stdout.readline()
        assert "<bytes, 2 B>" in process.stdout.readline()


def test_the_page_shows_plots_and_pictures_of_them(lab):
    """A hint that is typed once makes an array of packed bytes; nothing is written."""
    with served(live(lab.url)) as (address, source), client_of(address) as page:
        eventually(lambda: page.rows().keys() >= {"mine", "sai::q", "camera::rgb", "battery", '["a.b"]'})
        rows = page.rows()
        assert (rows["sai::q"]["raw"], rows["battery"]["raw"], rows["mine"]["raw"]) == ("string", "hash", "")
        assert (rows["sai::force"]["kind"], rows["camera::rgb"]["kind"]) == ("list", "bytes")
        assert page.rows("battery")["volts"]["text"] == "24.5"
        assert page.json("node", path="sai::q")["snippets"]["blocking (reem)"].endswith("kvs.raw['sai::q'].read()\n")
        for number in range(3):
            lab.set("sai::force", f"{number} 0 1")
            lab.set("sai::q", f"[{number}]")
            time.sleep(0.15)
        for path in ("sai::force", "sai::q"):
            eventually(lambda path=path: page.json("series", path=path)["lines"][0][-1:] == [2.0])
        send = {"path": "camera::rgb", "value": "uint8[40,60,3]+8"}
        options = {"headers": {"origin": address, "x-reem-key": page_key(page)}}
        assert page.http.post("/api/hint", json=send | {"value": "uint8[4000,6000]"}, **options).status_code == 400
        assert page.http.post("/api/hint", json=send).status_code == 403
        assert page.http.post("/api/hint", json=send, **options).status_code == 200
        assert page.rows()["camera::rgb"]["text"] == "uint8[40,60,3]"
        lab.set("camera::rgb", bytes(8) + bytes(IMAGE.size))
        eventually(lambda: source.history.tree(("camera::rgb",), time.time()).whole.max() == 0)
        assert page.ask("image", path="camera::rgb", slice=":,:,:").headers["content-type"] == "image/png"
        lab.set("photo", JPEG)
        eventually(lambda: "photo" in page.rows())
        assert page.json("bytes", path="photo")["picture"]
        lab.delete("battery")
        eventually(lambda: "battery" not in page.rows())
        assert page.http.post("/api/write", json={"path": "sai::q", "value": 1}, **options).status_code == 403


def page_key(page):
    config = re.search(r'data-config="([^"]*)"|<script[^>]*>(\{.*?\})', page.http.get("/").text)
    return json.loads(html.unescape(config[1] or config[2]))["key"]


@pytest.mark.parametrize("text", ["uint8", "uint8[]", "object[3]", "uint8[2]-1", "nonsense[3]", "<U4[2]", ""])
def test_a_hint_that_says_nothing_is_refused(text):
    with pytest.raises(BadValue, match="does not say what bytes are"):
        hint_of(text)


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("0.1 0.2", [0.1, 0.2]),
        ("1,2;3", [1.0, 2.0, 3.0]),
        (" 1\n-2e3 ", [1.0, -2000.0]),
        ("1", "1"),
        ("1 two", "1 two"),
        ("2026-11-26 10", "2026-11-26 10"),
        ("", ""),
        ("1e", "1e"),
    ],
)
def test_separated_numbers_are_a_list(text, numbers):
    assert numbers_of(text) == numbers


async def test_they_are_recorded_with_their_types_and_times(lab, file):
    async with RedisInterface(lab.url) as interface, Recorder(interface, path=file) as recorder:
        await asyncio.to_thread(lab.set, "sai::q", "[7, 8]")
        await asyncio.to_thread(lab.set, "new", b"\x00\x01")
        await asyncio.sleep(0.3)
        await asyncio.to_thread(lab.delete, "imu")
        await asyncio.sleep(0.3)
    assert (recorder.status.lost, recorder.status.dropped) == (0, 0)
    with open_log(file) as log:
        last = {name: log[name].at(log.end) for name in ("sai::q", "sai::force", "new", "battery", "mine")}
        assert_same(last["sai::q"], [7, 8])
        assert (last["sai::force"], last["new"]) == ("0.5, 1.5, -2e1", b"\x00\x01")
        assert_same(last["battery"], {"volts": 24.5, "state": "ok"})
        assert_same(last["mine"], {"image": IMAGE, "n": 1})
        assert log["camera::rgb"].at(log.end)[8:] == IMAGE.tobytes()
        assert_same(next(log["sai::q"].values())[1], [0.1, 0.2])


async def test_a_document_that_another_program_replaces_is_recorded_as_what_it_is_then(server, file):
    async with RedisInterface(server) as interface:
        mine = KeyValueStore(interface)["mine"]
        await mine.write({"n": 1})
        with redis.Redis.from_url(server.url) as robot:
            robot.set("other", "0")
            async with Recorder(interface, path=file) as recorder:
                for number in range(3):
                    await mine.write({"n": number, "image": IMAGE})
                    await asyncio.sleep(0.2)
                    robot.delete("mine")
                    robot.set("mine", f"[{number}]")
                    await asyncio.sleep(0.3)
                    robot.delete("mine")
                robot.hset("mine", "volts", "24.5")
            assert (recorder.status.lost, recorder.status.dropped) == (0, 0)
    with open_log(file) as log:
        assert log["mine"].at(log.end) == {"volts": 24.5}
        values = [repr(it.value) for it in log.updates(patterns=["mine"])]
        assert all(f"[{number}]" in values for number in range(3)), values


@pytest.fixture(scope="module")
def lab_program(tmp_path_factory):
    """The lab's robot, compiled."""
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc: the program stands for those that are no Python")
    program = tmp_path_factory.mktemp("lab") / "lab"
    source = ROOT / "tests/lab/lab.c"
    subprocess.run(["gcc", "-O2", "-Wall", "-Werror", "-o", program, source, "-lm"], check=True)
    return program


@pytest.mark.long
def test_a_robot_in_c_is_seen_by_all_tools(server, lab_program, file):
    """JSON at 1 kHz, images at 30 Hz, a hash and a stream; the tools get no option."""
    port, path = server.url.rpartition(":")[2], "sai::sensors::Panda::joint_positions"
    cli = CommandLine(server.url, "")
    with subprocess.Popen([lab_program, "127.0.0.1", port, "300"], stdout=subprocess.PIPE, text=True) as robot:
        try:
            with served(live(server.url)) as (address, _), client_of(address) as page:
                with cli.running("record", "-o", file, "--json") as recording:
                    while json.loads(recording.stdout.readline())["messages"] < 200:  # each key has its share
                        assert robot.poll() is None
                    assert "camera::rgb  bytes  921.6 kB  (raw string)" in cli("tree").stdout
                    eventually(lambda: len(page.json("series", path=path)["times"]) > 10)
                    recording.send_signal(signal.SIGINT)
                    status = json.loads(recording.communicate(timeout=PATIENCE)[0].splitlines()[-1])
                assert "camera::rgb" in page.rows()
            robot.terminate()
            turns = int(robot.communicate(timeout=PATIENCE)[0].split()[1])
        finally:
            robot.kill()
    assert (status["dropped"], status["lost"]) == (0, 0)
    assert json.loads(server_value(server, path))[-1] == turns - 1
    with open_log(file) as log:
        joints = np.array([value for _, value in log[path].values()])
        images = [np.frombuffer(value, np.uint8).reshape(480, 640, 3) for _, value in log["camera::rgb"].values()]
        counts = [len(joints), len(images), *(sum(1 for _ in log[name].values()) for name in ("battery", "imu"))]
    assert min(counts) > 5, counts
    assert min(counts[:2]) > 10, counts
    assert (np.diff(joints[:, -1]) > 0).all()
    assert np.allclose(joints[:, 0], np.sin(joints[:, -1] / 1000), atol=1e-6)
    for image in images:  # a white bar on one colour: none is torn, or of two pictures
        assert (image == image[0]).all()
        assert np.isin(image[0], (255, image[0, -1, 0])).all()


def server_value(server, name):
    with redis.Redis.from_url(server.url) as robot:
        return robot.get(name)
