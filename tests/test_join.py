"""Joined streams: matched as a model says, in both fronts, in bounded memory, with a reason for what is skipped."""

import asyncio
import gc
import time
import weakref

import numpy as np
import pytest
from conftest import aeventually, assert_same, sized

import reem
import reem_async
from reem_async.errors import BadInput, InterfaceClosed, WriteOnly
from reem_async.pubsub import join as module
from reem_async.pubsub.join import Joiner, JoinSkips, _Arrival


@pytest.mark.parametrize("seed", range(sized(30, 1000)))
def test_each_update_of_the_first_path_gets_the_nearest_of_the_others(seed):
    """At random times in ms, handed over at random moments: never late by more than `slop`, and never another value."""
    random = np.random.default_rng(seed)
    slop, count = int(random.choice([0, 5, 40])), int(random.integers(2, 4))
    times = [np.sort(random.integers(0, 1000, random.integers(0, 60))).tolist() for _ in range(count)]
    joiner, joined = Joiner(count, slop), []
    for now in range(1100):
        for place in random.permutation(count).tolist():
            for number, at in enumerate(times[place]):
                if at == now:
                    joiner.add(place, _Arrival(at, number))
        joined += [(now, *each) for each in joiner.take(now)]
    expected, unmatched = [], [0] * count
    for number, at in enumerate(times[0]):
        nearest = [min((abs(it - at) for it in each), default=slop + 1) for each in times[1:]]
        for place, distance in enumerate(nearest, 1):
            unmatched[place] += distance > slop
        if max(nearest) <= slop:
            expected.append((at, number, nearest))
    found = [
        (at, values[0], [abs(times[n][it] - at) for n, it in enumerate(values[1:], 1)]) for _, at, values in joined
    ]
    assert found == expected
    assert joiner.unmatched == unmatched
    assert all(0 <= now - at <= slop for now, at, _ in joined)
    assert joiner.due() == float("inf")


def test_memory_is_bounded_if_a_path_is_silent_or_the_first_one_is(monkeypatch):
    monkeypatch.setattr(module, "_MOST_WAITING", 10)
    joiner = Joiner(2, 1000.0)
    for number in range(100):
        joiner.add(0, _Arrival(float(number), number))
    assert list(joiner.take(99.0)) == []
    assert joiner.crowded == [90, 0]
    joiner = Joiner(2, 0.01)
    for number in range(100):
        joiner.add(1, _Arrival(float(number), number))
    assert (len(joiner._waiting[1]), joiner.crowded) == (1, [0, 0])


async def test_pictures_and_joints_arrive_together(key, akvs, apspace):
    """The picture with the joints that are nearest; one without any is skipped, and counted."""
    image = np.zeros((100, 1000), np.uint8)
    await apspace[key("arm")].write({"q": 0.0})  # what is there already was not published now
    async with akvs.join(key("cam.rgb"), key("arm.q"), slop=1) as joined:
        await apspace[key("cam")].write({"rgb": image})
        await aeventually(lambda: joined.skipped[key("arm.q")] == JoinSkips(unmatched=1))
        assert joined.skipped[key("cam.rgb")] == JoinSkips()
        for number in (1, 2):
            await apspace[key("arm")]["q"].write(float(number))
            await apspace[key("cam")]["rgb"].write(image + np.uint8(number))
            t, (picture, q) = await joined.next(5)
            assert 0 <= time.monotonic() - t < 5
            assert_same(picture, image + np.uint8(number))
            assert q == number
    with pytest.raises(InterfaceClosed):
        await joined.next(0)


def test_a_loop_in_plain_code(key, kvs, pspace):
    with kvs.join(key("a"), key("b"), key("c.x"), slop=5) as joined:
        for number in range(3):
            pspace[key("c")] = {"x": -number}
            pspace[key("b")] = 10 * number
            pspace[key("a")] = number
            assert next(joined)[1] == (number, 10 * number, -number)
        assert joined.paths == [key("a"), key("b"), key("c.x")]
        assert joined.dropped == 0
    assert list(joined) == []


def test_what_cannot_be_joined_is_refused_before_anything_is_sent(kvs, pspace):
    for paths, slop in [(["a"], 0.1), (["a", "a"], 0.1), (["a", "b"], -1), (["a", "b"], "x"), (["a", ""], 1)]:
        with pytest.raises(BadInput):
            kvs.join(*paths, slop=slop)
    with pytest.raises(WriteOnly):
        pspace.join("a", "b", slop=1)
    assert reem.KeyValueStore.join.__doc__ != reem_async.KeyValueStore.join.__doc__


async def test_a_join_that_was_dropped_is_collected(key, akvs, apspace):
    joined = akvs.join(key("a"), key("b"), slop=30)
    await joined.listen()
    await apspace[key("a")].write(1)
    while joined._timer is None:
        await asyncio.sleep(0.01)
    reference = weakref.ref(joined)
    del joined
    gc.collect()
    assert reference() is None
