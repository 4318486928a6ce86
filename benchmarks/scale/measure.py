"""What is measured in one setting: operations, followers, standing by, memory."""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reem import KeyValueStore, PublishSpace, RedisInterface

from .audience import Audience
from .servers import Running, Sample

NAMESPACE = "robots/r1:"
FRESH_SECONDS = 3.2
"""A publisher's first three seconds with a key cost more on a cluster: all nodes are told."""
BURST = 20
"""Small updates on their way at a time: few enough that nothing piles up at a follower."""

Value = Callable[[int], Any]


def point(step: int) -> dict[str, float]:
    """A set point: seven joints."""
    return {f"joint_{joint}": 0.001 * step + joint / 7 for joint in range(7)}


def _camera(image: np.ndarray[Any, Any]) -> Value:
    return lambda step: {"time": 0.033 * step, "image": image}


_noise = np.random.default_rng(1)
frame = _camera(_noise.integers(0, 256, (480, 640, 3), np.uint8))
packed = _camera(_noise.integers(0, 256, 60_000, np.uint8))
VALUES: dict[str, Value] = {"point": point, "packed": packed, "frame": frame}
FOLLOWERS = {"point": (0, 1, 10, 50), "packed": (0, 1, 10), "frame": (0, 1, 10)}


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        rounds: Blocks of each case, in turns; their median counts.
        points: Small operations in a block.
        frames: Large ones.
        seconds: How long idling, and the replayed fleet, are looked at.
        keys: Keys whose memory is looked at.
        buffers: Seconds until servers have given back the buffers that took large values in.
    """

    rounds: int
    points: int
    frames: int
    seconds: float
    keys: int
    buffers: float = 3.0


WHOLE = Effort(rounds=7, points=400, frames=20, seconds=4.0, keys=2000)
QUICK = Effort(rounds=3, points=100, frames=5, seconds=2.0, keys=200)


@dataclass(frozen=True)
class Case:
    """One kind of operation.

    Attributes:
        value: point, packed or frame.
        operation: write, read or publish.
        followers: How many follow what is published.
    """

    value: str
    operation: str
    followers: int = 0

    @property
    def name(self) -> str:
        """Its name among the results."""
        return f"{self.value}.{self.operation}" + (f".{self.followers}" if self.operation == "publish" else "")

    @property
    def key(self) -> str:
        """The top-level key it works on."""
        return f"{self.value}_{self.operation}_{self.followers}"

    @property
    def burst(self) -> int:
        """How many are published before all followers have to have them: large values one by one."""
        return BURST if self.value == "point" else 1


def cases() -> Iterator[Case]:
    """Yield all cases."""
    for value, followers in FOLLOWERS.items():
        yield Case(value, "write")
        yield Case(value, "read")
        for count in followers:
            yield Case(value, "publish", count)


class Bench:
    """Measures one setting, from a client in this process and followers in another.

    Attributes:
        found: What was measured, as it is kept.
    """

    def __init__(self, running: Running, effort: Effort) -> None:
        self.running = running
        self.effort = effort
        self.found: dict[str, Any] = {}
        self.interface = RedisInterface(running.url, namespace=NAMESPACE, timeout=5.0, local="off")
        self.kvs, self.pspace = KeyValueStore(self.interface), PublishSpace(self.interface)
        self._audience: Audience | None = None
        self._published: dict[str, int] = {}
        self._blocks: dict[str, list[dict[str, float]]] = {}
        self._freshness = 0
        self._cost = (running.primaries.asking(), running.replicas.asking())
        self._idle = (Sample(), Sample())
        self._alone = Sample()
        self._connections = 0
        for case in cases():  # everything is there, and connected
            self.once(case, 1)

    def gather(self) -> None:
        """Have the followers begin; nothing may have been published for some seconds."""
        groups = {NAMESPACE + case.key: case.followers for case in cases() if case.followers}
        nodes = self.running.primaries
        self._connections, memory = nodes.total("clients", "connected_clients"), nodes.total("memory", "used_memory")
        self._audience = Audience(self.running.url, groups)
        more = nodes.total("clients", "connected_clients") - self._connections
        self.found["memory"]["connection"] = (nodes.total("memory", "used_memory") - memory) / more

    def rest(self, first: tuple[Sample, Sample], seconds: float) -> None:
        """Note what the servers used while nobody asked for anything: first alone, then with followers."""
        self._idle = (Sample(), Sample())
        primaries, replicas = self.spent(first, seconds)
        self._idle = primaries.times(1 / seconds), replicas.times(1 / seconds)
        if self._audience is None:
            self._alone = self._idle[0]
            self.found["idle"] = row(self._alone, self.running.count)
        else:
            self.found["heartbeat"] = row((self._idle[0] - self._alone).times(1 / self._audience.size))

    def round(self) -> None:
        """Measure a block of each case."""
        for case in cases():
            self._blocks.setdefault(case.name, []).append(self.block(case))
        if self.running.count > 1:
            self._blocks.setdefault("fresh", []).append(self.fresh())

    def finish(self) -> dict[str, Any]:
        """Return all that was found: medians of the blocks; the followers end."""
        assert self._audience is not None
        # Fetching large values takes another connection, which is there from the first update on.
        more = self.running.primaries.total("clients", "connected_clients") - self._connections
        medians = {name: _medians(blocks) for name, blocks in self._blocks.items()}
        self.found["connections"] = more / self._audience.size
        if "fresh" in medians:
            self.found["fresh"] = medians.pop("fresh")
        self.found["cases"] = medians
        return self.found

    def once(self, case: Case, step: int) -> None:
        """Do it once."""
        if case.operation == "read":
            if step == 1:
                self.kvs[case.key] = VALUES[case.value](step)
            self.kvs[case.key].read()
        elif case.operation == "write":
            self.kvs[case.key] = VALUES[case.value](step)
        else:
            self.pspace[case.key] = VALUES[case.value](step)

    def samples(self) -> tuple[Sample, Sample]:
        """Return the counters of the primaries and the replicas."""
        return self.running.primaries.sample(), self.running.replicas.sample()

    def spent(self, first: tuple[Sample, Sample], seconds: float) -> tuple[Sample, Sample]:
        """Return what the primaries and the replicas have used since then, without what idling takes."""
        one, two = (
            b - a - cost - idle.times(seconds)
            for a, b, cost, idle in zip(first, self.samples(), self._cost, self._idle, strict=True)
        )
        return one, two

    def block(self, case: Case) -> dict[str, float]:
        """Return what one operation costs on average over a block."""
        assert self._audience is not None
        count = self.effort.points if case.value == "point" else self.effort.frames
        count *= 1 if case.followers else 3  # so that looking at the counters does not show
        audience_cpu = self._audience.cpu()
        first, begin = self.samples(), time.monotonic()
        client = time.process_time()
        for step in range(2, count + 2):
            self.once(case, step)
            if case.followers:
                self._published[case.key] = self._published.get(case.key, 0) + 1
                if (step - 1) % case.burst == 0 or step == count + 1:
                    self._audience.wait(NAMESPACE + case.key, case.followers * self._published[case.key])
        client = time.process_time() - client
        primaries, replicas = self.spent(first, time.monotonic() - begin)
        audience_cpu = self._audience.cpu() - audience_cpu
        seen = count * case.followers
        return {
            **row(primaries.times(1 / count)),
            "replica_core_us": replicas.core / count * 1e6,
            "client_us": client / count * 1e6,
            "follower_us": audience_cpu / seen * 1e6 if seen else 0.0,
        }

    def fresh(self) -> dict[str, float]:
        """Return what a set point costs in a publisher's first seconds: its node, and each other primary."""
        nodes, count, share = self.running.primaries, self.effort.points, 1 / self.running.count
        self._freshness += 1
        key = f"fresh_{self._freshness}"
        self.pspace[key] = point(1)
        first, begin = nodes.samples(), time.monotonic()
        for step in range(count):
            self.pspace[key] = point(step)
        last, seconds = nodes.samples(), time.monotonic() - begin
        free = self._cost[0].times(share) + self._idle[0].times(share * seconds)
        spent = sorted((b - a - free).core / count * 1e6 for a, b in zip(first, last, strict=True))
        return {"core_us": spent[-1], "other_core_us": statistics.fmean(spent[:-1])}

    def measure_memory(self) -> None:
        """Note the bytes that keys take: what the servers' memory grows by, and what MEMORY USAGE says."""
        nodes, found = self.running.primaries, self.found.setdefault("memory", {})
        for value, make in VALUES.items():
            count = self.effort.keys if value == "point" else 20
            before = nodes.memory()
            for number in range(count):
                self.pspace[f"memory_{value}_{number}"] = make(1)
            if value != "point":
                time.sleep(self.effort.buffers)
            found[value] = (nodes.memory() - before) / count
            document = f"{NAMESPACE}memory_{value}_0"
            found[f"{value}.document"] = nodes.usage(document)
            if value != "point":
                found[f"{value}.array"] = nodes.usage(f"{{{document}}}.image")

    def close(self) -> None:
        """Have the followers end, and disconnect."""
        if self._audience is not None:
            self._audience.end()
        self.interface.close()


def idle(benches: Sequence[Bench], seconds: float) -> None:
    """Have all settings note what idling takes, at the same time."""
    first, begin = [bench.samples() for bench in benches], time.monotonic()
    time.sleep(seconds)
    for bench, samples in zip(benches, first, strict=True):
        bench.rest(samples, time.monotonic() - begin)


def measure(everything: Mapping[str, Running], effort: Effort) -> dict[str, dict[str, Any]]:
    """Measure all settings, in turns, so that what else the machine does falls on all alike.

    Args:
        everything: The servers of each setting.
        effort: How much.
    """
    with contextlib.ExitStack() as stack:
        benches = {}
        for setting, running in everything.items():
            benches[setting] = Bench(running, effort)
            stack.callback(benches[setting].close)
        settle = FRESH_SECONDS if any(running.count > 1 for running in everything.values()) else 0.0
        time.sleep(settle)
        idle(list(benches.values()), effort.seconds)
        for bench in benches.values():
            bench.measure_memory()
            bench.gather()
        time.sleep(settle)
        idle(list(benches.values()), effort.seconds)
        for _ in range(effort.rounds):
            for bench in benches.values():
                bench.round()
        return {setting: bench.finish() for setting, bench in benches.items()}


def row(sample: Sample, share: int = 1) -> dict[str, float]:
    """Return a sample as it is kept: microseconds and bytes."""
    each = sample.times(1 / share)
    return {
        "core_us": each.core * 1e6,
        "process_us": each.process * 1e6,
        "bytes_in": each.bytes_in,
        "bytes_out": each.bytes_out,
        "bytes_replica": each.bytes_replica,
    }


def _medians(blocks: list[dict[str, float]]) -> dict[str, float]:
    found = {name: statistics.median(block[name] for block in blocks) for name in blocks[0]}
    cores = sorted(block["core_us"] for block in blocks)
    return found | {"core_us_least": cores[0], "core_us_most": cores[-1]}
