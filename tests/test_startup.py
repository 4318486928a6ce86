"""`RedisInterface(wait=)`: programs that start before their server."""

import asyncio
import contextlib
import os
import signal
import socket
import threading
import time

import pytest
from chaos.proxy import Proxy
from conftest import FRONTS, PATIENCE, PLAIN, url_of_user
from own_servers import HOST, caller, free_port, liar, own_server

import reem
import reem_async
from reem_async.server import EmbeddedCluster, EmbeddedServer

both = pytest.mark.parametrize("name", FRONTS)
LACKING = "-type" if PLAIN else "-type -json.type"


@contextlib.contextmanager
def late(target, seconds=0.4):
    """A way to the server at `target`, which opens after some seconds; its port."""
    port = free_port()
    with contextlib.ExitStack() as stack:
        opening = threading.Timer(seconds, lambda: stack.enter_context(Proxy(target, port)))
        opening.start()
        yield port
        opening.join()


@pytest.fixture(scope="module")
def cluster_port():
    with EmbeddedCluster(replicas=0) as cluster:
        yield cluster.nodes[0].port


@both
@pytest.mark.parametrize(
    "kind", ["one server", *[pytest.param(it, marks=pytest.mark.long) for it in ("cluster", "sentinel")]]
)
def test_the_first_call_waits_for_the_server(name, kind, request):
    if kind == "sentinel":
        target, url = request.getfixturevalue("watched").ports[0], "redis+sentinel://127.0.0.1:{}/mymaster"
    elif kind == "cluster":
        target, url = request.getfixturevalue("cluster_port"), "redis+cluster://127.0.0.1:{}"
    else:
        target, url = request.getfixturevalue("server").port, "redis://127.0.0.1:{}"
    for call in (0, 3, 5, 6):  # initialize, write an array, publish one, listen
        with late(target) as port, caller(name, url.format(port), wait=PATIENCE) as made:
            begin = time.monotonic()
            made(made.calls[call])
            assert 0.3 < time.monotonic() - begin < 10


@both
def test_waiting_ends_with_the_usual_error_and_is_not_repeated(name):
    with caller(name, f"redis://{HOST}:{free_port()}", wait=0.5) as made:
        begin = time.monotonic()
        with pytest.raises(reem.NotConnected, match=r"(?s)reem up.*compose|compose.*reem up"):
            made(made.interface.initialize)
        assert 0.45 < time.monotonic() - begin < 5
        begin = time.monotonic()
        for call in made.calls:
            with pytest.raises(reem.NotConnected):
                made(call)
        assert time.monotonic() - begin < 0.4


@both
def test_a_server_that_is_lost_later_is_not_waited_for(name):
    with EmbeddedServer() as server, caller(name, server.url, wait=PATIENCE) as made:
        made(made.calls[2])
        server.stop()
        begin = time.monotonic()
        for call in made.calls[:3]:
            with pytest.raises((reem.NotConnected, reem.ConnectionLost)):
                made(call)
        assert time.monotonic() - begin < 5


@both
def test_what_waiting_cannot_cure_is_raised_at_once(name):
    with (
        own_server(f"user robot on >pw ~* &* +@all {LACKING}", "requirepass admin", wait=False) as guarded,
        liar(lambda _: None, greets=False) as closing,
    ):
        begin = time.monotonic()
        refused = {
            url_of_user(guarded.url, "robot", "wrong"): reem.LoginRefused,
            guarded.url: reem.LoginRefused,
        }
        if not PLAIN:  # with the module, the first call looks for its commands
            refused[url_of_user(guarded.url, "robot", "pw")] = reem.NotAllowed
        for url, error in refused.items():
            with caller(name, url, wait=PATIENCE) as made, pytest.raises(error):
                made(made.interface.initialize)
        assert time.monotonic() - begin < 10
        # A forwarder whose server is not up yet accepts connections and closes them: that may end.
        begin = time.monotonic()
        with caller(name, closing, wait=0.5) as made, pytest.raises(reem.NotConnected):
            made(made.interface.initialize)
        assert time.monotonic() - begin > 0.4


def test_ctrl_c_ends_the_wait():
    with socket.socket() as taken:
        taken.bind((HOST, 0))  # and does not listen
        interface = reem.RedisInterface(f"redis://{HOST}:{taken.getsockname()[1]}", wait=PATIENCE)
        threading.Timer(0.3, os.kill, [os.getpid(), signal.SIGINT]).start()
        with pytest.raises(KeyboardInterrupt):
            interface.initialize()
        interface.close()


async def test_a_cancelled_call_ends_the_wait():
    interface = reem_async.RedisInterface(f"redis://{HOST}:{free_port()}", wait=PATIENCE)
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.3):
            await interface.initialize()
    await interface.close()


@pytest.mark.parametrize(
    ("wait", "error"),
    [(-1, reem.BadValue), (float("nan"), reem.BadValue), ("30", reem.BadType), (None, reem.BadType)],
)
@pytest.mark.parametrize("front", [reem, reem_async])
def test_what_is_no_time_to_wait_is_refused(front, wait, error):
    with pytest.raises(error, match="wait="):
        front.RedisInterface("localhost", wait=wait)
