"""A writer, a reader, a counter and mirrors at work, and what must hold of them whatever happens to the servers."""

import asyncio
import contextlib
import threading
import time

import numpy as np

import reem
import reem_async
from reem_async.errors import ConnectionLost, NotConnected


class Load:
    """Work on one top-level key, and a counter beside it, over three interfaces of their own.

    Args:
        host: Where.
        name: The key; the counter's gets an ending.
        failover: A primary will be lost, and with it what it had not sent to its replica yet.

    Attributes:
        done: Writes that were reported as done.
        refused: Calls that were refused: nothing was applied.
        unknown: Calls that were applied once or not at all.
        counted, uncounted: Increments reported as done, and those whose outcome is unknown.
        torn: Reads and updates whose array does not fit the number beside it.
        unflagged: Updates that came after a lost one and did not say so.
        gaps: Updates that did.
    """

    def __init__(self, host, name, *, failover=False):
        self._may_be_lost = 100 if failover else 0
        self.host, self.name, self.counter = host, name, f"{name}:count"
        self.done = self.refused = self.unknown = self.counted = self.uncounted = 0
        self.reads = self.torn = self.unflagged = self.gaps = 0
        self.stopping = threading.Event()
        self._last = {}
        self._latest = None

    @contextlib.asynccontextmanager
    async def running(self):
        """Work while the block runs, then stop, and compare everything with the truth."""
        async with (
            reem_async.RedisInterface(self.host) as writing,
            reem_async.RedisInterface(self.host) as following,
        ):
            space, kvs = reem_async.PublishSpace(writing), reem_async.KeyValueStore(following)
            await reem_async.KeyValueStore(writing)[self.counter].write(0)
            await space[self.name].write({"n": 0, "image": np.zeros(300), "s": 0})
            mirror = reem_async.SilentSubscriber(self.name, following)
            await mirror.listen()
            updates = kvs[self.name].watch(reem_async.Every(100_000))
            await updates.listen()
            thread = asyncio.create_task(asyncio.to_thread(self._count))
            watching = asyncio.create_task(self._watch(updates))
            tasks = [asyncio.create_task(self._write(space)), asyncio.create_task(self._read(kvs)), thread]
            try:
                yield self
                done = self.done
                async with asyncio.timeout(5):
                    while self.done < done + 5:
                        await asyncio.sleep(0.005)
            finally:
                self.stopping.set()
                await asyncio.gather(*tasks)
            truth = await kvs[self.name].read()
            async with asyncio.timeout(5):
                while not (_same(mirror.value(), truth) and _same(self._latest, truth)):
                    await asyncio.sleep(0.005)
            watching.cancel()
            count = await kvs[self.counter].read()
            assert self.counted - self._may_be_lost <= count <= self.counted + self.uncounted, (
                count,
                self.counted,
                self.uncounted,
            )
            assert (self.torn, self.unflagged) == (0, 0)

    async def _write(self, space):
        number = 0
        while not self.stopping.is_set():
            number += 1
            try:
                if number % 3:
                    await space[self.name].write({"n": number, "image": np.full(300, float(number)), "s": number})
                else:
                    await space[self.name]["s"].write(number)
                self.done += 1
            except NotConnected:
                self.refused += 1
            except ConnectionLost:
                self.unknown += 1
            await asyncio.sleep(0.002)

    async def _read(self, kvs):
        while not self.stopping.is_set():
            with contextlib.suppress(NotConnected, ConnectionLost):
                self._look(await kvs[self.name].read())
                self.reads += 1
            await asyncio.sleep(0.001)

    async def _watch(self, updates):
        async for update in updates:
            self.gaps += update.gap
            self._look(update.data)
            self._latest = update.data
            if update.sequence is not None:
                last = self._last.get(update.publisher)
                self.unflagged += last is not None and update.sequence > last + 1 and not update.gap
                self._last[update.publisher] = update.sequence
            else:  # a snapshot: what it holds is not numbered
                self._last.clear()

    def _look(self, value):
        self.torn += not (value["image"] == value["n"]).all()

    def _count(self):
        with contextlib.closing(reem.RedisInterface(self.host)) as interface:
            kvs = reem.KeyValueStore(interface)
            while not self.stopping.is_set():
                try:
                    kvs[self.counter] += 1
                    self.counted += 1
                except NotConnected:
                    self.refused += 1
                except ConnectionLost:
                    self.uncounted += 1
                time.sleep(0.001)


def _same(one, other):
    return one["n"] == other["n"] and one["s"] == other["s"] and (one["image"] == other["image"]).all()
