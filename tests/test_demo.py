"""`reem demo` as a newcomer runs it: one command, then the three lines that it prints."""

import contextlib
import math
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest
from clikit import REEM
from conftest import eventually

import reem
from reem_async.tools.demo import BALL_RADIUS, REACH, Camera, angles_to, place_of, points_of


@contextlib.contextmanager
def demo(**environment):
    """The running command, and what it has printed until it said how to go on."""
    clean = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    with subprocess.Popen(
        [REEM, "demo"],
        env={**clean, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            said = ""
            while "Or look on" not in said:
                line = process.stdout.readline()
                assert line, said
                said += line
            yield process, said
        finally:
            process.kill()


def programs(port):
    found = subprocess.run(["ps", "-axwwo", "args"], capture_output=True, text=True, check=True).stdout
    return [line for line in found.splitlines() if "tools.demo" in line and line.endswith(f":{port}")]


@pytest.mark.parametrize("plain", ["0", pytest.param("1", marks=pytest.mark.long)])
def test_one_command_and_the_lines_that_it_prints(plain):
    begun = time.monotonic()
    with contextlib.ExitStack() as stack:
        for port in (6379, 8080):
            with contextlib.suppress(OSError):  # else it is taken by something else
                stack.enter_context(socket.create_server(("127.0.0.1", port)))
        process, said = stack.enter_context(demo(REEM_SERVER_PLAIN=plain))
        port, page = re.search(r"redis://localhost:(\d+)", said)[1], re.search(r"http://127\.0\.0\.1:(\d+)/", said)
        assert "6379" not in said.replace("localhost:" + port, "")
        assert page[1] != "8080"
        with reem.RedisInterface(f"localhost:{port}") as interface:
            kvs = reem.KeyValueStore(interface)
            eventually(lambda: kvs.get("detection.label", "") == "ball", 20)
            assert kvs["camera"]["rgb"].read().shape == (360, 480, 3)
            if plain == "0":
                assert time.monotonic() - begun < 20
            assert b"REEM" in urllib.request.urlopen(page[0], timeout=10).read()
            lines = re.search(r"and paste\n((?:  .*\n)+)", said)[1]
            before = kvs["world"]["ball"].read()  # the arm may be carrying the ball, and turns at once
            subprocess.run([sys.executable, "-c", re.sub("(?m)^  ", "", lines)], check=True, timeout=30)
            goal = kvs["goal"].read()
            assert set(goal) == {"x", "y"}

            def distance(ball):
                return math.dist((ball["x"], ball["y"]), (goal["x"], goal["y"]))

            assert distance(before) > 0.1
            eventually(
                lambda: distance(kvs["world"]["ball"].read()) < 0.05 and kvs["controller"]["doing"].read() == "rest", 60
            )
        assert len(programs(port)) == 3
        os.killpg(process.pid, signal.SIGINT)  # as a terminal sends it, to all that it has started
        rest, _ = process.communicate(timeout=20)
        assert (process.returncode, rest) == (0, "")
        assert programs(port) == []


def test_nothing_is_left_if_it_is_killed():
    with demo() as (process, said):
        port = re.search(r"redis://localhost:(\d+)", said)[1]
        assert len(programs(port)) == 3
        process.kill()
        eventually(lambda: programs(port) == [], 10)

        def refused():
            with socket.socket() as sock:
                return sock.connect_ex(("127.0.0.1", int(port))) != 0

        eventually(refused, 10)


def test_the_arm_reaches_all_that_can_be_a_goal_and_the_camera_tells_where_the_ball_is():
    eye = Camera()
    for turn in np.linspace(-math.pi, math.pi, 25):
        for radius in (*REACH, 0.0, 0.33, 7.0):
            x, y = place_of({"x": radius * math.cos(turn), "y": radius * math.sin(turn)})
            for height in (BALL_RADIUS, 0.16):
                assert np.allclose(points_of(angles_to((x, y, height)))[-1], (x, y, height), atol=1e-6)
            pixel = eye._seen((x, y, BALL_RADIUS))[0][:2] / 2
            assert np.allclose(eye.place(pixel, BALL_RADIUS), (x, y, BALL_RADIUS), atol=1e-6)
    for nonsense in (None, 5, "x", {"x": 1}, {"x": "a", "y": []}, [1, 2]):
        assert place_of(nonsense) is None
