"""What is only stored reaches the page's past when the server says that it was changed: nothing is read at rest."""

import asyncio
import contextlib
import logging
import time
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import (
    LOOKING,
    PLAIN,
    RawCluster,
    aeventually,
    commands_run,
    same_bits,
    server_without_right,
    sized,
    subscribed,
)

import reem_async
from reem_async.errors import ConnectionLost
from reem_async.plan.placeholders import Unreadable
from reem_async.plan.trees import MISSING
from reem_async.pubsub import refresh
from reem_async.pubsub.monitor import Monitor
from reem_async.tools.browser import LiveSource
from reem_async.tools.browser import follower as follower_module
from reem_async.tools.browser.follower import Follower
from reem_async.tools.browser.history import History
from reem_async.tools.browser.source import NotKept
from reem_async.tools.browser.trees import thawed


@contextlib.asynccontextmanager
async def past_of(url, *names, **options):
    """A page's source, once the server tells it when these keys are changed."""
    source = LiveSource(reem_async.RedisInterface(url, **options), 60.0, 64 << 20)
    try:
        await source.start()
        await told(source, *names)
        yield source
    finally:
        await source.close()


async def told(source, *names):
    """Wait until the server tells of the next change of these keys and their arrays, and none is about to be read."""
    follower = source._follower
    await aeventually(
        lambda: (
            all(name not in follower.unread and source.history.knows(name) for name in names)
            and all(follower.is_settled(name) for name in names)
            and not follower._due
            and not any(key.looks.due or key.busy for key in follower._keys.values())
        )
    )


def content(source, *path):
    return thawed(source.history.tree(path, time.time()))


async def seen(source, value, *path):
    await aeventually(lambda: alike(content(source, *path), value))


def alike(one, other):
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return same_bits(one, other)
    return type(one) is type(other) and bool(one is other or one == other)


@pytest.fixture
def nobody_looks(monkeypatch):
    """The keys are listed at the beginning only: what is seen is what the server has told."""
    monkeypatch.setattr(refresh, "_PERIOD", 600.0)


@pytest.mark.long
async def test_at_rest_only_the_names_of_keys_are_asked_for(server_url, key, akvs, apspace, raw):
    await akvs[key("a")].write({"x": {"y": 1}, "image": np.zeros((30, 30))})
    await akvs[key("b")].write(np.zeros(5))
    await apspace[key("c")].write({"x": 1, "image": np.zeros((300, 300))})
    async with past_of(server_url, key("a"), key("b"), key("c")):
        asked = [await asked_in_three_seconds(raw) for _ in range(2)]  # the first reads may not be over yet
        # Without the JSON module the list of names looks how each string begins: there are those of others.
        assert asked[-1] <= LOOKING | ({"getrange"} if PLAIN else set())


async def asked_in_three_seconds(raw):
    """The names of commands that come until keys were listed three times more: in a cluster to follow them, too."""
    before, lists = commands_run(raw), 18 if isinstance(raw, RawCluster) else 3
    await aeventually(lambda: commands_run(raw)["scan"] >= before.get("scan", 0) + lists)
    return {name for name, count in commands_run(raw).items() if count != before.get(name)}


async def test_each_way_of_storing_is_seen_when_the_server_tells_of_it(server_url, key, akvs, raw, nobody_looks):
    await akvs[key()].write({"x": {"a": 0}, "image": np.zeros((30, 30))})
    await akvs[key("array")].write(np.zeros(5))
    await akvs[key("gone")].write(1)
    async with past_of(server_url, key(), key("array"), key("gone")) as source:
        began = time.time()
        await akvs[key()]["x"]["a"].write(1)
        await seen(source, 1, key(), "x", "a")
        raw.execute_command("JSON.SET", key(), "$.x.a", "2")
        await seen(source, 2, key(), "x", "a")
        for number in range(1, 4):
            await akvs[key()]["image"].write(np.full((30, 30), float(number)))
            await akvs[key("array")].write(np.full(5, float(number)))
            await seen(source, np.full((30, 30), float(number)), key(), "image")
            await seen(source, np.full(5, float(number)), key("array"))
        for number, blob in ((1, b"a"), (2, b"b")):  # the document's text stays as it is, or is not kept at first
            await akvs[key()].update({"raw": blob, "long": str(number) * 300_000})
            await seen(source, blob, key(), "raw")
            await seen(source, str(number) * 300_000, key(), "long")
        raw.delete(key("gone"))
        await seen(source, MISSING, key("gone"))
        await akvs[key("gone")].write(2)
        await seen(source, 2, key("gone"))
        raw.pexpire(key("gone"), 1)
        await seen(source, MISSING, key("gone"))
        assert source.history.tree((key(), "x", "a"), began) == 0
        assert source.history.tree((key("gone"),), began) == 1


async def test_a_key_that_is_new_is_found_by_its_name(server_url, key, akvs):
    async with past_of(server_url) as source:
        await akvs[key()].write({"x": 1, "image": np.zeros(3)})
        await seen(source, 1, key(), "x")
        await seen(source, np.zeros(3), key(), "image")
        assert key() in source._follower.names
        await told(source, key())
        await akvs[key()].delete()
        await aeventually(lambda: key() not in source._follower.names)


@pytest.mark.parametrize("size", [3, 100_000])
async def test_an_array_that_is_stored_right_behind_a_published_one_is_seen(
    server_url, key, akvs, apspace, nobody_looks, size
):
    await apspace[key()].write({"x": 1, "array": np.zeros(size)})
    async with past_of(server_url, key()) as source:
        for number in range(1, sized(8, 16)):
            await apspace[key()]["array"].write(np.full(size, number))
            await akvs[key()]["array"].write(np.full(size, -number))
            await seen(source, np.full(size, -number), key(), "array")
        await apspace[key()]["new"].write(np.full(size, 1))
        await akvs[key()]["new"].write(np.full(size, 2))
        await seen(source, np.full(size, 2), key(), "new")


async def test_of_a_key_only_the_arrays_that_changed_are_read_again(server_url, key, akvs, nobody_looks):
    """The others once, when the key is first seen to change: the slider has pictures of them, too."""
    await akvs[key()].write({"n": 0, "a": np.zeros(5), "b": np.zeros(6)})
    async with past_of(server_url, key()) as source:
        assert not list(source.history.frames.concerning((key(),)))
        for number in range(1, 4):
            await akvs[key()]["a"].write(np.full(5, float(number)))
            await akvs[key()]["n"].write(number)
            await seen(source, np.full(5, float(number)), key(), "a")
            await seen(source, number, key(), "n")
        await seen(source, np.zeros(6), key(), "b")
        await told(source, key())
        assert len(list(source.history.frames.concerning((key(), "a")))) >= 3
        assert len(list(source.history.frames.concerning((key(), "b")))) == 1
        assert source.history.times((key(), "b")) == [], "it did not change"


async def test_an_array_that_was_gone_before_is_unreadable_once_its_key_changes(server_url, key, akvs, raw):
    await akvs[key()].write({"n": 0, "image": np.zeros(100)})
    raw.delete(f"{{{key()}}}.image")
    async with past_of(server_url, key()) as source:
        await akvs[key()]["n"].write(1)
        await aeventually(lambda: isinstance(content(source, key(), "image"), Unreadable))


async def test_what_is_stored_anew_as_it_was_is_no_change(server_url, key, akvs, nobody_looks):
    await akvs[key()].write({"array": np.zeros(5)})
    async with past_of(server_url, key()) as source:
        await akvs[key()]["array"].write(np.ones(5))
        await seen(source, np.ones(5), key(), "array")
        times = source.history.times((key(),))
        await told(source, key())
        await akvs[key()]["array"].write(np.ones(5))
        await told(source, key())
        await akvs[key()]["array"].write(np.zeros(5))
        await seen(source, np.zeros(5), key(), "array")
        assert len(source.history.times((key(),))) == len(times) + 1


async def test_what_is_published_all_the_time_is_read_now_and_then(server_url, key, apspace, raw):
    await apspace[key()].write({"x": 0})
    async with past_of(server_url, key()) as source:
        before = commands_run(raw)
        for number in range(1, 501):
            await apspace[key()]["x"].write(number)
        await seen(source, 500, key(), "x")
        await told(source, key())
        read = max(commands_run(raw).get(name, 0) - before.get(name, 0) for name in ("json.get", "type"))
        assert read < 250


@pytest.mark.long
@pytest.mark.parametrize("right", ["client|tracking", "type"])
async def test_who_may_not_track_looks_once_a_second_and_says_so(caplog, right):
    async with server_without_right(right) as (kvs, url):
        await kvs["a"].write({"n": 1, "array": np.zeros(5)})
        with caplog.at_level(logging.WARNING, "reem"):
            async with past_of(url) as source:
                await seen(source, 1, "a", "n")
                at = time.time()
                for number in range(2, 4):
                    await kvs["a"]["n"].write(number)
                    await seen(source, number, "a", "n")
                await kvs["b"].write(3)
                await seen(source, 3, "b")
                await kvs["b"].delete()
                await seen(source, MISSING, "b")
                assert "once a second" in source.status().note
                assert source.history.tree(("a", "n"), at) == 1
    (warning,) = [record.getMessage() for record in caplog.records if record.name.startswith("reem")]
    assert f"+{right}," in warning


async def test_who_may_not_track_is_not_shown_the_present_of_an_array_for_its_past():
    async with server_without_right("client|tracking") as (kvs, url):
        await kvs["a"].write({"n": 1, "array": np.zeros(5)})
        async with past_of(url) as source:
            await seen(source, 1, "a", "n")
            at = time.time()
            await kvs["a"]["array"].write(np.ones(5))
            try:
                sample = await source.value(("a", "array"), at)
            except NotKept:
                return
            assert not isinstance(sample.value, np.ndarray)


async def test_nothing_is_kept_of_keys_that_are_gone(server_url, key, akvs):
    async with past_of(server_url) as source:
        follower = source._follower
        names = [key(f"gone{number}") for number in range(100)]
        for name in names:
            await akvs[name].write({"image": np.zeros(9)})
        await aeventually(lambda: all(follower.is_settled(name) and source.history.knows(name) for name in names))
        for name in names:
            await akvs[name].delete()
        await aeventually(lambda: all(content(source, name) is MISSING for name in names))

        await aeventually(lambda: not any(name in follower._keys for name in names))
        await akvs[names[0]].write({"n": 1})
        await seen(source, {"n": 1}, names[0])


@pytest.mark.long
async def test_a_clock_that_is_set_back_costs_nothing_of_the_past(server_url, key, apspace, monkeypatch):
    """For an hour there was no past, no plot and no rate, and each look took what was published for stored."""
    real, back = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: real() - back[0])
    name, published = key("n"), 0
    async with past_of(server_url) as source:
        for back[0] in (0.0, 3600.0, 7200.0):
            for _ in range(8):
                published += 1
                await apspace[name].write(published)
                await asyncio.sleep(0.05)
        await aeventually(lambda: source.history.tree((name,), source.status().end) == published)
        await asyncio.sleep(0.6)  # looks for what was stored besides are over
        start, end = source.status()[:2]
        assert 1.5 < end - start < 60
        (line,) = (await source.series((name,), start, end)).lines
        assert [value for value in line if value is not None] == list(range(1, published + 1))
        assert source.history.rate(name, end) > 1
        assert len(source.history.times((name,))) == published
        assert (await source.nodes([(name,)], end - 0.3))[0].text == str(published)
        back[0] = -3600.0  # as after a computer has slept
        assert source.status().end == pytest.approx(time.time(), abs=1)


# --- what the page reads into its past goes between the updates where it belongs


LARGE = np.zeros((300, 300))


def followed(interface, name, fence):
    """A key of the page that hears only what the test hands on."""
    history = History(1000.0, 1 << 24)
    history.begin(name, b"{}")
    follower = Follower(interface, history)
    follower.fence = fence
    return follower.key(name), history


async def test_each_update_is_in_what_is_shown_once_though_it_is_heard_of_late(key, apspace, binterface):
    """The second deletion is in what is read, the third is not: that of an item done twice would be seen."""
    monitor = Monitor(binterface, [key()])
    await monitor.listen()
    await apspace[key()].write({"l": [0, 1, 2, 3], "image": LARGE})
    await apspace[key()]["l"][0].delete()

    async def fence(channel):
        await apspace[key()]["l"][0].delete()
        for _ in range(3):
            page.hear(await anext(monitor))

    page, history = followed(binterface, key(), fence)
    await page.read()
    assert history.tree((key(),), time.time())["l"] == [2, 3]
    await monitor.close()


async def test_what_cannot_be_told_from_the_rest_is_not_shown(key, apspace, binterface):
    await apspace[key()].write({"n": 1, "image": LARGE})

    async def fence(channel):
        raise ConnectionLost("gone")

    page, history = followed(binterface, key(), fence)
    page.announced.add((key(),))
    with pytest.raises(ConnectionLost):
        await page.read()
    assert page.announced == {(key(),)}
    assert history.tree((key(),), time.time()) == {}


@contextlib.asynccontextmanager
async def followed_all(interface, name, akvs):
    await akvs[name].write({"n": 1})
    follower = Follower(interface, history := History(1000.0, 1 << 24))
    await follower.start()
    try:
        await aeventually(lambda: follower.is_settled(name))
        yield follower, history
    finally:
        await follower.close()


async def test_after_a_connection_that_nobody_missed_all_is_read_again(key, akvs, binterface, raw, monkeypatch):
    """It broke before it was followed, but keys were touched over it: the server reports nothing of them any more.

    The next search for keys is far, as after one that had no answer.
    """
    monkeypatch.setattr(refresh, "_PERIOD", 600.0)
    async with followed_all(binterface, key(), akvs) as (follower, history):
        follower.monitor.broken = lambda: None
        for connection in subscribed(raw):
            raw.client_kill_filter(_id=connection)
        await akvs[key()].write({"n": 2})
        await aeventually(lambda: history.tree((key(),), time.time()) == {"n": 2})


async def test_calls_that_waited_long_for_a_dead_link_delay_no_later_ones(key, akvs, binterface, monkeypatch):
    """Neither reads nor searches rest for a multiple of it: they spare a server at work."""
    waited = 0.0

    def lost(*args, **options):
        nonlocal waited
        waited += 1000.0
        raise ConnectionLost("gone")

    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + waited, time=time.time)
    monkeypatch.setattr(follower_module, "time", clock)
    monkeypatch.setattr(refresh, "time", clock)
    async with followed_all(binterface, key(), akvs) as (follower, history):
        with monkeypatch.context() as patched:
            patched.setattr(binterface.session.transport, "roundtrip", lost)
            patched.setattr(follower_module, "present_keys", lost)
            await akvs[key()].write({"n": 2})
            await aeventually(lambda: follower.lost and waited >= 2000.0)
        await aeventually(lambda: history.tree((key(),), time.time()) == {"n": 2} and not follower.lost)
