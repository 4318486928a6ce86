"""Defects that a review found, one test for each: publishing and following."""

import asyncio
import contextlib
import logging
import os
import threading

import numpy as np
import pytest
from conftest import PATIENCE, aeventually, assert_same, homes, python, subscribed

import reem
import reem_async
from reem_async import CallbackSubscriber, Every, KeyValueStore, PublishSpace, RedisInterface
from reem_async import SilentSubscriber as Mirror
from reem_async.errors import BadType, InterfaceClosed, PathRefused


async def waiting(awaitable):
    return await asyncio.wait_for(awaitable, PATIENCE)


def taken(updates):
    return [updates.queue.take() for _ in range(len(updates.queue._items))]


def connections(raw):
    return {row["id"] for row in raw.client_list()}


async def cut(raw, others):
    """Kill every subscribed connection but `others`, and let the client notice: it waits before it reconnects."""
    mine = subscribed(raw) - others
    assert mine
    for connection in mine:
        raw.client_kill_filter(_id=connection)
    await asyncio.sleep(0.01)


async def test_an_update_that_the_server_refuses_is_never_left_in_a_mirror(ainterface, akvs, apspace, key):
    """For want of a parent; nor does a callback get it."""
    heard = []
    await apspace[key()].write({"m": {"x": 1}})
    await apspace[key()]["m"].write({"x": 1})
    async with (
        Mirror(f"{key()}.m", ainterface) as mirror,
        CallbackSubscriber(f"{key()}.a.b", ainterface, lambda data, updated_path: heard.append(data)),
        Mirror(f"{key()}.a.b", ainterface) as below,
    ):
        with pytest.raises(PathRefused):
            await apspace[key()]["a"]["b"].write(5)
        await akvs[key()].write(7)
        for value in ({"x": 2}, {"x": np.arange(3)}):
            with pytest.raises(PathRefused):
                await apspace[key()]["m"].write(value)
        await aeventually(lambda: mirror.value() is None)
        await apspace[key()].write({"a": {"b": 6}, "m": {"x": 4}})
        await aeventually(lambda: mirror.value() == {"x": 4} and below.value() == 6 and 6 in heard)
        assert 5 not in heard


FORK = """
import os, sys
import reem
space = reem.PublishSpace(reem.RedisInterface(sys.argv[1]))
space[sys.argv[2]] = {"n": 0}
child = os.fork()
if child == 0:
    for number in range(1, 6):
        space[sys.argv[2]]["n"] = number
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
for number in range(6, 11):
    space[sys.argv[2]]["n"] = number
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
async def test_after_a_fork_parent_and_child_are_two_publishers(server_url, akvs, ainterface, key):
    """Otherwise the parent's numbers would seem to come a second time, and mirrors would skip them."""
    updates = akvs[key()].watch(Every(1000))
    async with Mirror(key(), ainterface) as mirror, updates:
        done = await asyncio.to_thread(python, FORK, server_url, key())
        assert done.returncode == 0, done.stderr
        await aeventually(lambda: (mirror.value() or {}).get("n") == 10)
        await aeventually(lambda: len(updates.queue._items) == 11)
    heard = taken(updates)
    assert [update.data["n"] for update in heard] == list(range(11))
    assert heard[0].publisher == heard[-1].publisher != heard[3].publisher
    assert not any(update.gap for update in heard)


async def test_a_cancelled_large_publish_and_a_later_small_one_keep_their_order(
    ainterface, apspace, akvs, binterface, key
):
    large, other = np.zeros(2_000_000), np.zeros(20_000)
    await apspace[key()].write(other)
    async with Mirror(key(), binterface) as mirror:
        for number in range(8):
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(apspace[key()].write(large), 0.002 * number)
            await apspace[key()].write(number)
            await akvs[key("behind")].write(other)  # goes behind all that is still on its way
            assert_same(await akvs[key()].read(), number)
            await aeventually(lambda number=number: repr(mirror.value()) == repr(number))


@pytest.mark.parametrize("kind", ["watch", "mirror", "callback"])
async def test_closing_while_listen_waits_ends_it_and_leaves_the_interface_usable(server_url, kvs, key, kind):
    """At whatever moment; later subscribers are not blocked by it."""
    kvs[key()] = {"big": "x" * 1_000_000}
    ended = []
    for turns in [*range(12), 15, 20, 30, 50]:
        async with asyncio.timeout(PATIENCE), RedisInterface(server_url) as interface:
            made = {
                "watch": lambda interface=interface: KeyValueStore(interface)[key()].watch(),
                "mirror": lambda interface=interface: Mirror(key(), interface),
                "callback": lambda interface=interface: CallbackSubscriber(key(), interface, lambda *_: None),
            }[kind]()
            task = asyncio.create_task(made.listen())
            for _ in range(turns):
                await asyncio.sleep(0)
            await made.close()
            done, _ = await asyncio.wait([task], timeout=3.0)
            task.cancel()
            assert done, f"listen() goes on waiting, closed after {turns} turns"
            ended.append(task.exception())
            async with Mirror(key("else"), interface):
                pass
    assert {type(error) for error in ended} <= {InterfaceClosed, type(None)}, ended
    assert any(ended)


@pytest.mark.parametrize("module", [reem, reem_async])
async def test_closing_a_subscriber_after_its_interface_is_quiet(server_url, key, module):
    async def done(result):
        return await result if asyncio.iscoroutine(result) else result

    interface = module.RedisInterface(server_url)
    made = [
        module.SilentSubscriber(key(), interface),
        module.CallbackSubscriber(key(), interface, lambda data, updated_path: None),
        module.KeyValueStore(interface)[key()].watch(),
        module.SilentSubscriber(key(), interface),  # these never listen
        module.KeyValueStore(interface)[key()].watch(),
    ]
    for each in made[:-2]:
        await done(each.listen())
    await done(interface.close())
    for each in made:
        await done(each.close())


async def test_two_calls_of_listen_at_once_both_return_when_the_value_is_there(ainterface, akvs, key):
    await akvs[key()].write({"n": 1})
    mirror = Mirror(key(), ainterface)
    first = asyncio.create_task(mirror.listen())
    await asyncio.sleep(0)
    await waiting(mirror.listen())
    assert mirror.value() == {"n": 1}
    await waiting(first)
    await mirror.close()


async def test_who_begins_to_follow_in_an_outage_misses_nothing_and_no_connection_is_left_over(
    server_url, binterface, key, raw
):
    """Beginning to follow and reconnecting make one connection between them."""
    space = PublishSpace(binterface)
    for name in (key(), key("0"), key("2"), key("4")):
        await space[name].write(-1)
    others, before = subscribed(raw), connections(raw)
    async with RedisInterface(server_url) as interface:
        first = Mirror(key(), interface)
        await first.listen()
        for number in range(0, 5, 2):  # in a cluster: now there are connections to all nodes that will be needed
            early = Mirror(key(str(number)), interface)
            await early.listen()
            await early.close()
        await KeyValueStore(interface).keys()  # and to any that may be asked who has what
        base = len(connections(raw))
        for number in range(5):
            await cut(raw, others)
            mirror = Mirror(key() if number % 2 else key(str(number)), interface)
            await waiting(mirror.listen())
            channel = mirror.channel
            await space[channel].write(number)
            await aeventually(lambda mirror=mirror, number=number: mirror.value() == number, 1.0)
            await space[key()].write(number)
            await aeventually(lambda number=number: first.value() == number, 1.0)
            await asyncio.sleep(0.07)  # by now a second attempt to reconnect would have been made
            assert len(subscribed(raw) - others) == homes(raw, {key(), channel})
            await space[channel].write(100 + number)
            await aeventually(lambda mirror=mirror, number=number: mirror.value() == 100 + number, 1.0)
        assert len(connections(raw)) <= base
    await aeventually(lambda: connections(raw) <= before)


async def test_nothing_goes_on_reconnecting_for_a_subscriber_that_was_closed_in_an_outage(server_url, key, raw):
    """Nor does a later subscriber have to wait for it."""
    others = subscribed(raw)
    async with RedisInterface(server_url, timeout=0.2) as interface:
        mirror = Mirror(key(), interface)
        await mirror.listen()
        await cut(raw, others)
        await mirror.close()
        before = raw.info("stats")["total_connections_received"]
        await asyncio.sleep(0.7)  # it would have tried at 0.05, 0.35 and 0.7 s
        assert raw.info("stats")["total_connections_received"] == before
        assert subscribed(raw) == others
        async with asyncio.timeout(1.0), Mirror(key(), interface):
            pass


async def test_an_update_of_over_32_megabytes_is_mirrored_and_small_ones_arrive_meanwhile(
    ainterface, server_url, key, raw
):
    """Servers close a subscribed connection that owes so much."""
    others = subscribed(raw)
    async with (
        Mirror(key("large"), ainterface) as large,
        Mirror(key("small"), ainterface) as small,
        reem_async.RedisInterface(server_url, local="off") as far,
    ):
        connection = subscribed(raw) - others
        space = PublishSpace(far)
        image = np.arange(5_000_000.0)
        number, most = 0, 0
        for again in range(3):  # how many fit in between depends on the machine
            await space[key("large")].write({"image": image, "again": again})
            meanwhile = set()
            while (large.value() or {}).get("again") != again:
                number += 1
                await waiting(space[key("small")].write(number))
                meanwhile.add(small.value())
            assert np.array_equal(large["image"].read(), image)
            if (most := max(most, len(meanwhile))) > 3:
                break
        assert most > 3
        assert subscribed(raw) - others == connection


async def test_a_callback_subscriber_fetches_a_large_update_once(ainterface, binterface, key, raw):
    """Its value and its calls have one follower."""
    calls = []
    subscriber = CallbackSubscriber(key(), ainterface, lambda data, updated_path: calls.append(data))
    async with subscriber:
        before = raw.info("stats")["total_net_output_bytes"]
        await PublishSpace(binterface)[key()].write(np.zeros(500_000))
        await aeventually(lambda: calls and subscriber.value() is not None)
        await asyncio.sleep(0.05)
        assert raw.info("stats")["total_net_output_bytes"] - before < 6_000_000
        assert len(calls) == 1


@pytest.mark.parametrize("module", [reem, reem_async])
async def test_a_callback_subscriber_whose_queue_overflows_says_that_it_ends(server_url, apspace, key, caplog, module):
    """With `Every`; what was waiting is still delivered."""
    gate, heard = threading.Event(), []

    def call(data, updated_path):
        heard.append(data)
        gate.wait(PATIENCE)

    async def acall(data, updated_path):
        heard.append(data)
        while not gate.is_set():
            await asyncio.sleep(0.001)

    function = call if module is reem else acall
    interface = module.RedisInterface(server_url)
    subscriber = module.CallbackSubscriber(key(), interface, function, policy=Every(3))
    with caplog.at_level(logging.ERROR, logger="reem.subscribe"):
        if (listening := subscriber.listen()) is not None:
            await listening
        for number in range(10):
            await apspace[key()].write(number)
            await aeventually(lambda: heard)
        await aeventually(lambda: subscriber.value() == 9)
        gate.set()
        await aeventually(lambda: "not called any more" in caplog.text)
    assert heard == [0, 1, 2, 3]
    assert key() in caplog.text
    for close in (subscriber.close, interface.close):
        if (closing := close()) is not None:
            await closing


def test_a_coroutine_function_is_refused_as_a_callback_of_the_blocking_front(interface, key):
    async def callback(data, updated_path):
        pass

    with pytest.raises(BadType, match="coroutine"):
        reem.CallbackSubscriber(key(), interface, callback)


async def test_a_follower_of_an_index_that_is_too_far_from_the_end_sees_nothing(ainterface, apspace, key):
    """Where the server would say the first item; also when the list has shrunk under it."""
    await apspace[key()].write([10, {"x": 20}])
    async with Mirror(key() + "[-5]", ainterface) as far, Mirror(key() + "[-2]", ainterface) as near:
        assert far.value() is None
        assert near.value() == 10
        await apspace[key()].append(30)
        await aeventually(lambda: near.value() == {"x": 20})
        await apspace[key()][1]["x"].write(21)
        await aeventually(lambda: near["x"].read() == 21)
        await apspace[key()].write([40])
        await aeventually(lambda: near.value() is None)
        assert far.value() is None
