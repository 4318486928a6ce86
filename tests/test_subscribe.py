"""Publishing and subscribing in `reem_async`: mirrors, callbacks, loops, and what they promise."""

from __future__ import annotations

import asyncio
import contextlib
import logging

import numpy as np
import pytest
from conftest import PATIENCE, aeventually, assert_same, nothing_sent, subscribed

import reem
from reem_async import CallbackSubscriber, Every, KeyValueStore, Last, Newest, PublishSpace, RedisInterface
from reem_async import SilentSubscriber as Mirror
from reem_async.errors import InterfaceClosed, MissingKey, QueueFull, ReadOnly


async def following(updates):
    """The next update, or a failure in place of waiting for ever."""
    return await asyncio.wait_for(anext(updates), PATIENCE)


@pytest.fixture
async def aother(server_url):
    """A second client: another program, as far as the server can tell."""
    async with RedisInterface(server_url) as opened:
        yield opened


# --- the mirror ------------------------------------------------------------------------------------


async def test_a_mirror_starts_with_what_is_there(ainterface, akvs, key):
    """Arrays included, without any publish."""
    value = {"number": 5, "image": np.arange(6).reshape(2, 3), "l": [b"x", np.arange(2)]}
    await akvs[key()].write(value)
    mirror = Mirror(channel=key(), interface=ainterface)
    await mirror.listen()
    assert_same(mirror.value(), value)
    assert mirror["number"].read() == 5
    assert_same(mirror["l"][1].read(), np.arange(2))
    await mirror.close()


async def test_a_mirror_follows_every_change_of_shape(ainterface, apspace, key):
    """Dicts, entries, scalars, lists and arrays, at the root and below."""
    async with Mirror(key(), ainterface) as mirror:
        assert not mirror.value()
        await apspace[key()].write({"number": 5, "string": "REEM"})
        await aeventually(lambda: mirror.value() == {"number": 5, "string": "REEM"})
        await apspace[key()]["number"].write(6)
        await aeventually(lambda: mirror["number"].read() == 6)
        await apspace[key()]["deep"].write({"l": [1, np.arange(3)], "odd.'key é": 1.5})
        await apspace[key()]["deep"]["l"][0].write(np.arange(2))
        await aeventually(lambda: isinstance(mirror["deep"]["l"][0].read(), np.ndarray))
        deep = {"l": [np.arange(2), np.arange(3)], "odd.'key é": 1.5}
        assert_same(mirror.value(), {"number": 6, "string": "REEM", "deep": deep})
        for value in (5, [1, 2], np.arange(4), b"x", None, 0.9374604873776271, {}, "$ship x"):
            await apspace[key()].write(value)
            await aeventually(lambda value=value: type(mirror.value()) is type(value))
            assert_same(mirror.value(), value)


async def test_everything_a_publish_space_writes_is_published(ainterface, apspace, akvs, key):
    """Arithmetic, append, extend, delete and dotted set too: it is written like a store."""
    await apspace[key()].write({"n": 5, "l": [1], "gone": np.arange(2)})
    async with Mirror(key(), ainterface) as mirror:
        await apspace[key()]["n"].increment(2)
        await apspace[key()]["n"].multiply(3)
        await apspace[key()]["l"].append(np.arange(2))
        await apspace[key()]["l"].extend(["x"])
        await apspace[key()]["gone"].delete()
        await apspace.set(key() + ".last", True)
        await aeventually(lambda: "last" in mirror.value())
        assert_same(mirror.value(), {"n": 21, "l": [1, np.arange(2), "x"], "last": True})
        assert_same(await akvs[key()].read(), mirror.value())


async def test_reading_a_mirror_is_local(ainterface, akvs, key, raw):
    """Plain calls that send nothing, and copies that may be changed."""
    await akvs[key()].write({"number": 5, "l": [1]})
    async with Mirror(key(), ainterface) as mirror:
        with nothing_sent(raw):
            for _ in range(100):
                assert mirror["number"].read() == 5
                mirror.value()["l"].append(2)
                mirror["l"].read().append(3)
        assert mirror.value() == {"number": 5, "l": [1]}
        with pytest.raises(MissingKey, match="absent"):
            mirror["absent"].read()


async def test_a_mirror_cannot_be_written(ainterface, akvs, key):
    """It only follows the server."""
    await akvs[key()].write({"a": 1})
    async with Mirror(key(), ainterface) as mirror:
        with pytest.raises(ReadOnly):
            await mirror["a"].write(2)
        with pytest.raises(TypeError):
            mirror["a"] = 2
    assert await akvs[key()].read() == {"a": 1}


async def test_no_publish_after_listen_is_missed(ainterface, key, aother):
    """By another client, at once."""
    publishing = PublishSpace(aother)
    for n in range(30):
        async with Mirror(key(f"channel{n}"), ainterface) as mirror:
            await publishing[key(f"channel{n}")].write({"n": n})
            await aeventually(lambda mirror=mirror, n=n: mirror.value() == {"n": n})


async def test_a_mirror_that_starts_while_others_publish_ends_up_right(ainterface, key, aother, akvs):
    """The snapshot and the notices are of one order."""
    publishing = PublishSpace(aother)
    await publishing[key()].write({"n": -1, "image": np.zeros(3)})
    for n in range(20):
        publishes = asyncio.gather(*(publishing[key()]["n"].write(100 * n + i) for i in range(10)))
        async with Mirror(key(), ainterface) as mirror:
            await publishes
            stored = await akvs[key()].read()
            await aeventually(lambda mirror=mirror, stored=stored: mirror.value()["n"] == stored["n"])


async def test_a_mirror_ends_up_equal_to_the_server_after_competing_publishers(ainterface, key, aother, akvs):
    """A publish is one transaction of the write and its notice."""
    spaces = [PublishSpace(ainterface), PublishSpace(aother)]
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


async def test_large_updates_arrive_whole(ainterface, key, aother):
    """A full camera image, announced and fetched rather than carried in the notice."""
    publishing = PublishSpace(aother)
    async with Mirror(key(), ainterface) as mirror:
        for n in range(3):
            image = np.full((640, 480, 3), float(n))
            await publishing[key()].write({"image": image, "n": n})
            await aeventually(lambda n=n: (mirror.value() or {}).get("n") == n)
            assert_same(mirror["image"].read(), image)
        await publishing[key()]["n"].write(99)
        await aeventually(lambda: mirror["n"].read() == 99)
        assert_same(mirror["image"].read(), image)


async def test_a_store_write_is_not_published(ainterface, akvs, apspace, key):
    """Subscribers hear of what a PublishSpace writes."""
    heard = []
    async with CallbackSubscriber(key(), ainterface, lambda data, updated_path: heard.append(updated_path), {}):
        await akvs[key()].write({"a": 1})
        await apspace[key()]["b"].write(2)
        await aeventually(lambda: f"{key()}.b" in heard)
        await asyncio.sleep(0.1)
        assert [path for path in heard if path != f"{key()}.b"] == []


# --- channels --------------------------------------------------------------------------------------


async def test_foo_does_not_hear_of_foobar(ainterface, apspace, key):
    """Nor of anything that merely begins alike."""
    heard = []

    def hear(data, updated_path):
        heard.append(updated_path)

    async with CallbackSubscriber(key("foo"), ainterface, hear):
        for name in ("foobar", "fo", "foo bar", "foo:ships", "bar"):
            await apspace[key(name)].write({"foo": 1})
            await apspace[key(name)]["foo"].write(2)
        await apspace[key("foo")].write({"bar": {"x": 1}})
        await aeventually(lambda: heard)
        await apspace[key("foo")]["bar"]["x"].write(2)
        await aeventually(lambda: len(heard) == 2)
        assert heard == [key("foo"), key("foo") + ".bar.x"]


async def test_foo_dot_bar_hears_of_itself_below_and_of_a_fresh_foo(ainterface, apspace, key):
    """And not of foo.other, nor of foo.barbar."""
    calls = []

    def hear(data, updated_path):
        calls.append((data, updated_path.removeprefix(key("foo"))))

    await apspace[key("foo")].write({"bar": {"x": 0}, "other": 0, "barbar": 0})
    async with (
        CallbackSubscriber(f"{key('foo')}.bar", ainterface, hear),
        Mirror(f"{key('foo')}.bar", ainterface) as mirror,
    ):
        assert mirror.value() == {"x": 0}
        calls.clear()
        expected = []
        for path, value, data in [
            (("other",), 1, None),
            (("barbar",), 1, None),
            (("bar", "x"), 1, {"x": 1}),
            (("bar",), {"y": 2}, {"y": 2}),
            ((), {"bar": {"z": 3}, "other": 2}, {"z": 3}),
        ]:
            accessor = apspace[key("foo")]
            for element in path:
                accessor = accessor[element]
            await accessor.write(value)
            if data is not None:
                expected.append((data, "".join(f".{element}" for element in path)))
                await aeventually(lambda: len(calls) >= len(expected))
        assert calls == expected
        await aeventually(lambda: mirror.value() == {"z": 3})


async def test_namespaces_do_not_hear_each_other(server_url, key):
    """A channel is prefixed like a key."""
    async with contextlib.AsyncExitStack() as stack:
        one, two = [
            await stack.enter_async_context(RedisInterface(server_url, namespace=key(name))) for name in ("1:", "2:")
        ]
        mirrors = [await stack.enter_async_context(Mirror(key("c"), each)) for each in (one, two)]
        await PublishSpace(one)[key("c")].write(1)
        await PublishSpace(two)[key("c")].write(2)
        await aeventually(lambda: [mirror.value() for mirror in mirrors] == [1, 2])


# --- callbacks -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["plain", "coroutine"])
async def test_a_callback_gets_data_path_and_its_keyword_arguments(ainterface, apspace, key, kind):
    """The whole structure below the channel, and the path as a string; a plain or a coroutine function."""
    calls = []

    def plain(data, updated_path, foo, scale=1):
        calls.append((data, updated_path, foo, scale))

    async def coroutine(data, updated_path, foo, scale=1):
        await asyncio.sleep(0)
        plain(data, updated_path, foo, scale)

    subscriber = CallbackSubscriber(
        channel=key("c"),
        interface=ainterface,
        callback_function=plain if kind == "plain" else coroutine,
        kwargs={"foo": 5},
    )
    await subscriber.listen()
    await apspace[key("c")].write({"number": 5, "string": "REEM"})
    await aeventually(lambda: len(calls) == 1)
    await apspace[key("c")]["number"].write(6)
    await aeventually(lambda: len(calls) == 2)
    await subscriber.close()
    assert calls == [
        ({"number": 5, "string": "REEM"}, key("c"), 5, 1),
        ({"number": 6, "string": "REEM"}, f"{key('c')}.number", 5, 1),
    ]


async def test_a_callback_may_use_reem(ainterface, akvs, apspace, key):
    """Read, write and publish on the very interface that called it."""

    async def process(data, updated_path):
        count = await akvs[key("count")].get(0)
        await akvs[key("count")].write(count + 1)
        await apspace[key("out")].write({"twice": data["n"] * 2})

    async with CallbackSubscriber(key("in"), ainterface, process, {}), Mirror(key("out"), ainterface) as out:
        for n in range(1, 4):
            await apspace[key("in")].write({"n": n})
            await aeventually(lambda n=n: out.value() == {"twice": 2 * n})
    assert await akvs[key("count")].read() == 3


@pytest.mark.parametrize("kind", ["plain", "coroutine"])
async def test_an_exception_in_a_callback_is_logged_and_ends_nothing(ainterface, apspace, key, caplog, kind):
    """The next update is delivered."""
    seen = []

    def fail(data, updated_path):
        seen.append(data)
        if data == 1:
            raise ZeroDivisionError("on purpose")

    async def coroutine(data, updated_path):
        fail(data, updated_path)

    with caplog.at_level(logging.ERROR):
        async with CallbackSubscriber(key(), ainterface, fail if kind == "plain" else coroutine, {}):
            await apspace[key()].write(1)
            await aeventually(lambda: seen == [1])
            await apspace[key()].write(2)
            await aeventually(lambda: seen == [1, 2])
    assert any(record.exc_info and record.exc_info[0] is ZeroDivisionError for record in caplog.records)


# --- loops -----------------------------------------------------------------------------------------


async def test_a_loop_begins_with_what_is_there_and_then_tells_every_update(akvs, apspace, key):
    """Each with its path, what was written, the whole below the channel, and who published it when."""
    await akvs[key()].write({"n": 0, "image": np.arange(3)})
    updates = akvs[key()].watch()
    first = await following(updates)
    assert first.initial is True
    assert first.path == key()
    assert_same(first.data, {"n": 0, "image": np.arange(3)})
    assert_same(first.value, first.data)
    await apspace[key()]["n"].write(7)
    second = await following(updates)
    assert (second.initial, second.path, second.value) == (False, f"{key()}.n", 7)
    assert_same(second.data, {"n": 7, "image": np.arange(3)})
    await apspace[key()].write({"n": 8})
    third = await following(updates)
    assert (third.path, third.value, third.data) == (key(), {"n": 8}, {"n": 8})
    assert second.publisher == third.publisher is not None
    assert second.sequence < third.sequence
    assert second.time is not None
    assert second.time <= third.time
    assert not second.gap
    assert not third.gap
    assert updates.dropped == 0


async def test_a_loop_below_a_path(akvs, apspace, key):
    """`kvs["foo"]["bar"].watch()` hears of foo.bar and of a fresh foo."""
    await akvs[key()].write({"bar": 1, "other": 1})
    updates = akvs[key()]["bar"].watch()
    assert (await following(updates)).data == 1
    await apspace[key()]["other"].write(2)
    await apspace[key()]["bar"].write(3)
    assert (await following(updates)).data == 3
    await apspace[key()].write({"bar": 4})
    update = await following(updates)
    assert (update.data, update.path) == (4, key())


async def test_without_a_value_a_loop_begins_with_the_first_publish(akvs, apspace, key, raw):
    """There is no initial update then."""
    before = subscribed(raw)
    updates = akvs[key()].watch()
    waiting = asyncio.ensure_future(following(updates))
    await aeventually(lambda: subscribed(raw) - before)
    await asyncio.sleep(0.1)
    await apspace[key()].write("first")
    update = await waiting
    assert (update.initial, update.data) == (False, "first")


@pytest.mark.parametrize(("policy", "kept"), [(None, 1), (Newest(), 1), (Last(5), 5), (Every(100), 20)], ids=repr)
async def test_a_queue_is_bounded_by_a_named_policy_and_counts_what_it_dropped(akvs, apspace, key, policy, kept):
    """Newest only by default, the last n, or every one."""
    await akvs[key()].write(-1)
    updates = akvs[key()].watch() if policy is None else akvs[key()].watch(policy=policy)
    assert (await following(updates)).initial
    async with Mirror(key(), akvs.interface) as mirror:
        for n in range(20):
            await apspace[key()].write(n)
        await aeventually(lambda: mirror.value() == 19)
    await asyncio.sleep(0.2)
    got = []
    while not got or got[-1] != 19:
        got.append((await following(updates)).data)
    assert got == list(range(20 - kept, 20))
    assert updates.dropped == 20 - kept


async def test_every_one_beyond_its_bound_is_an_error(akvs, apspace, key):
    """A subscriber that asked for all must not miss some silently."""
    await akvs[key()].write(-1)
    updates = akvs[key()].watch(policy=Every(5))
    await following(updates)
    for n in range(20):
        await apspace[key()].write(n)
    await asyncio.sleep(0.2)
    got = []
    with pytest.raises(QueueFull):  # noqa: PT012
        for _ in range(20):
            got += [(await following(updates)).data]
    assert got == list(range(len(got)))
    assert len(got) <= 5


async def test_updates_of_one_publisher_arrive_in_order_and_once(akvs, apspace, key, aother):
    """Of two publishers each one's own, with growing sequence numbers."""
    await akvs[key()].write({"a": -1, "b": -1})
    updates = akvs[key()].watch(policy=Every(1000))
    await following(updates)
    spaces = {"a": apspace, "b": PublishSpace(aother)}

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


@pytest.mark.parametrize("make", [Mirror, lambda *args: CallbackSubscriber(*args, lambda data, updated_path: None)])
async def test_subscribers_are_async_iterators(ainterface, apspace, key, make):
    """`async for update in subscriber` as with watch()."""
    got = []
    async with make(key(), ainterface) as subscriber, asyncio.timeout(PATIENCE):

        async def loop():
            async for update in subscriber:
                got.append(update.data)
                if update.data == "last":
                    return

        task = asyncio.create_task(loop())
        await asyncio.sleep(0.1)
        await apspace[key()].write({"n": 1})
        await aeventually(lambda: {"n": 1} in got)
        await apspace[key()].write("last")
        await task


async def test_a_cancelled_wait_swallows_no_update(akvs, apspace, key):
    """The next one is there for the next wait."""
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


# --- connections and endings -----------------------------------------------------------------------


async def test_all_subscribers_of_an_interface_share_one_connection(server_url, key, raw):
    """However many there are, and none is left after close."""
    before = subscribed(raw)
    async with RedisInterface(server_url) as interface:
        kvs = KeyValueStore(interface)
        mirrors = [Mirror(key(f"c{n % 5}"), interface) for n in range(20)]
        for mirror in mirrors:
            await mirror.listen()
        await kvs[key("w")].write(1)
        updates = kvs[key("w")].watch()
        await following(updates)
        assert len(subscribed(raw) - before) == 1
        await PublishSpace(interface)[key("c3")].write(5)
        await aeventually(lambda: [mirror.value() for mirror in mirrors[3::5]] == [5] * 4)
    await aeventually(lambda: not subscribed(raw) - before)


async def test_a_closed_subscriber_follows_no_more(ainterface, akvs, apspace, key):
    """The others on the same channel do; closing twice is fine."""
    heard = []
    one, other = Mirror(key(), ainterface), Mirror(key(), ainterface)
    calls = CallbackSubscriber(key(), ainterface, lambda data, updated_path: heard.append(data), {})
    for subscriber in (one, other, calls):
        await subscriber.listen()
    await apspace[key()].write(1)
    await aeventually(lambda: heard == [1] and one.value() == other.value() == 1)
    await one.close()
    await calls.close()
    await calls.close()
    await apspace[key()].write(2)
    await aeventually(lambda: other.value() == 2)
    assert heard == [1]
    with contextlib.suppress(InterfaceClosed):
        assert one.value() == 1


async def test_close_ends_every_loop(server_url, key):
    """No task waits for ever, and none is left over."""
    tasks = asyncio.all_tasks()
    interface = RedisInterface(server_url)
    await KeyValueStore(interface)[key()].write(1)
    mirror = Mirror(key(), interface)
    await mirror.listen()
    started = []

    async def loop(updates):
        with contextlib.suppress(InterfaceClosed):
            async for update in updates:
                started.append(update)  # noqa: PERF401

    loops = [asyncio.create_task(loop(KeyValueStore(interface)[key()].watch())) for _ in range(3)]
    loops.append(asyncio.create_task(loop(mirror)))
    await aeventually(lambda: len(started) >= 3)
    await interface.close()
    async with asyncio.timeout(PATIENCE):
        await asyncio.gather(*loops)
    await aeventually(lambda: asyncio.all_tasks() <= tasks)


async def test_an_async_subscriber_hears_a_blocking_publisher(ainterface, key, pspace):
    """One layout, one wire."""
    assert isinstance(pspace, reem.PublishSpace)
    async with Mirror(key(), ainterface) as mirror:
        pspace[key()] = {"image": np.arange(3)}
        await aeventually(lambda: mirror.value() is not None)
        assert_same(mirror.value(), {"image": np.arange(3)})
