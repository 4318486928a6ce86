"""A robot node: sensing, control and heartbeat, several loops at rates of their own in one program.

In the asyncio front they are tasks of one group: if one fails, the others are cancelled and the program ends with that
error; Ctrl-C and SIGTERM end them in order, motors last. In the blocking front they are threads. An operator loop is
a program of its own that moves the set point. The gain of the wheel is a parameter: `reem param set wheel.gain 0.8`.

    python -m examples.robot_node [--front asyncio] [--seconds 5] [--url redis://...]
"""

from __future__ import annotations

import math
import signal
import threading
import time
from argparse import Namespace
from collections import Counter
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

import anyio

import reem
import reem_async
from examples.common import aticks, parser, run, server, ticks

GAIN = {"low": 0.0, "high": 1.0, "help": "share of the difference to the set point that one step makes up for"}


class Robot:
    """A simulated wheel that turns at the speed it is told."""

    def __init__(self) -> None:
        self.speed = 0.0
        self.done: Counter[str] = Counter()

    def sense(self) -> dict[str, float]:
        self.done["readings"] += 1
        return {"speed": self.speed + 0.01 * math.sin(50 * time.time()), "time_stamp": time.time()}

    def steer(self, set_point: dict[str, float], gain: float) -> None:
        self.done["set points followed"] += 1
        self.speed += gain * (set_point["speed"] - self.speed)

    def beat(self) -> dict[str, float]:
        self.done["heartbeats"] += 1
        return {"number": self.done["heartbeats"], "time_stamp": time.time()}

    def report(self) -> None:
        print("stopped after " + ", ".join(f"{count} {what}" for what, count in sorted(self.done.items())))


# --- asyncio: tasks of one group ---


async def sensor_loop(robot: Robot, pspace: reem_async.PublishSpace) -> None:
    async for _ in aticks(100):
        await pspace["sensors"].write(robot.sense())


async def control_loop(robot: Robot, kvs: reem_async.KeyValueStore) -> None:
    gain = await kvs["wheel"].parameter("gain", 0.5, **GAIN)
    try:
        async for update in kvs["set_point"].watch():
            robot.steer(update.data, float(gain))
    finally:
        robot.speed = 0.0  # whatever the reason, the wheel does not go on turning


async def heartbeat_loop(robot: Robot, pspace: reem_async.PublishSpace) -> None:
    async for _ in aticks(5):
        await pspace["heartbeat"].write(robot.beat())


async def operator_loop(pspace: reem_async.PublishSpace) -> None:
    async for seconds in aticks(20):
        await pspace["set_point"].write({"speed": math.sin(seconds)})


async def stop_on_signal(scope: anyio.CancelScope) -> None:
    with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
        async for _ in signals:
            scope.cancel()


async def asynchronous(options: Namespace) -> None:
    robot = Robot()
    async with server(options.url) as host, reem_async.RedisInterface(host) as interface:
        kvs, pspace = reem_async.KeyValueStore(interface), reem_async.PublishSpace(interface)
        with anyio.move_on_after(options.seconds):
            async with anyio.create_task_group() as loops:
                loops.start_soon(stop_on_signal, loops.cancel_scope)
                loops.start_soon(control_loop, robot, kvs)
                loops.start_soon(sensor_loop, robot, pspace)
                loops.start_soon(heartbeat_loop, robot, pspace)
                loops.start_soon(operator_loop, pspace)
                print("running; Ctrl-C stops", flush=True)
        await pspace["sensors"].write(robot.sense())  # the last word: it stands still
    robot.report()


# --- blocking: threads that an event stops ---


def blocking(options: Namespace) -> None:
    robot, stop = Robot(), threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    with server(options.url) as host, reem.RedisInterface(host) as interface:
        kvs, pspace = reem.KeyValueStore(interface), reem.PublishSpace(interface)
        set_points = kvs["set_point"].watch()
        gain = kvs["wheel"].parameter("gain", 0.5, **GAIN)

        def sense() -> None:
            for _ in ticks(100):
                pspace["sensors"] = robot.sense()
                if stop.is_set():
                    return

        def control() -> None:
            try:
                for update in set_points:  # ends when it is closed
                    robot.steer(update.data, float(gain))
            finally:
                robot.speed = 0.0

        def beat() -> None:
            while not stop.wait(0.2):  # at once, however slow the loop
                pspace["heartbeat"] = robot.beat()

        def operate() -> None:
            while not stop.wait(0.05):
                pspace["set_point"] = {"speed": math.sin(time.time())}

        with ThreadPoolExecutor() as threads:
            loops = [threads.submit(loop) for loop in (sense, control, beat, operate)]
            print("running; Ctrl-C stops", flush=True)
            wait(loops, options.seconds, FIRST_COMPLETED)  # the time is up, a signal came, or a loop failed
            stop.set()
            set_points.close()
        for loop in loops:
            loop.result()  # raises what the loop raised
        pspace["sensors"] = robot.sense()
    robot.report()


if __name__ == "__main__":
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=float, default=5.0, help="how long to run; default: %(default)s")
    run(arguments.parse_args(), blocking, asynchronous)
