"""A controller beside a camera, and what an import costs."""

import dataclasses
import os
import subprocess
import sys
import time

from .environment import FOLDER
from .measure import Bench, Case, Found, fresh_key
from .process import ContenderError
from .results import failure, summary


@dataclasses.dataclass(frozen=True)
class CameraCase(Case):
    """A 1 kHz writer of set points alone and beside 8 MB frames on one interface, in alternating blocks."""

    rate: float = 1000.0
    frames: float = 30.0
    seconds: float = 1.0
    rounds: int = 4

    def measure(self, bench: Bench) -> Found:
        """Yield the writer's calls, their lateness counted from when each was due, and the frames' calls."""
        taken: dict[tuple[str, str], list[float]] = {}
        failed: set[str] = set()
        seconds, rounds = bench.scaled(self.seconds, 0.3), int(bench.scaled(self.rounds, 1))
        for _ in range(rounds):
            for name in self.contenders:
                for beside in (False, True):
                    if name in failed:
                        continue
                    try:
                        self._block(bench, name, beside, seconds, taken)
                    except ContenderError as error:
                        failed.add(name)
                        yield f"{self.identifier}.beside", name, failure(error)
        for (case, name), samples in taken.items():
            if name not in failed:
                yield case, name, summary(samples)

    def _block(
        self, bench: Bench, name: str, beside: bool, seconds: float, taken: dict[tuple[str, str], list[float]]
    ) -> None:
        worker = bench.workers.get(name)
        reply = worker.ask(
            "camera", key=fresh_key(), seconds=seconds, beside=beside, rate=self.rate, frames=self.frames
        )
        place = f"{self.identifier}.{'beside' if beside else 'alone'}"
        taken.setdefault((place, name), []).extend(reply["calls"])
        taken.setdefault((f"{place}.late", name), []).extend(reply["late"])
        if beside:
            taken.setdefault((f"{self.identifier}.frames", name), []).extend(reply["frames"])


IMPORTS = {
    "python": "pass",
    "redis+numpy": "import redis, numpy",
    "reem": "import reem; reem.KeyValueStore",
    "async": "import reem_async; reem_async.KeyValueStore",
}


@dataclasses.dataclass(frozen=True)
class ImportCase(Case):
    """Whole processes that import one thing and end, in turn."""

    times: int = 12

    def measure(self, bench: Bench) -> Found:
        """Wall time of each process."""
        samples: dict[str, list[float]] = {}
        failed: set[str] = set()
        surroundings = {**os.environ, "PYTHONPATH": str(FOLDER.parent)}
        # pip has compiled the others when it installed them; this folder is compiled by the first run, and kept.
        surroundings.pop("PYTHONDONTWRITEBYTECODE", None)
        for _ in range(int(bench.scaled(self.times, 3)) + 1):
            for name in self.contenders:
                if name in failed:
                    continue
                start = time.perf_counter()
                done = subprocess.run(
                    [sys.executable, "-c", IMPORTS[name]],
                    env=surroundings,
                    capture_output=True,
                    text=True,
                    check=False,
                )
                samples.setdefault(name, []).append(time.perf_counter() - start)
                if done.returncode:
                    failed.add(name)
                    yield self.identifier, name, failure((done.stderr.strip().splitlines() or ["?"])[-1])
        for name in samples:
            if name not in failed:
                yield self.identifier, name, summary(samples[name][1:])
