"""A writer, a counter, a reader and followers at work, and what must hold of them whatever happens to the servers."""

import asyncio
import contextlib
import itertools

import numpy as np

import reem_async
from reem_async.errors import ConnectionLost, NotConnected

LOST = 100
"""Increments that a primary may not have sent to its replica when it was killed."""


def is_whole(value):
    return (value["image"] == value["n"]).all()


@contextlib.asynccontextmanager
async def load(host, name):
    """Work on a key, and a counter beside it, while the block runs; then compare everything with the truth.

    Yields the updates that came with a gap.
    """
    counter, counted, uncounted, done, gaps, told = f"{name}:count", 0, 0, 0, [], []
    async with reem_async.RedisInterface(host) as writing, reem_async.RedisInterface(host) as following:
        space, kvs = reem_async.PublishSpace(writing), reem_async.KeyValueStore(following)

        async def write():
            nonlocal done
            for number in itertools.count(1):
                with contextlib.suppress(NotConnected, ConnectionLost):
                    value = {"n": number, "image": np.full(300, float(number)), "s": number}
                    await (space[name].write(value) if number % 3 else space[name]["s"].write(number))
                    done += 1
                await asyncio.sleep(0.002)

        async def count():
            nonlocal counted, uncounted
            while True:
                try:
                    await kvs[counter].increment(1)
                    counted += 1
                except ConnectionLost:
                    uncounted += 1
                except NotConnected:
                    pass
                await asyncio.sleep(0.001)

        async def read():
            while True:
                with contextlib.suppress(NotConnected, ConnectionLost):
                    assert is_whole(await kvs[name].read())
                await asyncio.sleep(0.001)

        async def watch(updates):
            last = None
            async for update in updates:
                assert is_whole(update.data)
                gaps.extend([update] if update.gap else [])
                assert update.gap or None in (last, update.sequence) or update.sequence == last + 1
                last = update.sequence
                told.append(update.data)

        await kvs[counter].write(0)
        await space[name].write({"n": 0, "image": np.zeros(300), "s": 0})
        async with (
            reem_async.SilentSubscriber(name, following) as mirror,
            kvs[name].watch(reem_async.Every(100_000)) as updates,
        ):
            watching = asyncio.create_task(watch(updates))
            working = [asyncio.create_task(work()) for work in (write, count, read)]
            yield gaps
            async with asyncio.timeout(5):
                before = done
                while done < before + 5:
                    await asyncio.sleep(0.005)
            for task in working:
                assert not task.done(), task.exception()
                task.cancel()
            await asyncio.wait(working)
            truth = await kvs[name].read()
            async with asyncio.timeout(5):
                while not all(
                    value["s"] == truth["s"] and value["n"] == truth["n"] for value in (mirror.value(), told[-1])
                ):
                    assert not watching.done(), watching.exception()
                    await asyncio.sleep(0.005)
            watching.cancel()
            assert is_whole(mirror.value())
            assert counted - LOST <= await kvs[counter].read() <= counted + uncounted + 1
