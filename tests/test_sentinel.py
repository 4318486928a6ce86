"""A primary that sentinels watch: found, lost, found again where they say."""

import asyncio
import contextlib
import os
import signal
import socket

import pytest
from conftest import FRONTS, aeventually, eventually
from loadkit import load

import reem
import reem_async
from reem_async.errors import BadType, NotConnected, ServerReadOnly


@pytest.fixture(params=list(FRONTS))
def front(request, watched):
    opened = FRONTS[request.param](watched.url)
    yield opened
    opened.close()


def test_the_primary_is_found_through_any_sentinel_that_answers(watched):
    """The first of the URL may be down."""
    url = watched.url.replace("redis+sentinel://", "redis+sentinel://127.0.0.1:1,")
    with reem.RedisInterface(url) as interface:
        reem.KeyValueStore(interface)["found"] = 1
        assert interface.hostname.startswith("mymaster (sentinels 127.0.0.1:1,")
    assert watched.now().json().get("found") == 1


@pytest.mark.parametrize("name", FRONTS)
def test_sentinels_that_never_answer_keep_nobody_out(watched, name):
    """Two at the head of the URL took the whole time that asyncio has for connecting, each time anew."""
    with contextlib.ExitStack() as stack:
        silent = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        addresses = "".join(f"127.0.0.1:{each.getsockname()[1]}," for each in silent)
        url = watched.url.replace("redis+sentinel://", f"redis+sentinel://{addresses}")
        opened = stack.enter_context(contextlib.closing(FRONTS[name](url)))
        opened.write(("found",), 2)
        assert opened.interface.hostname.startswith(f"mymaster (sentinels {addresses}")
        last = list(opened.interface.session.options.sentinels() if name == "asyncio" else [])[-2:]
        assert all(f"{each.address}," in addresses for each in last)


@pytest.mark.parametrize("package", [reem, reem_async])
def test_an_option_that_nobody_knows_is_refused(package):
    package.RedisInterface("redis+sentinel://127.0.0.1/mymaster", sentinel_password="x")
    with pytest.raises(BadType, match="sentinel_pasword"):
        package.RedisInterface("redis+sentinel://127.0.0.1/mymaster", sentinel_pasword="x")


def test_a_service_that_no_sentinel_knows_is_named(watched):
    interface = reem.RedisInterface(watched.url.replace("mymaster", "yours"))
    with pytest.raises(NotConnected, match="yours"):
        interface.initialize()
    interface.close()


def test_a_write_to_a_demoted_primary_is_not_reported_as_done(front, watched):
    """Nothing is applied, and as long as the sentinels name it nobody connects to it."""
    front.write(("demoted",), 1)
    old, new = watched.now(), watched.standby()
    new.replicaof("NO", "ONE")
    old.replicaof("127.0.0.1", new.connection_pool.connection_kwargs["port"])
    try:
        with pytest.raises(NotConnected, match="nothing was applied"):
            front.write(("demoted",), 2)
        assert front.interface.state == "lost"
        with pytest.raises(NotConnected, match="not the primary any more"):
            front.write(("demoted",), 3)
        assert new.json().get("demoted") == 1
    finally:
        old.replicaof("NO", "ONE")
        new.replicaof("127.0.0.1", old.connection_pool.connection_kwargs["port"])
    front.write(("demoted",), 4)
    assert (front.read(("demoted",)), front.interface.state) == (4, "connected")
    watched.settle()


def test_a_primary_that_takes_no_writes_for_want_of_replicas_is_no_replica(front, watched):
    """It was taken for one, and each refused write left a connection behind."""
    watched.settle()
    primary = watched.now()
    front.write(("wanting",), 1)
    states = []
    front.interface.on_state(lambda change: states.append(change.state))
    primary.config_set("min-replicas-to-write", 5)
    try:
        before = primary.info("clients")["connected_clients"]
        for _ in range(10):
            with pytest.raises(ServerReadOnly, match="min-replicas-to-write"):
                front.write(("wanting",), 2)
        assert front.read(("wanting",)) == 1
        assert primary.info("clients")["connected_clients"] <= before + 1
    finally:
        primary.config_set("min-replicas-to-write", 0)
    assert states == []


@pytest.mark.long
async def test_a_switch_by_an_administrator_is_told_to_followers_and_to_who_only_calls(watched):
    """And what becomes of connections to the old primary afterwards is nobody's loss."""
    watched.settle()
    heard = {"follower": [], "caller": []}
    async with contextlib.AsyncExitStack() as stack:
        for name, told in heard.items():
            interface = await stack.enter_async_context(reem_async.RedisInterface(watched.url))
            await reem_async.KeyValueStore(interface)["m"].write(1)
            if name == "follower":
                mirror = reem_async.SilentSubscriber("m", interface)
                await mirror.listen()
            interface.on_state(lambda change, told=told: told.append(change.state))
        old = watched.now()
        watched.sentinels[0].execute_command("SENTINEL", "FAILOVER", "mymaster")
        await aeventually(lambda: heard["follower"] == ["lost", "reconnecting", "connected"])
        old.client_kill_filter(_type="normal", skipme=True)  # it does that itself, when it hears of its successor
        await aeventually(lambda: heard["caller"] == ["lost", "connected"])
        await asyncio.sleep(0.2)
        assert heard == {"follower": ["lost", "reconnecting", "connected"], "caller": ["lost", "connected"]}
    await asyncio.to_thread(watched.settle)


@pytest.mark.long
async def test_what_is_stored_after_a_switch_is_told_by_the_new_primary(watched):
    """Behind a gap with what is there; a mirror has it too."""
    watched.settle()
    async with reem_async.RedisInterface(watched.url) as interface:
        handle = reem_async.KeyValueStore(interface)["w"]
        await handle.write(1)
        async with handle.watch(reem_async.Every(1000)) as updates, handle.mirror() as mirror:
            assert (await anext(updates)).initial
            watched.sentinels[0].execute_command("SENTINEL", "FAILOVER", "mymaster")
            async with asyncio.timeout(20):
                while not (await anext(updates)).gap:
                    pass
                await handle.write(2)
                update = await anext(updates)
                assert (update.data, str(update.origin) in ("stored", "found")) == (2, True)
                assert await mirror.wait_until(lambda value: value == 2) == 2
    await asyncio.to_thread(watched.settle)


async def test_a_failover_is_seen_as_a_change_of_state_and_all_go_on(watched):
    """Killed -9: calls fail until the sentinels have agreed; followers converge, and say that there is a gap."""
    async with reem_async.RedisInterface(watched.url) as interface, load(watched.url, "robot") as gaps:
        changes = []
        interface.on_state(changes.append)
        store = reem_async.KeyValueStore(interface)
        async with store["robot"].watch(reem_async.Every(100_000)) as updates:
            assert (await anext(updates)).initial
            old = await asyncio.to_thread(watched.primary)
            os.kill(watched.pid(old), signal.SIGKILL)
            await aeventually(lambda: interface.state == "reconnecting")
            await asyncio.to_thread(eventually, lambda: watched.primary() != old)
            async with asyncio.timeout(10):
                while not (await anext(updates)).gap:
                    pass
        assert [change.state for change in changes] == ["lost", "reconnecting", "connected"]
        assert changes[-1].restarted
    assert gaps
