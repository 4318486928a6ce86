"""Large values from publisher to subscribers of one host through shared memory, and what happens where that fails."""

import os

import numpy as np
import pytest
from conftest import assert_same, eventually
from slotkit import in_slot

import reem
import reem_async
from reem_async.local.segment import SLOTS, LocalReader, Segment, reason_against
from reem_async.plan.notices import Slot

pytestmark = pytest.mark.skipif(bool(reason_against()), reason=f"no shared memory: {reason_against()}")

IMAGE = np.arange(30_000, dtype=np.float64).reshape(100, 300)


@pytest.fixture
def seen(server_url, key):
    updates = []
    with reem.RedisInterface(server_url) as interface:
        subscriber = reem.CallbackSubscriber(key("cam"), interface, lambda data, updated_path: updates.append(data))
        subscriber.listen()
        yield updates


def test_a_large_update_is_looked_at_in_the_publishers_memory(seen, pspace, key):
    for number in range(20):
        pspace[key("cam")] = {"image": IMAGE + number, "n": number, "also": np.arange(10_000) + number}
        eventually(lambda number=number: len(seen) == number + 1)
        assert_same(seen[-1], {"image": IMAGE + number, "n": number, "also": np.arange(10_000) + number})
        assert in_slot(seen[-1]["image"])
        assert not seen[-1]["image"].flags.writeable
        del seen[-1]["image"], seen[-1]["also"]  # so that the slots come free again


def test_who_collects_frames_gets_copies_and_keeps_what_he_has(seen, pspace, key):
    for number in range(30):
        pspace[key("cam")] = {"image": IMAGE + number}
        eventually(lambda number=number: len(seen) == number + 1)
    assert sum(in_slot(each["image"]) for each in seen) == 3
    for number, each in enumerate(seen):
        assert_same(each["image"], IMAGE + number)


def test_what_is_stored_at_the_server_is_the_same(seen, pspace, kvs, key):
    pspace[key("cam")] = {"image": IMAGE}
    eventually(lambda: seen)
    assert_same(kvs[key("cam")].read(), {"image": IMAGE})


@pytest.mark.parametrize("who", ["publisher", "subscriber"])
def test_switched_off_it_is_fetched(who, server_url, key):
    options = {"local": "off"}
    with (
        reem.RedisInterface(server_url, **(options if who == "publisher" else {})) as one,
        reem.RedisInterface(server_url, **(options if who == "subscriber" else {})) as other,
    ):
        subscriber = reem.SilentSubscriber(key("cam"), other)
        subscriber.listen()
        reem.PublishSpace(one)[key("cam")] = {"image": IMAGE}
        eventually(lambda: subscriber.value() is not None)
        assert_same(subscriber.value(), {"image": IMAGE})
        assert not in_slot(subscriber.value()["image"])


def test_nothing_is_copied_where_nobody_listens(interface, key):
    space = reem.PublishSpace(interface)
    for _ in range(3):
        space[key("cam")] = {"image": IMAGE}
    assert not interface._direct.session.local._segments


def test_beyond_its_share_of_memory_it_goes_through_the_server(server_url, key, seen):
    with reem.RedisInterface(server_url, local_memory=1 << 16) as small:
        reem.PublishSpace(small)[key("cam")] = {"image": IMAGE}
        eventually(lambda: seen)
    assert_same(seen[-1], {"image": IMAGE})
    assert not in_slot(seen[-1]["image"])


@pytest.mark.parametrize(
    ("name", "wrong"), [("local", "on"), ("local", None), ("local_memory", -1), ("local_memory", 1.5)]
)
def test_options_that_mean_nothing_are_refused(name, wrong):
    with pytest.raises(reem.BadValue, match=name):
        reem.RedisInterface("localhost", **{name: wrong})


async def test_early_an_update_is_told_once_and_says_so(server_url, key):
    async with (
        reem_async.RedisInterface(server_url, local="early") as one,
        reem_async.RedisInterface(server_url) as other,
    ):
        space, told = reem_async.PublishSpace(one), []
        await space[key("cam")].write({"n": -1})
        async with reem_async.SilentSubscriber(key("cam"), other) as subscriber:
            watch = subscriber.watch(reem_async.Every(100))
            assert (await anext(watch)).initial
            for number in range(20):
                await space[key("cam")].write({"n": number, "image": IMAGE})
            async for update in watch:
                told.append(update)
                if update.data["n"] == 19:
                    break
        assert [each.data["n"] for each in told] == list(range(20))
        assert not any(each.gap for each in told)
        assert all(each.early for each in told[1:])


def put(segment, data):
    number, stamp = segment.put([data], [len(data)])
    return Slot("", os.getpid(), segment.descriptor, segment.inode, number, stamp)


def test_a_slot_that_is_looked_at_is_not_written():
    segment, reader = Segment(1000), LocalReader()
    first = put(segment, b"first" * 10)
    view = reader.view(first, 50)
    for number in range(100):
        put(segment, b"%d" % number)
    assert bytes(view) == b"first" * 10
    del view
    for number in range(100):
        put(segment, b"%d" % number)
    assert reader.view(first, 50) is None


def test_a_segment_whose_slots_are_all_looked_at_has_no_room():
    segment = Segment(1000)
    views = [LocalReader().view(put(segment, b"%d" % number), 1) for number in range(SLOTS)]
    assert segment.put([b"x"], [1]) is None
    assert [bytes(view) for view in views] == [b"%d" % number for number in range(SLOTS)]
    views.pop(2)
    assert segment.put([b"x"], [1])[0] == 2
