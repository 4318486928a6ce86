"""Programs at work on one key while its slot moves, each with its own part of the document and a model of it.

A call that returns has changed the server as it changes the model; one that says that nothing was applied has not. So
at the end the server has to hold what the models say, to the last bit.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import threading
import time

import numpy as np
import redis
from clusterkit import Move, assert_tidy, clients_of
from conftest import aeventually, assert_same

import reem
import reem_async
from reem_async.errors import Contended, NotConnected

KEY = "alpha"
SHAPES = [(3,), (10, 2), (0,), (50, 50), (100, 100)]
"""float64: the last is large enough to be sent ahead of its transaction."""


class Worker:
    """One program, which works on one part of the document.

    Args:
        space: Where to write: `space[KEY]`.
        part: Its name in the document.
        seed: Of what it does.

    Attributes:
        model: What has to be there.
        done, refused: Calls that returned, and calls that said that nothing was applied.
    """

    published = True
    start: object = 0

    def __init__(self, space, part, seed):
        self.at = space[KEY][part]
        self.part = part
        self.random = random.Random(f"{part} {seed}")
        self.model = self.start
        self.done = self.refused = 0

    async def run(self, stopping):
        """Work until `stopping` is set. Whatever a call raises but that nothing was applied is a defect."""
        while not stopping.is_set():
            try:
                after = await self.step()
            except (Contended, NotConnected):
                self.refused += 1
            else:
                self.model = after
                self.done += 1
            await asyncio.sleep(self.random.random() * 0.006)

    async def step(self):
        raise NotImplementedError

    def array(self):
        return np.full(self.random.choice(SHAPES), self.random.random())


class Counts(Worker):
    async def step(self):
        await self.at.increment(1)
        return self.model + 1


class Calculates(Worker):
    start = 0.1

    async def step(self):
        if self.random.random() < 0.7:
            return await self.at.increment(0.1)
        return await self.at.divide(3)


class Films(Worker):
    """Writes arrays of other shapes each time, and the number beside them."""

    start = {"image": np.zeros(3), "n": 0}  # noqa: RUF012

    async def step(self):
        after = {"image": self.array(), "n": self.model["n"] + 1}
        await self.at.write(after)
        return after


class Lists(Worker):
    """Replaces, appends and deletes items of a list, with arrays and without."""

    start = [np.zeros(3), 1, {"a": np.ones(2)}]  # noqa: RUF012

    async def step(self):
        what = self.random.choice(["replace", "replace", "append", "append", "delete", "extend"])
        item = self.random.choice([self.array(), 7, {"a": self.array()}])
        here = self.random.randrange(len(self.model)) if self.model else 0
        if what == "extend" and len(self.model) < 12:
            await self.at.extend([item, 8])
            return [*self.model, item, 8]
        if what == "append" or not self.model:
            await self.at.append(item)
            return [*self.model, item]
        if what == "replace":
            await self.at[here].write(item)
            return [*self.model[:here], item, *self.model[here + 1 :]]
        await self.at[here].delete()
        return [*self.model[:here], *self.model[here + 1 :]]


class Comes(Worker):
    """Is written with arrays, or as something plain, and deleted."""

    start = None

    async def step(self):
        if isinstance(self.model, dict) and self.random.random() < 0.4:
            await self.at["x"].delete()
            self.model = {}  # should the rest be refused, this is what stays
            await self.at.write(None)
            return None
        after = self.random.choice([{"x": self.array()}, {"x": 1}, {"x": [self.array(), self.array()]}])
        await self.at.write(after)
        return after


class Edits(Worker):
    published = False
    start = {"n": 0, "image": np.zeros(4), "l": [np.zeros(1)]}  # noqa: RUF012

    async def step(self):
        async with self.at.edit() as value:
            value["n"] += 1
            value["image"] = self.array()
            value["l"][0] = value["l"][0] + 1
        return value


class StoresLists(Lists):
    published = False


class Stores(Comes):
    published = False


KINDS = {
    "count": Counts, "float": Calculates, "film": Films, "list": Lists, "comes": Comes, "edit": Edits,
    "stored": Stores, "items": StoresLists,
}  # fmt: skip


class Blocking:
    """A program of the blocking front, on a thread: counts, and writes an item of a list."""

    def __init__(self, host, stopping):
        self.model = {"n": 0, "l": [np.zeros(2)]}
        self.done = self.refused = 0
        self._host, self._stopping = host, stopping

    def run(self):
        with reem.RedisInterface(self._host, timeout=2) as interface:
            at = reem.PublishSpace(interface)[KEY]["thread"]
            while not self._stopping.is_set():
                for call in (self._count, self._replace):
                    try:
                        call(at)
                        self.done += 1
                    except (Contended, NotConnected):
                        self.refused += 1
                    time.sleep(0.004)

    def _count(self, at):
        at["n"].increment(1)
        self.model["n"] += 1

    def _replace(self, at):
        item = np.full(2, float(self.done))
        at["l"][0] = item
        self.model["l"] = [item]


def moved(cluster, chance):
    """Move the slot: key by key in any order, or in batches as redis-cli does it, the nodes told in either order."""
    move = Move(cluster, KEY).begin()
    batch, pause = chance.choice([1, 1, 3, 10]), chance.choice([0, 0.002, 0.01])
    while keys := move.all_keys():
        chance.shuffle(keys)
        if batch == 1:
            move.take(keys[0])
        else:
            with redis.Redis(port=move.source.port) as client:
                words = ("127.0.0.1", move.target.port, "", 0, 5000, "KEYS", *keys[:batch])
                client.execute_command("MIGRATE", *words)
        time.sleep(chance.random() * pause)
    time.sleep(chance.random() * pause)
    move.finish(source_first=chance.random() < 0.5)


async def load(cluster, moves, seed):
    """Work while the slot moves so many times; check everything; return the calls done and refused."""
    chance, stopping = random.Random(seed), threading.Event()
    async with contextlib.AsyncExitStack() as stack:
        interfaces = [await stack.enter_async_context(reem_async.RedisInterface(cluster, timeout=2)) for _ in range(3)]
        spaces = reem_async.PublishSpace(interfaces[0]), reem_async.KeyValueStore(interfaces[1])
        workers = [kind(spaces[not kind.published], part, seed) for part, kind in KINDS.items()]
        thread = Blocking(cluster, stopping)
        start = {each.part: each.model for each in workers} | {"thread": thread.model}
        await spaces[0][KEY].write(start)
        mirror = await stack.enter_async_context(reem_async.SilentSubscriber(KEY, interfaces[2]))
        tasks = [asyncio.create_task(each.run(stopping)) for each in workers]
        tasks.append(asyncio.create_task(asyncio.to_thread(thread.run)))
        try:
            for _ in range(moves):
                await asyncio.to_thread(moved, cluster, chance)
                await asyncio.sleep(chance.random() * 0.1)
        finally:
            stopping.set()
            await asyncio.gather(*tasks)
        truth = await reem_async.KeyValueStore(interfaces[2])[KEY].read()
        for each in workers:
            assert_same(truth[each.part], each.model, each.part)
        assert_same(truth["thread"], thread.model, "thread")
        told = [each.part for each in workers if each.published] + ["thread"]
        await aeventually(lambda: all(_is_same(mirror.value()[part], truth[part]) for part in told))
        with clients_of(cluster.nodes) as clients:
            assert_tidy(clients, KEY)
        return sum(each.done for each in [*workers, thread]), sum(each.refused for each in [*workers, thread])


def _is_same(one, other):
    with contextlib.suppress(AssertionError):
        assert_same(one, other)
        return True
    return False
