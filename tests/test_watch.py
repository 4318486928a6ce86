"""`watch()` sees every change of what is stored: published updates one by one, all else as what it led to."""

import asyncio
import contextlib
import functools
import logging

import numpy as np
import pytest
from chaos.servers import PrivateServer
from clusterkit import Move, clients_of
from conftest import FRONTS, PATIENCE, Loop, RawCluster, aeventually, assert_same, commands_run

import reem
import reem_async
from reem_async import Every, Last
from reem_async.pubsub.manager import manager_of
from reem_async.server import EmbeddedServer

IMAGE = np.arange(10_000, dtype=np.float64).reshape(100, 100)
"""80 kB: over a connection of its own."""


@pytest.fixture
def watching(front):
    return functools.partial(watched, front)


def watched(front, path, **options):
    return Loop(front, front.at(path).watch(Last(1000), **options))


def test_what_anybody_stores_is_told_as_what_it_led_to(front, watching, raw, kvs, key):
    top = key()
    front.write((top,), {"a": 1, "b": {"c": 2, "d": 3}, "l": [1, 2, 3]})
    watch = watching((top,))
    first = watch.next()
    assert (first.origin, first.initial, first.deleted) == ("found", True, False)
    kvs[top]["b"]["c"] = 4
    assert watch.told() == ("stored", f"{top}.b.c", 4, False)
    kvs[top]["b"] = {"c": 5, "d": 6}
    assert watch.told() == ("stored", f"{top}.b", {"c": 5, "d": 6}, False)
    raw.execute_command("JSON.SET", top, "$.l[1]", "7")
    assert watch.told() == ("stored", f"{top}.l[1]", 7, False)
    raw.execute_command("JSON.ARRAPPEND", top, "$.l", "8")
    assert watch.told() == ("stored", f"{top}.l", [1, 7, 3, 8], False)
    kvs[top]["a"] += 1
    assert watch.told() == ("stored", f"{top}.a", 2, False)
    kvs[top]["new"] = None
    assert watch.told() == ("stored", f"{top}.new", None, False)
    del kvs[top]["new"]
    assert watch.told() == ("stored", f"{top}.new", None, True)
    update = (raw.execute_command("JSON.SET", top, "$.a", "9"), watch.next())[1]
    assert update.data == {"a": 9, "b": {"c": 5, "d": 6}, "l": [1, 7, 3, 8]}
    assert (update.publisher, update.sequence, update.time, update.gap) == (None, None, None, False)


@pytest.mark.parametrize("ends", ["del", "unlink", "expire", "rename"])
def test_what_goes_is_told_to_be_gone_and_what_comes_back_too(watching, raw, kvs, key, ends):
    """A deletion, an expiry: not to be mistaken for None."""
    top = key()
    watch = watching((top, "a"))
    kvs[top] = {"a": None}
    assert watch.told() == ("stored", f"{top}.a", None, False)
    if ends == "expire":
        raw.pexpire(top, 1)
    elif ends == "rename" and not isinstance(raw, RawCluster):
        raw.rename(top, key("other"))
    else:
        getattr(raw, ends if ends == "unlink" else "delete")(top)
    update = watch.next()
    assert (update.origin, update.path, update.value, update.data, update.deleted) == (
        ("stored", f"{top}.a", None, None, True)
    )
    kvs[top] = {"a": 1}
    assert watch.told() == ("stored", f"{top}.a", 1, False)


def test_nothing_is_told_where_nothing_differs(watching, kvs, pspace, key):
    """Of an equal value, of another part of the key, or of an update that was told already."""
    top = key()
    kvs[top] = {"a": 1, "b": 2, "image": IMAGE}
    watch = watching((top, "a"))
    watch.next()
    kvs[top]["a"] = 1
    kvs[top]["b"] = 3
    pspace[top]["a"] = 2
    pspace[top]["a"] = 2
    pspace[top]["b"] = 2
    kvs[top]["image"] = IMAGE + 1
    kvs[top]["a"] = "last"
    told = [watch.told(), watch.told(), watch.told()]
    assert told == [
        ("published", f"{top}.a", 2, False),
        ("published", f"{top}.a", 2, False),
        ("stored", f"{top}.a", "last", False),
    ]


def test_a_number_is_not_the_same_as_another_type_of_it(watching, kvs, key):
    """1, 1.0 and True are equal in Python, and three things in a document."""
    top = key()
    kvs[top] = [1]
    watch = watching((top,))
    watch.next()
    for value in (1.0, True, 1, -1.0, 0.0, -0.0):
        kvs[top][0] = value
        assert_same(watch.next().value, value)


def test_published_and_stored_changes_of_one_key_are_both_told(watching, kvs, pspace, key):
    """Each update that is published, in its order, and in the end what was stored."""
    top = key()
    pspace[top] = {"p": 0, "s": 0}
    watch = watching((top,))
    watch.next()
    for number in range(1, 51):
        pspace[top]["p"] = number
        kvs[top]["s"] = number
    published, stored = [], []
    while (published[-1:], stored[-1:]) != ([50], [50]):
        update = watch.next()
        (published if update.origin == "published" else stored).append(update.data["p" if update.sequence else "s"])
    assert published == sorted(set(published)) == list(range(1, 51))
    assert stored == sorted(set(stored))
    assert update.data == {"p": 50, "s": 50}


def test_arrays_that_were_not_written_again_are_not_fetched(watching, raw, kvs, key):
    """Those that were are, also as the whole value, in lists, small and large."""
    top = key()
    kvs[top] = {"n": 1, "small": np.arange(3), "large": IMAGE, "l": [np.arange(2)]}
    watch = watching((top,))
    watch.next()
    before = commands_run(raw).get("get", 0)
    kvs[top]["n"] = 2
    update = watch.next()
    assert update.path == f"{top}.n"
    assert_same(update.data, {"n": 2, "small": np.arange(3), "large": IMAGE, "l": [np.arange(2)]})
    got = commands_run(raw).get("get", 0) - before
    assert got <= 4  # the note of the last update, and those of the heartbeats
    for name, value in (("large", IMAGE + 1), ("small", np.arange(4)), ("large", IMAGE[:50]), ("l", [np.arange(9)])):
        kvs[top][name] = value
        update = watch.next()
        assert update.path.startswith(f"{top}.{name}")
        assert_same(update.data[name], value)
    kvs[top]["l"][0] = np.arange(5)
    assert_same(watch.next().data["l"], [np.arange(5)])
    kvs[top] = IMAGE
    assert_same(watch.next().value, IMAGE)


def test_an_array_that_is_all_of_a_key_is_told_when_it_is_written_again(watching, kvs, key):
    """Its name on the server is the key's in braces, with nothing behind it."""
    kvs[key()] = np.array(b"ab")
    watch = watching((key(),))
    watch.next()
    for value in (np.array(b"cd"), np.zeros((2, 3)), np.ones((2, 3))):
        kvs[key()] = value
        np.testing.assert_array_equal(watch.next().data, value, strict=True)


def test_what_a_neighbour_with_a_longer_name_stores_is_not_told(watching, kvs, key):
    kvs[key()] = 1
    watch = watching((key(),))
    watch.next()
    kvs[key("foobar")] = {"a": np.arange(2)}
    kvs[key("foo.a")] = 2
    kvs[key()] = 3
    assert watch.told() == ("stored", key(), 3, False)


def test_a_watch_of_published_updates_alone_does_not_hear_stores(watching, kvs, pspace, key):
    watch = watching((key(),), stored=False)
    kvs[key()] = {"a": 1}
    pspace[key()]["a"] = 2
    update = watch.next()
    assert (update.origin, update.path, update.data) == ("published", f"{key()}.a", {"a": 2})


def test_subscribers_hear_what_is_published_and_all_if_asked(interface, kvs, pspace, key):
    heard = []
    with (
        reem.SilentSubscriber(key(), interface) as published,
        reem.SilentSubscriber(key(), interface, stored=True) as every,
        contextlib.closing(reem.CallbackSubscriber(key(), interface, lambda data, path: heard.append(data))) as calls,
        contextlib.closing(
            reem.CallbackSubscriber(key(), interface, lambda data, path: heard.append(path), stored=True)
        ) as all_calls,
    ):
        calls.listen()
        all_calls.listen()
        kvs[key()] = {"a": 1}
        asyncio.run(aeventually(lambda: every.value() == {"a": 1}))
        assert published.value() is None
        asyncio.run(aeventually(lambda: heard == [key()]))
        pspace[key()]["a"] = 2
        asyncio.run(aeventually(lambda: len(heard) == 3 and published.value() == every.value() == {"a": 2}))
        assert every["a"].read() == 2


@pytest.mark.parametrize("kind", list(FRONTS))
def test_who_may_not_track_hears_what_is_published_and_is_warned_once(kind, caplog):
    with EmbeddedServer() as server, clients_of([server]) as (raw,):
        raw.execute_command("ACL", "SETUSER", "robot", "on", ">pw", "~*", "&*", "+@all", "-client|tracking")
        url = f"redis://robot:pw@127.0.0.1:{server.port}"
        front, space = FRONTS[kind](url), FRONTS[kind](server.url, "PublishSpace")
        with contextlib.closing(front), contextlib.closing(space), caplog.at_level(logging.WARNING, "reem.subscribe"):
            watch, other = watched(front, ("foo",)), watched(front, ("bar",))
            front.write(("foo",), {"a": 1})
            space.write(("foo", "a"), 2)
            update = watch.next()
            assert (update.origin, update.data) == ("published", {"a": 2})
            watch.close()
            other.close()
        (warning,) = [record.getMessage() for record in caplog.records if record.name == "reem.subscribe"]
        assert "client|tracking" in warning


async def test_a_restart_without_data_is_told_as_a_gap_and_that_all_is_gone():
    """Not as a value that looks as if somebody had stored None."""
    with PrivateServer() as server:
        async with reem_async.RedisInterface(server.url) as interface:
            kvs = reem_async.KeyValueStore(interface)
            await kvs["foo"].write({"a": 1})
            watch = kvs["foo"]["a"].watch(Every(100))
            assert (await anext(watch)).value == 1
            server.kill()
            server.start()
            update = await asyncio.wait_for(anext(watch), PATIENCE)
            assert (update.gap, update.deleted, update.value, update.data) == (True, True, None, None)
            assert update.origin == "found"
            await kvs["foo"].write({"a": 2})
            update = await asyncio.wait_for(anext(watch), PATIENCE)
            assert (update.origin, update.value, update.gap) == ("stored", 2, False)


def test_a_flushed_server_is_told_by_everybody_who_watches():
    with EmbeddedServer() as server, clients_of([server]) as (raw,), reem.RedisInterface(server) as interface:
        kvs = reem.KeyValueStore(interface)
        kvs["foo"], kvs["bar"] = {"a": 1}, [np.arange(3)]
        watches = [kvs["foo"]["a"].watch(Last(9)), kvs["bar"].watch(Last(9))]
        for watch in watches:
            assert next(watch).initial
        raw.flushall()
        for watch in watches:
            update = next(watch)
            assert (update.deleted, update.origin) == (True, "stored")


async def test_a_broken_connection_is_told_as_a_gap_and_following_goes_on(ainterface, akvs, raw, key):
    await akvs[key()].write({"a": 1})
    async with akvs[key()].watch(Every(100)) as watch:
        assert (await anext(watch)).initial
        for wire in list(manager_of(ainterface.session)._wires.values()):
            wire.abort(reem_async.ConnectionLost("cut"))
        await akvs[key()]["a"].write(2)
        update = await asyncio.wait_for(anext(watch), PATIENCE)
        assert (update.gap, update.data, update.origin, update.deleted) == (True, {"a": 2}, "found", False)
        await akvs[key()]["a"].write(3)
        update = await asyncio.wait_for(anext(watch), PATIENCE)
        assert (update.origin, update.data) == ("stored", {"a": 3})


async def test_nobody_is_tracked_who_only_follows_what_is_published(binterface, raw, key):
    """The server is asked once somebody wants to hear of stores."""
    silent = reem_async.SilentSubscriber(key(), binterface)
    await silent.listen()
    (wire,) = manager_of(binterface.session)._wires.values()
    assert wire.tracked is None
    watch = reem_async.KeyValueStore(binterface)[key()].watch()
    await watch.listen()
    assert wire.tracked is True


async def test_what_is_pushed_and_is_no_invalidation_is_counted(ainterface, akvs, key):
    watch = akvs[key()].watch()
    await watch.listen()
    manager = manager_of(ainterface.session)
    for names in ("x", [1], [b"{"], [b""], [b"{" + key().encode()], [b"\xff\xfe"], [key().encode()]):
        manager._inbox.take([b"invalidate", names])
    assert ainterface.unreadable == 2
    await akvs[key()].write(1)
    assert (await asyncio.wait_for(anext(watch), PATIENCE)).value == 1


@pytest.mark.parametrize("kind", list(FRONTS))
def test_a_slot_that_moves_is_told_as_a_gap_and_stores_are_told_from_its_new_node(kind, cluster):
    """What is stored while it moves is not lost."""
    front = FRONTS[kind](cluster.url)
    name = "moving-watch"
    with contextlib.closing(front):
        front.write((name,), {"n": 1, "image": IMAGE})
        watch = watched(front, (name,))
        assert watch.next().initial
        slot = Move(cluster, name)
        slot.begin()
        slot.take(*slot.left())
        front.write((name, "n"), 2)
        slot.finish()
        while (update := watch.next()).data["n"] != 2 or not update.gap:
            assert update.origin in ("found", "stored")
        front.write((name, "n"), 3)
        while (update := watch.next()).data != 3 and update.data["n"] != 3:
            assert update.origin in ("found", "stored")
        assert_same(update.data, {"n": 3, "image": IMAGE})
        watch.close()
        front.delete((name,))
