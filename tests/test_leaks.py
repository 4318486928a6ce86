"""What is kept for each key or each loop goes when nobody needs it any more."""

import asyncio
import gc
import logging
import os
import random
import time
from types import SimpleNamespace

import pytest
from conftest import PATIENCE, aeventually, eventually

import reem
import reem_async
from reem_async import session as sessions
from reem_async.concurrency.locks import Locks
from reem_async.plan.keys import keys_of
from reem_async.plan.placeholders import Placeholder
from reem_async.plan.reads import RawRead
from reem_async.plan.shapes import ShapeCache
from reem_async.pubsub.manager import manager_of
from reem_async.session import PublisherIdentity


def listeners(interface):
    return [each for audience in manager_of(interface.session)._topics.values() for each in audience.present()]


class SlowShip(reem_async.BytesShip):
    async def unpack(self, blob):
        await asyncio.sleep(PATIENCE)
        return bytes(blob)


async def test_closing_ends_what_runs_in_the_background(server_url, key):
    """The heartbeat, and a ship that is at work on an update."""
    interface = reem_async.RedisInterface(server_url, ships=[SlowShip()])
    space = reem_async.PublishSpace(interface)
    await space[key()].write({"n": 0})
    mirror = reem_async.SilentSubscriber(key(), interface)
    await mirror.listen()

    def running():
        return {task.get_name() for task in asyncio.all_tasks() if task.get_name().startswith("reem")}

    await space[key()].write({"n": b"slow"})
    await aeventually(lambda: f"reem ships {key()}" in running())
    assert "reem heartbeat" in running()
    await interface.close()
    assert not running()


async def test_a_loop_that_is_left_by_break_drops_its_watch(server_url, key, raw):
    """Without `gc.collect`: nothing refers back to it. A heartbeat ends the subscription, nothing published."""
    name = key()
    gc.disable()
    try:
        async with reem_async.RedisInterface(server_url) as interface:
            await reem_async.PublishSpace(interface)[name].write({"n": 0})
            subscriber = reem_async.SilentSubscriber(name, interface)
            await subscriber.listen()
            for _ in range(10):
                async for _update in subscriber:
                    break
                async for _update in reem_async.KeyValueStore(interface)[name].watch():
                    break
            assert len(subscriber._watches) == 0
            await aeventually(lambda: len(listeners(interface)) == 1)
            watch = reem_async.KeyValueStore(interface)[name].watch()
            await watch.__anext__()
            waiting = asyncio.ensure_future(watch.__anext__())  # a loop that has waited, too
            await asyncio.sleep(0.01)
            waiting.cancel()
            await asyncio.wait([waiting])
            del watch, waiting
            await aeventually(lambda: len(listeners(interface)) == 1)
            await subscriber.close()
            del subscriber
            async for _update in reem_async.KeyValueStore(interface)[name].watch():
                break
            await aeventually(lambda: not manager_of(interface.session)._topics)
            await aeventually(lambda: raw.execute_command("PUBSUB", "NUMSUB", f"{{{name}}}:notices")[1] == 0)
    finally:
        gc.enable()


async def test_a_mirror_that_is_dropped_is_unsubscribed(ainterface, akvs, key):
    """Without `gc.collect`, as a watch: nothing refers back to it."""
    gc.disable()
    try:
        mirror = akvs[key()].mirror()
        await mirror.listen()
        await akvs[key()].write(1)
        assert await mirror.wait_until(lambda value: value == 1, PATIENCE) == 1
        del mirror
        await aeventually(lambda: not manager_of(ainterface.session)._topics)
    finally:
        gc.enable()


def test_a_dropped_watch_of_the_blocking_front_is_unsubscribed(server_url, key):
    with reem.RedisInterface(server_url) as interface:
        name = key()
        reem.KeyValueStore(interface)[name] = 1
        for _update in reem.KeyValueStore(interface)[name].watch():
            break
        gc.collect()
        manager = interface._followers.session.subscriptions
        eventually(lambda: not manager._topics)
        assert not manager._subscribed


async def test_a_store_and_its_transport_keep_a_bounded_number_of_keys(server_url, key):
    async with reem_async.RedisInterface(server_url) as interface:
        pspace = reem_async.PublishSpace(interface)
        for number in range(2100):
            pspace[f"{key.prefix}:{number}"]
            interface.session.transport.ordered(f"{number}")
        assert len(pspace._tops) <= 1000
        assert len(interface.session.transport._orders.all()) <= 1000


class FailingShip(reem_async.BytesShip):
    def unpack(self, blob):
        if bytes(blob).startswith(b"bad"):
            raise ValueError("bad")
        return bytes(blob)


@pytest.mark.parametrize("stored", [False, True])
async def test_a_copy_keeps_no_replies_that_its_values_were_made_of(server_url, key, monkeypatch, stored):
    monkeypatch.setattr(logging.getLogger("reem.subscribe"), "disabled", True)  # pytest keeps the errors in its records

    def kept():
        gc.collect()  # an error and the frames it names
        return [each for each in gc.get_objects() if isinstance(each, RawRead) and each.name == key()]

    async with reem_async.RedisInterface(server_url, ships=[FailingShip()]) as interface:
        space = reem_async.PublishSpace(interface)
        await space[key()].write({"n": b"good"})
        async with reem_async.SilentSubscriber(key(), interface, stored=stored) as subscriber:
            assert subscriber.value() == {"n": b"good"}
            assert not kept()
            await space[key()].write({"n": b"bad"})
            await aeventually(lambda: subscriber.value() != {"n": b"good"})
            assert not kept()


class _Lock:
    pass


def test_a_lock_in_use_is_never_replaced():
    """However many others were asked for meanwhile; those that nobody uses go."""
    locks = Locks(_Lock)
    held = {f"held {number}": locks.of(f"held {number}") for number in range(20)}
    for number in range(10_000):
        locks.of(str(number))
        name = f"held {number % 20}"
        assert locks.of(name) is held[name]
    gc.collect()
    assert len(locks.all()) <= 1020


def new_identity():
    return PublisherIdentity(SimpleNamespace(sharded=False))


def test_numbers_of_a_publisher_never_go_back_when_keys_are_forgotten(monkeypatch):
    """A key that comes back is published under another id, from 1 on."""
    monkeypatch.setattr(sessions, "_KEPT", 1000)
    identity, last, ids = new_identity(), {}, set()
    for _ in range(20_000):
        keys = keys_of(str(int(random.paretovariate(0.3)) % 4000))
        publisher, number = identity.stamp(keys)
        assert number == last.get((publisher, keys.channel), 0) + 1
        last[publisher, keys.channel] = number
        ids.add(publisher)
    assert len(identity._last) <= 1000
    assert len(ids) > 2


def test_keys_that_are_published_now_and_then_keep_their_numbers():
    identity = new_identity()
    for turn in range(1, 4):
        for number in range(5000):
            assert identity.stamp(keys_of(str(number))) == (identity.publisher, turn)


def test_what_is_remembered_of_documents_is_bounded():
    """Also while no reply to a write comes."""
    memory = ShapeCache()
    for number in range(25_000):
        document = str(number)
        memory.of(document).saw_members(frozenset([b"x"]))
        memory.of(document).saw_interrupted()
        memory.of("one").saw_layout((document,), (Placeholder("numpy", ".x"),))
        memory.of("one").saw_number((document,), 1.0)
    assert len(memory._shapes) <= 10_000
    one = memory.of("one")
    assert 0 < len(one._layouts) <= 1000
    assert 0 < len(one._numbers) <= 1000
    assert memory.of("24999").sure_members() == frozenset()


def test_a_number_is_taken_back_only_if_it_was_the_last():
    """A handler of signals may have published in between, on the thread that keeps all others away."""
    identity, keys = new_identity(), keys_of("a")
    stamp = identity.stamp(keys)
    identity.take_back(keys, stamp)
    assert [identity.stamp(keys), identity.stamp(keys)] == [stamp, (stamp[0], 2)]
    identity.take_back(keys, stamp)
    assert identity.stamp(keys) == (stamp[0], 3)


async def test_a_forked_childs_loop_does_not_wait_for_its_parents_tasks(ainterface, key):
    """They never end there; it took a second until it was given up."""
    mirror = reem_async.SilentSubscriber(key(), ainterface)
    await mirror.listen()
    pid = os.fork()
    if pid == 0:
        store = reem_async.KeyValueStore(ainterface)
        begun = time.monotonic()
        asyncio.run(store[key()].get())
        os._exit(time.monotonic() - begun > 0.9)
    assert await asyncio.to_thread(os.waitpid, pid, 0) == (pid, 0)


def test_after_a_change_that_was_broken_off_an_empty_registry_shows_that_nothing_was_left():
    """So the next changes need not look again."""
    shape = ShapeCache().of("foo")
    shape.saw_interrupted()
    assert shape.interrupted
    shape.saw_members(frozenset())
    assert not shape.interrupted
