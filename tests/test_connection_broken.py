"""Connections that break, stand still or are broken off: no call waits longer, and none of them stays."""

import asyncio
import contextlib
import os
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import redis
from conftest import FRONTS, aeventually, stopped
from own_servers import caller, liar

import reem
import reem_async
from reem._portal import finish
from reem_async.errors import ConnectionLost, InterfaceClosed, NotConnected, PartialWrite
from reem_async.transport.blocking import BlockingTransport
from reem_async.transport.options import Options

LARGE = np.zeros(1_000_000)


@pytest.fixture
def clients(server):
    with redis.Redis(port=server.port) as admin:
        yield lambda: int(admin.info("clients")["connected_clients"]) - 1


def sockets():
    found = 0
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            found += os.readlink(f"/proc/self/fd/{name}").startswith("socket")
    return found


@contextlib.contextmanager
def signalled(every):
    """A signal is handled each `every` seconds inside the block."""
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    signal.setitimer(signal.ITIMER_REAL, every, every)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.alone
@pytest.mark.parametrize(
    "call",
    [lambda at: at.read(), lambda at: at.write(1), lambda at: at.write(LARGE), lambda at: at["large"].read()],
    ids=["read", "write", "large write", "large read"],
)
def test_signals_give_a_server_that_stands_still_no_more_time(server, call):
    """The kernel's own time limits begin anew after each."""
    with reem.RedisInterface(server.url, timeout=0.4) as interface:
        at = reem.KeyValueStore(interface)["foo"]
        at.write({"large": LARGE})
        call(at)
        at.write({"large": LARGE})
        timer = threading.Timer(5, os.kill, (server.pid, signal.SIGCONT))  # else a failing test would never end
        timer.start()
        with stopped(server), signalled(0.02):
            began = time.monotonic()
            with pytest.raises(ConnectionLost, match=r"0\.4 s"):
                call(at)
            assert 0.3 < time.monotonic() - began < 1.5
        timer.cancel()


def test_threads_that_give_back_broken_connections_do_not_come_in_each_others_way():
    """Each closes what it finds; an IndexError went out in place of ConnectionLost."""

    class Line:
        broken = True

        def close(self):
            sum(range(5))

    transport, until = BlockingTransport(Options("127.0.0.1", 1.0, {})), time.monotonic() + 1

    def give(_):
        while time.monotonic() < until:
            transport._idle.extend((Line(), Line(), Line()))
            transport._give(Line())

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(3) as pool:
            list(pool.map(give, range(3)))
    finally:
        sys.setswitchinterval(before)


def test_a_connection_that_is_given_back_as_the_interface_is_closed_does_not_stay():
    """The other thread has looked through all that were idle just before."""

    class Line:
        closed = False

        @property
        def broken(self):  # looked at between the two
            finish(transport.close())
            return False

        def close(self):
            self.closed = True

    transport, line = BlockingTransport(Options("127.0.0.1", 1.0, {})), Line()
    transport._give(line)
    assert line.closed
    assert not transport._idle


@pytest.mark.parametrize("name", FRONTS)
def test_what_greets_and_hangs_up_has_taken_no_call(name):
    """A proxy whose server is gone, say: each connection asks a question of its own first."""
    with (
        liar(lambda words: None) as url,
        caller(name, url) as made,
        pytest.raises(NotConnected, match="nothing was applied"),
    ):
        made(made.calls[2])


async def test_what_greets_and_hangs_up_is_not_connected_to_without_end():
    """An idle program made a hundred connections a second, and told of two changes of state for each."""
    asked, states = [], []
    with liar(lambda words: asked.append(words)) as url:
        interface = reem_async.RedisInterface(url)
        interface.on_state(lambda change: states.append(change.state))
        with pytest.raises(NotConnected):
            await reem_async.KeyValueStore(interface)["a"].read()
        await asyncio.sleep(0.3)
        await interface.close()
    assert len(asked) <= 2
    assert states == ["closed"]


async def test_a_write_that_loses_the_server_before_its_last_step_says_so(server):
    """The document is written; arrays of which this interface did not know need one more connection."""
    with redis.Redis(port=server.port) as admin:
        async with reem_async.RedisInterface(server) as one, reem_async.RedisInterface(server) as two:
            await reem_async.KeyValueStore(one)["cam"].write({"n": 1, "image": np.arange(5)})
            cam = reem_async.KeyValueStore(two)["cam"]
            await reem_async.KeyValueStore(two)["warm"].write(1)
            admin.config_set("maxclients", admin.info("clients")["connected_clients"])
            with pytest.raises(PartialWrite, match="the document was written, but arrays"):
                await cam.write({"n": 2})
            admin.config_set("maxclients", 10_000)
            assert await cam.read() == {"n": 2}
            await cam["n"].write(3)  # removes them, though it is elsewhere in the key
        assert {name for name in admin.scan_iter() if b"cam" in name} == {b"cam"}


@pytest.mark.parametrize("turns", [0, 1, 2, 5])
async def test_close_that_is_cancelled_leaves_no_connection(server, clients, turns):
    """Whenever that is: all are hung up before any is waited for."""
    interface = reem_async.RedisInterface(server)
    store = reem_async.KeyValueStore(interface)
    await store["a"].write(LARGE)
    await store["a"].read()
    assert clients() >= 2
    closing = asyncio.create_task(interface.close())
    for _ in range(turns + 1):
        await asyncio.sleep(0)
    closing.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await closing
    await aeventually(lambda: clients() == 0)
    await interface.close()
    with pytest.raises(InterfaceClosed):
        await store["a"].read()


async def test_close_beside_a_server_that_stands_still_keeps_no_socket(server):
    """What was to be sent is waited for for a second, and no longer."""
    before = sockets()
    interface = reem_async.RedisInterface(server.url, timeout=30)
    store = reem_async.KeyValueStore(interface)
    await store["a"].write(LARGE)
    with stopped(server):
        writing = asyncio.create_task(store["a"].write(np.zeros(4_000_000)))
        await asyncio.sleep(0.1)
        await interface.close()
        with pytest.raises(InterfaceClosed):
            await writing
        await aeventually(lambda: sockets() == before, timeout=2)
