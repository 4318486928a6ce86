"""Programs that rows run as processes of their own: `python -m tests.chaos.programs NAME ARGUMENTS`.

They say what they found as lines of JSON on stdout.
"""

from __future__ import annotations

import asyncio
import gc
import os
import resource
import sys
import time

import numpy as np
from redis.exceptions import RedisError

import reem_async
from reem_async.concurrency.queues import Last

from .tools import Log, background, became, descriptors, heard, rss, say

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
