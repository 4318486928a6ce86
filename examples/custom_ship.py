"""A custom type: a ship that carries laser scans, and its asyncio twin, which compresses in a thread.

A ship says which values it takes and records the commands that store and fetch them. REEM sends
these inside the transaction of the whole write, so a scan and what is written with it are never
seen apart. The label that a value was stored under says which ship reads it: a program that has
both ships reads the scans of either.

    python -m examples.custom_ship [--front asyncio] [--url redis://...]
"""

from __future__ import annotations

import zlib
from argparse import Namespace
from dataclasses import dataclass
from typing import Any

import anyio.to_thread
import numpy as np

import reem
import reem_async
from examples.common import parser, run, server
from reem import NumpyShip, SpecialDatatypeShip


@dataclass
class Scan:
    """One turn of a laser scanner: points in the frame of the sensor."""

    sensor: str
    points: np.ndarray  # float32, one row (x, y, z) for each point


class ScanShip(SpecialDatatypeShip):
    """Carries a scan as a hash of its name and the bytes of its points."""

    def get_label(self) -> str:
        return "scan"

    def check_fit(self, value: Any) -> bool:
        return isinstance(value, Scan)

    def describe(self, value: Scan) -> tuple[int, str]:  # optional: what `redis-cli JSON.GET` shows
        return value.points.nbytes, f"{value.sensor}, {len(value.points)} points"

    def write(self, key: str, value: Scan, client: Any) -> None:
        client.hset(key, mapping={"sensor": value.sensor, "points": value.points.astype("<f4").tobytes()})

    def read(self, key: str, client: Any) -> None:
        client.hgetall(key)  # one command that fetches all of it

    def interpret_read(self, responses: list[Any]) -> Scan:
        fields = responses[0]
        points = np.frombuffer(fields[b"points"], "<f4").reshape(-1, 3)
        return Scan(fields[b"sensor"].decode(), points)


class CompressedScanShip(ScanShip):
    """The same with compressed points. The work is done in a thread, so the event loop goes on."""

    def get_label(self) -> str:
        return "compressed_scan"

    async def write(self, key: str, value: Scan, client: Any) -> None:
        points = await anyio.to_thread.run_sync(zlib.compress, value.points.astype("<f4").tobytes(), 1)
        client.hset(key, mapping={"sensor": value.sensor, "points": points})

    async def interpret_read(self, responses: list[Any]) -> Scan:
        fields = responses[0]
        points = await anyio.to_thread.run_sync(zlib.decompress, fields[b"points"])
        return Scan(fields[b"sensor"].decode(), np.frombuffer(points, "<f4").reshape(-1, 3))


def take_scan() -> Scan:
    """A round room as the scanner in its middle sees it."""
    angles = np.linspace(0, 2 * np.pi, 20_000, endpoint=False)
    points = np.stack([4 * np.cos(angles), 4 * np.sin(angles), np.zeros_like(angles)], 1)
    return Scan("front laser", points.round(2).astype(np.float32))


def report(front: str, written: Scan, back: dict[str, Any]) -> None:
    scan = back["scan"]
    assert isinstance(scan, Scan)
    assert np.array_equal(scan.points, written.points)
    print(f"{front}: read back {len(scan.points)} points of the {scan.sensor}, taken at pose {back['pose']}")


def blocking(options: Namespace) -> None:
    # `ships` replaces the default list, so NumpyShip is named as well.
    with server(options.url) as host, reem.RedisInterface(host, ships=[ScanShip(), NumpyShip()]) as interface:
        kvs = reem.KeyValueStore(interface)
        scan = take_scan()
        kvs["room"] = {"pose": [1.0, 2.0, 0.5], "scan": scan}
        report(options.front, scan, kvs["room"].read())


async def asynchronous(options: Namespace) -> None:
    ships = [CompressedScanShip(), ScanShip(), NumpyShip()]  # the first that fits writes; each reads its own
    async with server(options.url) as host, reem_async.RedisInterface(host, ships=ships) as interface:
        kvs = reem_async.KeyValueStore(interface)
        scan = take_scan()
        await kvs["room"].write({"pose": [1.0, 2.0, 0.5], "scan": scan})
        report(options.front, scan, await kvs["room"].read())


if __name__ == "__main__":
    run(parser(__doc__).parse_args(), blocking, asynchronous)
