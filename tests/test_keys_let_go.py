"""Keys of a cluster that came and went: nobody keeps anything of them, and when they come again, all is heard.

In these tests a second without a key is as long as a minute and a half.
"""

import asyncio
import contextlib

import pytest
from clusterkit import raw_of
from conftest import Keys, aeventually

import reem_async
from reem_async import session
from reem_async.pubsub import key_watcher
from reem_async.pubsub.manager import manager_of
from reem_async.pubsub.monitor import Monitor

MANY, AGAIN = 500, 30


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(session, "QUIET", 0.5)
    monkeypatch.setattr(key_watcher, "_GONE", 1.0)


@pytest.fixture
def key():
    return Keys()


@pytest.fixture
async def pair(cluster):
    async with reem_async.RedisInterface(cluster) as one, reem_async.RedisInterface(cluster) as two:
        yield one, two


@contextlib.asynccontextmanager
async def taking(stream):
    """What a stream has had, taken as it comes."""
    taken = []

    async def take():
        async for each in stream:
            taken.append(each)  # noqa: PERF401

    async with stream:
        task = asyncio.create_task(take())
        yield taken
        task.cancel()


async def let_go(cluster, interface, key):
    """Wait until nothing is left of the keys: here, and at the nodes."""
    manager = manager_of(interface.session)
    watcher = manager._key_watcher

    def left():
        topics = {*manager._topics, *manager._subscribed}
        topics |= {listener.topic for there in watcher._followed.values() for listener in there.values()}
        channels = {topic.name for topic in topics if not topic.pattern}
        channels |= {channel for new_keys in watcher._new_keys.values() for channel in new_keys._buffers}
        return [channel for channel in channels if key.prefix.encode() in channel]

    await aeventually(lambda: not left())
    for node in cluster.nodes:
        with raw_of(node) as raw:
            await aeventually(lambda raw=raw: not raw.pubsub_shardchannels(f"*{key.prefix}*"))


async def test_of_keys_that_were_published_and_deleted_nothing_is_kept_and_no_later_update_is_missed(
    cluster, pair, key
):
    """The same publisher, which has told all nodes long ago, makes them again."""
    one, two = pair
    space, names = reem_async.PublishSpace(one), [key(f"k{number}") for number in range(MANY)]
    async with taking(Monitor(two, [key("*")])) as events:
        await asyncio.gather(*[space[name].write(0) for name in names])
        await asyncio.gather(*[space[name].delete() for name in names])
        await aeventually(lambda: len(events) == 2 * MANY)
        await let_go(cluster, two, key)
        for number in range(1, 6):
            for name in names[:AGAIN]:
                await space[name].write(number)
        await aeventually(lambda: len(events) >= 2 * MANY + 5 * AGAIN)
    assert not [event for event in events if event.gap or event.missed]
    for name in names[:AGAIN]:
        assert [event.value for event in events if event.name == name] == [0, None, 1, 2, 3, 4, 5]


@pytest.mark.long
async def test_a_watch_of_all_keys_keeps_none_that_are_gone_and_finds_them_again(cluster, pair, key):
    """Published or only stored, as they were before or the other way round."""
    one, two = pair
    space, kvs = reem_async.PublishSpace(one), reem_async.KeyValueStore(one)
    names = [key(f"k{number}") for number in range(MANY)]
    watch = reem_async.KeyValueStore(two).watch(key("*"), policy=reem_async.Every(100_000))
    async with taking(watch) as updates:

        def last():
            return {update.path: update.data for update in updates}

        await asyncio.gather(*[(space if place % 2 else kvs)[name].write(0) for place, name in enumerate(names)])
        await aeventually(lambda: last() == dict.fromkeys(names, 0))
        await asyncio.gather(*[(space if place % 4 < 2 else kvs)[name].delete() for place, name in enumerate(names)])
        await aeventually(lambda: last() == dict.fromkeys(names))
        await let_go(cluster, two, key)
        assert not watch._followed
        for number in (1, 2):
            for place, name in enumerate(names[:AGAIN]):
                await (space if place % 3 else kvs)[name].write(number)
        await aeventually(lambda: [last()[name] for name in names[:AGAIN]] == [2] * AGAIN)
        assert {str(update.origin) for update in updates if update.data == 2} == {"published", "stored"}
        await asyncio.gather(*[kvs[name].delete() for name in names[:AGAIN]])
        await aeventually(lambda: last() == dict.fromkeys(names))


async def test_a_key_that_is_there_is_not_let_go_of_though_nobody_says_anything_of_it(cluster, pair, key):
    """Its publisher takes it for known, so the next word comes at its own node only."""
    one, two = pair
    space = reem_async.PublishSpace(one)
    await space[key("there")].write(0)
    async with taking(Monitor(two, [key("*")])) as events:
        watcher = manager_of(two.session)._key_watcher
        (listeners,) = watcher._followed.values()
        followed = dict(listeners)
        await space[key("gone")].write(0)
        await reem_async.KeyValueStore(one)[key("gone")].delete()
        await aeventually(lambda: key("gone").encode() in listeners)
        await aeventually(lambda: key("gone").encode() not in listeners)
        assert listeners == followed
        await space[key("there")].write(1)
        await aeventually(lambda: [event.value for event in events if event.name == key("there")] == [1])
        await reem_async.KeyValueStore(one)[key("there")].delete()
