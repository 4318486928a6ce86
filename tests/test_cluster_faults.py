"""What the servers of a cluster may do while programs work: slots move back and forth, a primary is killed."""

import asyncio
import contextlib
import socket
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from clusterkit import kill_primary, owner, raw_of, whole_again
from conftest import aeventually
from loadkit import load

import reem
import reem_async
from reem_async.errors import NotConnected
from reem_async.server.cluster import EmbeddedCluster


@pytest.fixture(scope="module")
def cluster():
    with EmbeddedCluster(node_timeout=0.5) as running:
        yield running


async def test_a_killed_primary_is_replaced_and_all_go_on(cluster):
    """Calls fail until then, and say what became of them; followers converge, and say that there is a gap."""
    changes = []
    async with reem_async.RedisInterface(cluster) as interface, load(cluster, "robot") as gaps:
        mirror = reem_async.SilentSubscriber("robot", interface)
        await mirror.listen()
        interface.on_state(changes.append)
        victim = kill_primary(cluster, "robot")
        await aeventually(lambda: interface.state == "reconnecting")
        await asyncio.to_thread(whole_again, cluster, victim)
        await aeventually(lambda: interface.state == "connected")
    assert [change.state for change in changes][:3] == ["lost", "reconnecting", "connected"]
    assert gaps


async def test_an_idle_connection_to_a_node_that_is_cut_is_made_anew(cluster):
    """Nobody need call for what that node has: nothing is missed."""
    async with reem_async.RedisInterface(cluster) as interface:
        store, heard = reem_async.KeyValueStore(interface), []
        for number in range(20):
            await store[f"idle{number}"].write(number)
        nodes = await interface.session.transport.nodes()
        wires = [node._lanes[False] for node in nodes]
        interface.on_state(heard.append)
        with raw_of(owner(cluster, "idle0")) as raw:
            raw.client_kill_filter(_type="normal", skipme=True)
        await aeventually(lambda: any(node._lanes[False] not in wires for node in nodes))
        await aeventually(lambda: interface.state == "connected")
        assert {change.state for change in heard} <= {"lost", "connected"}


@pytest.fixture
def silent(monkeypatch):
    """The URL of four nodes that take connections and never answer; what a handshake may take is short."""
    from reem_async.transport.options import Options

    made = Options.__init__

    def short(self, *args, **options):
        made(self, *args, **options)
        self.handshake_timeout = self.settings["socket_connect_timeout"] = 0.2

    monkeypatch.setattr(Options, "__init__", short)
    with contextlib.ExitStack() as stack:
        nodes = [stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=512)) for _ in range(4)]
        yield "redis+cluster://" + ",".join(f"127.0.0.1:{node.getsockname()[1]}" for node in nodes)


@pytest.mark.alone
async def test_calls_in_asyncio_share_what_a_look_for_a_node_that_answers_came_to(silent):
    """Each looked by itself, one after the other: eight calls took eight times as long, and twice at that."""
    async with asyncio.timeout(20):
        interface = reem_async.RedisInterface(silent, timeout=0.2)
        store = reem_async.KeyValueStore(interface)
        began = time.monotonic()
        for error in await asyncio.gather(*(store["a"].read() for _ in range(8)), return_exceptions=True):
            assert isinstance(error, NotConnected)
        assert time.monotonic() - began < 0.9  # two nodes are asked in any case
        await interface.close()


@pytest.mark.alone
def test_blocking_calls_share_what_a_look_for_a_node_that_answers_came_to(silent):
    def read(_):
        with pytest.raises(NotConnected, match="no node of the cluster answers"):
            store["a"].read()

    interface = reem.RedisInterface(silent, timeout=0.2)
    store = reem.KeyValueStore(interface)
    began = time.monotonic()
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(read, range(8)))
    assert time.monotonic() - began < 0.9
    interface.close()


async def test_the_next_look_begins_with_nodes_that_were_not_asked(silent, cluster):
    """So one that answers is found, however many do not."""
    url = f"{silent},127.0.0.1:{cluster.nodes[-1].port}"  # no test kills that one: it was a replica
    interface = reem_async.RedisInterface(url, timeout=0.2)
    store = reem_async.KeyValueStore(interface)
    done = False
    for _ in range(6):
        with contextlib.suppress(NotConnected):
            await store["a"].write(1)
            done = True
    assert done
    await interface.close()
