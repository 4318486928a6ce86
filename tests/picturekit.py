"""A robot with a camera and a depth camera, and how much of it the page's slider has."""

import contextlib
import itertools
import json
import subprocess
import sys
import time

import numpy as np

from reem import PublishSpace, RedisInterface


def robot(url, name):
    """Publish a camera's 640x480x3 uint8 at 30 Hz and depth, 640x480 float32, at 10 Hz, until killed."""
    rows, columns = np.mgrid[0:480, 0:640].astype(np.float32)
    noise = np.random.default_rng(1).normal(0, 4, (480, 640, 3))
    pictures = []
    for number in range(10):
        wave = 128 + 60 * np.sin((columns + 20 * number) / 40) + 50 * np.cos(rows / 60)
        pictures.append(
            np.clip(wave[:, :, None] * (1.0, 0.8, 0.6) + np.roll(noise, number, 0), 0, 255).astype(np.uint8)
        )
    depth = (1.0 + rows / 100 + 0.3 * np.sin(columns / 25)).astype(np.float32)
    with RedisInterface(url) as interface:
        space = PublishSpace(interface)
        space[name] = {"camera": {"image": pictures[0], "frame": 0}, "depth": {"image": depth, "frame": 0}}
        began = time.monotonic()
        for number in itertools.count(1):
            time.sleep(max(began + number / 30 - time.monotonic(), 0))
            space[name]["camera"]["image"] = pictures[number % 10]
            if number % 3 == 0:
                space[name]["depth"]["image"] = depth + np.float32(number % 100 / 1000)


@contextlib.contextmanager
def running_robot(url, name):
    process = subprocess.Popen([sys.executable, __file__, url, name])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def look_back(ask, path, start, end, instants):
    """Ask for the picture at so many instants of a span; returns what is said of each, None where there is none."""
    found = []
    for at in np.linspace(start, end, instants):
        answer = ask.ask("image", path=path, at=at)
        found.append(json.loads(answer.headers["x-picture"]) if answer.status_code == 200 else None)
    return found


if __name__ == "__main__":
    robot(*sys.argv[1:])
