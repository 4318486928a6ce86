"""What the servers of a cluster may do while programs work: slots move back and forth, a primary is killed."""

from __future__ import annotations

import asyncio
import os
import time

import pytest
from clusterkit import Move, kill_primary, owner, raw_of, whole_again
from conftest import aeventually
from loadkit import Load

import reem_async
from reem_async.server.cluster import EmbeddedCluster

SECONDS = float(os.environ.get("REEM_FAULT_SECONDS", "2"))
"""How long slots go back and forth; the full check is 60."""


@pytest.fixture(scope="module")
def cluster():
    with EmbeddedCluster(node_timeout=0.5) as running:
        yield running


async def test_slots_that_move_back_and_forth_cost_no_write_and_no_reader_sees_a_wrong_value(cluster):
    """Key by key, as every tool for it does, with all that REEM stores of a key."""
    load, moves = Load(cluster, "robot"), 0
    async with load.running():
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            for key in ("robot", "robot:count"):
                await asyncio.to_thread(_moved_slowly, cluster, key)
                moves += 1
            await asyncio.sleep(0.02)
    assert load.unknown == load.uncounted == 0
    assert load.refused == 0
    assert moves > 3
    assert load.gaps >= 1
    assert load.reads > 10


def _moved_slowly(cluster, key):
    move = Move(cluster, key).begin()
    while keys := move.all_keys():
        move.take(keys[0])
        time.sleep(0.002)
    move.finish()


async def test_a_killed_primary_is_replaced_and_all_go_on(cluster):
    """Calls fail until then, and say what became of them; followers converge, and say that there is a gap."""
    load, changes = Load(cluster, "robot", failover=True), []
    async with reem_async.RedisInterface(cluster) as interface, load.running():
        mirror = reem_async.SilentSubscriber("robot", interface)
        await mirror.listen()
        interface.on_state(changes.append)
        victim = kill_primary(cluster, "robot")
        await aeventually(lambda: interface.state == "reconnecting")
        await asyncio.to_thread(whole_again, cluster, victim)
        await aeventually(lambda: interface.state == "connected")
    assert [change.state for change in changes][:3] == ["lost", "reconnecting", "connected"]
    assert load.gaps >= 1


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
