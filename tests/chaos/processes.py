"""Rows 14, 15 and 16: forks, the wrong loop or thread, and the ways in which a program may end."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import re
import subprocess
import sys
import threading
import time
from typing import Any

import reem
import reem_async
from reem_async.errors import WrongLoop

from .programs import EXITS
from .scoreboard import ROOT, Run, row
from .servers import PrivateServer
from .tools import program, said


@row(14, "forks: os.fork, multiprocessing, out of a loop", "child works or is refused <= 1 s; parent's next 100 right")
def forks(run: Run) -> None:
    """The children use the interface, the stores and the subscription that they have inherited."""
    count = run.size(100, 9)
    with PrivateServer() as server, program("forks", server.url, count, module="family") as process:
        found = said(process)
    run.at_least("forks", found["worked"] + found["refused"], count)
    run.at_least("children that worked", found["worked"], 0)
    run.at_least("frames seen in shared memory", found["shared"], count // 2)  # a busy machine may be too late
    run.at_most("s the slowest child", found["slowest"], 1.0)
    run.none("wrong", found["wrong"])


# --- 15 --------------------------------------------------------------------------------------------


class _Refusals:
    """Calls in the wrong place, and how much work it was to refuse them."""

    def __init__(self) -> None:
        self.work: list[float] = []
        self.wrong: list[Any] = []

    @contextlib.contextmanager
    def expected(self):
        """The block must raise WrongLoop; time spent waiting for the processor does not count."""
        begun = time.thread_time()
        try:
            yield
        except WrongLoop as error:
            if "loop" not in str(error):
                self.wrong.append(error)
        except Exception as error:
            self.wrong.append(error)
        else:
            self.wrong.append("it was let through")
        self.work.append((time.thread_time() - begun) * 1000)


@row(15, "second loop, and blocking calls on REEM's own loop thread", "a clear error <= 10 ms of work, 0 deadlocks")
def wrong_places(run: Run) -> None:
    """100 times each; a call that waited for itself would end the row by its time limit."""
    times = run.size(100, 20)
    refusals = _Refusals()
    with PrivateServer() as server:
        _second_loop(server.url, times, refusals)
        _loop_thread(server.url, times, refusals)
        run.at_least("calls from within callbacks that worked", _callbacks(server.url, times), times)
    run.at_least("calls in the wrong place", len(refusals.work), 4 * times)
    run.at_most("ms of work the longest", max(refusals.work), 10)
    run.none("wrong", refusals.wrong)


def _second_loop(url: str, times: int, refusals: _Refusals) -> None:
    """One interface in two loops, of which the first is not over."""
    with asyncio.Runner() as first:
        interface = reem_async.RedisInterface(url)
        first.run(interface.initialize())
        kvs = reem_async.KeyValueStore(interface)
        mirror = reem_async.SilentSubscriber("a", interface)

        async def second() -> None:
            for call in (kvs["a"].read, lambda: kvs["a"].write(1), mirror.listen):
                with refusals.expected():
                    await call()

        for _ in range(times):
            asyncio.run(second())
        first.run(kvs["a"].write(2))  # and the first loop is not disturbed
        if first.run(kvs["a"].read()) != 2:
            refusals.wrong.append("the first loop was disturbed")
        first.run(interface.close())


def _loop_thread(url: str, times: int, refusals: _Refusals) -> None:
    """An `async def` ship runs on REEM's own loop; a blocking call there would wait for itself."""
    done = threading.Event()

    class Ship(reem.BytesShip):
        async def check_fit(self, value: Any) -> bool:
            if isinstance(value, bytes) and not done.is_set():
                with refusals.expected():
                    kvs["a"].read()
            return isinstance(value, bytes)

    with contextlib.closing(reem.RedisInterface(url, ships=[Ship()])) as interface:
        kvs = reem.KeyValueStore(interface)
        for _ in range(times):
            kvs["b"] = b"bytes"
        done.set()
        if kvs["b"].read() != b"bytes":
            refusals.wrong.append("the interface does not work afterwards")


def _callbacks(url: str, times: int) -> int:
    """Callbacks of the blocking front have a thread of their own, so there they may call whatever they like."""
    worked, over = [0], threading.Event()
    with contextlib.closing(reem.RedisInterface(url)) as interface:
        kvs, space = reem.KeyValueStore(interface), reem.PublishSpace(interface)
        space["c"] = {"n": -1}

        def call(data: Any, updated_path: str) -> None:
            worked[0] += kvs["c"]["n"].read() >= data["n"]
            if data["n"] == times - 1:
                over.set()

        calls = reem.CallbackSubscriber("c", interface, call)
        calls.listen()
        for n in range(times):
            space["c"]["n"] = n
        over.wait(20)
    return worked[0]


# --- 16 --------------------------------------------------------------------------------------------


@row(16, "6 ways to end a program, -X dev -W error", "exit <= 2 s, stderr empty, 0 hangs")
def exits(run: Run) -> None:
    """Two at a time: connections open, threads waiting, finalizers and `atexit` at work."""
    times = run.size(30, 1)
    seconds: list[float] = []
    wrong: list[Any] = []
    with PrivateServer() as server:

        def end(name: str) -> None:
            command = [sys.executable, "-X", "dev", "-W", "error", "-m", "tests.chaos.programs", name, server.url]
            with subprocess.Popen(
                command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            ) as process:
                try:
                    line = process.stdout.readline()
                    begun = time.monotonic()
                    _, complaints = process.communicate(timeout=10)
                    seconds.append(time.monotonic() - begun)
                except subprocess.TimeoutExpired:
                    process.kill()
                    wrong.append(f"{name} hangs")
                    return
            # asyncio's debugging mode remarks on a busy machine.
            complaints = re.sub(r"^Executing <.*> took \d+\.\d+ seconds\n", "", complaints, flags=re.MULTILINE)
            if not line or complaints or process.returncode:
                wrong.append(f"{name} ended with {process.returncode}: {complaints[-1500:]}")

        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            list(pool.map(end, EXITS * times))
    run.at_least("exits", len(seconds), times * len(EXITS))
    run.at_most("s the longest", max(seconds, default=float("inf")), 2.0)
    run.none("hung or complained", wrong)
