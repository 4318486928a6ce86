"""A recording of gigabytes: written at once, and how long the library and the page take over it.

    python -m benchmarks.gigabytes write /tmp/run.mcap --gigabytes 3     a robot's rates, without waiting for them
    python -m benchmarks.gigabytes library /tmp/run.mcap                 first keys, one number's history, memory
    python -m benchmarks.gigabytes page /tmp/run.mcap --actions 50       the same in Chromium: slider and plots
    python -m benchmarks.gigabytes hour /tmp/run.mcap --minutes 60       memory of program and browser, each minute

`write` and `library` run on earlier commits too: put the commit's tree first on PYTHONPATH.
"""

import argparse
import contextlib
import json
import math
import pathlib
import random
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from reem_async.ships.registry import Ships, default_ships
from reem_async.tools.recording import open_log
from reem_async.tools.recording.format import Role
from reem_async.tools.recording.sink import FLUSH_SECONDS, Sink
from reem_async.tools.recording.writer_thread import Operation, WriterThread
from reem_async.transport.protocol import CommandRecorder

_START = 1_700_000_000_000_000_000
_TICK = 5_000_000  # ns: the fastest rate is 200 Hz
_KEYFRAME = 1000  # ticks: 5 s, as the recorder's
_FRAMES = 8  # different pictures, of noise: they do not become smaller
PLOTTED = ("arm.q", "battery.voltage", "imu.gyro", "camera.t", "base.x")


def _values(tick: int, frames: list[Any], points: list[Any]) -> Iterator[tuple[str, Any]]:
    """Yield what a robot publishes in one tick: an arm and an IMU at 200 Hz, a base at 50 Hz, two sensors at 10 Hz."""
    t = tick * _TICK / 1e9
    joints = [math.sin(t * (joint + 1)) for joint in range(7)]
    yield "arm", {"q": joints, "dq": [math.cos(each) for each in joints], "t": t}
    yield "imu", {"gyro": joints[:3], "acceleration": joints[3:6], "n": tick}
    if tick % 4 == 0:
        yield "base", {"x": t, "y": joints[0], "theta": joints[1], "mode": "drive"}
    if tick % 20 == 0:
        yield "camera", {"t": t, "exposure": 0.01, "rgb": frames[tick // 20 % len(frames)]}
        yield "lidar", {"t": t, "points": points[tick // 20 % len(points)]}
    if tick % 200 == 0:
        yield "battery", {"voltage": 24.0 - t / 3600, "state": "discharging"}


def write(file: pathlib.Path, size: float) -> None:
    """Write a recording of about so many bytes, with the recorder's own writer and at its pace of flushes."""
    began, rng = time.perf_counter(), np.random.default_rng(1)
    frames = [rng.integers(0, 256, (480, 640, 3), np.uint8) for _ in range(_FRAMES)]
    points = [rng.random((2000, 4), np.float32) for _ in range(_FRAMES)]
    sink = Sink(file, "zstd", {"version": "benchmark"}, overwrite=True)
    sink.output.appear()
    writer, tick, names = WriterThread(sink, Ships(default_ships(), CommandRecorder), 0), 0, set()
    while sink.output.tell() < size:
        at, now = 0, _START + tick * _TICK
        for at, (name, value) in enumerate(_values(tick, frames, points)):
            stamp = now + at * 2000
            names.add(name)
            writer._write(Operation(Role.UPDATE, (name,), value, (stamp, stamp - 100_000, tick + 1)))
        if tick % _KEYFRAME == 0:
            for name in sorted(names):
                at += 1
                writer._write(Operation(Role.KEYFRAME, (name,), None, (now + at * 2000, 0, 0)))
        tick += 1
        if tick * _TICK % int(FLUSH_SECONDS * 1e9) == 0:
            sink._closed_at = -FLUSH_SECONDS
            sink.tick()
    sink.finish({})
    took = time.perf_counter() - began
    print(f"{file}: {file.stat().st_size / 1e9:.2f} GB, {tick * _TICK / 1e9:.0f} s of a robot, written in {took:.0f} s")


def _timed(what: str, work: Callable[[], Any]) -> Any:
    began, used = time.perf_counter(), time.process_time()
    found = work()
    print(f"{what:48} {time.perf_counter() - began:8.3f} s, of the processor {time.process_time() - used:.3f} s")
    return found


def library(file: pathlib.Path) -> None:
    """Print what the library takes: each history in a log that was just opened."""
    log = _timed("open_log, names", lambda: (log := open_log(file), log.names())[0])
    _timed("tree_at the end", lambda: log.tree_at(log.end))
    middle = log.start + log.duration / 2
    _timed("tree_at the middle", lambda: log.tree_at(middle))
    log.close()
    for path in PLOTTED:
        with open_log(file) as log:
            times, _ = _timed(f"history of {path}", log[path].history)
            print(f"{'':48} {len(times)} values")
    print(f"{'largest memory of the process':48} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:8.0f} MB")


@contextlib.contextmanager
def _served(file: pathlib.Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Run `reem browse --log`, as a user does; yields its address and the process."""
    command = [
        str(pathlib.Path(sys.executable).parent / "reem"),
        "browse",
        "--log",
        str(file),
        "--port",
        "0",
        "--no-open",
    ]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        address = ""
        while not address:
            line = (program.stdout or sys.stdin).readline()
            if not line:
                raise SystemExit("reem browse ended")
            address = next((word for word in line.split() if word.startswith("http://")), "")
        yield address.rstrip("/"), program
    finally:
        program.terminate()
        program.wait()


def _memory(process: int) -> float:
    """Return the MB of a process."""
    text = pathlib.Path(f"/proc/{process}/status").read_text()
    return int(text.partition("VmRSS:")[2].split()[0]) / 1024


class _Actions:
    """Does something on the page, and takes the time until the page has all that it asked for."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.took: dict[str, list[float]] = {}
        self._waiting: set[Any] = set()
        self._last = 0.0
        for event in ("request", "requestfinished", "requestfailed"):
            page.on(event, self._noted if event == "request" else self._answered)

    def _noted(self, request: Any) -> None:
        if "/api/" in request.url and "/api/events" not in request.url:
            self._waiting.add(request)
            self._last = time.perf_counter()

    def _answered(self, request: Any) -> None:
        if request in self._waiting:
            self._waiting.discard(request)
            self._last = time.perf_counter()

    def do(self, what: str, work: Callable[[], Any]) -> None:
        began = self._last = time.perf_counter()
        work()
        # Quiet for 0.1 s: nothing more is asked for.
        while self._waiting or time.perf_counter() - self._last < 0.1:
            self.page.wait_for_timeout(5)
        self.took.setdefault(what, []).append(self._last - began)


_SEEK = """part => {
  const slider = document.getElementById("slider");
  slider.value = part * slider.max;
  slider.dispatchEvent(new Event("input", { bubbles: true }));
}"""


_GO = """there => {
  history.pushState(null, "", there);
  dispatchEvent(new PopStateEvent("popstate"));
}"""


@contextlib.contextmanager
def _shown(file: pathlib.Path) -> Iterator[tuple[_Actions, subprocess.Popen[str]]]:
    """Open the page in Chromium, as a visitor does; yields it when it has its first keys."""
    from playwright.sync_api import sync_playwright

    began = time.perf_counter()
    with _served(file) as (address, program), sync_playwright() as driver:
        print(f"{'reem browse --log answers':48} {time.perf_counter() - began:8.3f} s")
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--headless", "--no-sandbox"])
        shown = browser.new_page(viewport={"width": 1200, "height": 800})
        done, began = _Actions(shown), time.perf_counter()
        shown.goto(address)
        shown.locator("#tree .row").first.wait_for()
        print(f"{'first keys':48} {time.perf_counter() - began:8.3f} s")
        done.do("first page, wholly", lambda: None)
        yield done, program
        browser.close()


def _act(done: _Actions, number: int, rng: random.Random) -> None:
    """Do what a visitor does: four moves of the slider, then another view."""
    if number % 5 == 0:
        there = f"/view/{PLOTTED[number // 10 % len(PLOTTED)]}" if number % 10 == 0 else "/"
        done.do("another view", lambda: done.page.evaluate(_GO, there))
    else:
        done.do("slider", lambda: done.page.evaluate(_SEEK, rng.random()))


def page(file: pathlib.Path, actions: int) -> None:
    """Print what a page in Chromium takes: until there are keys, and for each of some actions of a visitor."""
    rng = random.Random(1)
    with _shown(file) as (done, program):
        for number in range(actions):
            _act(done, number, rng)
        for what, took in done.took.items():
            print(f"{what:48} {statistics.median(took):8.3f} s median of {len(took)}, {max(took):.3f} at most")
        every = [each for what, took in done.took.items() if what != "first page, wholly" for each in took]
        print(f"{'all actions':48} {statistics.median(every):8.3f} s median of {len(every)}, {max(every):.3f} at most")
        used = done.page.evaluate("() => performance.memory.usedJSHeapSize") / 1e6
        print(f"{'memory: the program, the JavaScript of the page':48} {_memory(program.pid):8.0f} MB, {used:.0f} MB")


def _children(process: int) -> Iterator[int]:
    """Yield the processes that a process started, and theirs."""
    for task in pathlib.Path(f"/proc/{process}/task").glob("*/children"):
        for child in map(int, task.read_text().split()):
            yield child
            yield from _children(child)


_VISIT = """(async () => {
  const go = %s, seek = %s, paths = %s;
  window.actions = 0;
  for (;; ++actions) {
    if (actions %% 5) seek(Math.random());
    else go(actions %% 10 ? "/" : `/view/${paths[(actions / 10) %% paths.length]}`);
    await new Promise(done => setTimeout(done, 2500));
  }
})()"""


def hour(file: pathlib.Path, minutes: int) -> None:
    """Print the memory of the program and of Chromium each minute, with an action each 2.5 s.

    The page acts by itself: a browser that Playwright drives keeps the answers to all requests.
    """
    from websockets.sync.client import connect

    with _served(file) as (address, program), tempfile.TemporaryDirectory() as profile:
        command = ["chromium", "--headless", "--no-sandbox", "--remote-debugging-port=0", f"--user-data-dir={profile}"]
        browser = subprocess.Popen([*command, "--window-size=1200,800", address], stderr=subprocess.DEVNULL)
        time.sleep(10)
        port = (pathlib.Path(profile) / "DevToolsActivePort").read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            shown = next(each for each in json.load(answer) if each["url"].startswith(address))

        def evaluated(script: str) -> Any:
            """Return what a script gives in the page."""
            with connect(shown["webSocketDebuggerUrl"]) as page:
                page.send(json.dumps({"id": 1, "method": "Runtime.evaluate", "params": {"expression": script}}))
                return json.loads(page.recv())["result"]["result"].get("value")

        evaluated(_VISIT % (_GO, _SEEK, json.dumps(PLOTTED)))
        for minute in range(1, minutes + 1):
            time.sleep(60)
            each = [_memory(child) for child in _children(browser.pid)]
            done, nodes = evaluated("actions"), evaluated("document.querySelectorAll('*').length")
            print(
                f"minute {minute}: {done} actions, the program {_memory(program.pid):.0f} MB, the page's process "
                f"{max(each):.0f} MB, all of the browser {sum(each):.0f} MB, {nodes} elements",
                flush=True,
            )
        browser.terminate()
        browser.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("write", "library", "page", "hour"))
    parser.add_argument("file", type=pathlib.Path)
    parser.add_argument("--gigabytes", type=float, default=3.0)
    parser.add_argument("--actions", type=int, default=50)
    parser.add_argument("--minutes", type=int, default=60)
    given = parser.parse_args()
    if given.what == "write":
        write(given.file, given.gigabytes * 1e9)
    elif given.what == "library":
        library(given.file)
    elif given.what == "page":
        page(given.file, given.actions)
    else:
        hour(given.file, given.minutes)


if __name__ == "__main__":
    main()
