"""Subscribing in `reem_async`: what depends on tasks and event loops. `test_following.py` has what both fronts do."""

import asyncio

import numpy as np
import pytest
from conftest import PATIENCE, aeventually, assert_same, eventually

import reem
from reem_async import CallbackSubscriber, Every, KeyValueStore, Last, PublishSpace
from reem_async import SilentSubscriber as Mirror
from reem_async.concurrency.queues import EMPTY
from reem_async.errors import MissingKey
from reem_async.pubsub.manager import manager_of


async def following(updates):
    return await asyncio.wait_for(anext(updates), PATIENCE)


async def test_a_mirror_ends_up_equal_to_the_server_after_competing_publishers(ainterface, key, binterface, akvs):
    """A publish is one transaction of the write and its notice."""
    spaces = [PublishSpace(ainterface), PublishSpace(binterface)]
    await spaces[0][key()].write({"n": 0})
    async with Mirror(key(), ainterface) as mirror:

        async def publish(me):
            for n in range(50):
                await spaces[me % 2][key()].write({"n": n, "me": me, "image": np.full(me + 1, n)})
                await spaces[me % 2][key()]["n"].write(1000 * me + n)
                await spaces[me % 2][key()]["image"].write(np.full(3, n) if n % 2 else n)

        await asyncio.gather(*(publish(me) for me in range(4)))
        stored = await akvs[key()].read()
        await aeventually(lambda: repr(mirror.value()) == repr(stored))
        assert_same(mirror.value(), stored)


def held_back(interface, monkeypatch):
    """Have this interface's reads of large values wait for the event that is returned."""
    gate, roundtrip = asyncio.Event(), interface.session.transport.roundtrip

    async def held(commands, **options):
        if options.get("bulk"):
            await gate.wait()
        return await roundtrip(commands, **options)

    monkeypatch.setattr(interface.session.transport, "roundtrip", held)
    return gate


async def changed_inside(space, key):
    """Publish large values with small ones inside and beside, and an item that moves; return what was written."""
    large = {"image": np.zeros(50_000), "state": "raw", "items": [1, 2]}
    sent = {}
    for path, value in [
        ((), large),
        (("n",), {"x": 1, "y": 1}),
        (("n", "x"), 2),
        (("n", "x"), 3),
        (("n",), None),
        (("n",), 4),
        (("state",), "done"),
        (("image",), np.ones(50_000)),
    ]:
        handle = space[key]
        for name in path:
            handle = handle[name]
        await (handle.delete() if value is None else handle.write(value))
        sent[len(sent) + 1] = value
    await space[key]["items"][0].delete()
    return sent | {9: None}


async def test_a_large_update_is_never_told_with_what_later_ones_made_of_it(ainterface, binterface, key, monkeypatch):
    """It is skipped, and counted; what came with its value has that, however new `data` is."""
    space = PublishSpace(binterface)
    await space[key()].write({"image": np.full(50_000, 7.0)})
    async with KeyValueStore(ainterface)[key()].watch(Last(100)) as updates:
        assert (await anext(updates)).initial
        gate = held_back(ainterface, monkeypatch)
        sent = await changed_inside(space, key())
        await manager_of(ainterface.session).fence()
        gate.set()
        told = [await asyncio.wait_for(anext(updates), PATIENCE) for _ in range(8)]
        assert [update.sequence for update in told] == [3, 4, 5, 6, 7, 8, 9, 10]
        assert_same([update.value for update in told], [sent[update.sequence - 1] for update in told])
        assert_same(told[-1].data, await KeyValueStore(binterface)[key()].read())
        assert updates.dropped == 1
        assert not any(update.gap for update in told)


async def test_a_callback_is_called_for_the_place_of_a_large_update_that_was_changed_inside(
    ainterface, binterface, key, monkeypatch
):
    """It is told where, and what is there now: who waits for frames must not miss those that are worked on at once."""
    space, calls = PublishSpace(binterface), []
    await space[key()].write({"image": np.full(50_000, 7.0)})
    async with CallbackSubscriber(key(), ainterface, lambda data, path: calls.append((path, data["state"]))):
        gate = held_back(ainterface, monkeypatch)
        await changed_inside(space, key())
        await manager_of(ainterface.session).fence()
        gate.set()
        await aeventually(lambda: len(calls) == 9)
    assert calls[0] == (key(), "done")
    assert [path for path, _ in calls[1:]] == [
        f"{key()}.{place}" for place in ("n", "n.x", "n.x", "n", "n", "state")
    ] + [
        f"{key()}.image",
        f"{key()}.items[0]",
    ]


async def test_a_large_update_is_not_told_with_what_a_lost_one_made_of_it(
    ainterface, binterface, akvs, key, monkeypatch
):
    """What was read names an update whose notice never came."""
    space, session = PublishSpace(binterface), binterface.session
    await space[key()].write({"image": np.zeros(50_000)})
    async with KeyValueStore(ainterface)[key()].watch(Last(100)) as updates:
        await anext(updates)
        gate = held_back(ainterface, monkeypatch)
        await space[key()].write({"image": np.ones(50_000), "n": 1})
        publisher, number = session.stamp(session.keys(key()))
        await akvs[key()]["n"].write(2)
        await session.transport.roundtrip([("SET", session.keys(key()).last, f"{publisher} {number}", "EX", 60)])
        gate.set()
        gap = await asyncio.wait_for(anext(updates), PATIENCE)
        assert (updates.dropped, gap.gap, gap.missed, gap.data["n"]) == (1, True, 1, 2)
        await space[key()]["x"].write(3)
        update = await asyncio.wait_for(anext(updates), PATIENCE)
        assert (update.path, update.value, update.data["n"]) == (f"{key()}.x", 3, 2)


async def test_what_was_there_before_is_no_loss(ainterface, binterface, key):
    """The note of a key's last update names one of the past: nobody has missed it."""
    await PublishSpace(binterface)[key()].write({"x": 1})
    async with KeyValueStore(ainterface)[key()].watch(Last(100)) as updates:
        assert (await anext(updates)).initial
        listener = updates._link.follower
        for _ in range(2):  # what the heartbeat does
            (note,) = await ainterface.session.transport.roundtrip([("GET", listener.note)])
            listener.on_note(note)
        assert updates.queue.take() is EMPTY


async def test_updates_of_one_publisher_arrive_in_order_and_once(akvs, apspace, key, binterface):
    await akvs[key()].write({"a": -1, "b": -1})
    updates = akvs[key()].watch(policy=Every(1000))
    await following(updates)
    spaces = {"a": apspace, "b": PublishSpace(binterface)}

    async def publish(name):
        for n in range(100):
            await spaces[name][key()][name].write(n)

    await asyncio.gather(publish("a"), publish("b"))
    seen = {"a": [], "b": []}
    last = {}
    for _ in range(200):
        update = await following(updates)
        seen[update.path[-1]].append(update.value)
        assert update.sequence > last.get(update.publisher, -1)
        assert not update.gap
        last[update.publisher] = update.sequence
    assert seen == {"a": list(range(100)), "b": list(range(100))}
    assert len(last) == 2


async def test_an_update_that_the_server_applied_late_comes_late_and_once(akvs, apspace, key, ainterface, monkeypatch):
    """Its connection broke before the reply, so that the publisher's next update reached the server first."""
    await akvs[key()].write({"n": 0})
    updates = akvs[key()].watch(policy=Every(1000))
    await following(updates)
    await apspace[key()]["n"].write(1)
    late = ainterface.session.stamp(ainterface.session.keys(key()))
    await apspace[key()]["n"].write(3)
    with monkeypatch.context() as patch:
        patch.setattr(ainterface.session, "stamp", lambda _: late)
        await apspace[key()]["n"].write(2)
    await apspace[key()]["n"].write(4)
    seen = [await following(updates) for _ in range(4)]
    assert [it.sequence - late[1] for it in seen] == [-1, 1, 0, 2]
    assert [(it.value, it.data["n"], it.missed) for it in seen] == [(1, 1, 0), (3, 3, 1), (2, 2, 0), (4, 4, 0)]


async def test_a_cancelled_wait_swallows_no_update(akvs, apspace, key):
    await akvs[key()].write(-1)
    updates = akvs[key()].watch()
    await following(updates)
    for n in range(20):
        waiting = asyncio.ensure_future(anext(updates))
        await asyncio.sleep(0)
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        await apspace[key()].write(n)
        assert (await following(updates)).data == n


def test_a_deletion_at_any_index_is_a_notice_that_can_be_read(interface, pspace, key):
    """Where nothing is deleted, there is nothing to make of it."""
    pspace[key()] = {"l": [1]}
    with reem.SilentSubscriber(key(), interface) as mirror:
        for index in (2**31, 2**63 - 1, -(2**63)):
            with pytest.raises(MissingKey):
                del pspace[key()]["l"][index]
        pspace[key()]["l"][0] = 2
        eventually(lambda: mirror.value() == {"l": [2]})
        assert not interface.unreadable
