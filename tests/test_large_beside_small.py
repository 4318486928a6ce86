"""What a large array does for small calls beside it, and what is too large for the server."""

import asyncio
import itertools
import socket
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from conftest import assert_same

import reem_async
from reem_async.errors import BadValue
from reem_async.plan.sizes import LONGEST, check_sizes
from reem_async.transport.wire import BUFFER


async def test_a_large_array_waits_for_small_calls_that_are_under_way(ainterface, akvs, key, monkeypatch):
    """Encoding, copying and sending it keep the event loop for a millisecond, and their replies with it."""
    transport, name, busy = ainterface.session.transport, key(), []
    upload = type(transport).upload

    def watched(self, wire, commands):
        busy.append(self._lanes[False].busy)
        return upload(self, wire, commands)

    monkeypatch.setattr(type(transport), "upload", watched)
    for first in (True, False):  # whoever is woken first
        large = akvs[name].write({"image": np.zeros(100_000)})
        small = [akvs[key("other")].write(number) for number in range(300)]
        await asyncio.gather(*((large, *small) if first else (*small, large)))
    assert busy == [False, False]


async def test_it_does_not_wait_for_ever(akvs, key):
    name, others, over, calls = key(), key("others"), asyncio.Event(), itertools.count()

    async def call():
        while not over.is_set():
            await akvs[others].write(next(calls))

    async with asyncio.TaskGroup() as group:
        for _ in range(10):
            group.create_task(call())
        await akvs[name].write(np.arange(100_000))
        over.set()
    assert next(calls) < 1000  # each time it waits, ten or twenty come first
    assert_same(await akvs[name].read(), np.arange(100_000))


async def test_what_is_stored_is_of_one_instant_though_another_task_comes_first(akvs, key):
    """The array is changed in place, and what is said of it too, while the write waits."""
    name, value = key(), {"stamp": 0, "image": np.zeros(100_000)}

    async def change():
        for stamp in range(1, 50):
            value["stamp"] = stamp
            value["image"][:] = stamp
            await asyncio.sleep(0)

    await akvs[name].write(value)  # so that there are connections
    await asyncio.gather(akvs[name].write(value), akvs[key("other")].write(1), change())
    stored = await akvs[name].read()
    assert set(stored["image"].tolist()) == {stored["stamp"]}
    assert stored["stamp"] > 0  # the write has waited


@pytest.mark.skipif(sys.platform != "linux", reason="each system has its own limits")
async def test_beside_small_calls_loopback_tcp_takes_a_large_array_in_portions(server):
    """And alone all it can; a Unix socket has a small buffer anyway, and the line for small calls keeps its own."""
    image = np.zeros(1_000_000)

    def buffer(interface, large=True):
        return interface.session.transport._lanes[large]._socket.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)

    async with (
        reem_async.RedisInterface("127.0.0.1", port=server.port) as by_tcp,
        reem_async.RedisInterface(server) as by_socket,
    ):
        tcp, unix = reem_async.KeyValueStore(by_tcp), reem_async.KeyValueStore(by_socket)
        for kvs in (tcp, unix):
            await kvs["camera"].write({"image": image})
            await kvs["setpoint"].write(1.0)
        before = buffer(by_socket), buffer(by_tcp, large=False)
        for kvs in (tcp, unix):
            await kvs["camera"].write({"image": image})
        assert buffer(by_tcp) == 2 << 17
        assert (buffer(by_socket), buffer(by_tcp, large=False)) == before
        await asyncio.sleep(0.2)
        await tcp["camera"].write({"image": image})
        highest = int(Path("/proc/sys/net/core/wmem_max").read_text())
        assert buffer(by_tcp) == 2 * min(BUFFER, highest)


# --- what is too large for the server is refused before it is sent: the server would only close the connection


def untouched(size):
    """An array of so many bytes, of which the kernel makes none before somebody looks at them."""
    return np.zeros(size, np.uint8)


@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
def test_an_array_that_no_server_takes_is_refused(open_front, front, key, space):
    writer, too_large = open_front(space), untouched(LONGEST - 100)  # its header has 128 bytes
    front.write([key()], {"keep": [1]})
    for call in (
        lambda: writer.write([key(), "image"], too_large),
        lambda: writer.write([key(), "keep", 0], {"image": too_large}),
        lambda: writer.append([key(), "keep"], too_large),
    ):
        with pytest.raises(BadValue, match=f"{key()}.*536870940 bytes .* 536870912"):
            call()
    assert front.read([key()]) == {"keep": [1]}


@pytest.mark.parametrize("size", [2 << 30, 10**13])
def test_a_broadcast_array_is_refused_before_it_is_copied_out(front, key, size):
    """It takes one byte of memory; packed, it would take all there is."""
    tracemalloc.start()
    try:
        with pytest.raises(BadValue, match=f"{key()}.*{size} bytes"):
            front.write([key()], np.broadcast_to(np.uint8(7), (size,)))
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
def test_a_call_that_no_server_takes_is_refused(open_front, front, key, space):
    writer, parts = open_front(space), [untouched(400 << 20)] * 3
    front.write([key()], [1])
    for call in (lambda: writer.write([key()], parts), lambda: writer.extend([key()], parts)):
        with pytest.raises(BadValue, match=f"{key()}.*several calls"):
            call()
    assert front.read([key()]) == [1]


async def test_an_edit_that_no_server_takes_is_refused(akvs, key):
    await akvs[key()].write({"keep": 1})
    with pytest.raises(BadValue, match=key()):
        async with akvs[key()].edit() as value:
            value["image"] = untouched(513 << 20)
    assert await akvs[key()].read() == {"keep": 1}


def test_both_limits_are_kept_to():
    check_sizes([("a", 512 << 20), ("b", 511 << 20)])
    for sizes in ([("a", (512 << 20) + 1)], [("a", 512 << 20), ("b", 512 << 20)]):
        with pytest.raises(BadValue, match=r"^a: "):
            check_sizes(sizes)
