"""What looks at all keys, or waits for all nodes, reaches every node of a cluster, or says that it did not."""

import asyncio
import os
import signal

import pytest
import redis
from clusterkit import Move, on_each_node, owner
from conftest import aeventually
from own_servers import liar
from test_reorder import hearing

import reem_async
from reem_async.errors import ClusterNode, NotConnected
from reem_async.store.catalog import names
from reem_async.tools.recording import Recorder
from reem_async.tools.snapshots import RdbUnavailable, portable, restore, save, save_rdb


@pytest.fixture
async def fleet(cluster, key):
    """An interface to a cluster with some keys on each node, in a namespace of its own."""
    async with reem_async.RedisInterface(cluster, namespace=key("/")) as interface:
        store = reem_async.KeyValueStore(interface)
        for number in range(30):
            await store[f"key{number}"].write({"n": number})
        assert len({owner(cluster, key(f"/key{number}")).port for number in range(30)}) == 3
        yield interface


def leave_nothing_to_expire(cluster):
    """Remove what other tests have left to expire: the servers count it until then."""
    for node in cluster.nodes:
        with redis.Redis(port=node.port) as client:
            for each in client.scan_iter():
                if client.ttl(each) >= 0:
                    client.unlink(each)


ALL = {f"key{number}" for number in range(30)}


async def test_a_snapshot_of_a_cluster_holds_the_keys_of_all_nodes(fleet, key, tmp_path):
    saved = await save(fleet, tmp_path / "all.zip")
    assert ({each.name for each in saved.keys}, saved.doubt) == (ALL, "")
    for name in ALL:
        await reem_async.KeyValueStore(fleet)[name].delete()
    assert set((await restore(fleet, tmp_path / "all.zip")).names) == ALL
    assert {name async for name in names(fleet)} == ALL


async def test_a_key_that_moves_behind_the_look_is_found_by_the_next(cluster, fleet, key, tmp_path, monkeypatch):
    """From a node that was not looked at yet to one that was: neither names it."""
    ports = [node.options.settings["port"] for node in await fleet.session.transport.nodes()]
    first, last = (next(node for node in cluster.nodes if node.port == port) for port in (ports[0], ports[-1]))
    moving = next(name for name in sorted(ALL) if owner(cluster, key(f"/{name}")) is last)
    moves = [Move(cluster, key(f"/{moving}"), first)]
    looked = portable.scanned

    async def scanned(transport):
        async for page in looked(transport):
            yield page
            if moves:
                await asyncio.to_thread(moves.pop().begin().finish)

    monkeypatch.setattr(portable, "scanned", scanned)
    saved = await save(fleet, tmp_path / "all.zip")
    assert ({each.name for each in saved.keys}, saved.doubt) == (ALL, "")


async def test_a_count_that_goes_on_growing_is_told(cluster, fleet, key, tmp_path, monkeypatch):
    counted = portable.counted
    number = iter(range(1000))

    async def growing(*where):
        await reem_async.KeyValueStore(fleet)[f"new{next(number)}"].write(1)
        return await counted(*where)

    leave_nothing_to_expire(cluster)
    monkeypatch.setattr(portable, "counted", growing)
    saved = await save(fleet, tmp_path / "all.zip")
    assert {each.name for each in saved.keys} >= ALL
    assert saved.doubt == "the server counts 1 Redis keys more than it named: new ones, or missed"


async def test_a_missed_key_is_told_though_others_were_deleted_since_the_first_look(
    cluster, fleet, key, tmp_path, monkeypatch
):
    leave_nothing_to_expire(cluster)
    missed, looked, looks = key("/key0").encode(), portable.scanned, []

    async def scanned(transport):
        looks.append(transport)
        if len(looks) == 2:
            await reem_async.KeyValueStore(fleet)["key1"].delete()
        async for page in looked(transport):
            yield [each for each in page if bytes(each) != missed]

    monkeypatch.setattr(portable, "scanned", scanned)
    saved = await save(fleet, tmp_path / "all.zip")
    assert saved.doubt == "the server counts 1 Redis keys more than it named: new ones, or missed"


async def test_one_node_of_several_is_not_taken_for_all(cluster, fleet, key, tmp_path):
    """Whatever slot the first question goes to: some nodes answer that."""
    for node in cluster.nodes:
        alone = reem_async.RedisInterface(f"redis://127.0.0.1:{node.port}")
        with pytest.raises(ClusterNode, match=r"redis\+cluster://"):
            await save(alone, tmp_path / "part.zip")
        with pytest.raises(ClusterNode, match=r"redis\+cluster://"):
            await anext(names(alone))
        await alone.close()
    assert not list(tmp_path.iterdir())


async def test_slots_without_a_node_are_told():
    def answer(words):
        if [word.upper() for word in words] == [b"CLUSTER", b"SLOTS"]:
            host, _, port = url.removeprefix("redis://").partition(":")
            return f"*1\r\n*3\r\n:0\r\n:16000\r\n*2\r\n${len(host)}\r\n{host}\r\n:{port}\r\n".encode()
        return b"+OK\r\n"

    with liar(answer) as url:
        interface = reem_async.RedisInterface(url.replace("redis", "redis+cluster"))
        with pytest.raises(NotConnected, match=r"383 slots of the cluster .* have no node"):
            await anext(names(interface))
        await interface.close()


async def test_there_is_no_rdb_file_of_a_cluster(fleet, tmp_path):
    with pytest.raises(RdbUnavailable, match="nodes of a cluster have an RDB file each"):
        await save_rdb(fleet, tmp_path / "all.rdb")
    assert not list(tmp_path.iterdir())


async def test_a_restored_key_that_is_new_is_heard_of_at_once(cluster, key, tmp_path):
    """By whoever looks for keys and has not found it yet."""
    async with reem_async.RedisInterface(cluster) as source:
        await reem_async.KeyValueStore(source)[key("back")].write(1)
        await save(source, tmp_path / "one.zip", key("back"))
        await reem_async.KeyValueStore(source)[key("back")].delete()
    async with (
        reem_async.RedisInterface(cluster) as interface,
        reem_async.RedisInterface(cluster) as other,
        hearing(other, key("*")) as events,
    ):
        await restore(interface, tmp_path / "one.zip", key("back"))
        await aeventually(lambda: events)
    assert [(event.name, event.sequence, event.gap) for event in events] == [(key("back"), 1, False)]


async def test_the_fence_of_a_recorder_waits_for_every_node(cluster, key, file):
    """Deletions and the end of a recording rely on it."""
    async with reem_async.RedisInterface(cluster) as interface, reem_async.RedisInterface(cluster) as other:
        space, found = reem_async.PublishSpace(interface), on_each_node(cluster, key, 1)
        for name in found:
            await space[name].write(0)
        recorder = Recorder(other, [key("*")], file)
        async with recorder:
            for node in cluster.nodes:
                os.kill(node.pid, signal.SIGSTOP)
                try:
                    fence = asyncio.create_task(recorder.fence())
                    await asyncio.sleep(0.1)
                    assert not fence.done(), "a node has not said yet what was published there"
                finally:
                    os.kill(node.pid, signal.SIGCONT)
                await asyncio.wait_for(fence, 10)
