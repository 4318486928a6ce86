"""Programs that rows run as processes of their own: `python -m tests.chaos.programs NAME ARGUMENTS`.

They say what they found as lines of JSON on stdout.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import gc
import os
import resource
import sys
import threading
import time
from typing import Any

import numpy as np
from redis.exceptions import RedisError
from slotkit import shared_in

import reem
import reem_async
from reem_async.concurrency.queues import Last

from .tools import Log, background, became, descriptors, frame, heard, rss, say

# --- row 10 ----------------------------------------------------------------------------------------


def stalled(url: str) -> None:
    """Subscribe to `flood`; stand still when told; then say how long the copy took to be right again."""
    asyncio.run(_stalled(url))


async def _stalled(url: str) -> None:
    async with reem_async.RedisInterface(url) as interface:
        mirror = reem_async.SilentSubscriber("flood", interface)
        log = Log(mirror.watch(Last(1000)))
        await mirror.listen()
        await log.updates.listen()
        async with background(log.follow()):
            say(ready=True)
            await asyncio.to_thread(heard)
            before, gaps, told = rss(), log.gaps, log.told
            say(stalled=True, told=told)
            end = int(heard())  # on the loop's own thread: nothing is read meanwhile
            begun = time.monotonic()
            settled = await became(lambda: (mirror.value() or {}).get("end") == end and log.gaps > gaps, 20)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            say(
                settled=settled,
                took=time.monotonic() - begun,
                gaps=log.gaps - gaps,
                grown=max(peak, rss()) - before,
                silent=log.silent,
                disordered=log.repeated + log.backward,
            )


# --- row 16 ----------------------------------------------------------------------------------------

KEPT: list[Any] = []
"""What is alive until the interpreter clears its modules."""


def _following(url: str) -> tuple[reem.RedisInterface, reem.KeyValueStore]:
    """A program in the middle of its work: connections, a mirror, a callback."""
    interface = reem.RedisInterface(url)
    space = reem.PublishSpace(interface)
    space["exit"] = {"n": 0}
    heard: list[Any] = []
    mirror = reem.SilentSubscriber("exit", interface)
    calls = reem.CallbackSubscriber("exit", interface, lambda data, _: heard.extend([data] * bool(shared_in(data))))
    mirror.listen()
    calls.listen()
    while not heard:  # the end meets frames that are looked at
        space["exit"]["frame"] = frame(1)
        time.sleep(0.001)
    KEPT.extend([interface, mirror, calls])
    return interface, reem.KeyValueStore(interface)


def exit_at_the_end(url: str) -> None:
    """Nothing is closed."""
    _following(url)
    say(bye=True)


def exit_by_sys_exit(url: str) -> None:
    """Out of a loop over updates."""
    _, kvs = _following(url)
    for _ in kvs["exit"].watch():
        say(bye=True)
        sys.exit(0)


def exit_with_waiting_thread(url: str) -> None:
    """A daemon thread waits for an update that never comes."""
    _, kvs = _following(url)
    begun = threading.Event()

    def wait() -> None:
        for _ in kvs["exit"].watch():
            begun.set()

    threading.Thread(target=wait, daemon=True).start()
    begun.wait(5)
    say(bye=True)


def exit_with_calls_at_exit(url: str) -> None:
    """`atexit` still reads and writes: over what is connected, and over something new."""
    _, kvs = _following(url)

    def last_words() -> None:
        kvs["last"] = {"words": [1]}
        assert kvs["last"]["words"].read() == [1]
        with reem.RedisInterface(url) as fresh:
            assert reem.KeyValueStore(fresh)["last"]["words"][0].read() == 1

    atexit.register(last_words)
    say(bye=True)


class _Writes:
    """Writes when it is collected, which for this one is when there is hardly an interpreter any more."""

    def __init__(self, kvs: reem.KeyValueStore) -> None:
        self._kvs = kvs

    def __del__(self, suppress: Any = contextlib.suppress, error: Any = reem.ReemError) -> None:
        with suppress(error):
            self._kvs["collected"] = 1


def exit_with_finalizers(url: str) -> None:
    """`__del__` calls REEM at the very end: it may be refused, but it must not wait."""
    _, kvs = _following(url)
    KEPT.append(_Writes(kvs))
    say(bye=True)


def exit_from_asyncio(url: str) -> None:
    """asyncio.run ends around an interface that nobody closed, with a task that waits for updates."""

    async def main() -> None:
        interface = reem_async.RedisInterface(url)
        space = reem_async.PublishSpace(interface)
        await space["exit"].write({"n": 0, "frame": frame(0)})
        mirror = reem_async.SilentSubscriber("exit", interface)
        await mirror.listen()
        log = Log(mirror.watch(Last(10)))
        await log.updates.listen()
        KEPT.extend([interface, mirror, log, asyncio.ensure_future(log.follow())])
        await became(lambda: log.told, 5)
        await space["exit"].write({"n": 1, "frame": frame(1)})
        await became(lambda: shared_in(mirror.value()), 5)
        say(bye=bool(shared_in(mirror.value())))

    asyncio.run(main())


EXITS = [name for name in dict(globals()) if name.startswith("exit_")]


# --- row 17 ----------------------------------------------------------------------------------------

RATE = 200.0
ARRAY = 100_000


class _Soak:
    """A publisher and a subscriber, and every second a look at what they cost."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.begun = time.monotonic()
        self.calls = np.zeros((int(seconds * RATE) + 100, 2))  # when it began, how long it took; made here, once
        self.count = 0
        self.failed: list[float] = []
        self.samples: list[tuple[float, float, int, int, int]] = []

    def past(self) -> float:
        return time.monotonic() - self.begun

    async def publish(self, space: reem_async.PublishSpace) -> None:
        array, number = np.zeros(ARRAY, np.uint8), 0
        while self.past() < self.seconds:
            number += 1
            await asyncio.sleep(max(0.0, number / RATE - self.past()))
            array[:] = number % 256
            begun = self.past()
            try:
                await space["soak"].write({"n": number, "array": array})
            except RedisError:
                self.failed.append(self.past() - begun)
                number = int(self.past() * RATE)
            else:
                self.calls[self.count] = begun, self.past() - begun
                self.count += 1

    async def sample(self) -> None:
        while self.past() < self.seconds:
            gc.collect()
            others, shared = descriptors()
            self.samples.append((self.past(), rss(), others, len(asyncio.all_tasks()), shared))
            await asyncio.sleep(0.5)


def soak(url: str, seconds: str) -> None:
    """Publish 100 KB 200 times a second to a subscriber, over a connection that breaks again and again."""
    asyncio.run(_soak(url, float(seconds)))


async def _soak(url: str, seconds: float) -> None:
    async with reem_async.RedisInterface(url) as publishing, reem_async.RedisInterface(url) as following:
        it = _Soak(seconds)
        space = reem_async.PublishSpace(publishing)
        mirror = reem_async.SilentSubscriber("soak", following)
        log = Log(mirror.watch(Last(1000)))
        torn: list[int] = []

        async def look() -> None:
            while True:
                value = mirror.value()
                if value is not None and set(value["array"][[0, -1]].tolist()) != {value["n"] % 256}:
                    torn.append(value["n"])
                await asyncio.sleep(0.02)

        await mirror.listen()
        await log.updates.listen()
        gc.collect()
        gc.freeze()  # else each look at the memory goes over all modules, 26 ms in which every call waits
        say(ready=True)
        async with background(log.follow(), look(), it.sample()):
            await it.publish(space)
            await became(lambda: mirror.value() is not None, 2)
        say(
            calls=it.calls[: it.count].tolist(),
            failed=it.failed,
            samples=it.samples,
            told=log.told,
            gaps=log.gaps,
            silent=log.silent,
            disordered=log.repeated + log.backward,
            torn=torn,
            shared=log.shared,
        )


# --- row 18 ----------------------------------------------------------------------------------------


def record(url: str, path: str) -> None:
    """Record until killed."""
    asyncio.run(_record(url, path))


async def _record(url: str, path: str) -> None:
    from reem_async.tools.recording import Recorder

    async with reem_async.RedisInterface(url) as interface, Recorder(interface, ["run"], path):
        say(ready=True)
        await asyncio.to_thread(heard)


def record_on_full_disk(url: str, path: str, largest: str) -> None:
    """Record beside a control loop until the file cannot grow any more, and go on with the loop."""
    limit = int(largest)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))  # a write beyond is an OSError, as on a full disk
    asyncio.run(_record_on_full_disk(url, path))


async def _record_on_full_disk(url: str, path: str) -> None:
    from reem_async.tools.recording import Recorder, RecordingFailed

    before: list[float] = []
    after: list[float] = []
    failure = ""
    async with reem_async.RedisInterface(url) as interface:
        space = reem_async.PublishSpace(interface)

        async def control(times: list[float], rounds: int) -> None:
            for number in range(rounds):
                begun = time.perf_counter()
                await space["run"].write({"n": number, "array": np.frombuffer(os.urandom(4000), np.uint8)})
                times.append(time.perf_counter() - begun)
                await asyncio.sleep(0.002)

        try:
            async with Recorder(interface, ["run"], path) as recorder:
                await control(before, 100)
                await control(after, 500)
                await recorder.wait(5)
        except RecordingFailed as error:
            failure = str(error)
        await control(after, 100)
    say(before=before, after=after, failure=failure)


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
