"""Slots that move under every kind of call: each is applied as a whole or not at all, and no move is broken.

REEM_SLOT_MOVES=100 makes as many moves under load, REEM_SLOT_SEED=n other ones.
"""

import asyncio
import collections
import contextlib
import itertools
import os

import numpy as np
import pytest
from callkit import CALLS
from clusterkit import Move, assert_tidy, clients_of, raw_of, slot_of
from conftest import assert_same
from slotload import load

import reem_async
from reem_async.errors import MissingKey, NotConnected, PartialWrite, PathRefused
from reem_async.server.cluster import EmbeddedCluster

MOVES = int(os.environ.get("REEM_SLOT_MOVES", "5"))
SEED = int(os.environ.get("REEM_SLOT_SEED", "1"))


@pytest.fixture(scope="module")
def cluster():
    with EmbeddedCluster(primaries=3, replicas=0) as running:
        yield running


async def test_a_slot_that_moves_under_load_leaves_every_call_whole(cluster):
    """What the calls said is what is there, mirrors are equal, and nothing is left that nobody refers to."""
    done, refused = await load(cluster, MOVES, SEED)
    print(f"{MOVES} moves: {done} calls done, {refused} refused")
    assert done > 20 * MOVES


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
    kinds = [(space, kind) for kind in CALLS for space in ("KeyValueStore", "PublishSpace")]
    kinds.remove(("PublishSpace", "an edit"))
    names = names_of_one_slot(key(), len(kinds))
    async with contextlib.AsyncExitStack() as stack:
        over = {
            kind: await stack.enter_async_context(reem_async.RedisInterface(cluster, timeout=0.3)) for kind in CALLS
        }
        cases = [Case(name, over[kind], space, kind) for name, (space, kind) in zip(names, kinds, strict=True)]
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


@pytest.mark.parametrize("json", [True, False], ids=["json", "plain"])
async def test_a_registry_that_has_not_gone_yet_is_not_taken_for_missing(json):
    """The document has gone ahead of its array, which the interface that replaces it does not know of."""
    with EmbeddedCluster(primaries=3, replicas=0, json=json) as own:
        async with reem_async.RedisInterface(own) as one, reem_async.RedisInterface(own, timeout=0.3) as two:
            await reem_async.KeyValueStore(one)["cam"].write({"n": 1, "image": np.arange(5)})
            cam = reem_async.KeyValueStore(two)["cam"]
            await reem_async.KeyValueStore(two)["warm"].write(1)
            move = Move(own, "cam").begin()
            move.take("cam")
            with pytest.raises(PartialWrite, match="arrays that nothing refers to could not be removed"):
                await cam.write({"n": 2})
            move.finish()
            assert await cam.read() == {"n": 2}
            await cam.write({"n": 3})
            with raw_of(move.target) as client:
                assert not client.exists("{cam}.image")
