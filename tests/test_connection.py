"""The connection: its state, calls that stand still, what a stopped or restarted server does."""

import asyncio
import time

import numpy as np
import pytest
import redis
from chaos.proxy import CHUNK, Proxy
from chaos.servers import PrivateServer
from conftest import PATIENCE, PLAIN, aeventually, eventually, stopped, subscribed

import reem
import reem_async
from reem._portal import finish
from reem_async.concurrency.timeouts import moved_last
from reem_async.errors import BadInput, ConnectionLost, NotConnected
from reem_async.plan import Plan
from reem_async.plan.notices import note_of
from reem_async.pubsub import manager as manager_module
from reem_async.pubsub.manager import manager_of
from reem_async.server import EmbeddedServer


@pytest.mark.alone
def test_a_call_to_a_stopped_server_ends_in_time(server, open_front):
    front = open_front(url=server.url, timeout=0.3)
    front.write(["foo"], 1)
    with stopped(server):
        begin = time.monotonic()
        with pytest.raises(ConnectionLost, match=r"0\.3 s"):
            front.read(["foo"])
        assert 0.25 < time.monotonic() - begin < 0.9
        assert PLAIN or front.interface.state == "lost"  # there the write had a connection of its own, which is idle
    assert front.read(["foo"]) == 1
    assert front.interface.state == "connected"


@pytest.mark.parametrize("size", [1, 1 << 25], ids=["small", "large"])
def test_a_write_to_a_stopped_server_ends_by_itself(server, open_front, size):
    """Though a large one never waits for a reply: the server takes no byte of it any more."""
    front = open_front(url=server.url, timeout=0.3)
    front.write(["foo"], np.zeros(size, np.uint8))  # all connections are there
    with stopped(server), pytest.raises(ConnectionLost, match=r"0\.3 s"):
        front.write(["foo"], np.zeros(size, np.uint8))


async def test_a_dead_connection_is_given_up_though_calls_go_on(server):
    """A link swallows all bytes for a moment. New calls waited behind those before them, for ever."""
    with Proxy(server.port) as proxy:
        async with reem_async.RedisInterface(proxy.url, timeout=0.4) as interface:
            store = reem_async.KeyValueStore(interface)
            await store["foo"].write(1)
            proxy.black_hole()
            proxy.heal()  # for new connections
            calls = []
            for _ in range(25):
                calls.append(asyncio.ensure_future(store["foo"].read()))
                await asyncio.sleep(0.1)
            answers = await asyncio.gather(*calls, return_exceptions=True)
    assert isinstance(answers[0], ConnectionLost)
    assert answers[-10:] == [1] * 10


async def test_the_limit_of_one_call_is_its_own(server):
    """A short one does not cut off others on the same connection, a long one is not cut off by them."""
    async with reem_async.RedisInterface(server, timeout=30) as interface:
        store = reem_async.KeyValueStore(interface)
        await store["foo"].write(1)
        with stopped(server):
            patient = asyncio.create_task(store["foo"].read())
            await asyncio.sleep(0)
            with reem_async.timeout(0.2), pytest.raises(ConnectionLost, match=r"0\.2 s"):
                await store["foo"].read()
            assert not patient.done()
            assert interface.state == "connected"
        assert await patient == 1
        assert await store["foo"].read() == 1


def test_the_limit_of_one_blocking_call_is_its_own(server):
    with reem.RedisInterface(server, timeout=30) as interface:
        store = reem.KeyValueStore(interface)
        store["foo"] = 1
        with stopped(server), reem.timeout(0.2), pytest.raises(ConnectionLost, match=r"0\.2 s"):
            store["foo"].read()
        with reem.timeout(20):
            assert store["foo"].read() == 1


@pytest.mark.parametrize("seconds", [0, -1, float("nan"), float("inf"), True, "1", None])
def test_what_is_no_time_limit_is_refused(seconds):
    with pytest.raises(BadInput, match="timeout"), reem.timeout(seconds):
        pass


@pytest.mark.parametrize(
    ("before", "left", "limit", "moved"),
    [
        (9000, 9000, 1.0, 10.0),  # nothing was confirmed
        (0, 9000, 1.0, 10.0),  # written, not yet on its way
        (9000, 4000, 1.0, 10.5),  # moves
        (9000, 0, 1.0, 10.46),  # all is there: the kernel may say so 40 ms late
        (9000, 0, 0.25, 10.49),  # of a short limit, no more than a 25th is given away
        (9000, 0, 100.0, 10.46),
        (0, 0, 1.0, 10.0),
    ],
)
def test_the_last_confirmation_of_an_upload_counts_from_when_its_bytes_may_have_come(before, left, limit, moved):
    assert moved_last(10.0, 10.5, before, left, limit) == pytest.approx(moved)
    assert moved_last(10.495, 10.5, before, left, limit) >= 10.495  # never before what was seen


async def test_a_slow_upload_is_not_cut_off(server):
    """More than twice the limit, but bytes move."""
    value = np.zeros(12 << 20, np.uint8)

    def blocking():
        with reem.RedisInterface(slow.url, timeout=0.5) as interface:
            begin = time.monotonic()
            reem.KeyValueStore(interface)["big"] = value
            return time.monotonic() - begin

    with Proxy(server.port, buffer=1 << 16) as slow:  # what waits there looks delivered to the sender
        slow.delay = CHUNK / (10 << 20)
        async with reem_async.RedisInterface(slow.url, timeout=0.5) as interface:
            begin = time.monotonic()
            await reem_async.KeyValueStore(interface)["big"].write(value)
            assert time.monotonic() - begin > 1.0
        assert await asyncio.to_thread(blocking) > 1.0


async def test_states_are_told_in_order_and_to_callbacks(server):
    interface = reem_async.RedisInterface(server)
    heard = []
    interface.on_state(heard.append)
    interface.on_state(lambda change: 1 / 0)  # logged, and nothing else
    assert interface.state == "idle"
    changes = interface.states()
    await interface.initialize()
    await aeventually(lambda: interface.state == "connected")
    await interface.close()
    assert [change.state async for change in changes] == ["idle", "connected", "closed"]
    assert [change.state for change in heard] == ["connected", "closed"]
    assert interface.state == "closed"
    assert [change.state async for change in interface.states()] == ["closed"]


async def test_a_restarted_server_is_told_apart():
    with PrivateServer(keep=True) as server:
        async with reem_async.RedisInterface(server.url) as interface:
            store = reem_async.KeyValueStore(interface)
            changes = interface.states()
            await store["foo"].write(1)
            async with store["foo"].watch() as updates:
                assert (await anext(updates)).initial
                server.kill()
                await aeventually(lambda: interface.state == "reconnecting")
                with pytest.raises(NotConnected):
                    await store["foo"].read()
                server.start()
                update = await asyncio.wait_for(anext(updates), PATIENCE)
                assert (update.gap, update.missed) == (True, None)
                await aeventually(lambda: interface.state == "connected")
    told = [change async for change in changes]
    assert [change.state for change in told] == ["connected", "lost", "reconnecting", "connected", "closed"]
    assert [change.restarted for change in told] == [False, False, False, True, False]
    assert "restarted" in told[3].reason


async def test_a_connection_cut_by_the_server_is_no_restart(server, raw):
    async with reem_async.RedisInterface(server.url) as interface:
        await reem_async.KeyValueStore(interface)["foo"].write(1)
        changes, heard = interface.states(), []
        interface.on_state(heard.append)
        with redis.Redis.from_url(server.url) as other:
            other.client_kill_filter(_type="normal", skipme=True)
        await aeventually(lambda: len(heard) == 2)  # without a call
        assert await reem_async.KeyValueStore(interface)["foo"].read() == 1
    told = [(change.state, change.restarted) async for change in changes]
    assert told == [("connected", False), ("lost", False), ("connected", False), ("closed", False)]


def killed_connections(server, **which):
    with redis.Redis.from_url(server.url, decode_responses=True) as raw:
        for row in raw.client_list():
            if all(row[name] == value for name, value in which.items()):
                raw.client_kill_filter(_id=row["id"], skipme=True)


async def test_a_connection_that_breaks_beside_one_that_follows_is_no_loss(server):
    """Nobody would make it anew before the next call, which may be a long time."""
    async with reem_async.RedisInterface(server) as interface, reem_async.RedisInterface(server) as other:
        space, heard = reem_async.PublishSpace(other), []
        await space["foo"].write({"n": 0})
        mirror = reem_async.SilentSubscriber("foo", interface)
        await mirror.listen()
        await reem_async.KeyValueStore(interface)["foo"].read()
        interface.on_state(heard.append)
        calls = interface.session.transport._lanes[False]
        (number,) = await calls.roundtrip([("CLIENT", "ID")])
        killed_connections(server, id=str(number))
        await aeventually(lambda: not calls.alive)
        await space["foo"].write({"n": 1})
        await aeventually(lambda: mirror.value() == {"n": 1})
        await asyncio.sleep(0.1)
        assert (interface.state, heard) == ("connected", [])


async def test_one_of_two_connections_for_calls_that_breaks_is_no_loss(server):
    """The one for large values, of a program that goes on with small ones."""
    async with reem_async.RedisInterface(server) as interface:
        store, heard = reem_async.KeyValueStore(interface), []
        await store["foo"].write(np.zeros(1 << 17))
        await store["foo"].read()
        lanes = interface.session.transport._lanes
        assert len(lanes) == 2
        interface.on_state(heard.append)
        (number,) = await lanes[True].roundtrip([("CLIENT", "ID")])
        killed_connections(server, id=str(number))
        await aeventually(lambda: not lanes[True].alive)
        await store["foo"].type()
        assert (interface.state, heard) == ("connected", [])


async def test_followers_that_are_cut_off_are_told_whatever_else_works(server):
    async with reem_async.RedisInterface(server) as interface:
        store, heard = reem_async.KeyValueStore(interface), []
        await store["foo"].write(1)
        mirror = reem_async.SilentSubscriber("foo", interface)
        await mirror.listen()
        interface.on_state(lambda change: heard.append(change.state))
        with redis.Redis.from_url(server.url, decode_responses=True) as raw:
            (following,) = subscribed(raw)
        killed_connections(server, id=following)
        await aeventually(lambda: len(heard) == 3)
        assert heard == ["lost", "reconnecting", "connected"]


def two_idle(transport):
    """Two connections of the blocking front, the one that is taken next last."""
    lines = [transport._take() or finish(transport._opened()) for _ in range(2)]
    for line in lines:
        transport._give(line)
    return lines


def test_a_blocking_call_that_finds_another_connection_has_lost_nothing(server):
    with reem.RedisInterface(server) as interface:
        transport, heard = interface._direct.session.transport, []
        first, second = two_idle(transport)
        interface.on_state(lambda change: heard.append(change.state))
        killed_connections(server, id=str(second.exchange([("CLIENT", "ID")])[0]))
        eventually(lambda: not second.fresh())
        reem.KeyValueStore(interface)["foo"] = 1
        assert (interface.state, heard) == ("connected", [])
        killed_connections(server, id=str(first.exchange([("CLIENT", "ID")])[0]))
        eventually(lambda: not first.fresh())
        reem.KeyValueStore(interface)["foo"] = 2
        assert (interface.state, heard) == ("connected", ["lost", "connected"])


def test_a_blocking_call_that_fails_leaves_no_state_behind_that_the_next_one_does_not_mend(server):
    with reem.RedisInterface(server, timeout=0.3) as interface:
        transport = interface._direct.session.transport
        two_idle(transport)
        with stopped(server), pytest.raises(ConnectionLost):
            reem.KeyValueStore(interface)["foo"].read()
        assert interface.state == "lost"
        reem.KeyValueStore(interface)["foo"] = 1
        assert interface.state == "connected"


@pytest.mark.alone
async def test_a_stopped_server_is_noticed_by_who_only_follows(server):
    async with reem_async.RedisInterface(server, timeout=0.5) as interface:
        store, space = reem_async.KeyValueStore(interface), reem_async.PublishSpace(interface)
        await space["foo"].write(1)
        async with store["foo"].watch() as updates:
            assert (await anext(updates)).initial
            with stopped(server):
                begin = time.monotonic()
                await aeventually(lambda: interface.state in ("lost", "reconnecting"))
                assert time.monotonic() - begin < 3.5
            update = await asyncio.wait_for(anext(updates), PATIENCE)
            assert (update.gap, update.data) == (True, 1)


@pytest.mark.alone
async def test_a_connection_that_breaks_gives_no_other_more_time(server, monkeypatch):
    """The others are asked whether the server is gone, but not one that owes an answer: it would be waited for anew."""
    monkeypatch.setattr(manager_module, "_PERIOD", 1000.0)
    async with reem_async.RedisInterface(server, timeout=1) as interface:
        store = reem_async.KeyValueStore(interface)
        await store["foo"].write(1)
        async with store["foo"].watch():
            (followed,) = manager_of(interface.session)._wires.values()
            with stopped(server):
                begin = time.monotonic()
                owed = asyncio.ensure_future(followed.roundtrip([("PING",)]))
                await asyncio.sleep(0.6)
                for wire in list(interface.session.transport._open):
                    if wire is not followed:
                        wire.abort(ConnectionLost("cut"))
                with pytest.raises(ConnectionLost):
                    await owed
                await aeventually(lambda: not followed.alive)
                assert time.monotonic() - begin < 1.5


async def test_a_lost_last_update_is_noticed(server):
    """The server says that there was one more: as if its notice had been dropped on the way."""
    async with reem_async.RedisInterface(server) as interface, reem_async.RedisInterface(server) as other:
        store, space = reem_async.KeyValueStore(interface), reem_async.PublishSpace(other)
        await space["foo"].write(1)
        async with store["foo"].watch() as updates:
            assert (await anext(updates)).data == 1
            await space["foo"].write(2)
            update = await asyncio.wait_for(anext(updates), PATIENCE)
            assert (update.data, update.gap, update.missed) == (2, False, 0)
            # Written and noted as published, at one instant, and never announced.
            keys = space["foo"]._reader.keys
            noted = ("SET", keys.last, note_of(*other.session.stamp(keys)), "EX", "60")
            await other.session.run(Plan([("JSON.SET", keys.document, "$", "3"), noted], list, atomic=True))
            update = await asyncio.wait_for(anext(updates), PATIENCE)
            assert (update.data, update.gap, update.missed) == (3, True, 1)
            await space["foo"].write(4)
            update = await asyncio.wait_for(anext(updates), PATIENCE)
            assert (update.data, update.gap, update.missed) == (4, False, 0)


async def test_updates_missed_in_between_are_counted(server):
    async with reem_async.RedisInterface(server) as interface:
        store, space = reem_async.KeyValueStore(interface), reem_async.PublishSpace(interface)
        await space["foo"].write({"big": 0})
        async with store["foo"].watch() as updates:
            await anext(updates)
            await space["foo"].write({"big": 1})  # from here on the publisher is known
            await anext(updates)
            for value in (1, np.zeros(100_000)):
                interface.session.stamp(space["foo"]._reader.keys)
                interface.session.stamp(space["foo"]._reader.keys)
                await space["foo"]["big"].write(value)
                update = await asyncio.wait_for(anext(updates), PATIENCE)
                assert (update.gap, update.missed) == (True, 2)
                await space["foo"]["big"].write(value)
                update = await asyncio.wait_for(anext(updates), PATIENCE)
                assert (update.gap, update.missed) == (False, 0)


def test_an_idle_blocking_connection_survives_a_restart():
    """No call fails for a connection that the server had closed before."""
    with PrivateServer() as server, reem.RedisInterface(server.url) as interface:
        store = reem.KeyValueStore(interface)
        store["foo"] = 1
        server.kill()
        server.start()
        store["bar"] = 2
        assert store["bar"].read() == 2
        assert interface.states().__next__().restarted


@pytest.mark.alone
@pytest.mark.parametrize("json", [True, False], ids=["json", "plain"])
@pytest.mark.parametrize("front", ["tasks", "threads"])
async def test_calls_that_wait_for_each_other_share_the_time_limit(json, front):
    """Without the module those who change parts of one document go one after the other."""
    took, told = [], []

    def note(begin, error):
        took.append(time.monotonic() - begin)
        told.append(error)

    with EmbeddedServer(json=json) as own, reem.RedisInterface(own, timeout=0.5) as blocking:
        async with reem_async.RedisInterface(own, timeout=0.5) as interface:
            foo, here = reem_async.KeyValueStore(interface)["foo"], reem.KeyValueStore(blocking)["foo"]
            await foo.write({})

            async def write(number):
                begin = time.monotonic()
                try:
                    if front == "tasks":
                        await foo[f"n{number}"].write(number)
                    else:
                        await asyncio.to_thread(here[f"n{number}"].write, number)
                except (ConnectionLost, NotConnected) as error:
                    note(begin, error)

            for _ in range(2):
                await asyncio.gather(*map(write, range(6)))
            assert not told
            with stopped(own):
                await asyncio.gather(*map(write, range(6)))
            assert len(told) == 6
            assert max(took) < 1.4, took
            if not json:
                assert sum(isinstance(error, ConnectionLost) for error in told) == 1, told
            await foo["after"].write(1)
