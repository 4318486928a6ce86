"""What tools build on: which keys there are, what is in them, and every update of all of them."""

import asyncio
import re

import numpy as np
import pytest
from conftest import aeventually, nothing_fetched

import reem_async
from reem_async.concurrency.queues import Every, Last
from reem_async.errors import BadKey, InterfaceClosed, MissingKey, QueueFull
from reem_async.plan.paths import escaped, parse_pattern
from reem_async.pubsub.monitor import ANNOUNCED, Monitor
from reem_async.store.catalog import outline

SIZE = 200_000


async def taken(monitor, count):
    return [await asyncio.wait_for(anext(monitor), 10) for _ in range(count)]


async def test_keys_lists_what_is_there_and_nothing_else(akvs, kvs, key, raw):
    for name in ("foo", "foobar", "bär *?[x]", "cam1"):
        await akvs[key(name)].write({"a": np.zeros(3)})
    raw.set(key("foreign"), "1")
    mine = sorted(key(name) for name in ("foo", "foobar", "bär *?[x]", "cam1"))
    assert await akvs.keys(key("*")) == mine
    assert kvs.keys(key("*")) == mine
    assert await akvs.keys(key("foo")) == [key("foo")]
    assert await akvs.keys(key("cam?")) == [key("cam1")]
    assert set(mine) <= set(await akvs.keys())


async def test_outline_tells_what_is_there_without_fetching_arrays(akvs, ainterface, key, raw):
    frame = np.zeros((10, 20, 3), np.uint8)
    await akvs[key()].write({"im": frame, "deep": {"list": [1, 2.5, "text", None, True, np.zeros(2)]}, "raw": b"xy"})
    before = raw.info("commandstats").get("cmdstat_get", {"calls": 0})["calls"]
    it = await outline(ainterface, key())
    assert raw.info("commandstats").get("cmdstat_get", {"calls": 0})["calls"] == before
    assert (it.kind, [child.shown for child in it.children]) == (
        "dict",
        [f"{key()}.{n}" for n in ("im", "deep", "raw")],
    )
    image, deep, raw_bytes = it.children
    assert (image.kind, image.summary, image.size) == ("numpy", "uint8[10,20,3]", frame.nbytes)
    assert (raw_bytes.kind, raw_bytes.size) == ("bytes", 2)
    assert [child.kind for child in deep.children[0].children] == ["int", "float", "str", "NoneType", "bool", "numpy"]
    assert [child.value for child in deep.children[0].children] == [1, 2.5, "text", None, True, None]
    assert it.size > frame.nbytes


async def test_outline_of_an_inner_path_and_of_nothing(akvs, ainterface, key):
    await akvs[key()].write({"tiles": [np.zeros(1), np.zeros(2)]})
    assert (await outline(ainterface, f"{key()}.tiles[1]")).summary == "float64[2]"
    assert (await outline(ainterface, (key(), "tiles", -1))).summary == "float64[2]"
    for path in (f"{key()}.nothing", key("nothing"), f"{key()}.tiles[-3]"):
        with pytest.raises(MissingKey):
            await outline(ainterface, path)


async def test_monitor_brings_every_update_with_its_size_and_fetches_nothing(apspace, ainterface, key, raw):
    async with Monitor(ainterface, [key("*")]) as monitor:
        await apspace[key("a")].write({"x": 1, "small": np.arange(3)})
        with nothing_fetched(raw):
            (first,) = await taken(monitor, 1)
        await apspace[key("b")].write(np.zeros(SIZE, np.uint8))
        with nothing_fetched(raw):
            (second,) = await taken(monitor, 1)
        assert (first.path, first.deleted, first.sequence, first.gap) == ((key("a"),), False, 1, False)
        assert first.value["x"] == 1
        assert np.array_equal(first.value["small"], np.arange(3))
        assert (second.name, second.value, second.missed) == (key("b"), ANNOUNCED, 0)
        assert SIZE < second.size < SIZE + 1000
        assert first.publisher == second.publisher
        assert first.time <= first.received

        await apspace[key("a")]["x"].increment(2)
        await apspace[key("a")]["x"].delete()
        third, fourth = await taken(monitor, 2)
        assert (third.shown, third.value, third.size) == (f"{key('a')}.x", ANNOUNCED, 0)
        assert (fourth.deleted, fourth.value, fourth.sequence) == (True, None, 3)


async def test_monitor_hears_only_what_its_patterns_name_and_each_update_once(apspace, ainterface, key):
    async with Monitor(ainterface, [key("cam*.image"), key("c*.image")]) as monitor:
        await apspace[key("cam1")].write({"image": 1, "info": 2})
        await apspace[key("cam1")]["info"].write(3)
        await apspace[key("other")].write({"image": 1})
        events = await taken(monitor, 1)
        await apspace[key("cam2")].write({"image": 4})
        await apspace[key("cam2")]["image"].write(5)
        events += await taken(monitor, 2)
        assert [event.shown for event in events] == [key("cam1"), key("cam2"), key("cam2.image")]
        assert not any(event.gap for event in events)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(anext(monitor), 0.05)


async def test_monitor_reconnects_and_says_that_something_may_be_lost(apspace, ainterface, key, raw):
    async with Monitor(ainterface, [key("*")]) as monitor:
        await apspace[key()].write(1)
        await taken(monitor, 1)
        raw.client_kill_filter(_type="pubsub")
        await aeventually(lambda: raw.pubsub_numpat() >= 1)
        await apspace[key()].write(2)
        await apspace[key()].write(3)
        second, third = await taken(monitor, 2)
        assert (second.value, second.gap) == (2, True)
        assert (third.value, third.gap) == (3, False)


async def test_a_slow_loop_over_a_monitor_is_told(apspace, ainterface, key):
    async with Monitor(ainterface, [key()], Last(2)) as last, Monitor(ainterface, [key()], Every(2)) as every:
        for number in range(5):
            await apspace[key()].write(number)
        await aeventually(lambda: last.dropped == 3)
        assert [event.value for event in await taken(last, 2)] == [3, 4]
        with pytest.raises(QueueFull):
            await taken(every, 5)


async def test_a_closed_monitor_ends_its_loop(ainterface, key):
    monitor = Monitor(ainterface, [key()])
    await monitor.listen()
    await monitor.close()
    await monitor.close()
    assert [event async for event in monitor] == []
    with pytest.raises(InterfaceClosed):
        await monitor.listen()


@pytest.mark.parametrize(
    ("text", "path", "meant"),
    [
        ("arm", ("arm",), True),
        ("arm", ("arm", "q", 0), True),
        ("arm", ("armour",), False),
        ("arm.q", ("arm",), True),
        ("arm.q", ("arm", "p"), False),
        ("arm.**", ("arm", "p", "x"), True),
        ("*.q", ("leg", "q", 1), True),
        ("*.q[1]", ("leg", "q", 2), False),
        ("cam?", ("cam10",), False),
        ("*", ("x",), True),
    ],
)
def test_patterns(text, path, meant):
    assert parse_pattern(text).concerns(path) is meant


def test_what_cannot_be_a_pattern_is_refused():
    with pytest.raises(BadKey):
        parse_pattern("a{b}")


def test_escaping_leaves_no_pattern():
    assert re.sub(r"\\(.)", r"\1", escaped("a*?[b]\\^")) == "a*?[b]\\^"


@pytest.mark.parametrize(("patience", "gives_way"), [(0.0, False), (0.002, False), (0.01, True)])
async def test_a_monitor_that_has_time_gives_way_after_each_update(
    patience, gives_way, apspace, server_url, key, monkeypatch
):
    ways = []
    monkeypatch.setattr("reem_async.transport.wire.give_way", lambda: ways.append(1))
    async with reem_async.RedisInterface(server_url) as watching:
        monitor = Monitor(watching, [key("*")], patience=patience)
        async with monitor:
            for number in range(3):
                await apspace[key("a")].write(number)
            assert [event.value for event in await taken(monitor, 3)] == [0, 1, 2]
    assert (len(ways) >= 3) == gives_way
    assert gives_way or not ways
