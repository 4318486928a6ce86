"""Many calls at once, and an event loop that is busy with other things: a time limit counts what the server needs."""

import asyncio
import contextlib
import socket
import time

import pytest
from own_servers import own_server

import reem
import reem_async
from reem_async.errors import NotConnected

MANY = 300


async def edit(accessor):
    async with accessor.edit() as value:
        value["n"] += 1


CALLS = {
    "increment": lambda accessor: accessor["n"].increment(1),
    "multiply": lambda accessor: accessor["n"].multiply(2),
    "divide": lambda accessor: accessor["n"].divide(2),
    "setdefault": lambda accessor: accessor.setdefault("other", 1),
    "edit": edit,
}


@pytest.mark.parametrize("call", CALLS)
async def test_calls_that_need_a_connection_each_wait_for_one_of_32(ainterface, key, raw, call):
    """All succeed, and the connections are used again."""
    accessors = [reem_async.KeyValueStore(ainterface)[key(str(number))] for number in range(MANY)]
    await asyncio.gather(*(accessor.write({"n": 1}) for accessor in accessors))
    before = raw.info("stats")["total_connections_received"]
    await asyncio.gather(*(CALLS[call](accessor) for accessor in accessors))
    assert raw.info("stats")["total_connections_received"] - before <= 40
    transport = ainterface.session.transport
    if not transport.sharded:
        assert len(transport._spare) <= 4


async def test_a_caller_that_is_cancelled_while_it_waits_leaves_no_place_taken(ainterface, key):
    accessor = reem_async.KeyValueStore(ainterface)[key()]
    await accessor.write({"n": 0})
    for _ in range(3):
        tasks = [asyncio.ensure_future(accessor["n"].multiply(1)) for _ in range(MANY)]
        await asyncio.sleep(0.01)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    await asyncio.wait_for(asyncio.gather(*(accessor["n"].increment(1) for _ in range(100))), 30)
    assert await accessor["n"].read() == 100


async def test_a_call_that_is_cancelled_while_it_connects_leaves_the_connection_to_others(server_url, key):
    interface = reem_async.RedisInterface(server_url)
    accessor = reem_async.KeyValueStore(interface)[key()]
    first, second = [asyncio.create_task(accessor.read()) for _ in range(2)]
    await asyncio.sleep(0)
    first.cancel()
    assert await second is None
    await interface.close()


async def test_calls_made_in_a_turn_that_takes_longer_than_the_limit_are_answered(server_url, key):
    """The limit counts from when they are sent, and not while the loop is busy."""
    async with reem_async.RedisInterface(server_url, timeout=0.1) as interface:
        accessor = reem_async.KeyValueStore(interface)[key()]
        await accessor.write(1)
        assert set(await asyncio.gather(*(accessor.read() for _ in range(20_000)))) == {1}


@contextlib.asynccontextmanager
async def busy(seconds):
    """Inside the block each turn of the event loop takes so long."""

    async def work():
        while True:
            time.sleep(seconds)
            await asyncio.sleep(0)

    task = asyncio.ensure_future(work())
    try:
        yield
    finally:
        task.cancel()


async def test_a_busy_event_loop_connects_and_follows(server_url, key):
    """Each turn takes 0.06 s, and a handshake about thirty turns, which is longer than its limit of 1 s."""
    async with busy(0.06), reem_async.RedisInterface(server_url) as interface:
        accessor = reem_async.KeyValueStore(interface)[key()]
        await accessor.write(1)
        assert (await anext(accessor.watch())).data == 1


async def test_a_silent_server_is_given_up_by_a_busy_event_loop_too():
    with socket.create_server(("127.0.0.1", 0)) as silent:  # the kernel takes connections for it
        began = time.monotonic()
        async with busy(0.02):
            with pytest.raises(NotConnected):
                await reem_async.RedisInterface(f"redis://127.0.0.1:{silent.getsockname()[1]}").initialize()
        assert 0.9 < time.monotonic() - began < 10


async def test_callers_that_wait_for_a_connection_learn_that_none_can_be_made(key):
    """At once, and not 32 of them in each time limit."""
    with socket.create_server(("127.0.0.1", 0)) as silent:  # the kernel takes connections for it
        interface = reem_async.RedisInterface(f"redis://127.0.0.1:{silent.getsockname()[1]}")
        accessor, began = reem_async.KeyValueStore(interface)[key()], time.monotonic()
        results = await asyncio.gather(*(accessor["n"].multiply(2) for _ in range(MANY)), return_exceptions=True)
        assert {type(result) for result in results} == {NotConnected}
        assert time.monotonic() - began < 5
        await interface.close()


def test_a_server_that_takes_no_more_clients_says_so():
    with own_server() as server, reem.RedisInterface(server.url), server.admin() as admin:
        admin.config_set("maxclients", admin.info("clients")["connected_clients"])
        with pytest.raises(NotConnected, match="maxclients"):
            reem.RedisInterface(server.url).initialize()
