"""The key-value store of `reem_async`, as documented, and what both fronts share of it."""

import asyncio
import copy
import operator
import pickle

import numpy as np
import pytest
from conftest import assert_no_orphans, assert_same

import reem_async
from reem_async.concurrency.queues import Every
from reem_async.errors import Conflict, MissingKey, PathRefused
from reem_async.plan.arithmetic import calculate, compute
from reem_async.plan.changes import EncodedAttachment
from reem_async.plan.keys import keys_of
from reem_async.plan.reads import read
from reem_async.plan.shapes import ShapeCache
from reem_async.plan.writes import append_change, change, delete_change, set_change, takes, together
from reem_async.ships.registry import Ships, default_ships
from reem_async.store.publish import PublishTurn
from reem_async.transport.protocol import CommandRecorder


async def test_edit_writes_back_what_the_block_changed(akvs, key, raw):
    await akvs[key()].write({"n": 1, "image": np.zeros(3), "gone": np.ones(2)})
    async with akvs[key()].edit() as value:
        value["n"] += 1
        value["image"][1] = 5
        value["new"] = [np.arange(2)]
        del value["gone"]
    expected = {"n": 2, "image": np.array([0.0, 5.0, 0.0]), "new": [np.arange(2)]}
    assert_same(await akvs[key()].read(), expected)
    assert_no_orphans(raw, key())
    async with akvs[key()]["new"].edit() as items:
        items.append("tail")
    assert_same(await akvs[key()]["new"].read(), [np.arange(2), "tail"])


@pytest.mark.parametrize("image", [None, np.zeros(4)], ids=["plain", "array"])
async def test_an_edit_that_somebody_overtook_is_a_conflict(akvs, kvs, key, image, raw):
    """Nothing is written; the other's value stands, also if only an array's content changed."""
    await akvs[key()].write({"n": 1, "image": image})
    with pytest.raises(Conflict):  # noqa: PT012
        async with akvs[key()].edit() as value:
            value["n"] = 2
            if image is None:
                kvs[key()]["m"] = 3
            else:
                kvs[key()]["image"] = image + 1
    expected = {"n": 1, "image": None, "m": 3} if image is None else {"n": 1, "image": image + 1}
    assert_same(await akvs[key()].read(), expected)
    assert_no_orphans(raw, key())


async def test_a_cancelled_call_harms_no_other(akvs, key):
    await akvs[key()].write({str(n): n for n in range(50)} | {"image": np.zeros(100_000)})
    for _ in range(20):
        tasks = [asyncio.create_task(akvs[key()][str(n)].read()) for n in range(50)]
        tasks.append(asyncio.create_task(akvs[key()]["image"].read()))
        await asyncio.sleep(0)
        for task in tasks[::2]:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
        for n, result in enumerate(results[:50]):
            assert result == n or isinstance(result, asyncio.CancelledError)
    assert await akvs[key()]["7"].read() == 7


def test_handles_can_be_pickled(open_front, key):
    front, space = open_front(), open_front("PublishSpace")
    front.write([key()], {"a": np.arange(3)})
    store, accessor = pickle.loads(pickle.dumps((front.kvs, front.at([key(), "a"]))))
    assert_same(front.wait(store[key()].read()), {"a": np.arange(3)})
    assert_same(front.wait(accessor.read()), np.arange(3))
    publishing, bare = (pickle.loads(pickle.dumps(it)) for it in (space.kvs, space.interface))
    space.wait(publishing[key()]["a"].write(5))
    assert front.read([key(), "a"]) == 5
    front.wait(store.interface.close())
    space.wait(publishing.interface.close())
    space.wait(bare.close())


# --- publishing: a change and its notice in one transaction, numbered in the order of the calls


KEYS = keys_of("a", "", 0, False)
IMAGE = (EncodedAttachment(".x.image", "numpy", (("SET", "{a}.x.image", b"1"),), (b"1",)),)


def full_cache():
    """What an interface knows that has worked with a document for a while."""
    cache = ShapeCache()
    cache.of("a").saw_members(frozenset([b".x.image", b".y"]))
    cache.of("a").saw_number(("n",), 5)
    cache.of("a").saw_new()
    return cache


WRITES = {
    "set": lambda telling, cache: change(set_change(KEYS, ("x",), b"1", IMAGE, announcement=telling), cache),
    "set in a list": lambda telling, cache: change(set_change(KEYS, ("l", -1), b"1", (), announcement=telling), cache),
    "delete": lambda telling, cache: change(delete_change(KEYS, (), announcement=telling), cache),
    "append": lambda telling, cache: change(append_change(KEYS, ("l",), [b"1"], IMAGE, announcement=telling), cache),
    "update": lambda telling, cache: together([set_change(KEYS, ("y",), b"1", (), announcement=telling)], cache),
    "increment": lambda telling, cache: calculate(
        KEYS, ("n",), "JSON.NUMINCRBY", operator.add, 1, b"1", telling, cache
    ),
    "divide": lambda telling, cache: compute(KEYS, ("n",), abs, telling, cache),
    "look for the place": lambda _, cache: takes(KEYS, ("x",), IMAGE, cache),
    "read": lambda _, cache: read(KEYS, ("x",), Ships(default_ships(), CommandRecorder), cache),
}


@pytest.mark.parametrize("kind", WRITES)
@pytest.mark.parametrize("known", [True, False], ids=["known", "unknown"])
async def test_plans_change_nothing_while_they_are_built(known, kind):
    """Neither what is known of documents nor a publisher's numbers: a plan may be built and never sent."""
    session = reem_async.RedisInterface("127.0.0.1").session  # never connected
    cache = full_cache() if known else ShapeCache()
    turn = PublishTurn(session, KEYS)
    for telling in (turn.reserve(b"1", IMAGE), turn.reserve(), turn.reserve(deleted=True)):
        before = copy.deepcopy((cache.of("a"), session._last))
        plan = WRITES[kind](telling, cache)
        assert plan is None or plan.commands
        assert (cache.of("a"), session._last) == before


@pytest.mark.parametrize(
    ("refused", "error"),
    [
        (lambda place: place["l"][-1].write(1), PathRefused),
        (lambda place: place["l"][-1].delete(), MissingKey),
        (lambda place: place["n"].divide(2), MissingKey),
        (lambda place: place["no"]["image"].write(np.zeros(3)), PathRefused),
    ],
    ids=["write", "delete", "divide", "array"],
)
async def test_what_is_refused_before_it_is_sent_uses_no_number(apspace, akvs, ainterface, key, refused, error):
    """A number that no update has would be a gap for subscribers, who would read the whole key anew."""
    await apspace[key()].write({"l": []})
    async with akvs[key()].watch(Every(10)) as watch:
        await anext(watch)
        with pytest.raises(error):
            await refused(apspace[key()])
        await apspace[key()]["n"].write(1)
        update = await anext(watch)
        assert (update.path, update.sequence, update.gap, update.missed) == (f"{key()}.n", 2, False, 0)


@pytest.mark.parametrize("told", [True, False], ids=["published", "stored"])
async def test_a_small_change_is_over_when_its_replies_are_read(apspace, akvs, key, told):
    """What a look at the registry finds is still seen to: here an array that another program put there."""
    space = apspace if told else akvs
    await space[key()].write({"a": 1})
    async with reem_async.RedisInterface(space.interface._given[0]) as other:
        await reem_async.KeyValueStore(other)[key()]["a"].write(np.arange(3))
    await space[key()]["a"].write(2)
    assert await akvs[key()].read() == {"a": 2}
    keys = space.interface.session.keys(key())
    replies = await space.interface.session.transport.roundtrip([("SMEMBERS", keys.registry)])
    assert list(replies[0]) == []


@pytest.mark.parametrize("length", [2048, 2049, 5000])
async def test_a_path_of_any_length_is_told_without_a_loss(apspace, akvs, binterface, key, length):
    """Subscribers take no longer one than 2048 characters: what is deeper is told as a change of what is above it."""
    name = "k" * (length - 1)
    place = f"{key()}.a" if length > 2048 else f"{key()}.a.{name}"
    await apspace[key()].write({"a": {}})
    async with reem_async.SilentSubscriber(key(), binterface) as subscriber:
        told = subscriber.watch(Every(100))
        await anext(told)
        a = apspace[key()]["a"]
        for step in (
            lambda: a[name].write(1),
            lambda: a[name].increment(),
            lambda: a[name].write(np.arange(20_000.0)),
            lambda: a.update({name: 2}),
            lambda: a[name].delete(),
        ):
            await step()
            update = await anext(told)
            assert (update.path, update.gap) == (place, False)
            assert_same(update.data, await akvs[key()].read())
    assert binterface.unreadable == 0
