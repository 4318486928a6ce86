"""Actuator: turns a (simulated) camera mount towards the brightest spot, and measures how late it is.

It keeps its own state in the store, where anybody can look: `redis-cli JSON.GET actuator`.

    python -m examples.image_system.actuator --url redis://localhost:6379 [--front asyncio]
"""

from __future__ import annotations

import threading
import time
from argparse import Namespace
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

import reem
import reem_async
from examples.common import parser, run

DEGREES_PER_PIXEL = 0.1


@dataclass
class Mount:
    """Two simulated motors, which close a tenth of the distance with each command."""

    pan: float = 0.0
    tilt: float = 0.0
    frames: int = 0
    ready: bool = True

    def act(self, info: dict[str, Any]) -> None:
        """Turn towards what the processor has found."""
        (row, column), (height, width) = info["spot"], info["size"]
        self.pan += 0.1 * ((column - width / 2) * DEGREES_PER_PIXEL - self.pan)
        self.tilt += 0.1 * ((height / 2 - row) * DEGREES_PER_PIXEL - self.tilt)
        self.frames += 1


def blocking(options: Namespace) -> None:
    mount, latencies, done = Mount(), [], threading.Event()
    with reem.RedisInterface(options.url) as interface:
        kvs = reem.KeyValueStore(interface)

        def on_result(data: dict[str, Any] | None, updated_path: str) -> None:
            if data is None:  # the server was restarted without it
                return
            mount.act(data)
            latencies.append(time.time() - data["time_stamp"])
            kvs["actuator"] = asdict(mount)
            if data["last"]:
                done.set()

        with reem.CallbackSubscriber("processed_info", interface, on_result, policy=reem.Newest()):
            kvs["actuator"] = asdict(mount)
            done.wait()
        kvs["actuator"]["latencies"] = np.array(latencies)
    print(f"actuator: {mount.frames} frames acted upon, now at pan {mount.pan:+.1f}, tilt {mount.tilt:+.1f} degrees")


async def asynchronous(options: Namespace) -> None:
    mount, latencies = Mount(), []
    async with reem_async.RedisInterface(options.url) as interface:
        kvs = reem_async.KeyValueStore(interface)
        async with kvs["processed_info"].watch() as updates:
            await kvs["actuator"].write(asdict(mount))
            async for update in updates:
                if update.initial or update.deleted:  # of a processor that ran before, or lost in a server's restart
                    continue
                mount.act(update.data)
                latencies.append(time.time() - update.data["time_stamp"])
                await kvs["actuator"].write(asdict(mount))
                if update.data["last"]:
                    break
        await kvs["actuator"]["latencies"].write(np.array(latencies))
    print(f"actuator: {mount.frames} frames acted upon, now at pan {mount.pan:+.1f}, tilt {mount.tilt:+.1f} degrees")


if __name__ == "__main__":
    arguments = parser(__doc__, default="redis://localhost:6379", help="default: %(default)s, where `reem up` is")
    run(arguments.parse_args(), blocking, asynchronous)
