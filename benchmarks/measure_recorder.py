"""A set point at 1 kHz and a camera at 30 Hz, beside somebody who takes part."""

import contextlib
import dataclasses
import json
import os
import pathlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import numpy as np

from .environment import FOLDER
from .measure import Bench, Case, Found, rotated
from .process import ContenderError
from .results import failure, summary
from .server import socket_of

WRITERS = ("setpoint", "camera")
SETTLED = 1.8
"""Seconds after its start in which a program is still beginning."""

Windows = dict[str, list[tuple[float, float]]]

LISTENER = [sys.executable, "-m", "benchmarks.workers.listener"]
RECORDER = [sys.executable, "-c", "from reem_async.tools.cli import main; main()", "record", "--json", "--force"]
FRAME_KEY = "{cam}.image"
BESIDE = {
    "nobody": None,
    "fetches": [*LISTENER, "PORT", "0.005", FRAME_KEY],
    "recorder": [*RECORDER, "--url", "URL", "-o", "FILE"],
    "background": [*RECORDER, "--background", "--url", "URL", "-o", "FILE"],
}

LEAST = {
    "notices": [*LISTENER, "SOCKET", "0.01"],
    "frames": [*LISTENER, "SOCKET", "0.01", FRAME_KEY],
}
"""The least that a recorder does: it comes as often and the same way, and drops what it gets."""


@dataclasses.dataclass(frozen=True)
class RecorderCase(Case):
    """The writers go on all the time; the others come and go, in turns.

    The 99th percentile is the median of those of all windows: this machine has bad seconds of its own.
    """

    seconds: float = 2.0
    rounds: int = 5

    def measure(self, bench: Bench) -> Found:
        """Yield what the writers' calls took beside each of the others."""
        windows: Windows = {name: [] for name in self.contenders}
        seconds, rounds = bench.scaled(self.seconds, 1.0), int(bench.scaled(self.rounds, 1))
        with tempfile.TemporaryDirectory() as folder:
            with writers(bench.workers.server.url, folder):
                for number in range(rounds):
                    yield from self._round(bench, number, seconds, windows, folder)
            calls = {what: np.fromfile(f"{folder}/{what}").reshape(-1, 2) for what in WRITERS}
        for what, (begun, took) in ((what, found.T) for what, found in calls.items()):
            for name, spans in windows.items():
                inside = [took[(begun >= begin) & (begun < end)] for begin, end in spans]
                tails = [np.percentile(each, 99) for each in inside]
                entry = {**summary(np.concatenate(inside).tolist()), "p99": float(np.median(tails))}
                yield f"{self.identifier}.{what}", name, entry

    def _round(self, bench: Bench, number: int, seconds: float, windows: Windows, folder: str) -> Found:
        for name in rotated(list(windows), number):
            try:
                with beside(name, bench.workers.server.url, folder):
                    time.sleep(SETTLED)
                    begin = time.perf_counter()
                    time.sleep(seconds)
                    windows[name].append((begin, time.perf_counter()))
            except ContenderError as error:
                del windows[name]
                for what in WRITERS:
                    yield f"{self.identifier}.{what}", name, failure(error)


def _surroundings() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(FOLDER.parent)}


@contextlib.contextmanager
def writers(url: str, folder: str) -> Iterator[None]:
    """Both writers at work; at the end their files are complete."""
    module = [sys.executable, "-m", "benchmarks.workers.steady", url]
    running = [
        subprocess.Popen([*module, what, f"{folder}/{what}"], cwd=FOLDER.parent, env=_surroundings())
        for what in WRITERS
    ]
    try:
        time.sleep(1.0)
        yield
    finally:
        for writer in running:
            writer.terminate()
        for writer in running:
            writer.wait(10)


@contextlib.contextmanager
def beside(name: str, url: str, folder: str) -> Iterator[None]:
    """Somebody beside the writers; a recording that is not whole is an error."""
    command = (BESIDE | LEAST)[name]
    if command is None:
        yield
        return
    file = pathlib.Path(folder, "run.mcap")
    places = {"URL": url, "PORT": url.rpartition(":")[2], "SOCKET": socket_of(url), "FILE": str(file)}
    is_recording = "record" in command
    process = subprocess.Popen(
        [places.get(word, word) for word in command],
        cwd=FOLDER.parent,
        env=_surroundings(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        if is_recording:
            process.stdout.readline()  # it has begun, and ends properly at Ctrl-C
        yield
    finally:
        process.send_signal(signal.SIGINT if is_recording else signal.SIGKILL)
        said, complaint = process.communicate(timeout=30)
    if is_recording:
        _check(said, complaint)
        file.unlink()


def _check(said: str, complaint: str) -> None:
    lines = said.strip().splitlines()
    if not lines:
        raise ContenderError(f"the recorder said nothing: {complaint.strip()[-200:]}")
    told = json.loads(lines[-1])
    missing = {what: told[what] for what in ("dropped", "lost", "gaps") if told[what]}
    if missing:
        raise ContenderError(f"the recording is not whole: {missing}")
