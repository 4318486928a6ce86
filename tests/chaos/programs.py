"""Programs that rows run as processes of their own: `python -m tests.chaos.programs NAME ARGUMENTS`.

They say what they found as lines of JSON on stdout.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import gc
import os
import resource
import sys
import time
import zlib
from typing import Any

import numpy as np
from slotkit import in_slot, resident

import reem
import reem_async
from reem_async.concurrency.queues import Last

from .tools import Log, background, became, descriptors, heard, rss, say

SIZE = 100_000
"""Bytes of an image."""
_SOURCE = np.random.default_rng(31).integers(0, 256, 4 * SIZE, np.uint8)


def shot(n: int) -> dict[str, Any]:
    """An image that can be told from the others, and from a torn one."""
    start = n * 64 % (3 * SIZE)
    image = _SOURCE[start : start + SIZE]
    return {"n": n, "image": image, "sum": zlib.crc32(image)}


def is_whole(data: Any) -> bool:
    """Whether an image is that of its checksum."""
    return zlib.crc32(data["image"]) == data["sum"]


def segments() -> float:
    """The megabytes of shared memory that this process has descriptors of."""
    sizes: dict[int, int] = {}
    for entry in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            if os.readlink(f"/proc/self/fd/{entry}").startswith("/memfd:reem"):
                found = os.stat(f"/proc/self/fd/{entry}")
                sizes[found.st_ino] = found.st_size
    return sum(sizes.values()) / 2**20


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
                disordered=[repr(it) for it in log.repeated + log.backward],
            )


# --- row 22 ----------------------------------------------------------------------------------------


def camera(url: str, rate: str) -> None:
    """Publish images, and say what that has cost from the one on whose number is given."""
    asyncio.run(_camera(url, float(rate)))


async def _camera(url: str, rate: float) -> None:
    calls: list[float] = []
    published = 0

    async def publish(space: reem_async.PublishSpace) -> None:
        nonlocal published
        begun = time.monotonic()
        while True:
            value, called = shot(published), time.monotonic()
            await space["cam"].write(value)
            calls.append(time.monotonic() - called)
            published += 1
            await asyncio.sleep(max(0.0, begun + published / rate - time.monotonic()))

    async with reem_async.RedisInterface(url) as interface:
        say(ready=True)
        await asyncio.to_thread(heard)  # all are listening
        async with background(publish(reem_async.PublishSpace(interface))):
            while word := await asyncio.to_thread(heard):
                say(published=published, calls=calls[int(word) :], memory=resident(), segments=segments())


def reader(url: str, most: str) -> None:
    """Keep the newest images, so many, and say how they are."""
    kept: collections.deque[Any] = collections.deque(maxlen=int(most))
    told = shared = torn = 0

    def see(data: Any, updated_path: str) -> None:
        nonlocal told, shared, torn
        told += 1
        shared += in_slot(data["image"])
        torn += not is_whole(data)
        if len(kept) == kept.maxlen:
            torn += not is_whole(kept[0])  # before it is let go
        kept.append(data)

    with reem.RedisInterface(url) as interface:
        calls = reem.CallbackSubscriber("cam", interface, see)
        calls.listen()
        say(ready=True)
        while heard():
            images = list(kept)
            say(
                told=told,
                shared=shared,
                torn=torn + sum(not is_whole(each) for each in images),
                kept=len(images),
                views=sum(in_slot(each["image"]) for each in images),
                newest=images[-1]["n"] if images else -1,
            )
            del images


# --- row 23 ----------------------------------------------------------------------------------------


def victims(url: str) -> None:
    """Follow `cam` in every way, and say when all have an update whose number is given."""
    asyncio.run(_victims(url))


async def _victims(url: str) -> None:
    called: list[Any] = [None]

    def see(data: Any, updated_path: str) -> None:
        called[0] = data

    async with reem_async.RedisInterface(url) as interface, reem_async.KeyValueStore(interface)["cam"].mirror() as copy:
        with contextlib.closing(reem.RedisInterface(url)) as blocking:
            mirror = reem_async.SilentSubscriber("cam", interface)
            await mirror.listen()
            calls = reem.CallbackSubscriber("cam", blocking, see)
            await asyncio.to_thread(calls.listen)

            def values(n: int) -> list[Any]:
                found = [mirror.value(), copy.value(), called[0]]
                return [value for value in found if isinstance(value, dict) and value.get("n") == n]

            say(ready=True, pid=os.getpid())
            while word := await asyncio.to_thread(heard):
                n = int(word)
                took = await became(lambda n=n: len(values(n)) == 3, 10)
                found = values(n)
                gc.collect()
                say(
                    took=took,
                    wrong=[str(value)[:200] for value in found if not is_whole(value)],
                    shared=sum(in_slot(value["image"]) for value in found),
                    descriptors=descriptors(),
                    memory=resident(),
                )
                del found


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
