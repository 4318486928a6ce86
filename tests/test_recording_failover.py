"""Recording what is only stored while servers fail over and slots move: it goes on, and ends with what is there.

Who stores does not tell anybody, so whatever breaks the connection that the server's word comes on must have all that
is recorded read anew, and touched anew at the server that has it now.
"""

import asyncio
import contextlib
import itertools
import os
import signal

import numpy as np
import pytest
from clusterkit import Move, kill_primary, owner, whole_again
from conftest import aeventually, assert_same, eventually
from test_recording_stored import is_followed, news, recording

import reem_async
from reem_async.errors import ConnectionLost, MissingKey, NotConnected, PathRefused
from reem_async.server.cluster import EmbeddedCluster
from reem_async.tools.recording import open_log

FRAME = np.arange(60 * 80 * 3, dtype=np.uint32).astype(np.uint8).reshape(60, 80, 3)
NAMES = [f"k{number}" for number in range(6)]


@pytest.fixture(scope="module")
def cluster():
    with EmbeddedCluster(node_timeout=0.5) as running:
        yield running


class Storing:
    """Stores all the time, in all keys, whatever becomes of it.

    Attributes:
        done: Rounds in which every call was reported as done.
    """

    def __init__(self, kvs):
        self.done = 0
        self._kvs = kvs

    @contextlib.asynccontextmanager
    async def running(self):
        stopping = asyncio.Event()
        task = asyncio.create_task(self._run(stopping))
        yield
        done = self.done
        await aeventually(lambda: self.done > done + 3 or task.done())
        stopping.set()
        await task

    async def _run(self, stopping):
        for number in itertools.count():
            if stopping.is_set():
                return
            with contextlib.suppress(NotConnected, ConnectionLost):
                for place, name in enumerate(NAMES):
                    await self._store(self._kvs[name], number + place)
                self.done += 1
            await asyncio.sleep(0.01)

    async def _store(self, handle, number):
        if number % 7 == 6:
            with contextlib.suppress(MissingKey):
                await handle.delete()
        elif number % 3 == 0:
            await handle.write({"n": number, "a": FRAME + np.uint8(number), "extra": {}})
        else:
            with contextlib.suppress(MissingKey, PathRefused):  # it is gone
                await handle["n"].write(number)
                await handle["extra"].delete()


async def truth_of(kvs):
    return {name: await kvs[name].read() for name in NAMES if await kvs.contains(name)}


def outlined(trees):
    """What is recorded by now or read, without arrays: the writing thread has other things in their places."""
    return {name: {key: tree[key] for key in sorted(tree.keys() - {"a"})} for name, tree in trees.items()}


async def check(url, patterns, file, disturb):
    async with reem_async.RedisInterface(url) as one, reem_async.RedisInterface(url) as two:
        kvs, storing = reem_async.KeyValueStore(one), None
        for name in NAMES:
            await kvs[name].write({"n": 0, "a": FRAME})
        async with recording(two, patterns, file) as recorder:
            for name in NAMES:
                await kvs[name]["n"].write(-1)
                await recorder.written(name)
            storing = Storing(kvs)
            async with storing.running():
                await disturb()
                await aeventually(lambda: recorder.status.gaps)
            truth = outlined(await truth_of(kvs))

            def recorded():
                trees = recorder.writer_thread._trees
                return outlined({name: tree for name, tree in trees.items() if type(tree) is dict})

            await aeventually(lambda: recorded() == truth)
            await aeventually(lambda: all(is_followed(recorder, name) for name in NAMES))
            recorder.writer_thread.stored.ever.clear()
            for number, name in enumerate(NAMES):
                await kvs[name].write({"n": f"after {number}", "a": FRAME + np.uint8(number)})
                await recorder.written(name)
            await kvs[NAMES[0]]["a"].write(FRAME + np.uint8(99))
            await recorder.written(NAMES[0])
            await kvs[NAMES[1]].delete()
            await recorder.written(NAMES[1])
            truth = await truth_of(kvs)
        with open_log(file) as log:
            assert_same(log.value_at("", log.end), truth)
        for number, name in enumerate(NAMES):  # the whole, or its number alone
            told = [
                (kind, value["n"] if path == name else value)
                for path, kind, value in news(file, name)
                if value is not True and path in (name, f"{name}.n")
            ]
            assert ("stored", f"after {number}") in told
        for name in NAMES:
            with contextlib.suppress(MissingKey):
                await kvs[name].delete()


PATTERNS = pytest.mark.parametrize(
    "patterns",
    [["*"], pytest.param(NAMES, marks=pytest.mark.long), pytest.param(["k0", "k?"], marks=pytest.mark.long)],
    ids=["all", "names", "a name and a glob"],
)


@PATTERNS
async def test_a_slot_that_moves(cluster, file, patterns):
    async def moved():
        move = await asyncio.to_thread(lambda: Move(cluster, NAMES[-1]).begin())
        while keys := await asyncio.to_thread(move.all_keys):
            await asyncio.to_thread(move.take, keys[0])
            await asyncio.sleep(0.01)
        await asyncio.to_thread(move.finish)

    await check(cluster, patterns, file, moved)


@PATTERNS
async def test_a_primary_of_a_cluster_that_is_killed(file, patterns):
    """Not the one of the first key."""
    with EmbeddedCluster(node_timeout=0.5) as cluster:

        async def killed():
            key = next(name for name in reversed(NAMES) if owner(cluster, name) is not owner(cluster, NAMES[0]))
            victim = kill_primary(cluster, key)
            await asyncio.to_thread(whole_again, cluster, victim)

        await check(cluster, patterns, file, killed)


@pytest.mark.long
@pytest.mark.parametrize("kill", [False, True], ids=["switched", "killed"])
async def test_a_primary_that_sentinels_replace(watched, file, kill):
    await asyncio.to_thread(watched.settle)

    async def replaced():
        old = await asyncio.to_thread(watched.primary)
        if kill:
            os.kill(watched.pid(old), signal.SIGKILL)
        else:
            watched.sentinels[0].execute_command("SENTINEL", "FAILOVER", "mymaster")
        await asyncio.to_thread(eventually, lambda: watched.primary() != old)

    await check(watched.url, ["*"], file, replaced)
