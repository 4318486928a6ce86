"""The Unix socket of a server on this machine, taken in place of TCP by `reem record`."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import signal
from pathlib import Path

import pytest
import redis
from conftest import aeventually, eventually
from test_cli_record import is_recording, started

import reem
import reem_async
from reem_async.recording import open_log
from reem_async.server import EmbeddedServer
from reem_async.transport import nearby
from reem_async.transport.nearby import take_shortcut


@pytest.fixture
def server():
    """A server of the test's own."""
    with EmbeddedServer() as own:
        yield own


async def ways(interface):
    """Of each connection to the server that the interface has, whether it was made through the socket."""
    (clients,) = await interface.session.transport.roundtrip([("CLIENT", "LIST")])
    mine = f"name={interface.session.options.settings['client_name']} "
    return ["redis.sock" in line for line in clients.decode().splitlines() if mine in line]


@contextlib.asynccontextmanager
async def connected(server, **options):
    """An interface that goes by TCP, and has a connection."""
    url = f"redis://127.0.0.1:{server.port}"
    async with reem_async.RedisInterface(url, client_name="nearby", **options) as interface:
        yield interface


async def test_later_connections_go_through_the_socket(server):
    async with connected(server) as interface:
        assert await take_shortcut(interface.session) == str(server.socket_path)
        space = reem_async.PublishSpace(interface)
        mirror = reem_async.SilentSubscriber("a", interface)
        await mirror.listen()
        await space["a"].write({"n": 1})
        await aeventually(lambda: mirror.value() == {"n": 1})
        assert sorted(await ways(interface)) == [False, True]


async def test_a_password_is_given_there_too():
    with EmbeddedServer(password="secret") as server:
        async with connected(server, password="secret") as interface:
            assert await take_shortcut(interface.session) == str(server.socket_path)


async def test_another_server_at_the_same_path_is_not_taken(server):
    """As behind a tunnel: the server that answers says a path that leads to another one here."""
    with EmbeddedServer() as other:
        Path(server.socket_path).unlink()
        shutil.move(other.socket_path, server.socket_path)
        async with connected(server) as interface:
            assert await take_shortcut(interface.session) is None
            assert await reem_async.KeyValueStore(interface).keys() == []


async def test_a_socket_that_is_gone_is_not_taken(server):
    Path(server.socket_path).unlink()
    async with connected(server) as interface:
        assert await take_shortcut(interface.session) is None


@pytest.mark.parametrize("said", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\0" * 100, b"", None])
async def test_a_stranger_at_the_path_is_left_alone(server, said):
    """One that speaks something else, hangs up, or says nothing at all."""
    Path(server.socket_path).unlink()

    async def answer(reader, writer):
        await reader.read(100)
        if said is not None:
            writer.write(said)
        else:
            await reader.read()  # until the other side gives up
        writer.close()

    listening = await asyncio.start_unix_server(answer, server.socket_path)
    async with connected(server) as interface:
        async with asyncio.timeout(3):
            assert await take_shortcut(interface.session) is None
        await reem_async.KeyValueStore(interface)["a"].write(1)
    listening.close()
    await listening.wait_closed()


async def test_who_may_not_ask_goes_on_by_tcp(server):
    async with connected(server) as interface:
        await interface.session.transport.roundtrip(
            [("ACL", "SETUSER", "robot", "on", ">pw", "~*", "&*", "+@all", "-config")]
        )
    async with connected(server, username="robot", password="pw") as interface:
        assert await take_shortcut(interface.session) is None
        await reem_async.KeyValueStore(interface)["a"].write(1)


async def test_by_the_socket_there_is_nothing_shorter(server):
    async with reem_async.RedisInterface(server) as interface:
        assert await take_shortcut(interface.session) is None


async def test_a_server_elsewhere_is_not_asked(server, monkeypatch):
    """It would find the socket: all but the address is as in the first test."""
    monkeypatch.setattr(nearby, "is_this_machine", lambda host: host != "127.0.0.1")
    async with connected(server) as interface:
        assert await take_shortcut(interface.session) is None


async def test_when_the_socket_goes_away_it_goes_on_by_tcp(server):
    async with connected(server) as interface:
        assert await take_shortcut(interface.session)
        mirror = reem_async.SilentSubscriber("a", interface)
        await mirror.listen()
        Path(server.socket_path).unlink()
        async with connected(server) as killer:
            await killer.session.transport.roundtrip([("CLIENT", "KILL", "TYPE", "pubsub")])
            await reem_async.PublishSpace(killer)["a"].write(1)
        await aeventually(lambda: mirror.value() == 1)
        assert not any(await ways(interface))


def test_a_recorder_takes_it(server, tmp_path):
    url, file = f"redis://127.0.0.1:{server.port}", tmp_path / "run.mcap"
    with reem.RedisInterface(server) as interface:
        reem.PublishSpace(interface)["arm"] = 1
    with started(url, tmp_path, "record", "-o", file) as process:
        eventually(lambda: is_recording(file))
        with contextlib.closing(redis.Redis(port=server.port)) as client:
            assert [each for each in client.client_list() if "redis.sock" in each["addr"] and each["psub"] != "0"]
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10)
    assert (process.returncode, errors) == (0, "")
    with open_log(file) as log:
        assert log.names() == ["arm"]
