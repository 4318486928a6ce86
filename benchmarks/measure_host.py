"""The programs of a robot's computer: messages by size, a control loop beside a camera, and viewers attached to it.

iceoryx2 is left out where it has no wheel. All take turns, so that a slow minute of the machine meets all alike.
"""

import contextlib
import dataclasses
import os
import pathlib
import select
import shutil
import signal
import socket
import subprocess
import sys
import time

from .contenders import HOST, SHOWN
from .environment import FOLDER
from .measure import Bench, Case, Found, fresh_key, rotated
from .measure_pubsub import PublishCase
from .process import ContenderError, Worker, Workers
from .results import failure, summary
from .server import free_port

SIZES = {"state": (200, 0.004), "scan": (200, 0.004), "image": (60, 0.02), "frame": (30, 0.05)}
"""Messages, and seconds between two of them, with one subscriber; fewer and longer ones with more."""
HERTZ = {"command": 100.0, "camera": 30.0, "loop": 1000.0}
SETTLED = 1.0  # seconds from the start of all programs to the first cycle
DRAWN = 3.0  # the same beside programs that import or compile for long first
STARTED = 20.0  # seconds within which a viewer must accept connections
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")


@dataclasses.dataclass(frozen=True)
class HostCase(PublishCase):
    """Publish to callback for each size, by the same processes."""

    def parts(self) -> list[PublishCase]:
        """A case for each size."""
        slower = 1 + self.subscribers / 4
        return [
            PublishCase(
                f"{self.identifier}.{payload}",
                self.contenders,
                payload,
                int(count / slower),
                gap * slower,
                subscribers=self.subscribers,
            )
            for payload, (count, gap) in SIZES.items()
        ]


@dataclasses.dataclass(frozen=True)
class Way:
    """A contender's control loop, and what runs beside it.

    Attributes:
        looks: A viewer in `VIEWER`, "subscriber" for a program of the contender's own, or nothing.
    """

    contender: str
    looks: str = ""
    camera: bool = True


_FLOOR = {"datagram": Way("datagram", camera=False)}  # without load
LOOP = {name: Way(name, "subscriber") for name in HOST if name not in ("iceoryx2", "datagram")} | _FLOOR
VIEWERS = {
    "no viewer": Way("reem-local"),
    "reem browse": Way("reem-local", "browse"),
    "page": Way("reem-local", "page"),
    "page in Chromium": Way("reem-local", "chromium"),
    "reem foxglove": Way("reem-local", "bridge"),
    "reem rerun": Way("reem-local", "entities"),
    **{viewer: Way(viewer, viewer) for viewer in SHOWN},
    **_FLOOR,
}
"""REEM's loop with each viewer. "rerun" and "foxglove" log from the loop itself. `workers/viewer.py` receives what the
page and foxglove send, as on another computer. The data for rerun goes to the server of its viewer. None of these
draws; Chromium draws the page on this computer. "reem browse" runs without a page."""

_VIEWER = [sys.executable, "-m", "benchmarks.workers.viewer"]
_REEM = [sys.executable, "-c", "from reem_async.tools.cli import main; main()"]


@dataclasses.dataclass(frozen=True)
class ControlLoopCase(Case):
    """A loop at 1 kHz beside a camera of 0.92 MB at 30 Hz, a planner that commands it, and a program that looks."""

    ways: dict[str, Way] = dataclasses.field(default_factory=dict)
    periods: int = 10_000
    rounds: int = 2

    def measure(self, bench: Bench) -> Found:
        """Start the programs of one way at a time; each round begins with another way."""
        cycles: dict[str, list[float]] = {name: [] for name in self.contenders}
        missed = dict.fromkeys(self.contenders, 0)
        rounds = int(bench.scaled(self.rounds, 1))
        periods = int(bench.scaled(self.periods, self.periods / 10)) // rounds
        for number in range(rounds):
            for name in rotated(list(cycles), number):
                try:
                    reply = turn(bench, self.ways[name], periods)
                    cycles[name] += reply["cycles"]
                    missed[name] += reply["missed"]
                except ContenderError as error:
                    del cycles[name]
                    yield self.identifier, name, failure(error)
        for name, taken in cycles.items():
            yield self.identifier, name, summary(taken, missed=missed[name], periods=periods * rounds)


def turn(bench: Bench, way: Way, periods: int) -> dict[str, list[float] | int]:
    """Start the programs of one way, and return the seconds of each cycle and how many missed their deadline."""
    port, command, state, camera = free_port(), fresh_key(), fresh_key(), fresh_key()
    with contextlib.ExitStack() as stack:

        def started(hub: bool = False) -> Worker:
            worker = bench.workers.start(way.contender, port, hub)
            stack.callback(worker.end)
            return worker

        viewer = stack.enter_context(Viewer(bench.workers, way.looks, port, camera))
        loop = started(hub=True)
        loop.ask("prepare_control", command=command, state=state)
        started().ask("stream", channel=command, payload="state", rate=HERTZ["command"])
        if way.camera:
            started().ask("stream", channel=camera, payload="image", rate=HERTZ["camera"])
        if way.looks == "subscriber":
            subscriber = started()
            subscriber.ask("listen", channel=camera, payload="image")
            subscriber.ask("listen", channel=state, payload="state")
        time.sleep(DRAWN if way.looks in ("chromium", "entities") else SETTLED)
        if way.looks == "subscriber" and not subscriber.ask("heard"):  # the state comes later
            raise ContenderError("the program that looks had no picture")
        reply = loop.ask("control", periods=periods, rate=HERTZ["loop"])
        viewer.check()
        return reply


class Viewer:
    """The processes of a viewer, and its check that it has had a picture."""

    def __init__(self, workers: Workers, kind: str, port: int, camera: str) -> None:
        url, address = workers.server.url, f"http://127.0.0.1:{port}/"
        browse, free = [*_REEM, "browse", "--no-open", "--url", url, "--port", str(port)], ["--port", str(port)]
        self.serving: list[str] = []  # accepts connections before the other starts
        self.looking: list[str] = []
        self.running: list[subprocess.Popen[bytes]] = []
        self.port, self.profile = port, f"{workers.folder}/chromium-{port}"
        if kind == "browse":
            self.serving = browse
        elif kind == "page":
            self.serving, self.looking = browse, [*_VIEWER, "page", address, camera]
        elif kind == "chromium":
            chromium = next(filter(None, map(shutil.which, CHROMIUM)), None)
            if chromium is None:
                raise ContenderError("Chromium is not installed")
            options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"]
            self.serving, self.looking = browse, [chromium, *options, f"--user-data-dir={self.profile}", address]
        elif kind in ("rerun", "entities"):
            rerun = str(pathlib.Path(sys.executable).with_name("rerun"))
            self.serving = [rerun, "--serve-grpc", *free, "--memory-limit", "1GB"]
            if kind == "entities":
                self.looking = [*_REEM, "rerun", "--url", url, "--connect", f"rerun+http://127.0.0.1:{port}/proxy"]
        elif kind == "bridge":
            self.serving = [*_REEM, "foxglove", "--url", url, *free]
            self.looking = [*_VIEWER, "bridge", str(port)]
        elif kind == "foxglove":
            self.looking = [*_VIEWER, "foxglove", f"{workers.folder}/foxglove-{port}"]

    def __enter__(self) -> "Viewer":
        try:
            if self.serving:
                self._start(self.serving)
                self._connect()
            if self.looking:
                self._start(self.looking)
        except BaseException:
            self.__exit__()
            raise
        return self

    def _start(self, command: list[str]) -> None:
        surroundings = {**os.environ, "PYTHONPATH": str(FOLDER.parent)}
        process = subprocess.Popen(
            command,
            cwd=FOLDER.parent,
            env=surroundings,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # rerun and Chromium have processes of their own, which end with the group
        )
        self.running.append(process)

    def _connect(self) -> None:
        end = time.monotonic() + STARTED
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port), 1).close()
                return
            except OSError:
                if time.monotonic() > end or self.running[0].poll() is not None:
                    raise ContenderError(f"{self.serving[0]} does not accept connections") from None
                time.sleep(0.1)

    def check(self) -> None:
        """Raise unless all processes still run, and a viewer of ours has had a picture."""
        for process in self.running:
            if process.poll() is not None:
                raise ContenderError(f"{process.args[0]} ended with {process.returncode}")
        if self.looking[: len(_VIEWER)] == _VIEWER and not select.select([self.running[-1].stdout], [], [], 5)[0]:
            raise ContenderError("the viewer had no picture")

    def __exit__(self, *_: object) -> None:
        for process in reversed(self.running):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(5)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
        shutil.rmtree(self.profile, ignore_errors=True)
