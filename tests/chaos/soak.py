"""Row 17: a minute of a camera and a subscriber, with a fault every two seconds."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from .programs import ARRAY, RATE
from .proxy import Proxy
from .scoreboard import Run, row
from .servers import PrivateServer
from .tools import program, quantile, said

EVERY = 2.0


class _Mischief:
    """Makes a fault every two seconds, of every kind in turn, and puts things right again."""

    def __init__(self, run: Run, proxy: Proxy) -> None:
        self._rng = run.rng
        self._proxy = proxy
        self._over = threading.Event()
        self.made = 0
        self.thread = threading.Thread(target=self._make)

    def _make(self) -> None:
        faults = [self._reset, self._lose, self._half, self._hole, self._slow]
        while not self._over.wait(EVERY):
            faults[self.made % len(faults)]()
            self.made += 1

    def _reset(self) -> None:
        self._proxy.reset()

    def _lose(self) -> None:
        self._proxy.drop_reply(b"soak")

    def _half(self) -> None:
        self._proxy.half_close()

    def _hole(self) -> None:
        self._proxy.black_hole()
        self._over.wait(self._rng.uniform(0.05, 0.5))
        self._proxy.heal()

    def _slow(self) -> None:
        self._proxy.delay = 0.003
        self._over.wait(0.1)
        self._proxy.heal()

    def __enter__(self) -> _Mischief:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.thread.join()


class _Yardstick:
    """A plain client that sends as much, straight to the server: how busy the machine is, apart from REEM."""

    def __init__(self, server: PrivateServer) -> None:
        self._raw = server.raw()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._send)
        self.calls: list[tuple[float, float]] = []

    def _send(self) -> None:
        began, payload = time.monotonic(), bytes(ARRAY)
        while not self._over.wait(0.015):
            begun = time.monotonic()
            self._raw.set("yardstick", payload)
            self.calls.append((begun - began, time.monotonic() - begun))

    def __enter__(self) -> _Yardstick:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._raw.close()


@row(
    17,
    "soak: 200 Hz x 100 KB, a fault every 2 s",
    "memory < +1 MB/min, descriptors and tasks flat, last p99 <= 1.2x first, 0 never retrieved",
)
def soak(run: Run) -> None:
    """60 s (quick: 7 s, too short for a slope, so only growth is bounded)."""
    seconds = run.size(60.0, 7.0)
    with PrivateServer() as server, Proxy(server.port) as proxy, program("soak", proxy.url, seconds) as process:
        said(process)
        begun = time.monotonic()
        with _Mischief(run, proxy) as mischief, _Yardstick(server) as yardstick:
            found = said(process)
        seconds = time.monotonic() - begun
    run.at_least("faults", mischief.made, seconds / EVERY * 0.7)
    run.at_least("of the updates published", len(found["calls"]) / (seconds * RATE), 0.5)
    run.at_least("updates told", found["told"], 0.3 * len(found["calls"]))
    run.at_least("of them with frames in shared memory", found["shared"], 0.5 * found["told"])
    run.at_least("calls failed", len(found["failed"]), run.size(5, 0))
    run.at_most("s the longest call", max(found["failed"] + [taken for _, taken in found["calls"]]), 1.1)
    run.at_least("gaps flagged", found["gaps"], 1)
    run.none("losses not flagged", found["silent"])
    run.none("updates told again or backwards", found["disordered"])
    run.none("torn", found["torn"])
    _judge_costs(run, np.array(found["samples"]))
    _judge_times(run, np.array(found["calls"]), np.array(yardstick.calls), seconds)


def _judge_costs(run: Run, samples: Any) -> None:
    """Memory, descriptors and tasks: flat after the first quarter. A leak with each fault would show as many."""
    warm = samples[len(samples) // 4 :]
    if run.full:
        run.at_most("MB/min more memory", float(np.polyfit(warm[:, 0], warm[:, 1], 1)[0] * 60), 1.0)
    else:
        run.at_most("MB more memory", float(warm[-1, 1] - warm[0, 1]), 8.0)
    # Publisher and follower are one process: two of a segment, two of its mapping, one for each of up to four views,
    # and as many again while a segment takes the place of another.
    run.at_most("descriptors of shared memory", float(samples[:, 4].max()), 16.0)
    half = len(warm) // 2
    for column, what in ((2, "more descriptors"), (3, "more tasks")):
        run.at_most(what, float(np.median(warm[half:, column]) - np.median(warm[:half, column])), 1.0)


def _judge_times(run: Run, calls: Any, plain: Any, seconds: float) -> None:
    """The calls that worked, the last third against the first, by what a plain client saw in the same thirds."""

    def slower(both: Any) -> float:
        first, last = (both[both[:, 0] < seconds / 3, 1], both[both[:, 0] > seconds * 2 / 3, 1])
        return quantile(last.tolist(), 0.99) / quantile(first.tolist(), 0.99)

    ratio = slower(calls)
    machine = max(1.0, slower(plain))
    run.at_most("x the first p99 at the end", ratio / machine, 1.2 if run.full else 3.0)
    run.at_least("x that of a plain client", machine, 1.0)
