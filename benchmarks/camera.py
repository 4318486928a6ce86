"""A camera at 30 Hz with ten readers, for a while: `python -m benchmarks.camera [--minutes 10] [--readers 10]`.

Each reader is a program of its own with a callback. A row for each part of the time: how old frames were when the
callback had them, how many of them were checked and how many were wrong, and the memory and file descriptors of all
parties. At the end the second half of the time is compared with the first, without the first part of it, in which
memory is taken.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import pathlib
import statistics
import time
import zlib
from typing import Any

import numpy as np

import reem

from .server import private_server
from .values import FRAME_SHAPE, PIXELS

_HERTZ = 30
_KEY = "camera"
_EVERY = 10
"""Of so many frames a reader compares one with its checksum: else, that would be what is measured."""
_PARTIES = ("publisher", "readers", "server")


# --- the parties ---------------------------------------------------------------------------------------


def publish(url: str, options: dict[str, Any], payload: str, pipe: Any) -> None:
    """Publish frames until told to stop; what calls took is handed over when asked for."""
    random = np.random.default_rng(1)
    image = random.integers(0, 256, FRAME_SHAPE).astype(PIXELS[payload])
    calls: list[float] = []
    with reem.RedisInterface(url, **options) as interface:
        space, number, due = reem.PublishSpace(interface), 0, time.perf_counter()
        while True:
            while pipe.poll(max(due - time.perf_counter(), 0)):
                if not pipe.recv():
                    return
                pipe.send(calls.copy())
                calls.clear()
            number += 1
            image[number % FRAME_SHAPE[0], :, 0] = number % 251
            checked = zlib.crc32(image) if number % _EVERY == 0 else None
            begun = time.perf_counter()
            space[_KEY] = {"image": image, "n": number, "crc": checked, "t": time.monotonic_ns()}
            calls.append(time.perf_counter() - begun)
            due = max(due + 1 / _HERTZ, begun)


def read(url: str, pipe: Any) -> None:
    """Note how old frames are, and compare some with their checksums; handed over when asked for."""
    ages: list[float] = []
    counts = {"checked": 0, "wrong": 0, "missed": 0}
    last = [0]

    def hear(data: Any, updated_path: str) -> None:
        ages.append((time.monotonic_ns() - data["t"]) / 1e9)
        counts["missed"] += max(data["n"] - last[0] - 1, 0) if last[0] else 0
        last[0] = data["n"]
        if data["crc"] is not None:
            counts["checked"] += 1
            counts["wrong"] += zlib.crc32(data["image"]) != data["crc"]

    with reem.RedisInterface(url) as interface:
        subscriber = reem.CallbackSubscriber(_KEY, interface, hear)
        subscriber.listen()
        pipe.send(None)
        while pipe.recv():
            pipe.send((ages.copy(), counts.copy()))
            ages.clear()
            counts.update(dict.fromkeys(counts, 0))


# --- what they take ------------------------------------------------------------------------------------


def memory(pid: int) -> tuple[float, float, int]:
    """Return a process's own memory and what it has mapped of shared memory, in MB, and its file descriptors."""
    fields = dict(line.split(":", 1) for line in pathlib.Path(f"/proc/{pid}/status").read_text().splitlines())
    own, shared = (int(fields[name].split()[0]) / 1024 for name in ("RssAnon", "RssShmem"))
    return own, shared, len(os.listdir(f"/proc/{pid}/fd"))


def of_all(pids: dict[str, list[int]]) -> dict[str, tuple[float, float, int]]:
    """Return `memory` of each party; of several processes the most of each."""
    found = {}
    for party, members in pids.items():
        own, shared, descriptors = zip(*(memory(pid) for pid in members), strict=True)
        found[party] = max(own), max(shared), max(descriptors)
    return found


class Party:
    """A process that is asked through a pipe."""

    def __init__(self, work: Any, *arguments: Any) -> None:
        self.pipe, there = multiprocessing.Pipe()
        self.process = multiprocessing.Process(target=work, args=(*arguments, there), daemon=True)
        self.process.start()

    def ask(self) -> Any:
        """Return what it has noted since it was asked last."""
        self.pipe.send(True)
        return self.pipe.recv()

    def end(self) -> None:
        """Have it end."""
        with contextlib.suppress(OSError):
            self.pipe.send(False)
        self.process.join(5)
        self.process.kill()


# --- the table -----------------------------------------------------------------------------------------


def row(minute: float, ages: list[float], calls: list[float], counts: dict[str, int], taken: Any) -> dict[str, float]:
    """Return the figures of one part of the time."""
    middle, late = np.percentile(ages, [50, 99]) * 1e3 if ages else (float("nan"),) * 2
    figures = {"minute": minute, "frames": len(ages), "p50 ms": middle, "p99 ms": late}
    figures |= {"call ms": statistics.median(calls) * 1e3 if calls else float("nan")} | counts
    for party in _PARTIES:
        own, shared, descriptors = taken[party]
        figures |= {f"{party} MB": own, f"{party} shared MB": shared, f"{party} fds": descriptors}
    return figures


def line(figures: dict[str, float]) -> str:
    """Return a row as text."""
    return (
        "| "
        + " | ".join(f"{value:.2f}" if isinstance(value, float) else str(value) for value in figures.values())
        + " |"
    )


def verdict(rows: list[dict[str, float]]) -> list[str]:
    """Compare the second half with the first."""
    settled = rows[1:] if len(rows) > 2 else rows
    half = max(len(settled) // 2, 1)
    lines = []
    for name in settled[0]:
        if name in ("minute", "frames", "checked"):
            continue
        first, second = (
            statistics.median([each[name] for each in part]) for part in (settled[:half], settled[half:] or settled)
        )
        if name in ("wrong", "missed"):
            lines.append(f"{name}: {sum(each[name] for each in rows):.0f} in all")
        elif name.endswith("ms"):
            lines.append(f"{name}: {first:.2f} -> {second:.2f}, {second / first if first else 1:.2f} times")
        else:
            flat = second - first <= max(0.02 * first, 1.0)
            lines.append(f"{name}: {first:.1f} -> {second:.1f}, {'flat' if flat else 'GROWS'}")
    return lines


def main() -> None:
    """Run it and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.camera", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--readers", type=int, default=10)
    parser.add_argument("--parts", type=int, default=20, help="rows of the table")
    parser.add_argument(
        "--payload", choices=tuple(PIXELS), default="image", help="0.92 MB of uint8, or 7.4 MB of float64"
    )
    parser.add_argument("--local", choices=("auto", "off", "early"), default="auto", help="of the publisher")
    given = parser.parse_args()
    multiprocessing.set_start_method("spawn")
    with private_server() as server:
        readers = [Party(read, server.url) for _ in range(given.readers)]
        for reader in readers:
            reader.pipe.recv()
        camera = Party(publish, server.url, {"local": given.local}, given.payload)
        everyone = [camera, *readers]
        pids = {
            "publisher": [camera.process.pid],
            "readers": [it.process.pid for it in readers],
            "server": [server.pid()],
        }
        rows: list[dict[str, float]] = []
        try:
            begun = time.monotonic()
            for part in range(1, given.parts + 1):
                time.sleep(max(begun + part * given.minutes * 60 / given.parts - time.monotonic(), 0))
                rows.append(_asked(camera, readers, (time.monotonic() - begun) / 60, of_all(pids)))
                if part == 1:
                    print(f"{given.payload}, local={given.local!r}, {given.readers} readers")
                    print(f"| {' | '.join(rows[0])} |")
                    print("|---" * len(rows[0]) + "|")
                print(line(rows[-1]), flush=True)
        finally:
            for party in everyone:
                party.end()
    print("\n".join(verdict(rows)))


def _asked(camera: Party, readers: list[Party], minute: float, taken: Any) -> dict[str, float]:
    calls, heard = camera.ask(), [reader.ask() for reader in readers]
    ages = [age for each, _ in heard for age in each]
    counts = {name: sum(counts[name] for _, counts in heard) for name in heard[0][1]}
    return row(minute, ages, calls, counts, taken)


if __name__ == "__main__":
    main()
