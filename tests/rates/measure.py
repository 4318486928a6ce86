"""Record publishers at a robot's rates, compare the recording with what they published, and play it."""

from __future__ import annotations

import asyncio
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from reem_async import KeyValueStore, RedisInterface
from reem_async.errors import MissingKey
from reem_async.plan.trees import MISSING, same
from reem_async.recording import Replayer, open_log
from reem_async.server import EmbeddedServer

from .compare import Compared, compare
from .streams import STREAMS

__all__ = ["Outcome", "run"]

_ROOT = Path(__file__).resolve().parents[2]
_MOST_GROWTH = 4.0
"""Megabytes by which a recorder may be larger in the last third of its time than in the second."""
_MEASURED = 120.0
"""Seconds from which its memory is judged: at first it meets new shapes."""


class Outcome(NamedTuple):
    keys: dict[str, Compared]
    said: str  # by the recorder, at its end
    memory: list[float]  # its resident megabytes, every second
    played: int
    refused: int  # of those played: what they are inside of was skipped
    faults: list[str]


def _megabytes(process: int) -> float:
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * 4096 / 1e6


def _record(url: str, seed: int, seconds: float, folder: Path) -> tuple[str, list[float]]:
    reem = Path(sys.executable).with_name("reem")
    command = [reem, "record", "--url", url, "-o", folder / "run.mcap"]
    recorder = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    recorder.stderr.readline()  # "recording into": it has begun
    writers = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.rates.writer", url, name, str(seed), str(seconds), folder / f"{name}.npy"],
            cwd=_ROOT,
        )
        for name in STREAMS
    ]
    memory = []
    try:
        while any(writer.poll() is None for writer in writers):
            memory.append(_megabytes(recorder.pid))
            time.sleep(min(1.0, seconds / 10))
    finally:
        for writer in writers:
            writer.kill()
        recorder.send_signal(signal.SIGINT)
        said = recorder.communicate(timeout=60)[0].decode().strip()
    return said, memory


async def _whole(store: KeyValueStore, name: str) -> Any:
    try:
        return await store[name].read()
    except MissingKey:
        return MISSING


async def _play(file: Path, now: dict[str, Any]) -> tuple[int, int, list[str]]:
    """Play it to another server, as fast as that can; its end is what the first one has."""
    faults = []
    with EmbeddedServer() as server, open_log(file) as log:
        async with RedisInterface(server.url, timeout=30) as interface:
            status = await Replayer(interface, log, rate=1e9).play()
            store = KeyValueStore(interface)
            ends = {name: await _whole(store, name) for name in now}
            faults += [f"{name}: played, it is not what it was" for name in now if not same(ends[name], now[name])]
            for name, truth in now.items():
                found = log.tree_at(log.end).get(name, MISSING) if truth is MISSING else log.value_at((name,), log.end)
                if not same(found, truth):
                    faults.append(f"{name}: the recording does not end with what is there")
    return status.published, status.refused, faults


async def _now(url: str) -> dict[str, Any]:
    async with RedisInterface(url, timeout=30) as interface:
        return {name: await _whole(KeyValueStore(interface), name) for name in STREAMS}


def run(seed: int, seconds: float, instants: int, folder: Path) -> Outcome:
    with EmbeddedServer() as server:
        said, memory = _record(server.url, seed, seconds, folder)
        now = asyncio.run(_now(server.url))
    played, refused, faults = asyncio.run(_play(folder / "run.mcap", now))
    with open_log(folder / "run.mcap") as log:
        keys = compare(log, seed, folder, instants)
        lost = len(log.gaps()) + int(log.metadata["dropped"])
        if int(log.metadata["skipped"]) != len(log.skipped()):
            faults.append(f"{log.metadata['skipped']} are counted as skipped, {len(log.skipped())} named")
    faults += [fault for each in keys.values() for fault in each.faults]
    missing = {name: each.missing for name, each in keys.items() if each.missing}
    faults += [f"{name}: {number} updates are missing, and not told" for name, number in missing.items() if not lost]
    if any(each.recorded == 0 for each in keys.values()):
        faults.append("of some keys nothing was recorded")
    if len(memory) > _MEASURED:
        third = len(memory) // 3
        growth = statistics.median(memory[2 * third :]) - statistics.median(memory[third : 2 * third])
        if growth > _MOST_GROWTH:
            faults.append(f"the recorder's memory grew by {growth:.1f} MB")
    return Outcome(keys, said, memory, played, refused, faults)
