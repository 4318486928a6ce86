"""One write is one transaction, one read one version, and no change of shape loses or leaves anything.

The full promise (20,000 reads, 8 x 2,000 changes of shape) runs with REEM_TEST_EXAMPLES=100000.
"""

import asyncio
import contextlib
import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from conftest import EXAMPLES, PATIENCE, assert_no_orphans, assert_same, commands_run, keys_of, nothing_sent

import reem
from reem_async.errors import BadType, MissingKey, PathRefused

READS = max(200, EXAMPLES // 5)
CHANGES = max(40, EXAMPLES // 50)
SMALL, FULL = (48, 64, 3), (640, 480, 3)


def frame(stamp, shape):
    return {
        "stamp": float(stamp),
        "image": np.full(shape, float(stamp)),
        "deep": [{"copy": np.full(5, float(stamp))}],
    }


def assert_not_torn(value):
    image, copy = value["image"], value["deep"][0]["copy"]
    seen = {value["stamp"], float(image.min()), float(image.max()), float(copy.min()), float(copy.max())}
    assert len(seen) == 1, f"torn: {seen}"


# --- torn values -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "reads"), [(SMALL, READS), (FULL, max(20, READS // 20) if EXAMPLES < 50_000 else READS)]
)
def test_image_and_stamp_are_never_read_apart(server_url, key, shape, reads):
    """Two writers that replace both, two readers of the whole and of a part, each with an interface."""
    with contextlib.ExitStack() as stack:
        stores = [
            reem.KeyValueStore(stack.enter_context(contextlib.closing(reem.RedisInterface(server_url))))
            for _ in range(4)
        ]
        stores[0][key()] = {"frame": frame(0, shape)}
        written, over = [0, 0], threading.Event()

        def write(me):
            for stamp in range(1 + me, 10**9, 2):
                if over.is_set():
                    return
                if stamp % 5:
                    stores[me][key()]["frame"] = frame(stamp, shape)
                else:
                    stores[me][key()] = {"frame": frame(stamp, shape)}
                written[me] += 1

        def read(me):
            number = 0
            while number < reads // 2 or (min(written) < 3 and not any(each.done() for each in writers)):
                number += 1
                if number % 3:
                    assert_not_torn(stores[me][key()]["frame"].read())
                else:
                    assert_not_torn(stores[me][key()].read()["frame"])

        with ThreadPoolExecutor(4) as pool:
            writers = [pool.submit(write, me) for me in range(2)]
            try:
                list(pool.map(read, range(2, 4)))
            finally:
                over.set()
            assert [each.result() for each in writers] == [None, None]
        assert min(written) >= 3, "a run counts only if there was load"


# --- how many commands -----------------------------------------------------------------------------


def test_a_plain_read_is_one_command_and_a_plain_write_needs_no_transaction(front, key, raw):
    front.write([key()], {"n": 1, "x": 0.5})
    before = commands_run(raw)
    front.read([key()])
    front.read([key(), "n"])
    after = commands_run(raw)
    assert sum(after.values()) - sum(before.values()) == 2
    front.write([key()], {"n": 2, "x": 0.25})
    with nothing_sent(raw):
        pass
    for name in ["eval", "evalsha", "fcall", "script", "function", "keys", "flushall", "flushdb", "config|set"]:
        assert not commands_run(raw).get(name), f"{name} was used"


# --- changes of shape ------------------------------------------------------------------------------


@pytest.mark.parametrize("published", [False, True], ids=["store", "space"])
def test_arrays_of_a_write_that_cannot_be_are_not_even_sent(interface, key, raw, published):
    """If the connection broke just then, nobody would take them away."""
    place = (reem.PublishSpace if published else reem.KeyValueStore)(interface)[key()]
    place.write({"scalar": 1, "l": [1], "d": {"a": np.zeros(900)}})
    del place["d"]
    before = commands_run(raw)
    for path in (["scalar", "x"], ["gone", "x"], ["l", 5], ["l", 0, "x"], ["d", "a"]):
        at = place
        for element in path:
            at = at[element]
        with pytest.raises(PathRefused):
            at.write(np.arange(900))
    for name, error in (("scalar", BadType), ("gone", MissingKey)):
        with pytest.raises(error):
            place[name].append(np.arange(900))
    if not published:
        for name in ("scalar", "gone", "l"):
            with pytest.raises(PathRefused):
                place[name].setdefault("x", {"y": np.arange(900)})
    after = commands_run(raw)
    assert {name: after.get(name) for name in ("set", "sadd")} == {name: before.get(name) for name in ("set", "sadd")}


def _shape(rng, n):
    """A value that shows in itself whether it is whole: everything in it is n."""
    array = np.full(rng.choice([(2,), (3, 1), ()]), n)
    return rng.choice(
        [
            n,
            array,
            {"n": n, "a": array},
            {"n": n, "deep": {"a": array, "b": array}},
            [n, array],
            str(n),
            {"a": [array]},
        ]
    )


def _numbers(value):
    if isinstance(value, np.ndarray):
        return {int(number) for number in value.ravel()}
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return set().union(*map(_numbers, value)) if value else set()
    return {int(value)}


def _change_shapes(store, top, me, rng, failed):
    """One client's work: its own entry must keep what it wrote last, the shared one must always be whole."""
    mine = f"mine{me}"
    last = None
    for step in range(CHANGES):
        n = me * 1_000_000 + step
        kind = rng.randrange(8)
        try:
            if kind < 3:
                store[top]["shared"] = _shape(rng, n)
            elif kind == 3:
                store[top]["shared"]["sub"] = _shape(rng, n)
            elif kind == 4:
                del store[top]["shared"]["deep"]
            elif kind == 5:
                store[top]["list"].append(_shape(rng, n))
                if rng.random() < 0.7:
                    del store[top]["list"][0]
            elif kind == 6:
                value = store[top]["shared"].read()
                if not (isinstance(value, dict) and "sub" in value):
                    assert len(_numbers(value)) <= 1, f"a mixture: {value!r}"
            else:
                store[top].read()
        except (PathRefused, MissingKey, reem.BadType):
            failed.append(kind)
        last = _shape(rng, n)
        store[top][mine] = last
        if step % 10 == 0:
            assert_same(store[top][mine].read(), last)
    return mine, last


def test_eight_clients_that_change_shapes_lose_nothing_and_leave_no_orphans(server_url, key, raw):
    """`foo` beside `foobar`; each client's own entry holds what it wrote last."""
    seed = time.time_ns()
    print("seed", seed)
    expected = {key("foo"): {}, key("foobar"): {}}
    failed = []
    with contextlib.ExitStack() as stack:
        opened = [stack.enter_context(contextlib.closing(reem.RedisInterface(server_url))) for _ in range(8)]
        for top in expected:
            reem.KeyValueStore(opened[0])[top] = {"shared": 0, "list": []}

        def work(me):
            top = key("foo") if me % 4 else key("foobar")
            mine, last = _change_shapes(reem.KeyValueStore(opened[me]), top, me, random.Random(seed + me), failed)
            expected[top][mine] = last

        with ThreadPoolExecutor(8) as pool:
            list(pool.map(work, range(8)))
        kvs = reem.KeyValueStore(opened[0])
        for top, entries in expected.items():
            assert_no_orphans(raw, top)
            value = kvs[top].read()
            assert_same({name: value[name] for name in entries}, entries)
            assert set(value) == {"shared", "list", *entries}
        for top in expected:
            del kvs[top]
            assert keys_of(raw, top) == set()
    assert len(failed) < 8 * CHANGES, "every operation failed"


async def test_a_cancelled_write_is_whole_or_absent(akvs, key, raw):
    """Never a document without its arrays, nor arrays without a document."""
    await akvs[key()].write(frame(0, SMALL))
    for stamp in range(1, 60):
        task = asyncio.create_task(akvs[key()].write(frame(stamp, SMALL)))
        for _ in range(stamp % 6):
            await asyncio.sleep(0)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        value = await akvs[key()].read()
        assert_not_torn(value)
    await akvs[key()].write(frame(99, SMALL))
    assert_same(await akvs[key()].read(), frame(99, SMALL))
    assert_no_orphans(raw, key())


LARGE_WRITES = {
    "array": lambda place: place.write({"n": "old", "image": np.zeros(1_000_000)}),
    "text": lambda place: place.write({"n": "old", "text": "x" * 3_000_000}),
    "items": lambda place: place["list"].extend([np.zeros(1_000_000)]),
}
LATER = {
    "write": (lambda place: place["n"].write("new"), lambda value: value["n"] == "new"),
    "delete": (lambda place: place["n"].delete(), lambda value: "n" not in value),
    "whole": (lambda place: place.write("new"), lambda value: value == "new"),
    "add": (lambda place: place["count"].add(1), lambda value: value["count"] == 1),
}


async def test_what_a_cancelled_write_left_goes_with_the_next_one_to_the_key(akvs, kvs, key, raw):
    """Cancelled before it has removed the arrays it replaced, which another program had put there."""
    left = 0
    for turns in range(40):
        name = key(f"k{turns}")
        await akvs[name].write({"a": 0, "b": 0})
        kvs[name]["a"] = np.arange(3)
        task = asyncio.ensure_future(akvs[name]["a"].write(1))
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        await akvs[name].read()
        left += await akvs[name]["a"].type() is int and raw.exists(f"{{{name}}}:ships")
        await akvs[name]["b"].write(1)
        assert_no_orphans(raw, name)
    assert left, "no write was cancelled between both"


@pytest.mark.parametrize("later", LATER)
@pytest.mark.parametrize("large", LARGE_WRITES)
@pytest.mark.parametrize("publishes", [False, True])
async def test_nothing_overtakes_a_cancelled_large_write(akvs, apspace, key, publishes, large, later):
    """Though a small one takes another connection: what the program did last is what is there."""
    place = (apspace if publishes else akvs)[key()]
    change, is_there = LATER[later]
    for number in range(12):
        await akvs[key()].write({"n": "old", "count": 0, "list": [np.zeros(3)]})
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(LARGE_WRITES[large](place), 0.0004 * number)
        try:
            await change(place)
        except (MissingKey, PathRefused):
            assert large != "items"  # the large write took away what was to be changed
            continue
        after = await akvs[key()].read()
        assert is_there(after)
        await asyncio.sleep(0.02)
        assert_same(await akvs[key()].read(), after)


async def test_an_array_that_changes_after_a_cancelled_write_is_not_on_its_way_any_more(akvs, apspace, key):
    """What the program does to its array once the call is over cannot be seen by others."""
    image = np.zeros(1_000_000)
    for number in range(1, 25):
        place = (apspace if number % 2 else akvs)[key()]
        image[:] = number
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(place.write({"image": image, "n": number}), 0.0003 * number)
        image[:] = -1
        await akvs[key()].get()
        await akvs[key("other")].write(1)
        await asyncio.sleep(0.01)
        value = await akvs[key()].get()
        if value is not None:
            assert value["n"] > 0
            assert (value["image"] == value["n"]).all()


async def test_calls_that_queue_behind_a_cancelled_large_publish_go_on(akvs, apspace, key):
    large = {"count": 0, "image": np.zeros(1_000_000)}
    await apspace[key()].write(large)
    for number in range(12):
        first = asyncio.create_task(apspace[key()].write(large))
        await asyncio.sleep(0)
        calls = [
            asyncio.create_task(apspace[key()]["count"].add(1)),
            asyncio.create_task(apspace[key()].write(large)),
            asyncio.create_task(apspace[key()]["count"].add(1)),
            asyncio.create_task(apspace[key()]["more"].write(number)),
        ]
        await asyncio.sleep(0.0005 * number)
        calls[1].cancel()
        async with asyncio.timeout(PATIENCE):
            await asyncio.gather(first, calls[0], *calls[2:])
            await asyncio.gather(calls[1], return_exceptions=True)
        assert (await akvs[key()].read())["count"] >= 1
