"""Actuator: drives a (simulated) joint 1000 times a second towards the set point as it is at that time.

With `--way store` it asks the server each time; with `--way publish` it keeps a local variable that
follows what the controller publishes, and asks nobody. It ends with the controller.

    python -m examples.arm_actuator.actuator --url redis://localhost:6379 --way publish [--front asyncio]
"""

from __future__ import annotations

import time
from argparse import Namespace
from contextlib import ExitStack
from typing import Any

import numpy as np

import reem
import reem_async
from examples.common import aticks, parser, run, ticks

RATE = 1000  # commands to the motor per second


class Joint:
    """A simulated motor, and a note of how old each set point was when it was used."""

    def __init__(self) -> None:
        self.started = time.time()
        self.first = 0.0
        self.angle = 0.0
        self.ages: list[float] = []

    def drive(self, set_point: dict[str, Any] | None) -> bool:
        """Move one step; whether there is more to do. Set points from before the start do not count."""
        if set_point is None or set_point["time_stamp"] < self.started:
            return True
        now = time.time()
        self.first = self.first or now
        self.ages.append(now - set_point["time_stamp"])
        self.angle += 0.05 * (set_point["angle"] - self.angle)
        return bool(set_point["more"])

    def report(self, options: Namespace) -> None:
        if len(self.ages) < 2:
            raise SystemExit("actuator: no set point arrived")
        rate = len(self.ages) / (time.time() - self.first)
        median, late = 1000 * np.percentile(self.ages, [50, 99])
        name = f"actuator ({options.way}, {options.front})"
        print(f"{name}: {rate:.0f} Hz, age of the set point {median:.1f} ms (median), {late:.1f} ms (p99)", flush=True)


def blocking(options: Namespace) -> None:
    joint = Joint()
    with reem.RedisInterface(options.url) as interface, ExitStack() as stack:
        if options.way == "publish":
            subscriber = stack.enter_context(reem.SilentSubscriber("set_point", interface))
            look = subscriber.value
        else:
            look = reem.KeyValueStore(interface)["set_point"].get
        for _ in ticks(RATE, options.seconds):
            if not joint.drive(look()):
                break
        joint.report(options)


async def asynchronous(options: Namespace) -> None:
    joint = Joint()
    async with reem_async.RedisInterface(options.url) as interface:
        set_point = reem_async.KeyValueStore(interface)["set_point"]
        async with reem_async.SilentSubscriber("set_point", interface) as subscriber:
            async for _ in aticks(RATE, options.seconds):
                if not joint.drive(subscriber.value() if options.way == "publish" else await set_point.get()):
                    break
        joint.report(options)


if __name__ == "__main__":
    arguments = parser(__doc__, default="redis://localhost:6379", help="default: %(default)s, where `reem up` is")
    arguments.add_argument("--way", choices=["store", "publish"], default="store", help="default: %(default)s")
    arguments.add_argument("--seconds", type=float, default=60.0, help="at most; default: %(default)s")
    run(arguments.parse_args(), blocking, asynchronous)
