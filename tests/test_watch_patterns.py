"""`kvs.watch("robot1.*")`: every change of all keys that patterns name, those that come to be and those that go."""

import asyncio

import numpy as np
import pytest
from conftest import Loop, RawCluster, aeventually, assert_same

import reem_async
from reem_async import Last
from reem_async.errors import BadKey, ConnectionLost, RedisError, WriteOnly
from reem_async.plan import keys as key_plans
from reem_async.plan.notices import announce
from reem_async.plan.paths import show
from reem_async.pubsub.follower import Follower
from reem_async.pubsub.manager import manager_of
from reem_async.pubsub.monitor import Monitor

IMAGE = np.zeros((480, 640, 3), np.uint8)


@pytest.fixture
def watching(front):
    return lambda *patterns: Loop(front, front.kvs.watch(*patterns, policy=Last(10_000)))


def test_all_keys_of_a_pattern_are_told_first_and_then_what_changes(watching, kvs, pspace, key):
    kvs[key("a1")], kvs[key("a2")], kvs[key("b")] = {"n": 1}, [1, 2], 3
    watch = watching(key("a*"))
    first = {update.path: update for update in (watch.next(), watch.next())}
    assert {path: update.data for path, update in first.items()} == {key("a1"): {"n": 1}, key("a2"): [1, 2]}
    assert all(update.initial for update in first.values())
    kvs[key("b")] = 4
    kvs[key("a1")]["n"] = 2
    assert watch.told() == ("stored", f"{key('a1')}.n", 2, False)
    pspace[key("a2")][0] = 7
    assert watch.told() == ("published", f"{key('a2')}[0]", 7, False)


def test_keys_come_and_go_and_come_again(watching, kvs, pspace, raw, key):
    """Stored ones are found within a second, published ones at once, with each of their updates."""
    watch = watching(key("*"))
    kvs[key("stored")] = {"n": 1, "image": np.arange(4)}
    update = watch.next()
    assert (update.origin, update.path, update.initial) == ("stored", key("stored"), False)
    assert_same(update.data, {"n": 1, "image": np.arange(4)})
    for number in range(5):
        pspace[key("published")] = number
    told = [watch.next()]
    while told[-1].value != 4:
        told.append(watch.next())
    assert [each.value for each in told] == sorted({each.value for each in told})
    if not isinstance(raw, RawCluster):  # whose nodes tell each other of the first ones, which takes a moment
        assert [(each.origin, each.path, each.value, each.sequence) for each in told] == [
            ("published", key("published"), number, number + 1) for number in range(5)
        ]
    raw.delete(key("stored"))
    gone = watch.next()
    assert (gone.origin, gone.path, gone.deleted, gone.data) == ("stored", key("stored"), True, None)
    del pspace[key("published")]
    gone = watch.next()
    assert (gone.origin, gone.path, gone.deleted) == ("published", key("published"), True)
    kvs[key("stored")] = 5
    told = [watch.told()]
    while isinstance(raw, RawCluster) and told[-1][2] != 5:  # the first updates of a key may come once more, late
        told.append(watch.told())
    assert told[-1] == ("stored", key("stored"), 5, False)
    pspace[key("published")] = 6
    assert watch.told()[1:3] == (key("published"), 6)


def test_what_a_pattern_spells_out_is_what_is_read(watching, kvs, key):
    """Of `imu.temp` nothing but that; of `robot.*.battery` what concerns a battery."""
    imu, robot = key("imu"), key("robot")
    kvs[imu] = {"temp": 20, "image": IMAGE}
    kvs[robot] = {"r1": {"battery": 1, "n": 1}, "r2": {"battery": 2, "n": 2}}
    watch = watching(f"{imu}.temp", f"{robot}.*.battery")
    assert sorted(watch.next().path for _ in range(2)) == sorted([f"{imu}.temp", robot])
    kvs[imu]["image"] = IMAGE + 1
    kvs[robot]["r1"]["n"] = 5
    kvs[imu]["temp"] = 21
    assert watch.told() == ("stored", f"{imu}.temp", 21, False)
    kvs[robot]["r2"]["battery"] = 7
    told = watch.told()
    if told[1] == robot:  # on a busy machine one read found both changes of the robot: told of what holds them
        assert told[2] == {"r1": {"battery": 1, "n": 5}, "r2": {"battery": 7, "n": 2}}
    else:
        assert told == ("stored", f"{robot}.r2.battery", 7, False)


def test_what_changes_at_a_key_that_no_path_addresses_is_told_of_the_dict_that_holds_it(watching, kvs, key):
    """Whoever stored it, and the next change is told as well."""
    kvs[key("a")] = {"d": {"n": 1}}
    watch = watching(key("*"))
    watch.next()
    for value in ({"n": 1, " b": 2}, {"n": 1, " b": 2, "q\\": 3}, {"n": 1}):
        kvs[key("a")]["d"] = value
        assert watch.told() == ("stored", f"{key('a')}.d", value, False)


@pytest.mark.parametrize("name", ["C:\\a.b", 'it\'s "x"', " lead.x", '"', "[0]", ".", "~a.", "a\nb.\u202e"])
def test_any_top_level_key_is_watched_and_disturbs_nobody_beside_it(watching, kvs, pspace, key, name):
    """Quoted where it is told, also a key that could not be addressed inside a dict."""
    kvs[key("beside")] = 0
    watch = watching(key("*"))
    watch.next()
    pspace[key(name)] = 1
    assert watch.told() == ("published", show((key(name),)), 1, False)
    kvs[key(name)] = {"x": 2}
    assert watch.told() == ("stored", show((key(name),)), {"x": 2}, False)
    kvs[key(name)]["x"] = 3
    assert watch.told() == ("stored", show((key(name), "x")), 3, False)
    pspace[key("beside")] = 4
    update = watch.next()
    assert (update.path, update.value, update.gap) == (key("beside"), 4, False)


def test_patterns_that_overlap_tell_each_change_once(watching, kvs, pspace, key):
    watch = watching(key("*"), key("a*"), f"{key('a')}.x")
    pspace[key("a")] = {"x": 1}
    assert watch.told() == ("published", key("a"), {"x": 1}, False)
    kvs[key("a")]["x"] = 2
    assert watch.told() == ("stored", f"{key('a')}.x", 2, False)
    kvs[key("a")]["x"] = 3
    assert watch.told() == ("stored", f"{key('a')}.x", 3, False)


def test_what_is_no_pattern_is_refused_and_so_is_a_publish_space(front, pspace):
    with pytest.raises(BadKey):
        front.kvs.watch("a..b")
    with pytest.raises(WriteOnly):
        pspace.watch("a")


async def test_a_watch_that_is_dropped_or_closed_leaves_nothing_behind(ainterface, akvs, key):
    await akvs[key("a")].write(1)
    watch = akvs.watch(key("*"))
    await watch.listen()
    manager = manager_of(ainterface.session)
    assert manager._topics
    await watch.close()
    assert not manager._topics
    assert [update.value async for update in watch] == [1]


async def test_documents_that_no_key_can_have_are_left_out(server_url, key, raw):
    """Those of strangers, before and after following begins: the others are followed."""
    space = f"{key.prefix}/"
    strange = [space.encode() + name for name in (b"", b"a}b", b"a{b", b"a" * 600, b"\xff")]
    try:
        async with reem_async.RedisInterface(server_url, namespace=space) as interface:
            for name in strange[:3]:
                raw.execute_command("JSON.SET", name, "$", "1")
            store = reem_async.KeyValueStore(interface)
            await store["z"].write(1)
            async with store.watch() as watch:
                assert (await anext(watch)).path == "z"
                for name in strange[3:]:
                    raw.execute_command("JSON.SET", name, "$", "1")
                raw.publish(f"{{{space}}}:notices", announce("stranger", 1, 0.0, ()))
                await manager_of(interface.session).fence()
                await store["zz"].write(2)
                await watch.look()
                assert (await asyncio.wait_for(anext(watch), 10)).path == "zz"
                assert list(watch._followed) == ["z", "zz"]
                assert not watch._born
    finally:
        for name in strange:
            raw.delete(name)


async def test_a_look_for_keys_that_the_server_refuses_is_made_again(akvs, key, monkeypatch):
    async with akvs.watch(key("*")) as watch:
        with monkeypatch.context() as patched:
            patched.setattr(key_plans, "_PAGE", "none")  # "ERR value is not an integer"
            with pytest.raises(RedisError):
                await watch.look()
        await akvs[key("a")].write(1)
        await watch.look()
        assert (await asyncio.wait_for(anext(watch), 10)).path == key("a")


@pytest.mark.long
async def test_of_a_key_that_is_gone_nothing_is_kept_where_only_places_in_it_are_watched(ainterface, akvs, key):
    """If it comes to be again, it is found like any other."""
    name = key("job")
    await akvs[name].write({"status": 1})
    async with akvs.watch(f"{key('*')}.status", f"{key('*')}.result") as watch:
        assert (await anext(watch)).data == 1
        await akvs[name].delete()
        assert (await asyncio.wait_for(anext(watch), 10)).deleted
        await aeventually(lambda: not watch._followed)
        await aeventually(lambda: not [each for each in manager_of(ainterface.session)._listeners() if each.stored])
        await akvs[name].write({"status": 2})
        update = await asyncio.wait_for(anext(watch), 10)
        assert (update.origin, update.path, update.data) == ("stored", f"{name}.status", 2)
        await akvs[name]["status"].delete()  # the key is there, the place is not
        assert (await asyncio.wait_for(anext(watch), 10)).deleted
        await watch.look()
        assert list(watch._followed) == [name]


async def test_what_goes_and_comes_again_before_it_is_followed_is_still_followed_then(akvs, kvs, pspace, raw, key):
    """All three are heard at once, since this thread publishes them; the last change is only known to who follows."""
    name = key("a")
    async with akvs.watch(key("*")) as watch:
        pspace[name] = 1
        del pspace[name]
        pspace[name] = 2
        while (await asyncio.wait_for(anext(watch), 10)).data != 2:
            pass
        raw.delete(name)  # before it could be found once more
        update = await asyncio.wait_for(anext(watch), 10)
        assert (update.path, update.deleted, update.origin) == (name, True, "stored")


async def test_of_keys_of_which_some_cannot_be_followed_yet_the_others_are(
    ainterface, akvs, kvs, raw, key, monkeypatch
):
    """A connection breaks after the first of them: what that one has told is not left standing when the key goes."""
    manager, later = manager_of(ainterface.session), [key("b")]
    follow = manager.follow_here

    async def broken(listener):
        if isinstance(listener, Follower) and listener.keys.name in later:
            raise ConnectionLost("cut")
        await follow(listener)

    async with akvs.watch(key("*")) as watch:
        kvs[key("a")], kvs[key("b")] = 1, 2  # this thread: nobody looks meanwhile
        monkeypatch.setattr(manager, "follow_here", broken)
        await watch.look()
        assert list(watch._followed) == [key("a")]
        assert (await asyncio.wait_for(anext(watch), 10)).data == 1
        raw.delete(key("a"))
        update = await asyncio.wait_for(anext(watch), 10)
        assert (update.path, update.deleted) == (key("a"), True)
        later.clear()
        assert (await asyncio.wait_for(anext(watch), 10)).data == 2


async def test_each_place_in_a_new_key_is_told_what_is_published_until_it_is_followed(
    ainterface, akvs, apspace, key, monkeypatch
):
    manager, name = manager_of(ainterface.session), key("job")
    follow_here, followed = manager.follow_here, []

    async def following(listener):
        followed.append(listener.stored)  # in a cluster others follow the key too
        if listener.stored and followed.count(True) == 2:
            for place in "a", "b":
                await apspace[name][place].write(2)
            await manager.fence()
        await follow_here(listener)

    async with akvs.watch(f"{key('*')}.a", f"{key('*')}.b") as watch:
        monkeypatch.setattr(manager, "follow_here", following)
        await apspace[name].write({"a": 1, "b": 1})
        told = set()
        while not {f"{name}.a", f"{name}.b"} <= told:
            update = await asyncio.wait_for(anext(watch), 10)
            if update.data == 2:
                assert update.origin == "published"
                told.add(update.path)
        assert followed.count(True) == 2


async def test_a_broken_connection_is_a_gap_of_each_key(ainterface, akvs, key):
    """And what came to be meanwhile is told."""
    await akvs[key("a")].write(1)
    async with akvs.watch(key("*")) as watch:
        assert (await anext(watch)).initial
        for wire in list(manager_of(ainterface.session)._wires.values()):
            wire.abort(reem_async.ConnectionLost("cut"))
        await akvs[key("a")].write(2)
        update = await asyncio.wait_for(anext(watch), 10)
        assert (update.gap, update.value) == (True, 2)
        await akvs[key("b")].write(3)
        update = await asyncio.wait_for(anext(watch), 10)
        assert (update.origin, update.path, update.value) == ("stored", key("b"), 3)


@pytest.mark.parametrize("loop", ["watch", "monitor"])
async def test_closing_the_interface_ends_loops_over_patterns_in_a_cluster_too(cluster, loop):
    """The keys of a pattern are followed one by one there, and the pattern by nobody."""
    interface = reem_async.RedisInterface(cluster.url)
    kvs = reem_async.KeyValueStore(interface)
    it = kvs.watch("closing*") if loop == "watch" else Monitor(interface, ["closing*"])
    await it.listen()
    waiting = asyncio.ensure_future(anext(it, "ended"))
    await asyncio.sleep(0)
    await interface.close()
    assert await asyncio.wait_for(waiting, 10) == "ended"


async def test_a_watch_that_could_not_begin_may_begin_later(ainterface, akvs, key, monkeypatch):
    """The call that failed had ended its loop for good."""
    manager = manager_of(ainterface.session)
    await akvs[key("a")].write(1)
    watch = akvs.watch(key("*"))

    async def refused(listeners):
        raise ConnectionLost("cut")

    with monkeypatch.context() as patch:
        patch.setattr(manager, "subscribe_all", refused)
        with pytest.raises(ConnectionLost):
            await watch.listen()
    async with watch:
        assert (await asyncio.wait_for(anext(watch), 10)).data == 1
