"""What each publisher publishes: the same again from the same seed, so that a frame need not be kept to be compared."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from reem_async.plan.trees import MISSING, get, removed, replaced

__all__ = ["STREAMS", "Op", "Stream", "after"]


class Op(NamedTuple):
    kind: str
    path: tuple[Any, ...]
    value: Any = None
    pause: float = 0.0


class Stream(NamedTuple):
    rate: float
    ops: Callable[[random.Random], Iterator[list[Op]]]


def after(tree: Any, op: Op) -> Any:
    if op.kind == "delete":
        return removed(tree, op.path)
    value = op.value
    if op.kind == "append":
        value = [*get(tree, op.path), op.value]
    elif op.kind == "add":
        value = get(tree, op.path) + op.value
    return replaced(tree, op.path, value)


def counter(rng: random.Random) -> Iterator[list[Op]]:
    number = 0
    while True:
        number += 1
        yield [Op("set", (), number)]


def imu(rng: random.Random) -> Iterator[list[Op]]:
    number = 0
    while True:
        number += 1
        yield [Op("set", (), {"a": [rng.random() for _ in range(3)], "q": np.full(4, number / 7), "n": number})]


def camera(rng: random.Random) -> Iterator[list[Op]]:
    number = 0
    while True:
        number += 1
        image = np.full((480, 640, 3), number % 251, np.uint8)
        image[0, 0] = number % 256, number // 256 % 256, number // 65536
        boxes = [[number, number + 1], [2, 3], [4, 5]]
        yield [
            Op("set", (), {"image": image, "n": number, "state": "raw", "boxes": boxes, "seen": 0}),
            Op("set", ("state",), "done", rng.choice((0.0, 0.001, 0.004, 0.012))),
            *rng.sample(
                [
                    Op("set", ("score",), number / 3, rng.choice((0.0, 0.001))),
                    Op("set", ("boxes", 0), [number]),
                    Op("delete", ("boxes", 1)),
                    Op("append", ("boxes",), [number, 9]),
                    Op("add", ("seen",), 1),
                    Op("set", ("mask",), np.full((240, 320), number % 200, np.uint8), rng.choice((0.0, 0.002))),
                ],
                3,
            ),
        ]


def lidar(rng: random.Random) -> Iterator[list[Op]]:
    number = 0
    while True:
        number += 1
        yield [Op("set", (), np.full((rng.randrange(20_000, 40_000), 4), number, np.float32))]


def odd(rng: random.Random) -> Iterator[list[Op]]:
    """Parts come, change their shapes, and go; so does the whole."""
    tree: Any = MISSING
    number = 0
    while True:
        number += 1
        size = rng.choice((3, 100, 30_000))
        shapes = [number, number / 3, f"text {number}", [number] * 5, {"x": {"y": number}}, np.full(size, number)]
        if type(tree) is not dict or rng.random() < 0.1:
            op = Op("set", (), {"d": {}, "n": number, "arr": np.full(size, -number)})
        elif rng.random() < 0.05:
            op = Op("delete", ())
        else:
            path = rng.choice([("d", f"x{number % 5}"), ("arr",), ("n",), ("d",)])
            there = path[0] in tree and get(tree, path) is not MISSING
            if rng.random() < 0.3 and there and path != ("d",):
                op = Op("delete", path)
            else:
                op = Op("set", path, {"z": number} if path == ("d",) else rng.choice(shapes))
        tree = after(tree, op)
        yield [op._replace(pause=rng.choice((0.0, 0.0, 0.002)))]


STREAMS = {
    "counter": Stream(1000, counter),
    "imu": Stream(200, imu),
    "camera": Stream(30, camera),
    "lidar": Stream(10, lidar),
    "odd": Stream(100, odd),
}
