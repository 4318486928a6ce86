"""The examples run, in both fronts, without a warning, and show what they say they show."""

import ast
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import ROOT, eventually

import reem

FILES = sorted((ROOT / "examples").rglob("*.py"))
KEYS = ["raw_image", "processed_info", "processed_image", "processor", "actuator", "set_point", "room"]
KEYS += ["sensors", "heartbeat"]
FRONTS = pytest.mark.parametrize("front", ["blocking", "asyncio"])

pytest.importorskip("PIL")
pytest.importorskip("rich")


def start(module, *arguments, **environment):
    command = [sys.executable, "-W", "error", "-m", f"examples.{module}", *map(str, arguments)]
    settings = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"} | environment
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=ROOT, env=settings, text=True, **pipes)


def run(module, *arguments, code=0, **environment):
    process = start(module, *arguments, **environment)
    try:
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == code, f"exit code {process.returncode}\n{out}\n{err}"
    if code == 0:
        assert err == ""
        return out
    return err


@pytest.fixture
def url(server_url, raw):
    yield server_url
    left = [name for key in KEYS for name in (key, *raw.scan_iter(match=f"{{{key}}}*", count=1000))]
    raw.unlink(*left)


def counts(printed):
    found = re.search(r"(\d+) frames sent, (\d+) processed, (\d+) acted upon", printed)
    assert found, printed
    times = re.search(r"median ([\d.]+) ms, p99 ([\d.]+) ms", printed)
    assert times, printed
    return [int(number) for number in found.groups()], [float(number) for number in times.groups()]


# --- the image system ---


@FRONTS
def test_the_image_system_runs_as_three_processes(front, url, tmp_path):
    from PIL import Image

    png = tmp_path / "new folder" / "last.png"
    printed = run("image_system", "--front", front, "--seconds", 1.5, "--out", png, "--url", url)
    (sent, processed, acted), (median, late) = counts(printed)
    assert sent == 45
    assert 1 <= acted <= processed <= sent
    assert 0 < median <= late
    assert re.search(r"^camera \d+, processor \d+, actuator \d+$", printed, re.MULTILINE), "shows progress"
    assert str(png) in printed

    with reem.RedisInterface(url) as interface:
        kvs = reem.KeyValueStore(interface)
        frame, shown = kvs["raw_image"].read(), kvs["processed_image"].read()
        assert kvs["actuator"]["frames"].read() == len(kvs["actuator"]["latencies"]) == acted
    assert set(frame) == {"image", "time_stamp", "images_sent", "last"}
    assert (frame["images_sent"], frame["last"]) == (45, True)
    with Image.open(png) as image:
        picture = np.asarray(image)
    assert (picture == shown["image"]).all()
    assert picture.shape == frame["image"].shape == (480, 640, 3)
    marked = (picture != frame["image"]).any(2)
    assert 0.005 < marked.mean() < 0.5, "edges and a box are drawn on the photograph"
    assert (picture == (255, 210, 0)).all(2).sum() > 400, "the box"


@pytest.mark.long
def test_the_demo_needs_no_server(tmp_path):
    printed = run("image_system", "--seconds", 1, "--out", tmp_path / "last.png")
    assert counts(printed)[0][0] == 30
    assert (tmp_path / "last.png").stat().st_size > 10_000


@pytest.mark.long
def test_the_demo_fails_if_a_program_does(url, tmp_path):
    (tmp_path / "PIL.py").write_text("raise ImportError")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    error = run("image_system", "--seconds", 1, "--out", tmp_path / "x.png", "--url", url, code=1, PYTHONPATH=path)
    assert "The demo failed: the camera ended with exit code 1" in error
    assert "pip install 'reem-async[demo]'" in error
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize(
    "module", ["image_system", "image_system.camera", "custom_ship", "robot_node", "policy_server"]
)
@FRONTS
def test_an_example_without_its_server_says_so(module, front):
    error = run(module, "--front", front, "--url", "redis://127.0.0.1:1", code=1)
    assert "no server answers at 127.0.0.1:1" in error
    assert "reem up" in error
    assert "Traceback" not in error


# --- the others ---


@pytest.mark.long
@FRONTS
def test_the_arm_actuator_runs_both_ways(front, url):
    printed = run("arm_actuator", "--front", front, "--seconds", 1, "--url", url)
    for way in "store", "publish":
        found = re.search(rf"controller \({way}, {front}\): (\d+) set points at ([\d.]+) Hz", printed)
        assert found, printed
        assert found[1] == "100"
        assert 50 < float(found[2]) < 105
        pattern = rf"actuator \({way}, {front}\): (\d+) Hz, age of the set point ([\d.]+) ms \(median\)"
        found = re.search(pattern, printed)
        assert found, printed
        assert 100 < float(found[1]) < 1100
        assert 0 < float(found[2]) < 200


@FRONTS
def test_the_custom_ship_carries_a_scan(front, url, raw):
    assert "read back 20000 points of the front laser" in run("custom_ship", "--front", front, "--url", url)
    assert "front laser, 20000 points" in raw.execute_command("JSON.GET", "room")


def test_a_scan_can_be_read_with_either_ship(url, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    from examples.custom_ship import CompressedScanShip, ScanShip, take_scan

    for front in "blocking", "asyncio":
        run("custom_ship", "--front", front, "--url", url)
        with reem.RedisInterface(url, ships=[CompressedScanShip(), ScanShip()]) as interface:
            scan = reem.KeyValueStore(interface)["room"]["scan"].read()
        assert (scan.points == take_scan().points).all()


@FRONTS
def test_the_robot_asks_the_policy_server(front, url):
    printed = run("policy_server", "--front", front, "--seconds", 1, "--url", url)
    assert int(re.search(r"executed (\d+) chunks", printed)[1]) >= 3
    assert "holding still" not in printed


STOPPED = r"stopped after (\d+) heartbeats, (\d+) readings, (\d+) set points followed"


@FRONTS
def test_the_robot_node_runs_its_loops(front, url):
    found = re.search(STOPPED, run("robot_node", "--front", front, "--seconds", 1.5, "--url", url))
    assert found
    beats, readings, followed = map(int, found.groups())
    assert 3 <= beats <= 9
    assert 40 <= readings <= 160
    assert 5 <= followed <= 32


@pytest.mark.skipif(sys.platform == "win32", reason="has no such signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@FRONTS
def test_the_robot_node_stops_in_order(front, number, url):
    process = start("robot_node", "--front", front, "--seconds", 50, "--url", url)
    try:
        assert process.stdout.readline().startswith("running")
        time.sleep(0.5)
        process.send_signal(number)
        out, err = process.communicate(timeout=10)
    finally:
        process.kill()
    assert (process.returncode, err) == (0, "")
    assert re.search(STOPPED, out)
    with reem.RedisInterface(url) as interface:
        assert abs(reem.KeyValueStore(interface)["sensors"]["speed"].read()) <= 0.011


@pytest.mark.parametrize("program", ["processor", "actuator"])
@FRONTS
def test_a_program_that_waits_stops_on_ctrl_c(front, program, url):
    process = start(f"image_system.{program}", "--front", front, "--url", url)
    try:
        with reem.RedisInterface(url) as interface:
            eventually(lambda: reem.KeyValueStore(interface).get(f"{program}.ready", False))
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=10)
    finally:
        process.kill()
    assert (process.returncode, out, err) == (130, "", "")


# --- all ---


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT / "examples")))
def test_an_example_is_short_and_says_what_it_shows(path):
    text = path.read_text(encoding="utf-8")
    documentation = ast.get_docstring(ast.parse(text))
    assert documentation
    # The bridge is a program to use, in one file for the Python of ROS 2.
    assert len(text.splitlines()) < (600 if path.name == "ros2_bridge.py" else 150)
    if "__main__" in text:
        assert "python -m examples." in documentation
