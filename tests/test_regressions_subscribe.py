"""Defects that a review found, one test for each: publishing and following."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import signal
import sys
import threading
import time

import numpy as np
import orjson
import pytest
from conftest import PATIENCE, aeventually, assert_same, homes, python, subscribed

import reem
import reem_async
from reem_async import CallbackSubscriber, Every, KeyValueStore, Last, PublishSpace, RedisInterface
from reem_async import SilentSubscriber as Mirror
from reem_async.errors import BadType, InterfaceClosed, PathRefused, QueueFull


async def waiting(awaitable):
    """The result, or a failure in place of waiting for ever."""
    return await asyncio.wait_for(awaitable, PATIENCE)


def taken(updates):
    """All updates that wait in a loop."""
    return [updates.queue.take() for _ in range(len(updates.queue._items))]


def connections(raw):
    """The ids of all connections."""
    return {row["id"] for row in raw.client_list()}


async def cut(raw, others):
    """Kill every subscribed connection but `others`, and let the client notice: it waits before it reconnects."""
    mine = subscribed(raw) - others
    assert mine
    for connection in mine:
        raw.client_kill_filter(_id=connection)
    await asyncio.sleep(0.01)


# --- what is followed -----------------------------------------------------------------------------


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
    """Though they take different connections."""
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


# --- closing --------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("kind", ["watch", "mirror"])
def test_closing_while_a_blocking_listen_waits_ends_it(server_url, kvs, key, kind):
    """From another thread."""
    kvs[key()] = {"big": "x" * 4_000_000}
    with reem.RedisInterface(server_url) as interface:
        store = reem.KeyValueStore(interface)
        for number in range(6):
            made = store[key()].watch() if kind == "watch" else reem.SilentSubscriber(key(), interface)
            ended = []

            def listen(made=made, ended=ended):
                try:
                    made.listen()
                except BaseException as failure:
                    ended.append(failure)

            thread = threading.Thread(target=listen, daemon=True)
            thread.start()
            thread.join(0.002 * number)
            made.close()
            thread.join(PATIENCE)
            assert not thread.is_alive()
            assert all(isinstance(error, InterfaceClosed) for error in ended), ended
        with reem.SilentSubscriber(key(), interface) as mirror:
            assert mirror.value() == kvs[key()].read()


@pytest.mark.parametrize("module", [reem, reem_async])
async def test_closing_a_subscriber_after_its_interface_is_quiet(server_url, key, module):
    """The interface has closed it already."""

    async def done(result):
        return await result if asyncio.iscoroutine(result) else result

    interface = module.RedisInterface(server_url)
    made = [
        module.SilentSubscriber(key(), interface),
        module.CallbackSubscriber(key(), interface, lambda data, updated_path: None),
        module.KeyValueStore(interface)[key()].watch(),
        module.SilentSubscriber(key(), interface),  # never listens
    ]
    for each in made[:-1]:
        await done(each.listen())
    await done(interface.close())
    for each in made:
        await done(each.close())


async def test_two_calls_of_listen_at_once_both_return_when_the_value_is_there(ainterface, akvs, key):
    """The second does not return early."""
    await akvs[key()].write({"n": 1})
    mirror = Mirror(key(), ainterface)
    first = asyncio.create_task(mirror.listen())
    await asyncio.sleep(0)
    await waiting(mirror.listen())
    assert mirror.value() == {"n": 1}
    await waiting(first)
    await mirror.close()


# --- outages --------------------------------------------------------------------------------------


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


# --- large updates --------------------------------------------------------------------------------


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


async def test_a_mirror_beside_a_publisher_of_large_and_small_never_goes_back(ainterface, server_url, akvs, key):
    """Large values go another way than small ones, and still it sees what the server went through, to the end."""

    def publish(start):
        for number in range(start, start + 12):
            if number % 12 == 8:
                space[key()] = {"n": number, "image": np.full(40_000, float(number))}
            elif number % 4 == 2:
                space[key()]["image"] = np.full(20_000, float(number))
            else:
                space[key()]["n"] = number

    await akvs[key()].write({"n": 0, "image": np.zeros(1)})
    updates, seen = akvs[key()].watch(Last(100_000)), []
    with reem.RedisInterface(server_url) as interface:
        space = reem.PublishSpace(interface)
        async with Mirror(key(), ainterface) as mirror, Mirror(f"{key()}.n", ainterface) as counter, updates:
            for start in range(0, 1200, 12):
                publishing = asyncio.create_task(asyncio.to_thread(publish, start))
                while not publishing.done():
                    seen.append((mirror["n"].read(), counter.value()))
                    await asyncio.sleep(0)
                await publishing
                last = start + 11
                await aeventually(lambda last=last: mirror["n"].read() == counter.value() == last)
                await aeventually(lambda last=last: mirror["image"].read()[0] == last - 1)
            assert_same(mirror.value(), await akvs[key()].read())
    for counts in ([update.data["n"] for update in taken(updates)], *map(list, zip(*seen, strict=True))):
        assert counts == sorted(counts)


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


# --- policies, callbacks and loops ----------------------------------------------------------------


async def test_every_update_cannot_be_had_of_large_ones_that_are_skipped(akvs, server_url, key):
    """Only the newest of them is ever fetched: the loop is told with QueueFull, and how many it missed."""
    updates = akvs[key()].watch(Every(100))
    await updates.listen()
    with reem.RedisInterface(server_url) as interface:
        space = reem.PublishSpace(interface)
        for number in range(20):  # the loop cannot run meanwhile
            space[key()] = np.full(5000, float(number))

    async def take_all():
        async for _ in updates:
            pass

    with pytest.raises(QueueFull):
        await waiting(take_all())
    assert updates.dropped > 0
    await updates.close()


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
    """It would never run."""

    async def callback(data, updated_path):
        pass

    with pytest.raises(BadType, match="coroutine"):
        reem.CallbackSubscriber(key(), interface, callback)


def test_two_threads_that_share_a_loop_both_get_updates(kvs, pspace, key):
    """Each update goes to one of them."""
    updates = kvs[key()].watch(Every(100))
    updates.listen()
    got = []
    threads = [threading.Thread(target=lambda: got.append(next(updates).value), daemon=True) for _ in range(2)]
    for thread in threads:
        thread.start()
    time.sleep(0.05)  # both wait by now
    pspace[key()] = 1
    pspace[key()] = 2
    for thread in threads:
        thread.join(PATIENCE)
        assert not thread.is_alive()
    assert sorted(got) == [1, 2]
    updates.close()


# --- hostile input --------------------------------------------------------------------------------


async def test_hostile_notices_do_not_cost_the_connection(ainterface, apspace, server_url, key, raw):
    """Arrays that claim to be huge, random bytes, deep nesting: a doubt, no more."""

    def notice(path, text, *blobs):
        parts = [["numpy", f".a{index}", len(blob)] for index, blob in enumerate(blobs)]
        fields = [1, "x", random.Random(len(text)).getrandbits(40), 0.0, path, "set", len(text), parts]
        return orjson.dumps(fields) + b"\n" + text + b"".join(blobs)

    def npy(descr, shape):
        text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape!r}, }}\n".encode()
        return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text

    shapes = [("|S0", (2**40,)), ("<U0", (2**36,)), ("|V0", (2**40,)), ("<f8", (0, 2**47, 2**47)), ("|S0", (3,))]
    hostile = [notice([], b'"$ship numpy .a0 0"', npy(descr, shape)) for descr, shape in shapes]
    hostile += [notice([], b"[" * depth + b"]" * depth) for depth in (500, 1000, 7000)]
    hostile += [notice([], b'{"a":' * depth + b"1" + b"}" * depth) for depth in (500, 1000)]
    hostile += [notice(["a"] * 3000, b"1"), notice([0] * 3000, b"1"), notice([], b"{"), notice([], b"")]
    hostile += [b"[" * 5000, b"[" * 5000 + b"]" * 5000 + b"\n", b"", b"\n", b"[1]\n", b"[]\n" * 10]
    dice = random.Random(7)
    good = notice([], b'{"a":[1,2]}')
    for _ in range(60):
        hostile.append(dice.randbytes(dice.randrange(200)))
        spoilt = bytearray(good)
        spoilt[dice.randrange(len(good))] = dice.randrange(256)
        hostile.append(bytes(spoilt))
    others = subscribed(raw)
    await apspace[key()].write({"n": 0})
    async with Mirror(key(), ainterface) as mirror:
        connection = subscribed(raw) - others
        assert len(connection) == 1
        for payload in hostile:
            assert raw.publish("{" + key() + "}:notices", payload) == 1
            await asyncio.sleep(0)
        await apspace[key()].write({"n": 1})
        await aeventually(lambda: mirror.value() == {"n": 1})
        assert subscribed(raw) - others == connection


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


# --- Ctrl-C ---------------------------------------------------------------------------------------


def interrupting(module, went):
    """A profiler that presses Ctrl-C in this module, in front of the step that tells a waiting task."""

    def profiler(frame, event, arg):
        its = event == "c_call" and arg.__name__ == "set_result" and frame.f_code.co_filename.endswith(module)
        if its and not went:
            went.append(module)
            signal.raise_signal(signal.SIGINT)

    return profiler


@pytest.mark.parametrize("module", ["streams.py", "wire.py"])
def test_ctrl_c_between_a_reply_and_its_waiter_costs_no_connection(server_url, key, caplog, module):
    """asyncio.run cancels its task within the handler of the signal, thus between any two steps."""
    went, afterwards = [], []

    async def program():
        async with asyncio.timeout(PATIENCE), RedisInterface(server_url) as interface:
            space, store = PublishSpace(interface), KeyValueStore(interface)
            await space[key()].write(0)
            async with store[key()].watch(Last(10)) as updates:
                writing = asyncio.create_task(write(space))
                sys.setprofile(interrupting(module, went))
                try:
                    while True:
                        await (anext(updates) if module == "streams.py" else store[key()].read())
                finally:
                    sys.setprofile(None)
                    writing.cancel()
                    afterwards.append(await store[key()].read() > 0)

    async def write(space):
        for number in range(1, 1000):
            await space[key()].write(number)
            await asyncio.sleep(0.01)

    with pytest.raises(KeyboardInterrupt):
        asyncio.run(program())
    assert (went, afterwards) == ([module], [True])
    assert caplog.records == []
