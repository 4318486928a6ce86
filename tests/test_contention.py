"""Changes that look first end beside programs that never rest: applied, or with a Conflict that says what to do."""

import asyncio
import contextlib
import itertools
import time
from zlib import crc32

import numpy as np
import pytest
import redis
from conftest import FRONTS, RawCluster

import reem
import reem_async
from reem.server import EmbeddedServer
from reem_async.transport import Contention
from reem_async.transport.blocking import _Line
from reem_async.transport.wire import Wire

LIMIT = 0.2


@pytest.fixture(scope="module", params=[True, False], ids=["json", "plain"])
def server(request):
    with EmbeddedServer(json=request.param) as running:
        yield running


@pytest.fixture(scope="module")
def raw(server):
    with redis.Redis(unix_socket_path=server.socket_path) as client:
        yield client


@contextlib.contextmanager
def overtaken(monkeypatch, write, times=None):
    """Somebody else writes just before each transaction is sent, or before the first `times`; yields how often."""
    writes, send, exchange = [], Wire.send, _Line.exchange

    def first(commands):
        if commands[0][0] == "MULTI" and (times is None or len(writes) < times):
            writes.append(write())

    def on_a_loop(self, commands, done):
        first(commands)
        send(self, commands, done)

    def blocking(self, commands, bulk=False):
        first(commands)
        return exchange(self, commands, bulk)

    with monkeypatch.context() as patch:
        patch.setattr(Wire, "send", on_a_loop)
        patch.setattr(_Line, "exchange", blocking)
        yield writes


def touching(raw, server, key):
    """What writes to a document and changes nothing that a test looks at."""
    if server.json:
        return lambda: raw.execute_command("JSON.SET", key, "$.busy", "1")
    return lambda: raw.append(key, " ")


CALLS = {
    "write": lambda place: place["l"][-1].write(7),
    "write an array": lambda place: place["l"][-1].write(np.arange(20_000.0)),
    "delete": lambda place: place["l"][-1].delete(),
    "divide": lambda place: place["n"].divide(2),
    "pop": lambda place: place["l"].pop(),
    "setdefault": lambda place: place.setdefault("new", 1),
}
VALUE = {"busy": 0, "n": 8, "l": [1, 2]}


@pytest.mark.parametrize("name", FRONTS)
@pytest.mark.parametrize("call", CALLS)
def test_what_others_are_always_faster_than_ends_with_a_conflict(server, raw, monkeypatch, name, call):
    with contextlib.closing(FRONTS[name](server.url, timeout=LIMIT)) as front:
        front.write(["robot"], VALUE)
        with overtaken(monkeypatch, touching(raw, server, "robot")) as writes:
            began = time.monotonic()
            with pytest.raises(reem.Conflict, match=r"^robot: others kept writing .* nothing was applied: .*timeout="):
                front.wait(CALLS[call](front.at(["robot"])))
            assert LIMIT < time.monotonic() - began < LIMIT + 2
        assert len(writes) > 1
        found = front.read(["robot"])
        assert {**found, "busy": 0} == VALUE
        front.wait(CALLS[call](front.at(["robot"])))


@pytest.mark.parametrize("name", FRONTS)
@pytest.mark.parametrize("call", CALLS)
def test_what_others_were_faster_than_some_times_is_applied(server, raw, monkeypatch, name, call):
    with contextlib.closing(FRONTS[name](server.url, timeout=30)) as front:
        front.write(["robot"], VALUE)
        with overtaken(monkeypatch, touching(raw, server, "robot"), 5) as writes:
            front.wait(CALLS[call](front.at(["robot"])))
        assert len(writes) == 5


@pytest.mark.parametrize("name", FRONTS)
@pytest.mark.parametrize("method", ["increment", "multiply"])
def test_nobody_is_faster_than_the_server_calculates(server, raw, monkeypatch, name, method):
    """Not even the first time, when nothing is known of the number."""
    with contextlib.closing(FRONTS[name](server.url, timeout=LIMIT)) as front:
        front.write(["robot"], VALUE)
        with overtaken(monkeypatch, touching(raw, server, "robot")) as writes:
            if server.json:
                getattr(front, method)(["robot", "n"], 3)
                assert front.read(["robot", "n"]) == {"increment": 11, "multiply": 24}[method]
                assert len(writes) == 2
            else:
                with pytest.raises(reem.Conflict):
                    getattr(front, method)(["robot", "n"], 3)


def test_a_refused_call_leaves_nothing_watched(server):
    with reem.RedisInterface(server.url) as one, reem.RedisInterface(server.url) as other:
        mine, others = reem.KeyValueStore(one), reem.KeyValueStore(other)
        mine["a"] = {"items": [np.zeros(2)]}
        with pytest.raises(reem.PathRefused):
            mine["a"]["items"][-5] = 1
        others["a"]["n"] = 1
        mine["b"] = {"image": np.zeros(2)}  # a transaction over the same connection


def test_there_are_two_attempts_however_long_they_take():
    commands = [("UNLINK", "{robot}.image"), ("JSON.SET", "robot", "$", b"1")]
    contention = Contention(1e-6)
    for _ in range(2):
        contention.given_up(commands)
        time.sleep(1e-3)
        with pytest.raises(reem.Conflict, match=r"^robot: "):
            contention.given_up(commands)
        contention.over()  # what follows has a time of its own


def test_waiting_for_calls_of_ones_own_interface_is_no_contention():
    contention = Contention(0.1)
    contention.given_up([("SET", "{foo}.a", b"")])
    time.sleep(0.15)
    contention.waited(0.14)
    contention.given_up([("SET", "{foo}.a", b"")])


async def test_a_connection_that_breaks_costs_only_the_call_that_it_was_lent_to(server, raw):
    """Who waits behind it has a connection of his own; the server is there."""
    async with reem_async.RedisInterface(server) as interface:
        place = reem_async.KeyValueStore(interface)["broken"]
        await place.write({"text": "x" * 3_000_000})
        calls = [asyncio.ensure_future(place[f"n{number}"].write(number)) for number in range(8)]
        while not server.json and not (busy := [each for each in raw.client_list() if int(each["watch"])]):
            await asyncio.sleep(0)
        if not server.json:
            raw.client_kill_filter(_id=busy[0]["id"])
        outcomes = await asyncio.gather(*calls, return_exceptions=True)
    failed = [outcome for outcome in outcomes if outcome is not None]
    assert all(isinstance(outcome, reem.ConnectionLost) for outcome in failed)
    assert len(failed) <= 1


@pytest.mark.parametrize("outage", ["raise", "newest"])
@pytest.mark.parametrize("index", [0, -1])
async def test_an_update_that_others_are_always_faster_than_is_neither_outage_nor_gap(
    server, raw, monkeypatch, outage, index
):
    async with reem_async.RedisInterface(server, timeout=LIMIT) as interface:
        space = reem_async.PublishSpace(interface, outage=outage)
        await space["robot"].write(VALUE)
        async with reem_async.SilentSubscriber("robot", interface) as subscriber:
            told = subscriber.watch(reem_async.Every(100))
            await anext(told)
            if index < 0 or not server.json:
                with overtaken(monkeypatch, touching(raw, server, "robot")), pytest.raises(reem.Conflict):
                    await space["robot"]["l"][index].write(7)
                assert (space.dropped, space.waiting) == (0, 0)
            await space["robot"]["l"][index].write(8)
            update = await anext(told)
            assert (update.gap, update.data["l"][index]) == (False, 8)


async def test_a_cluster_says_so_too(cluster, monkeypatch):
    key = "contended"
    first = cluster.url.replace("redis+cluster://", "redis://").split(",")[0]
    with contextlib.closing(RawCluster.from_url(first, decode_responses=True)) as raw:
        async with reem_async.RedisInterface(cluster.url, timeout=LIMIT) as interface:
            space, number = reem_async.PublishSpace(interface, outage="newest"), itertools.count()
            await space[key].write(VALUE)
            with (
                overtaken(monkeypatch, lambda: raw.execute_command("JSON.SET", key, "$.busy", str(next(number)))),
                pytest.raises(reem.Conflict, match="others kept writing"),
            ):
                await space[key]["n"].write(1)
            assert (space.dropped, space.waiting) == (0, 0)
            assert (await reem_async.KeyValueStore(interface)[key]["n"].read()) == 8
            await reem_async.KeyValueStore(interface)[key].delete()


async def test_who_is_never_first_keeps_nobody_who_writes_to_another_key(raw, server, monkeypatch):
    """A plain server's documents share a few locks."""
    if server.json:
        pytest.skip("with the module no lock is taken")
    beside = next(f"k{n}" for n in range(99) if crc32(f"k{n}".encode()) % 8 == crc32(b"robot") % 8)
    async with reem_async.RedisInterface(server, timeout=30) as interface:
        kvs = reem_async.KeyValueStore(interface)
        await kvs["robot"].write(VALUE)
        await kvs[beside].write({})
        over, touch = asyncio.Event(), touching(raw, server, "robot")
        with overtaken(monkeypatch, lambda: over.is_set() or touch()) as writes:
            starving = asyncio.create_task(kvs["robot"]["n"].write(9))
            while len(writes) < 3:
                await asyncio.sleep(0)
            await asyncio.wait_for(kvs[beside]["n"].write(1), 5)
            assert not starving.done()
            over.set()
            await starving
        assert await kvs["robot"]["n"].read() == 9
