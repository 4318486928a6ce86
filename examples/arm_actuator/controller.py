"""Controller: gives the joint of an arm a new set point 100 times a second.

With `--way store` the set point is written to the store, where the actuator polls it; with
`--way publish` it is published, and those who follow it are told.

    python -m examples.arm_actuator.controller --url redis://localhost:6379 --way publish [--front asyncio]
"""

from __future__ import annotations

import math
import time
from argparse import Namespace
from typing import Any

import reem
import reem_async
from examples.common import aticks, parser, run, ticks

RATE = 100  # set points per second


def set_point(seconds: float, more: bool = True) -> dict[str, Any]:
    """The wanted angle in radians, when it was decided, and whether more will come."""
    return {"angle": math.sin(2 * seconds), "time_stamp": time.time(), "more": more}


def report(options: Namespace, seconds: float) -> None:
    count = round(RATE * options.seconds)
    print(
        f"controller ({options.way}, {options.front}): {count} set points at {(count - 1) / seconds:.1f} Hz", flush=True
    )


def blocking(options: Namespace) -> None:
    with reem.RedisInterface(options.url) as interface:
        store = reem.PublishSpace(interface) if options.way == "publish" else reem.KeyValueStore(interface)
        start = time.perf_counter()
        for seconds in ticks(RATE, options.seconds):
            store["set_point"] = set_point(seconds)
        report(options, time.perf_counter() - start)
        store["set_point"] = set_point(seconds, more=False)


async def asynchronous(options: Namespace) -> None:
    async with reem_async.RedisInterface(options.url) as interface:
        store = reem_async.PublishSpace(interface) if options.way == "publish" else reem_async.KeyValueStore(interface)
        start = time.perf_counter()
        async for seconds in aticks(RATE, options.seconds):
            await store["set_point"].write(set_point(seconds))
        report(options, time.perf_counter() - start)
        await store["set_point"].write(set_point(seconds, more=False))


if __name__ == "__main__":
    arguments = parser(__doc__, default="redis://localhost:6379", help="default: %(default)s, where `reem up` is")
    arguments.add_argument("--way", choices=["store", "publish"], default="store", help="default: %(default)s")
    arguments.add_argument("--seconds", type=float, default=3.0, help="default: %(default)s")
    run(arguments.parse_args(), blocking, asynchronous)
