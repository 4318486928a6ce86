"""A cluster of real servers: where things go, what is refused, and what a slot on its way does to calls."""

import asyncio
import os
import pickle

import numpy as np
import pytest
from clusterkit import Move, agreed, on_each_node, owner, raw_of, slot_of
from conftest import FRONTS, Keys, aeventually, eventually, python

import reem
import reem_async
from reem_async.errors import BadValue, NotConnected, ServerFailed, WrongKind
from reem_async.pubsub.monitor import Monitor
from reem_async.server.cluster import EmbeddedCluster


@pytest.fixture
def key():
    return Keys()


@pytest.fixture(params=list(FRONTS))
def front(request, cluster):
    opened = FRONTS[request.param](cluster, timeout=0.5)
    yield opened
    opened.close()


def test_a_cluster_takes_writes_when_it_has_started_and_is_gone_when_it_has_stopped():
    """Primaries first, each replica known; nothing is left over."""
    with EmbeddedCluster(primaries=3, replicas=1, node_timeout=1.0) as cluster:
        assert len(cluster.nodes) == 6
        assert ["role:slave" in node.say("INFO", "replication") for node in cluster.nodes] == [False] * 3 + [True] * 3
        with reem.RedisInterface(cluster.url) as interface:
            kvs = reem.KeyValueStore(interface)
            for number in range(20):
                kvs[f"k{number}"] = number
            assert [kvs[f"k{number}"].read() for number in range(20)] == list(range(20))
        pids = [node.pid for node in cluster.nodes]
    assert not [pid for pid in pids if os.path.exists(f"/proc/{pid}")]
    assert cluster.nodes == []
    with pytest.raises(ServerFailed, match="not started"):
        _ = cluster.url


@pytest.mark.long
def test_a_cluster_ends_with_its_owner_however_it_ends():
    code = """
import os, signal
from reem_async.server.cluster import EmbeddedCluster
cluster = EmbeddedCluster(replicas=0)
cluster.start()
print(*[node.pid for node in cluster.nodes], flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    pids = python(code).stdout.split()
    assert len(pids) == 3
    eventually(lambda: not [pid for pid in pids if os.path.exists(f"/proc/{pid}")])


@pytest.mark.long
@pytest.mark.parametrize("then", ["", "cluster.stop()", "fork(cluster.stop)", "fork(lambda: cluster.start())"])
def test_no_noise_on_any_way_out(then):
    """Not at the interpreter's end either, when no thread can be had any more; a forked child leaves it alone."""
    code = """
import os
from reem_async.server.cluster import EmbeddedCluster
cluster = EmbeddedCluster(replicas=0)
cluster.start()

def fork(then):
    cluster._lock.acquire()  # as another thread may have it
    if child := os.fork():
        assert os.waitpid(child, 0)[1] == 0
    else:
        import signal
        signal.alarm(5)
        then()
        os._exit(0)
    cluster._lock.release()
    assert "cluster_state:ok" in cluster.nodes[0].say("CLUSTER", "INFO")

print(*[node.pid for node in cluster.nodes], flush=True)
"""
    done = python(code + then)
    assert (done.returncode, done.stderr) == (0, "")
    assert not [pid for pid in done.stdout.split() if os.path.exists(f"/proc/{pid}")]


@pytest.mark.parametrize("wrong", [{"primaries": 2}, {"replicas": 6}, {"node_timeout": 0}])
def test_a_cluster_that_cannot_be_is_refused(wrong):
    with pytest.raises(BadValue, match=next(iter(wrong))):
        EmbeddedCluster(**wrong)


def test_the_password_is_not_shown(cluster):
    interface = reem.RedisInterface("redis+cluster://user:secret@127.0.0.1:1,127.0.0.1:2")
    assert interface.hostname == "127.0.0.1:1,127.0.0.1:2"
    with pytest.raises(NotConnected) as refusal:
        interface.initialize()
    assert "secret" not in str(refusal.value) + repr(interface)
    interface.close()


def test_one_server_is_no_cluster(server_url):
    """It says so, and what to write instead."""
    if not server_url.startswith("redis://"):
        pytest.skip("this test run has a cluster")
    with (
        pytest.raises(BadValue, match="is no cluster"),
        reem.RedisInterface(server_url.replace("redis://", "redis+cluster://")),
    ):
        pass


def test_one_node_leads_to_all_and_an_interface_can_be_pickled(cluster, key):
    with reem.RedisInterface(f"redis+cluster://127.0.0.1:{cluster.nodes[1].port}") as interface:
        for name in on_each_node(cluster, key):
            reem.KeyValueStore(interface)[name] = name
        copied = pickle.loads(pickle.dumps(reem.KeyValueStore(interface)[name]))
        assert copied.read() == name


def test_keys_go_to_the_node_of_their_slot_and_all_of_a_key_to_one(front, cluster, key):
    for name in on_each_node(cluster, key):
        front.write((name,), {"image": np.arange(10), "n": 1})
        with raw_of(owner(cluster, name)) as raw:
            assert raw.exists(name, "{" + name + "}.image", "{" + name + "}:ships") == 3
        assert front.read((name, "image")).tolist() == list(range(10))


def test_a_foreign_type_is_named_by_the_node_that_has_it(front, cluster, key):
    for name in on_each_node(cluster, key):
        with raw_of(owner(cluster, name)) as raw:
            raw.set(name, "x")
        with pytest.raises(WrongKind, match="of type string"):
            front.read((name,))


@pytest.fixture
def moving(cluster, front, key):
    """A key with an array, on a slot that is on its way; moved to the end afterwards."""
    name = key("moving")
    front.write((name,), {"n": 1, "image": np.zeros(4)})
    move = Move(cluster, name).begin()
    move.name = name
    yield move
    move.finish()


def test_what_has_left_is_found_where_it_went(front, moving):
    moving.take(*moving.all_keys())
    assert front.read((moving.name, "n")) == 1
    assert front.read((moving.name, "image")).tolist() == [0, 0, 0, 0]
    front.write((moving.name,), {"n": 5, "image": np.ones(4)})
    front.increment((moving.name, "n"), 2)
    value = front.read((moving.name,))
    assert (value["n"], value["image"].tolist()) == (7, [1, 1, 1, 1])
    assert moving.left() == []


def test_a_transaction_over_keys_here_and_there_waits_until_they_are_together(front, moving):
    """And says that nothing was applied if that takes too long."""
    moving.take("{" + moving.name + "}.image")
    with pytest.raises(NotConnected, match="nothing was applied"):
        front.write((moving.name,), {"n": 9, "image": np.ones(4)})
    with pytest.raises(NotConnected, match="nothing was applied"):
        front.read((moving.name,))
    moving.take(*moving.all_keys())
    value = front.read((moving.name,))
    assert (value["n"], value["image"].tolist()) == (1, [0, 0, 0, 0])


def test_nodes_that_do_not_agree_are_named_as_the_reason(front, cluster, key):
    """Each sends to the other, until time is over."""
    agreed(cluster)
    first = owner(cluster, key())
    second = next(node for node in cluster.nodes[:3] if node is not first)
    first.say("CLUSTER", "SETSLOT", str(slot_of(key())), "NODE", second.id)
    with pytest.raises(NotConnected, match=f"slot {slot_of(key())} is said to be at 127.0.0.1:.*nothing was applied"):
        front.write((key(),), 1)
    first.say("CLUSTER", "SETSLOT", str(slot_of(key())), "NODE", first.id)
    front.write((key(),), 1)
    assert front.read((key(),)) == 1


def test_an_edit_goes_to_where_the_key_is_now(cluster, key):
    name = key()
    with reem.RedisInterface(cluster) as interface:
        kvs = reem.KeyValueStore(interface)
        kvs[name] = {"n": 1}
        with kvs[name] as value:
            value["n"] = 2
            Move(cluster, name).begin().finish()
        assert kvs[name].read() == {"n": 2}


async def test_a_follower_goes_where_the_slot_goes_and_says_that_there_is_a_gap(cluster, key):
    """What was published meanwhile is in the value; the state of the interface is the same all the time."""
    name = key()
    async with reem_async.RedisInterface(cluster) as interface:
        space, kvs = reem_async.PublishSpace(interface), reem_async.KeyValueStore(interface)
        await space[name].write({"n": 0})
        changes = []
        interface.on_state(changes.append)
        async with kvs[name].watch(reem_async.Every(100)) as updates:
            assert (await anext(updates)).initial
            for number in range(1, 4):
                move = Move(cluster, name).begin()
                move.take(*move.all_keys())
                await space[name]["n"].write(number)
                move.finish()
                update = await anext(updates)
                assert update.gap
                assert update.data == {"n": number}
                await space[name]["n"].write(number + 10)
                update = await anext(updates)
                assert (update.gap, update.data) == (False, {"n": number + 10})
        assert not changes


@pytest.mark.parametrize("gone", ["{}", "{{{}}}:ships"], ids=["document", "registry"])
async def test_who_follows_a_key_in_parts_is_not_advised_to_do_what_it_does(cluster, key, gone):
    """It is connected with the URL of the cluster already."""
    name = key()
    async with reem_async.RedisInterface(cluster) as interface:
        await reem_async.KeyValueStore(interface)[name].write({"n": 1, "a": np.arange(3)})
        move = Move(cluster, name).begin()
        move.take(gone.format(name))
        with reem_async.timeout(0.2), pytest.raises(NotConnected, match="nothing is followed") as caught:
            await reem_async.SilentSubscriber(name, interface).listen()
        assert "redis+cluster://" not in str(caught.value)
        assert "not hold this key now" in str(caught.value) or "parts of the key are on either" in str(caught.value)
        move.finish()
        mirror = reem_async.SilentSubscriber(name, interface)
        await mirror.listen()
        assert mirror.value()["n"] == 1


async def test_leaving_and_coming_back_to_channels_of_one_node_keeps_the_connection_in_order(cluster, key):
    """Each answer goes to whom it belongs, with the slot moving in between."""
    name = key()
    async with reem_async.RedisInterface(cluster) as interface:
        space = reem_async.PublishSpace(interface)
        for number in range(24):
            await space[name].write(number)
            mirror = reem_async.SilentSubscriber(name, interface)
            await mirror.listen()
            if number % 12 == 6:
                Move(cluster, name).begin().finish()
            assert mirror.value() == number
            await space[name].write(-number)
            await aeventually(lambda mirror=mirror, number=number: mirror.value() == -number)
            await mirror.close()


async def test_a_key_that_is_found_late_has_a_gap(cluster, key, monkeypatch):
    """As when it was made, and published to, by somebody who had done so before."""
    monkeypatch.setattr("reem_async.session._FRESH", 0.0)  # so long all nodes are told
    async with reem_async.RedisInterface(cluster) as interface:
        space, kvs = reem_async.PublishSpace(interface), reem_async.KeyValueStore(interface)
        await space[key()].write(1)
        await kvs[key()].delete()
        monitor = Monitor(interface, [key("*")])
        await monitor.listen()
        await space[key()].write(2)

        async def publish():
            for number in range(3, 1000):
                await space[key()].write(number)
                await asyncio.sleep(0.05)

        publishing = asyncio.create_task(publish())
        async with asyncio.timeout(10):
            event = await anext(monitor)
        publishing.cancel()
        assert event.gap
        await monitor.close()


def test_slots_are_those_of_the_servers(cluster, key):
    for name in (key("a b"), key("ü"), key(":x"), key("\n")):
        assert int(cluster.nodes[0].say("CLUSTER", "KEYSLOT", name)) == slot_of(name)
