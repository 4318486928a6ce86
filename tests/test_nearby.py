"""The Unix socket of a server on this machine: taken by whoever says localhost, and by `reem record`."""

import contextlib
import os
import shutil
import signal
import socket
import threading
from pathlib import Path

import numpy as np
import pytest
import redis
from chaos.proxy import Proxy
from clikit import begins, started
from conftest import FRONTS, eventually

import reem
from reem.errors import ConnectionLost, NotConnected
from reem_async.server import EmbeddedServer
from reem_async.tools.recording import open_log
from reem_async.transport.options import NodeOptions, Options, look_nearby

pytestmark = pytest.mark.skipif(
    not hasattr(socket, "SO_PEERCRED"), reason="this system does not tell who listens at a socket"
)


@pytest.fixture(params=list(FRONTS))
def connect(request):
    with contextlib.ExitStack() as stack:

        def open_(port, host="localhost", **options):
            front = FRONTS[request.param](host, port=port, client_name="nearby", **options)
            return stack.enter_context(contextlib.closing(front))

        yield open_


def ways(server):
    """Of each connection of a front, whether it came through the socket."""
    with contextlib.closing(redis.Redis(port=server.port, password=server.password)) as client:
        return ["redis.sock" in each["addr"] for each in client.client_list() if each["name"] == "nearby"]


def goes_on(front, value=1):
    front.write(["a"], {"n": value, "image": np.full(100_000, value)})
    assert front.read(["a", "n"]) == value
    assert front.read(["a", "image"])[-1] == value


@contextlib.contextmanager
def in_place_of(server, answer):
    """Have somebody else, `answer`, listen at the server's socket."""
    Path(server.socket_path).unlink()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(server.socket_path)
        listening.listen()

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = listening.accept()
                    with connection:
                        answer(connection)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield
        listening.shutdown(socket.SHUT_RDWR)
        thread.join()


@pytest.mark.parametrize("host", ["localhost", "redis://localhost:{port}/0"])
def test_localhost_means_the_socket(server, connect, host):
    front = connect(server.port, host.format(port=server.port))
    goes_on(front)
    assert all(ways(server))
    assert front.interface.hostname == f"localhost:{server.port}"


def test_subscribers_use_it_too(server):
    with reem.RedisInterface("localhost", port=server.port, client_name="nearby") as interface:
        mirror = reem.SilentSubscriber("a", interface)
        mirror.listen()
        reem.PublishSpace(interface)["a"] = {"n": 1}
        eventually(lambda: mirror.value() == {"n": 1})
        found = ways(server)
        assert all(found)
        assert len(found) == 2


def test_a_number_means_tcp(server, connect):
    goes_on(connect(server.port, "127.0.0.1"))
    assert not any(ways(server))


def test_a_password_is_given_there_too(connect):
    with EmbeddedServer(password="secret") as server:
        goes_on(connect(server.port, password="secret"))
        assert all(ways(server))


def test_who_may_not_ask_goes_by_tcp(server, connect):
    with contextlib.closing(redis.Redis(port=server.port)) as client:
        client.execute_command("ACL", "SETUSER", "robot", "on", ">pw", "~*", "&*", "+@all", "-info")
    goes_on(connect(server.port, username="robot", password="pw"))
    assert not any(ways(server))


def test_a_proxy_is_not_passed_by(server, connect):
    """It says that the server has another port than the one connected to: whoever put it there had a reason."""
    with Proxy(server.port) as proxy:
        goes_on(connect(proxy.port))
        assert not any(ways(server))


def test_another_server_at_the_same_path_is_not_taken(server, connect):
    with EmbeddedServer() as other:
        Path(server.socket_path).unlink()
        shutil.move(other.socket_path, server.socket_path)
        goes_on(connect(server.port))
        assert not any(ways(server) + ways(other))


def test_a_stranger_at_the_path_gets_no_password(connect):
    heard = []
    with (
        EmbeddedServer(password="secret") as server,
        in_place_of(server, lambda connection: heard.append(connection.recv(1000))),
    ):
        goes_on(connect(server.port, password="secret"))
        eventually(lambda: heard)
        assert set(heard) == {b""}  # connected to, and left without a word
        assert not any(ways(server))


def test_when_the_socket_goes_away_it_goes_on_by_tcp(server, connect):
    front = connect(server.port)
    goes_on(front)
    Path(server.socket_path).unlink()
    with contextlib.closing(redis.Redis(port=server.port)) as client:
        client.execute_command("CLIENT", "KILL", "TYPE", "normal", "SKIPME", "yes")
        eventually(lambda: not ways(server))
    with contextlib.suppress(ConnectionLost):  # the asyncio front's loop has not run since
        goes_on(front)
    goes_on(front, 2)
    assert not any(ways(server))


def test_a_restarted_server_is_gone_to_through_its_new_socket(server, connect):
    front, port = connect(server.port), server.port
    goes_on(front)
    server.stop()
    with contextlib.suppress(ConnectionLost, NotConnected):  # as above
        goes_on(front)
    with pytest.raises(NotConnected, match=f"localhost:{port} "):
        goes_on(front)
    with EmbeddedServer(port) as again:
        goes_on(front, 2)
        assert all(ways(again))


def test_a_silent_server_is_waited_for_once(server, connect):
    """What does not answer through the socket does not by TCP either."""
    front = connect(server.port, timeout=0.2)
    goes_on(front)
    os.kill(server.pid, signal.SIGSTOP)
    try:
        for error in (ConnectionLost, NotConnected):  # on a connection that was there, on a new one
            with pytest.raises(error):
                goes_on(front)
    finally:
        os.kill(server.pid, signal.SIGCONT)
    goes_on(front, 2)
    assert all(ways(server))  # it was not given up


@pytest.mark.filterwarnings("ignore::reem.InsecureConnection")
@pytest.mark.parametrize("host", ["192.0.2.1", "rediss://localhost", "unix:///tmp/redis.sock", "one of several"])
def test_elsewhere_nothing_is_looked_for(host):
    several = host == "one of several"
    options = NodeOptions(Options("localhost", 1.0, {}), ("localhost", 7000)) if several else Options(host, 1.0, {})
    look_nearby(options)
    assert options.nearby is None


def test_a_recorder_takes_it_by_any_address_of_this_machine(server, tmp_path):
    url, file = f"redis://127.0.0.1:{server.port}", tmp_path / "run.mcap"
    with reem.RedisInterface(server) as interface:
        reem.PublishSpace(interface)["arm"] = 1
    with started(url, tmp_path, "record", "-o", file) as process:
        begins(process)
        with contextlib.closing(redis.Redis(port=server.port)) as client:
            assert [each for each in client.client_list() if "redis.sock" in each["addr"] and each["psub"] != "0"]
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10)
    assert (process.returncode, errors) == (0, "")
    with open_log(file) as log:
        assert log.names() == ["arm"]
