"""What ails one follower, or one key, and leaves the others of an interface alone: rights, strangers, cancellations."""

import asyncio
import contextlib
import logging

import numpy as np
import pytest
from conftest import PLAIN, aeventually

import reem_async
from reem_async import Last
from reem_async.concurrency.queues import EMPTY
from reem_async.errors import NotAllowed, ServerNotReady
from reem_async.plan.keys import keys_of
from reem_async.pubsub.manager import manager_of
from reem_async.pubsub.monitor import Monitor

PATIENCE = 10


class Mine(reem_async.BytesShip):
    def get_label(self):
        return "mine"


@pytest.fixture
async def other(server):
    async with reem_async.RedisInterface(server, ships=[reem_async.NumpyShip(), Mine()]) as other:
        yield other


async def user(other, *rules):
    await other.client.execute_command("ACL", "SETUSER", "u", "reset", "on", ">p", *rules)


def of_user(server):
    return reem_async.RedisInterface(server, username="u", password="p")


async def following(interface, name):
    subscriber = reem_async.SilentSubscriber(name, interface)
    await subscriber.listen()
    return subscriber


async def cancelled(call, moment):
    task = asyncio.ensure_future(call)
    await moment
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def gathered(stack, stream):
    """Begin to follow; returns the list that what is told goes into."""
    await stream.listen()
    told = []

    async def hand_on(take):
        async for each in stream:
            take(each)

    task = asyncio.ensure_future(hand_on(told.append))
    stack.callback(task.cancel)
    return told


async def test_a_value_of_a_ship_that_is_lacking_ends_nobodys_following(server, other):
    """Its place is remembered by who leaves it at the server; who wants it warns, and goes on with the next."""
    pub = reem_async.PublishSpace(other)
    await pub["cam"].write({"n": 1})
    await pub["arm"].write(1)
    async with reem_async.RedisInterface(server) as interface:
        cam, arm = await following(interface, "cam"), await following(interface, "arm")
        async with reem_async.KeyValueStore(interface)["cam"].mirror(largest=1000) as mirror:
            await pub["cam"].write({"n": 2, "blob": b"x" * 20_000})
            await aeventually(lambda: mirror.value()["n"] == 2)
            await pub["cam"]["blob"].write(b"y" * 20_000)
            await pub["arm"].write(2)
            await aeventually(lambda: arm.value() == 2)
            await pub["cam"].write({"n": 3})
            await aeventually(lambda: cam.value() == mirror.value() == {"n": 3})
        assert (interface.state, interface.unreadable) == ("connected", 1)


@pytest.fixture
def held(monkeypatch):
    """Keep what subscribes from being confirmed; returns what is set when it would have been, and what lets it go."""

    def hold(manager):
        waiting, go_on = asyncio.Event(), []
        confirmed = manager._subscribing._confirmed

        def later(*arguments):
            go_on.append(arguments)
            waiting.set()

        def let_go():
            monkeypatch.undo()
            for arguments in go_on:
                confirmed(*arguments)

        monkeypatch.setattr(manager._subscribing, "_confirmed", later)
        return waiting, let_go

    return hold


async def test_a_cancelled_listen_leaves_no_other_subscriber_of_the_channel_behind(server, other, held):
    pub = reem_async.PublishSpace(other)
    await pub["b"].write(1)
    async with reem_async.RedisInterface(server) as interface:
        before, manager = await following(interface, "b"), manager_of(interface.session)
        waiting, let_go = held(manager)
        for wire in list(manager._wires.values()):
            wire.abort(reem_async.ConnectionLost("cut"))
        await cancelled(following(interface, "b"), waiting.wait())
        let_go()
        await pub["b"].write(2)
        await aeventually(lambda: before.value() == 2)


async def test_a_cancelled_listen_leaves_no_subscription(server, other, held):
    async with reem_async.RedisInterface(server) as interface:
        await following(interface, "a")
        manager = manager_of(interface.session)
        waiting, let_go = held(manager)
        await cancelled(following(interface, "b"), waiting.wait())
        let_go()
        await manager.fence()
        assert not [topic for topic in (*manager._subscribed, *manager._topics) if b"{b}" in topic.name]
        assert not [name for name in await other.client.pubsub_channels() if "{b}" in str(name)]


async def test_a_channel_that_is_refused_keeps_no_other_from_being_followed(server, other):
    """A right was taken away: who has it still begins."""
    await user(other, "~*", "&*", "+@all")
    pub = reem_async.PublishSpace(other)
    await pub["a"].write(1)
    await pub["b"].write(1)
    async with of_user(server) as interface:
        refused = await following(interface, "b")
        await other.client.execute_command("ACL", "SETUSER", "u", "resetchannels", "&{a}*")  # ends the connection
        await aeventually(lambda: refused._link.follower.down)
        assert (await following(interface, "a")).value() == 1
        with pytest.raises(NotAllowed, match=r"SUBSCRIBE \{b\}:notices"):
            await following(interface, "b")


BUSY = """
local function now() local t = redis.call('TIME'); return t[1] * 1000000 + t[2] end
local begun = now(); while now() < begun + 400000 do end
"""


@contextlib.asynccontextmanager
async def busy(other):
    """The server runs somebody's script."""
    await other.client.execute_command("CONFIG", "SET", "busy-reply-threshold", "1")
    script = asyncio.ensure_future(other.client.eval(BUSY, 0))
    await asyncio.sleep(0.05)
    yield
    await script


async def test_a_busy_server_is_asked_again_to_tell_what_is_changed(server, other):
    """As the connection is made anew, and as a mirror begins; it was taken for a right that is lacking."""
    theirs = reem_async.KeyValueStore(other)
    await theirs["foo"].write(1)
    async with reem_async.RedisInterface(server) as interface:
        await following(interface, "beside")
        async with busy(other):
            with pytest.raises(ServerNotReady, match="CLIENT TRACKING"):
                await reem_async.KeyValueStore(interface)["foo"].mirror().listen()
        async with reem_async.KeyValueStore(interface)["foo"].mirror(max_age=2.0) as mirror:
            async with busy(other):
                for wire in list(manager_of(interface.session)._wires.values()):
                    wire.abort(reem_async.ConnectionLost("cut"))
            await aeventually(lambda: interface.state == "connected")
            await theirs["foo"].write(2)
            await mirror.wait_until(lambda value: value == 2, PATIENCE)


async def test_who_may_not_touch_keys_is_warned_that_he_hears_of_no_store(server, other, caplog):
    """Large values are touched before they are read; without the right to that nothing says that they were changed."""
    await user(other, "~*", "&*", "+@all", "-type")
    await reem_async.KeyValueStore(other)["cam"].write({"image": np.zeros(300_000, np.uint8)})
    async with of_user(server) as interface, reem_async.KeyValueStore(interface)["cam"].watch() as watch:
        assert (await anext(watch)).data["image"].size == 300_000
        await reem_async.PublishSpace(other)["cam"]["n"].write(1)
        assert (await asyncio.wait_for(anext(watch), PATIENCE)).value == 1
    assert [record.message for record in caplog.records if "needs the right +type" in record.message]


@pytest.mark.parametrize("late", [False, True])
async def test_a_key_that_may_not_be_read_keeps_no_other_from_being_watched(server, other, caplog, late):
    """Whether it was there before or comes to be."""
    caplog.set_level(logging.WARNING)
    await user(other, "~a*", "~{a*", "~c*", "~{c*", "&*", "+@all")
    theirs = reem_async.KeyValueStore(other)

    async def write():
        for name in "abc":
            await theirs[name].write(1)

    async with of_user(server) as interface:
        with contextlib.ExitStack() as stack:
            if not late:
                await write()
            told = await gathered(stack, reem_async.KeyValueStore(interface).watch())
            if late:
                await write()
            await aeventually(lambda: {each.path for each in told} == {"a", "c"})
            await theirs["c"].write(2)
            await aeventually(lambda: told[-1].data == 2)
    # Without the module a document is told from other texts by what is in it, which this user may not read.
    assert PLAIN or [record for record in caplog.records if "b cannot be watched" in record.message]


async def lose_one(other, value):
    """Publish an update of the battery whose notice is lost on the way."""
    other.session.stamp(keys_of("robot"))
    await reem_async.KeyValueStore(other)["robot"]["r1"]["battery"].write(value)


@pytest.mark.parametrize("kind", ["monitor", "watch"])
async def test_a_loss_is_told_with_the_next_update_that_a_pattern_names(server, other, kind):
    """Though it shows in another one before that."""
    pub = reem_async.PublishSpace(other)
    await pub["robot"].write({"r1": {"battery": 1, "speed": 0}})
    pattern = "robot.*.battery"
    async with reem_async.RedisInterface(server) as interface:
        with contextlib.ExitStack() as stack:
            watch = reem_async.KeyValueStore(interface).watch(pattern, policy=Last(100))
            told = await gathered(stack, Monitor(interface, [pattern]) if kind == "monitor" else watch)
            await pub["robot"]["r1"]["battery"].write(2)
            await aeventually(lambda: told and told[-1].value == 2)
            await lose_one(other, 3)
            await lose_one(other, 4)
            await pub["robot"]["r1"]["speed"].write(1)
            await pub["robot"]["r1"]["battery"].write(5)
            await aeventually(lambda: told[-1].value == 5)
            await pub["robot"]["r1"]["battery"].write(6)
            await aeventually(lambda: told[-1].value == 6)
            since = [each for each in told if each.value != 2 and not getattr(each, "initial", False)]
            assert [each.missed for each in since if each.gap] == [2]
            assert not since[-1].gap


async def test_a_place_that_cannot_be_read_keeps_no_other_of_its_key_from_being_watched(server, other):
    """Those are told once, and each of their changes; the place itself is once it can be read."""
    pub = reem_async.PublishSpace(other)
    await pub["foo"].write({"a": 1, "b": b"x" * 20_000, "c": 3})
    async with reem_async.RedisInterface(server) as interface:
        with contextlib.ExitStack() as stack:
            watch = reem_async.KeyValueStore(interface).watch("foo.a", "foo.b", "foo.c", policy=Last(100))
            told = await gathered(stack, watch)
            await aeventually(lambda: {each.path for each in told} == {"foo.a", "foo.b", "foo.c"})
            (unreadable,) = [each.data for each in told if each.path == "foo.b"]
            assert isinstance(unreadable, reem_async.Unreadable)
            await watch.look()
            await pub["foo"]["a"].write(2)
            await aeventually(lambda: told[-1].value == 2)
            await pub["foo"]["b"].write(5)
            await aeventually(lambda: told[-1].data == 5)
            await pub["foo"]["c"].write(6)
            await aeventually(lambda: told[-1].value == 6)
    told.sort(key=lambda each: each.path)
    assert [(each.path, each.data, each.gap) for each in told] == [
        ("foo.a", 1, False),
        ("foo.a", 2, False),
        ("foo.b", unreadable, False),
        ("foo.b", 5, False),
        ("foo.c", 3, False),
        ("foo.c", 6, False),
    ]


async def test_a_subscriber_that_comes_while_a_cancelled_one_is_confirmed_begins_once(server, other, monkeypatch):
    """It has missed nothing, so it is told of no gap."""
    await reem_async.KeyValueStore(other)["k"].write(1)
    async with reem_async.RedisInterface(server) as interface:
        await following(interface, "beside")
        manager = manager_of(interface.session)
        confirmed, turn_on, kept = manager._subscribing._confirmed, manager.invalidations.turn_on, []
        monkeypatch.setattr(manager._subscribing, "_confirmed", lambda *arguments: kept.append(arguments))
        await cancelled(following(interface, "k"), aeventually(lambda: kept))
        monkeypatch.setattr(manager._subscribing, "_confirmed", confirmed)

        async def late(wire):
            while kept:  # the confirmation of the one before comes in between
                confirmed(*kept.pop())
            await turn_on(wire)

        monkeypatch.setattr(manager.invalidations, "turn_on", late)
        with contextlib.ExitStack() as stack:
            told = await gathered(stack, reem_async.KeyValueStore(interface)["k"].watch(Last(10)))
            await manager.fence()
            await reem_async.PublishSpace(other)["k"].write(2)
            await aeventually(lambda: told and told[-1].data == 2)
    assert [(each.data, each.gap, each.initial) for each in told] == [(1, False, True), (2, False, False)]


async def test_a_monitor_of_ever_so_many_keys_says_once_of_each_that_something_may_be_lost(server, monkeypatch):
    """Keys that no pattern names do not count."""
    from reem_async.plan.notices import Notice
    from reem_async.pubsub import monitor as module

    monkeypatch.setattr(module, "_MOST_OWED", 10)
    async with reem_async.RedisInterface(server) as interface:
        for pattern, due in (("*", 30), ("*.other", 0)):
            async with Monitor(interface, [pattern]) as monitor:
                broken = []
                monitor.broken = lambda broken=broken: broken.append(1)
                monitor._lost()
                gaps = 0
                for turn in range(1, 4):
                    for number in range(30):
                        name = f"k{number}"
                        monitor._heard(Notice("p", turn, 0.0, ("x",), False, 1), f"{{{name}}}:notices".encode())
                        while (event := monitor.queue.take()) is not EMPTY:
                            gaps += event.gap
                assert (gaps, broken) == (due, [1])
