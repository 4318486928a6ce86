"""Slots that move under every kind of call: each is applied as a whole or not at all, and no move is broken."""

import asyncio
import collections
import contextlib
import itertools
import random
import threading
import time

import numpy as np
import pytest
from callkit import CALLS
from clusterkit import Move, assert_tidy, clients_of, raw_of, slot_of
from conftest import aeventually, assert_same, sized

import reem
import reem_async
from reem_async.errors import MissingKey, NotConnected, PartialWrite, PathRefused
from reem_async.server.cluster import EmbeddedCluster

MOVES = sized(5, 30)


@pytest.fixture(scope="module")
def cluster():
    with EmbeddedCluster(primaries=3, replicas=0) as running:
        yield running


PHASES = {
    "nothing has left": lambda _: False,
    "the document has left": lambda key: not key.startswith("{"),
    "document and registry have left": lambda key: key.endswith(":ships") or not key.startswith("{"),
    "document and note have left": lambda key: key.endswith(":last") or not key.startswith("{"),
    "the document is still here": lambda key: key.startswith("{"),
    "only arrays have left": lambda key: key.startswith("{") and not key.endswith((":ships", ":last")),
    "all has left": lambda _: True,
    "the source has been told": lambda _: True,
    "the target has been told": lambda _: True,
}
WAIT = {"the document has left", "document and registry have left", "the document is still here"}
"""In these no publisher is done: a part of what it needs is on the other node."""
GO = {"nothing has left", "all has left", "the target has been told"}
"""In these some are."""


def names_of_one_slot(first, count):
    """Return so many names of top-level keys whose slot is that of the first."""
    same = (name for name in (f"{first}{n}" for n in itertools.count()) if slot_of(name) == slot_of(first))
    return list(itertools.islice(same, count))


class Case:
    """One call to a key of its own, over an interface that knows the key."""

    def __init__(self, name, interface, space, kind):
        self.name, self.space, self.kind = name, space, kind
        self.before, self._call, self.after = CALLS[kind]
        self.reader = reem_async.KeyValueStore(interface)[name]
        self.at = getattr(reem_async, space)(interface)[name]

    async def prepare(self):
        """Write what is to be there, twice, as a program would that has run for a while."""
        await self.at.write(self.before)
        await self.at.write(self.before)

    async def make(self):
        """Make the call; what it says decides what has to be there."""
        try:
            await self._call(self.at)
            self.told, self.due = "done", self.after
        except (NotConnected, PathRefused) as error:
            self.told, self.due = type(error).__name__, self.before
        if self.told != "NotConnected":
            assert (self.told == "PathRefused") == (self.after is PathRefused), (self.kind, self.told)

    async def check(self):
        with contextlib.suppress(MissingKey):
            assert_same(await self.reader.read(), self.due, f"{self.space}: {self.kind} ({self.told})")
            return
        assert self.due is None, (self.space, self.kind, self.told)


@contextlib.asynccontextmanager
async def cases_in_one_slot(cluster, key, timeout):
    """A case for each kind of call, of a store and of a publish space, all of them on keys of one slot."""
    kinds = [(space, kind) for kind in CALLS for space in ("KeyValueStore", "PublishSpace")]
    kinds.remove(("PublishSpace", "an edit"))
    async with contextlib.AsyncExitStack() as stack:
        over = {
            kind: await stack.enter_async_context(reem_async.RedisInterface(cluster, timeout=timeout)) for kind in CALLS
        }
        names = names_of_one_slot(key(), len(kinds))
        yield [Case(name, over[kind], space, kind) for name, (space, kind) in zip(names, kinds, strict=True)]


FIRST = [
    "nothing has left",
    "the document has left",
    "only arrays have left",
    "all has left",
    "the target has been told",
]


@pytest.mark.parametrize(
    "phase", [*FIRST, *(pytest.param(p, marks=pytest.mark.long) for p in PHASES if p not in FIRST)]
)
async def test_a_call_to_a_slot_on_its_way_is_whole_or_refused(cluster, key, phase):
    """Nothing is on both nodes, the rest can be moved, and then there is what the call said, and nothing else."""
    async with cases_in_one_slot(cluster, key, 0.3) as cases:
        names = [case.name for case in cases]
        await asyncio.gather(*(case.prepare() for case in cases))
        move = Move(cluster, names[0]).begin()
        for moved in filter(PHASES[phase], move.all_keys()):
            move.take(moved)
        if phase.endswith("been told"):
            move.tell(move.source if phase.startswith("the source") else move.target)
        await asyncio.gather(*(case.make() for case in cases))
        assert not move.on_both()
        move.finish()
        for case in cases:
            await case.check()
        with clients_of(cluster.nodes) as clients:
            assert_tidy(clients, *names)
        told = collections.Counter((case.space, case.told) for case in cases)
        assert not (phase in WAIT and told["PublishSpace", "done"]), told
        assert told["PublishSpace", "done"] or phase not in GO, told


def moved(cluster, key, chance):
    """Move the slot: key by key in any order, or in batches as redis-cli does it, the nodes told in either order."""
    move = Move(cluster, key).begin()
    batch, pause = chance.choice([1, 3, 10]), chance.choice([0, 0.002, 0.01])
    while keys := move.all_keys():
        chance.shuffle(keys)
        with raw_of(move.source) as client:
            client.execute_command("MIGRATE", "127.0.0.1", move.target.port, "", 0, 5000, "KEYS", *keys[:batch])
        time.sleep(chance.random() * pause)
    move.finish(source_first=chance.random() < 0.5)


async def test_a_slot_that_moves_under_load_leaves_every_call_whole(cluster, key):
    """What the calls said is what is there, mirrors are equal, and nothing is left that nobody refers to."""
    chance, stopping, told = random.Random(1), threading.Event(), collections.Counter()

    async def work(case):
        while not stopping.is_set():
            with contextlib.suppress(NotConnected):
                await case.prepare()
                await case.make()
                await case.check()
                told[case.told] += 1

    def count(name):
        """Count, in the blocking front; what is refused was not applied."""
        with reem.RedisInterface(cluster, timeout=5) as interface:
            kvs, space, number = reem.KeyValueStore(interface), reem.PublishSpace(interface), 0
            space[name] = {"n": 0, "l": [np.zeros(2)]}
            while not stopping.is_set():
                with contextlib.suppress(NotConnected):
                    space[name]["l"][0] = np.full(2, number)
                    space[name]["n"] += 1
                    number += 1
            assert kvs[name]["n"].read() == number > MOVES

    async with cases_in_one_slot(cluster, key, 5) as cases, reem_async.RedisInterface(cluster) as interface:
        names = [*(case.name for case in cases), names_of_one_slot(key(), len(cases) + 1)[-1]]
        mirror = reem_async.SilentSubscriber(names[-1], interface)
        await mirror.listen()
        tasks = [asyncio.create_task(work(case)) for case in cases]
        tasks.append(asyncio.create_task(asyncio.to_thread(count, names[-1])))
        try:
            for _ in range(MOVES):
                await asyncio.to_thread(moved, cluster, names[0], chance)
        finally:
            stopping.set()
            await asyncio.gather(*tasks)
        truth = await reem_async.KeyValueStore(interface)[names[-1]].read()
        await aeventually(lambda: mirror.value()["n"] == truth["n"])
        assert_same(mirror.value(), truth)
        with clients_of(cluster.nodes) as clients:
            assert_tidy(clients, *names)
    assert told["done"] > 20 * MOVES, told


async def test_a_registry_that_has_not_gone_yet_is_not_taken_for_missing(cluster):
    """The document has gone ahead of its array, which the interface that replaces it does not know of."""
    async with reem_async.RedisInterface(cluster) as one, reem_async.RedisInterface(cluster, timeout=0.3) as two:
        await reem_async.KeyValueStore(one)["cam"].write({"n": 1, "image": np.arange(5)})
        cam = reem_async.KeyValueStore(two)["cam"]
        await reem_async.KeyValueStore(two)["warm"].write(1)
        move = Move(cluster, "cam").begin()
        move.take("cam")
        with pytest.raises(PartialWrite, match="arrays that nothing refers to could not be removed"):
            await cam.write({"n": 2})
        move.finish()
        assert await cam.read() == {"n": 2}
        await cam.write({"n": 3})
        with raw_of(move.target) as client:
            assert not client.exists("{cam}.image")
