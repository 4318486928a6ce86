"""`reem record`, `reem play` and `reem log`, run as a user runs them."""

import json
import os
import pty
import re
import select
import signal
import subprocess
import time

import numpy as np
import pytest
from clikit import begins, finished, invoked, is_recording, started
from conftest import ROOT, assert_same, eventually
from test_recording import IMAGE
from test_recording_file import middle_chunk
from test_unreadable import Pose

from reem import KeyValueStore, NumpyShip, RedisInterface
from reem_async.tools.recording import open_log


@pytest.fixture
def reem(server_url, tmp_path, monkeypatch):
    """Runs a command to its end, in this process but for the one that lowers its priority."""
    monkeypatch.chdir(tmp_path)

    def run(command, *words, **changes):
        return (finished if command == "record" else invoked)(
            command, *words, REEM_URL=server_url, COLUMNS="200", **changes
        )

    return run


@pytest.fixture
def recorded(key, server_url, pspace, file, tmp_path):
    pspace[key("a")] = {"n": 0, "image": IMAGE}
    with started(server_url, tmp_path, "record", key("*"), "-o", file, "--json") as process:
        said = [begins(process, as_json=True)]
        eventually(lambda: is_recording(file))  # so that the updates are in a chunk of their own
        for number in range(1, 11):
            pspace[key("a")]["n"] = number
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=10)
    assert (process.returncode, errors) == (0, "")
    return file, [json.loads(line) for line in [*said, *out.splitlines()]]


@pytest.mark.skipif(not hasattr(os, "SCHED_IDLE"), reason="only Linux has a scheduling class for what can wait")
@pytest.mark.parametrize(
    "background", [pytest.param(True, marks=pytest.mark.long), False]
)  # the fast run leaves nothing
def test_in_the_background_it_takes_only_what_nobody_else_wants(background, key, server_url, pspace, file, tmp_path):
    """What reads and what writes; without --background it only does not take the processor from others."""
    pspace[key("a")] = 1
    option = ["--background"] if background else []
    with started(server_url, tmp_path, "record", key("*"), "-o", file, *option) as process:
        begins(process)
        threads = [int(name) for name in os.listdir(f"/proc/{process.pid}/task")]
        policies = [os.sched_getscheduler(thread) for thread in threads]
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=10)
    assert process.returncode == 0
    idle, batch = (policies.count(kind) for kind in (os.SCHED_IDLE, os.SCHED_BATCH))
    # numpy's own threads, which have nothing to do, began before
    assert (idle >= 2, batch) == (True, 0) if background else (batch >= 2, idle) == (True, 0)
    with open_log(file) as log:
        assert log[key("a")].at(log.end) == 1


def test_record_look_play_export(key, recorded, reem, kvs, tmp_path):
    file, said = recorded
    assert said[-1]["ended"] is True
    assert (said[-1]["dropped"], said[-1]["gaps"], said[-1]["file"]) == (0, 0, str(file))

    run = reem("log", "info", file, "--verify", "--json")
    assert (run.returncode, run.stderr) == (0, "")
    info = json.loads(run.stdout)
    assert (info["complete"], info["damaged"], info["gaps"]) == (True, 0, [])
    counts = {each["topic"]: each["messages"] for each in info["channels"] if each["role"] == "update"}
    assert counts == {f"/{key('a')}/n": 10}
    run = reem("log", "info", file)
    assert (run.returncode, run.stderr) == (0, "")
    assert "complete" in run.stdout
    assert f"/{key('a')}/n\tupdate\treem.{key('a')}.n\t10\t" in run.stdout
    assert re.search(rf"/{key('a')}/image\tpart \(read\)\tfoxglove.RawImage\t1\t-\t", run.stdout), run.stdout

    run = reem("play", file, "--rate", "20", "--remap", f"{key('a')}={key('b')}")
    assert (run.returncode, run.stderr) == (0, "")
    assert "11 published" in run.stdout
    assert_same(kvs[key("b")].read(), {"n": 10, "image": IMAGE})
    run = reem("play", file, key("a.n"), "--start", info["duration"], "--remap", f"{key('a')}={key('c')}", "--json")
    assert (run.returncode, json.loads(run.stdout.splitlines()[-1])["published"]) == (0, 1)
    assert kvs[key("c")].read() == {"n": 10}

    run = reem("log", "export", file, "--to", "npz")
    assert run.returncode == 0, run.stderr
    assert np.load(tmp_path / "run.npz")[f"{key('a')}.n"].tolist() == list(range(11))
    run = reem("log", "export", file, "--to", "npz")
    assert (run.returncode, "there already" in run.stderr) == (2, True)
    assert reem("log", "export", file, "-o", tmp_path / "by_name.npz").returncode == 0
    assert np.load(tmp_path / "by_name.npz").files
    run = reem("log", "export", file, "-o", "-")
    assert (run.returncode, run.stderr.count("\n"), run.stdout.count("\n")) == (0, 1, 12), "a note on the picture"
    assert run.stdout.startswith("time,")
    assert not (tmp_path / "-").exists()
    assert reem("record", "-o", "-").returncode == 2


def test_what_is_damaged_is_said_and_fails(key, recorded, reem, tmp_path):
    file, _ = recorded
    with open_log(file) as log:
        info = middle_chunk(log, key("a.n"))
    data = bytearray(file.read_bytes())
    data[info.offset + info.length - 5] ^= 1
    file.write_bytes(data)
    info = reem("log", "info", file, "--verify")
    assert (info.returncode, "1 records are damaged or missing" in info.stdout) == (1, True)
    play = reem("play", file, "--rate", "100")
    assert (play.returncode, "left out (see reem log info --verify)" in play.stdout) == (1, True)
    assert json.loads(reem("play", file, "--rate", "100", "--json").stdout.splitlines()[-1])["unreadable"] > 0
    export = reem("log", "export", file, "--to", "csv", "--json")
    assert (export.returncode, "damaged" in export.stderr) == (1, True), export.stderr
    assert json.loads(export.stdout)["unreadable"] > 0
    assert (tmp_path / "run.csv").exists()


def test_step(key, recorded, server_url, kvs, tmp_path):
    file, _ = recorded
    with started(
        server_url, tmp_path, "play", file, "--step", "--remap", f"{key('a')}={key('b')}", stdin=subprocess.PIPE
    ) as process:
        assert process.stdout.readline().endswith(f"{key('a')}.n\n")
        eventually(lambda: kvs.get(key("b.n"), None) == 1)
        process.stdin.write("\n")
        process.stdin.flush()
        assert process.stdout.readline().endswith(f"{key('a')}.n\n")
        assert kvs[key("b")]["n"].read() == 2
        rest, errors = process.communicate(timeout=10)
        assert (process.returncode, errors) == (0, "")
        assert "published" in rest


@pytest.mark.parametrize("option", [[], ["--json"]], ids=["text", "json"])
def test_once_it_says_that_it_has_begun_nothing_is_missed_and_ctrl_c_ends_it(
    option, key, server_url, pspace, file, tmp_path
):
    with started(server_url, tmp_path, "record", key("*"), "-o", file, *option) as process:
        line = begins(process, as_json=bool(option))
        pspace[key("a")] = 1
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    assert json.loads(line)["messages"] == 0 if option else line == f"recording into {file} until Ctrl-C\n"
    with open_log(file) as log:
        assert log[key("a")].at(log.end) == 1


def test_samples_for_some_time(key, kvs, reem, tmp_path):
    kvs[key("a")] = {"joint": 1.5}
    (tmp_path / "keys.csv").write_text(f"{key('a')}.joint, 0.02\n")
    (tmp_path / "run.mcap").write_bytes(b"old")
    run = reem("record", "--sample", "keys.csv")
    assert (run.returncode, "--force" in run.stderr) == (2, True)
    assert (tmp_path / "run.mcap").read_bytes() == b"old"
    assert "none.csv" in reem("record", "--sample", "none.csv", "-o", "x.mcap").stderr
    run = reem("record", "--sample", "keys.csv", "--duration", "0.3", "--force")
    assert (run.returncode, run.stderr) == (0, "recording into run.mcap for 0.3 s\n")
    assert run.stdout.startswith("run.mcap: ")
    with open_log(tmp_path / "run.mcap") as log:
        assert set(log[key("a.joint")].history()[1].tolist()) == {1.5}


@pytest.mark.long
def test_samples_that_are_late_or_fail_are_told(key, kvs, raw, reem, tmp_path):
    """They were counted in the file alone; where all had failed it was said that nothing was there."""
    kvs[key("a")] = 1
    raw.lpush(key("list"), 1)  # no document: it cannot be read
    (tmp_path / "both.csv").write_text(f"{key('a')}, 0.0001\n{key('list')}.x, 0.02\n")
    (tmp_path / "bad.csv").write_text(f"{key('list')}.x, 0.02\n")
    run = reem("record", "--sample", "both.csv", "--duration", "0.3")
    assert re.search(r"0 skipped, [1-9]\d* samples late, [1-9]\d* samples failed$", run.stdout.strip()), run
    said = re.search(r"missing +(.*)", reem("log", "info", "run.mcap").stdout)[1]
    assert re.fullmatch(r"0 dropped, 0 skipped, 0 gaps, [1-9]\d* samples late, [1-9]\d* samples failed", said)
    run = reem("record", "--sample", "bad.csv", "--duration", "0.3", "-o", "bad.mcap", "--json")
    last = json.loads(run.stdout.splitlines()[-1])
    assert (last["messages"], last["failed"] > 0, "late" in last) == (0, True, True)
    assert f"none of the paths of the samples could be read: {last['failed']} readings failed" in run.stderr


def test_on_a_terminal_a_line_is_written_over(key, server_url, pspace, tmp_path):
    mine, its = pty.openpty()
    try:
        with started(
            server_url, tmp_path, "record", key("*"), stdin=its, stdout=its, stderr=its, text=False
        ) as process:
            said, deadline = b"", time.monotonic() + 20
            while b"0 dropped" not in said and time.monotonic() < deadline:
                pspace[key("a")] = 1
                if select.select([mine], [], [], 0.05)[0]:
                    said += os.read(mine, 4096)
            assert b"\r0:0" in said
            assert b"/s" in said
            process.send_signal(signal.SIGINT)
            assert process.wait(10) == 0
            while select.select([mine], [], [], 0)[0]:
                said += os.read(mine, 4096)
            assert b"run.mcap: " in said
            assert b"Traceback" not in said
    finally:
        os.close(mine)
        os.close(its)


@pytest.mark.parametrize("ships", [["--ship", "test_unreadable:Pose"], []])
def test_a_ship_of_the_users_own_is_named_on_the_command_line(server_url, key, reem, tmp_path, ships):
    with RedisInterface(server_url, [Pose(), NumpyShip()]) as interface:
        KeyValueStore(interface)[key()] = {"n": 1, "pose": 1 + 2j, "array": IMAGE}
    run = reem("record", key(), "--duration", "0.5", *ships, PYTHONPATH=ROOT / "tests")
    assert run.returncode == 0, run.stderr
    assert ("1 unreadable or not recordable" in run.stdout) == (not ships)
    assert f"{key()}.pose 1" in reem("log", "info", "run.mcap").stdout or ships
    with open_log(tmp_path / "run.mcap", [Pose(), NumpyShip()]) as log:
        found = log[key()].at(log.end)
    assert_same({"n": found["n"], "array": found["array"]}, {"n": 1, "array": IMAGE})
    assert found["pose"] == 1 + 2j if ships else "which this interface lacks" in found["pose"].reason
    played = reem("play", "run.mcap", "--rate", "1000")
    assert (played.returncode, "left out" in played.stdout + played.stderr) == (1, True)  # without the ship
