"""`local="early"`: of what subscribers near by are notified before the server has it, and how that is put right."""

import asyncio
import contextlib
import time

import numpy as np
import pytest
import redis
from conftest import PATIENCE, aeventually, assert_same

import reem
import reem_async
from reem_async.errors import ServerFull, Stale
from reem_async.local.segment import reason_against
from reem_async.server import EmbeddedServer
from reem_async.store import publish

pytestmark = pytest.mark.skipif(bool(reason_against()), reason=f"no shared memory: {reason_against()}")

IMAGE = np.arange(30_000, dtype=np.float64)


@contextlib.asynccontextmanager
async def parties(url, name):
    """An early publisher, another one, a store, and the updates that a subscriber and a watch of the store are told."""
    async with contextlib.AsyncExitStack() as stack:
        early, other, near = [
            await stack.enter_async_context(reem_async.RedisInterface(url, local=local))
            for local in ("early", "auto", "auto")
        ]
        spaces, kvs = [reem_async.PublishSpace(each) for each in (early, other)], reem_async.KeyValueStore(near)
        await spaces[0][name].write({"n": 1})
        subscriber = await stack.enter_async_context(reem_async.SilentSubscriber(name, near))
        told = subscriber.watch(reem_async.Every(100))
        stored = await stack.enter_async_context(kvs[name].watch(reem_async.Every(100)))
        assert (await next_of(told)).initial
        assert (await next_of(stored)).initial
        yield spaces, kvs, told, stored


async def next_of(updates):
    return await asyncio.wait_for(anext(updates), PATIENCE)


async def test_early_what_the_server_refuses_is_put_right_with_a_gap():
    """And until then who was told is ahead of the server."""
    with EmbeddedServer() as server, redis.Redis.from_url(server.url) as admin:
        async with parties(server.url, "cam") as (spaces, kvs, told, stored):
            admin.config_set("maxmemory", "1")
            with pytest.raises(ServerFull):
                await spaces[0]["cam"].write({"n": 2, "image": IMAGE})
            assert (await kvs["cam"].read()) == {"n": 1}
            for updates in (told, stored):
                update = await next_of(updates)
                assert update.early
                assert_same(update.data, {"n": 2, "image": IMAGE})
                update = await next_of(updates)
                assert (update.early, update.gap, update.data) == (False, True, {"n": 1})
            admin.config_set("maxmemory", "0")
            await spaces[0]["cam"].write({"n": 3})
            for updates in (told, stored):
                assert (await next_of(updates)).data == {"n": 3}


@pytest.mark.parametrize("size", [0, 1000, 5000, 30_000])
async def test_early_updates_of_all_sizes_reach_subscribers_watches_and_mirrors(size, server_url, key):
    """In one datagram, also where the notice of the update itself has no value, or in shared memory."""
    async with parties(server_url, key("cam")) as (spaces, kvs, told, stored), kvs[key("cam")].mirror() as mirror:
        for number in range(2, 12):
            value = {"n": number, "image": IMAGE[:size]} if size else {"n": number}
            await spaces[0][key("cam")].write(value)
            early = await next_of(told)
            assert_same(early.data, value)
            assert (early.early, early.gap) == (True, False)
            update = await next_of(stored)
            assert_same(update.data, value)
            assert not update.gap
            assert_same(await mirror.wait_until(lambda tree, number=number: tree["n"] == number, PATIENCE), value)


async def test_an_early_update_is_read_before_that_of_the_server_where_both_wait(server_url, key):
    """As for a busy program: plain code publishes on the thread of the subscriber's event loop."""
    with reem.RedisInterface(server_url, local="early") as near, reem.RedisInterface(server_url) as far:
        async with parties(server_url, key("cam")) as (_, kvs, told, _), kvs[key("other")].watch() as others:
            seen = []
            for number in range(10):
                reem.PublishSpace(far)[key("other")] = number
                reem.PublishSpace(near)[key("cam")] = {"n": number}
                seen.append((await next_of(told)).early)
                assert (await next_of(others)).data == number
            assert seen == [False] + [True] * 9


async def test_a_mirror_is_as_old_as_what_the_server_has_not_confirmed():
    """Its age counts from when a refused update has arrived."""
    with EmbeddedServer() as server, redis.Redis.from_url(server.url) as admin:
        async with parties(server.url, "cam") as (spaces, kvs, _, _), kvs["cam"].mirror(max_age=0.2) as mirror:
            admin.config_set("maxmemory", "1")
            with pytest.raises(ServerFull):
                await spaces[0]["cam"].write({"n": 2})
            answered, value = [], {"n": 2}
            while value == {"n": 2}:
                now = time.monotonic()
                with contextlib.suppress(Stale):
                    value = mirror.value()
                    answered.append(now)
                await asyncio.sleep(0.01)
            assert value == {"n": 1}
            assert 0 < answered[-2] - answered[0] <= 0.2


async def test_early_what_another_publisher_overtook_is_put_right(server_url, key, monkeypatch):
    """The other one's update comes to the server between the early notice and the update itself."""
    async with parties(server_url, key("cam")) as ((one, other), kvs, told, _):
        await one[key("cam")].write({"n": 2, "image": IMAGE})
        assert (await next_of(told)).data["n"] == 2
        share, waiting = publish.ValueAnnouncement.share, [other]

        async def overtaken(self, path):
            await share(self, path)
            if waiting:
                await waiting.pop()[key("cam")].write({"n": 4, "image": IMAGE})

        monkeypatch.setattr(publish.ValueAnnouncement, "share", overtaken)
        await one[key("cam")].write({"n": 3, "image": IMAGE})
        updates = [await next_of(told)]
        assert updates[0].early
        assert updates[0].data["n"] == 3
        while not (updates[-1].data["n"] == 3 and any(update.gap for update in updates)):
            updates.append(await next_of(told))
        assert (await kvs[key("cam")]["n"].read()) == 3


FIRST = {
    "a dict with it": ([], {"n": 1, "image": IMAGE}),
    "the array alone": ([], IMAGE),
    "an array just below": (["image"], IMAGE),
}
"""What is written where there is no such top-level key: where, and what."""


def is_settled(follower):
    """Whether the server has confirmed all that was told early: from now on there is no gap for it."""
    return not follower._replica._early


@pytest.mark.parametrize("what", FIRST)
async def test_early_the_first_array_under_a_new_key_is_told_without_a_gap(what, server_url, key):
    """Nor is there one when the key was deleted behind the publisher's back: what it takes for granted is not there."""
    path, value = FIRST[what]
    async with (
        reem_async.RedisInterface(server_url, local="early") as one,
        reem_async.RedisInterface(server_url) as other,
    ):
        space, told = reem_async.PublishSpace(one)[key("cam")], []
        for element in path:
            space = space[element]
        watch = reem_async.SilentSubscriber(key("cam"), other).watch(reem_async.Last(100))
        await watch.listen()
        for _ in range(3):
            for _ in range(3):
                await space.write(value)
                told.append(await next_of(watch))
            await reem_async.KeyValueStore(other)[key("cam")].delete()
        await aeventually(lambda: is_settled(watch._link.follower))
    assert any(each.early for each in told)
    assert not any(each.gap for each in told)
    assert not any(each.missed for each in told)


@pytest.mark.parametrize("index", [0, -1])
async def test_what_counts_from_the_end_is_told_once_and_without_a_gap(index, server_url, key):
    """Which item it is nobody knows before the server has the update: it is told then."""
    async with parties(server_url, key("cam")) as (spaces, _, told, _):
        await spaces[0][key("cam")].write({"frames": [0, 1]})
        assert (await next_of(told)).data == {"frames": [0, 1]}
        for number in range(4):
            await spaces[0][key("cam")]["frames"][index].write(IMAGE + number)
            update = await next_of(told)
            assert (update.path, update.early, update.gap) == (f"{key('cam')}.frames[{index % 2}]", index == 0, False)
            assert_same(update.data["frames"][index], IMAGE + number)
        await spaces[0][key("cam")].write({})
        assert (await next_of(told)).data == {}
