"""What is recorded while values overtake each other, in lists of numbers, of samples, and by parts of keys."""

from __future__ import annotations

import asyncio
import math
import time

import numpy as np
import pytest
from conftest import aeventually, assert_same

from reem_async.monitor import ANNOUNCED, Event
from reem_async.plan.patterns import parse_pattern
from reem_async.recording import Recorder, Replayer, feed, open_log
from reem_async.recording.state import pruned
from reem_async.recording.times import published

LARGE = np.zeros((300, 300))


def news(file, path):
    """What was recorded of a path: True for each deletion, else the value."""
    with open_log(file) as log:
        return [update.deleted or update.value for update in log.updates(patterns=[path])]


async def test_what_is_stored_beside_what_is_published_is_seen(key, apspace, akvs, binterface, file):
    """At the next keyframe, though an update comes in each of them; and at the end, though there was none since."""
    await apspace[key()].write({"x": 0, "y": 0, "z": 0})
    async with Recorder(binterface, [key()], file, keyframe=0.2) as recorder:
        await akvs[key()]["y"].write(5)
        stored, frames = time.time(), recorder._keyframes
        while recorder._keyframes < frames + 3:
            await apspace[key()]["x"].increment()
            await asyncio.sleep(0.01)
        await akvs[key()]["z"].write(7)
    with open_log(file) as log:
        assert log[key()]["y"].at(stored + 0.6) == 5
        assert_same(log[key()].at(log.end), await akvs[key()].read())
        assert log[key()]["z"].at(log.end) == 7


async def test_a_frame_that_a_keyframe_reads_first_is_not_skipped(key, apspace, binterface, file, monkeypatch):
    """What a state brings of updates that were only announced is theirs."""
    monkeypatch.setattr(feed, "_LET_PASS", 0.05)
    await apspace[key()].write({"image": LARGE})
    async with Recorder(binterface, [key()], file) as recorder:
        for number in range(1, 4):
            recorder._feed(key()).read()  # what a keyframe does
            await apspace[key()]["image"].write(LARGE + number)
            await aeventually(lambda: recorder._feed(key()).busy is None)
        recorder._feed(key()).read()  # one comes while what was announced before waits to be fetched
        await apspace[key()]["image"].write(LARGE + 4)
        await asyncio.sleep(0.02)
        recorder._feed(key()).read()
        await apspace[key()]["image"].write(LARGE + 5)
    with open_log(file) as log:
        found = [update for update in log.updates() if update.path == (key(), "image")]
        assert [int(update.value[0, 0]) for update in found] == [update.sequence - 1 for update in found]
        assert {1, 2, 3, 5} <= {update.sequence - 1 for update in found}
        assert len(found) == 5 - recorder.status.skipped


async def test_what_was_deleted_before_it_could_be_fetched_is_skipped_and_counted(
    key, apspace, akvs, binterface, file, monkeypatch
):
    """It is neither a deletion of its own, nor is its deletion recorded twice."""
    monkeypatch.setattr(feed, "_LET_PASS", 0.05)
    await apspace[key()].write({})
    async with Recorder(binterface, [key()], file) as recorder:
        for _ in range(5):
            await apspace[key()]["image"].write(LARGE)
            await apspace[key()]["image"].delete()
            await asyncio.sleep(0.1)
    assert recorder.status.skipped == 5
    assert news(file, f"{key()}.image") == [{}, *[True] * 5]


async def test_what_was_replaced_with_what_holds_it_is_skipped_and_counted(key, apspace, binterface, file, monkeypatch):
    monkeypatch.setattr(feed, "_LET_PASS", 0.05)
    async with Recorder(binterface, [key()], file) as recorder:
        for number in range(4):
            await apspace[key()].write({"image": LARGE})
            await apspace[key()]["image"].write(LARGE + 1)
            await apspace[key()].write({"n": number})
            await asyncio.sleep(0.1)
    assert recorder.status.skipped == 8
    assert news(file, key()) == [{"n": number} for number in range(4)]


async def test_a_keyframe_comes_behind_all_that_it_holds(key, apspace, binterface, file):
    """Small updates between two large ones wait for the first; a keyframe among them must wait too."""
    async with Recorder(binterface, [key()], file) as recorder:
        await apspace[key()].write({"x": 0, "image": LARGE})
        await aeventually(lambda: recorder.status.messages >= 2)
        one, stamps = recorder._feed(key()), iter(range(2000, 20000, 2000))
        base = recorder.clock.stamp()

        def item(role, path, value, number):
            return feed.Item(role, (key(), *path), value, (base + next(stamps), 0, number))

        first = item("update", ["image"], ANNOUNCED, 2)
        one._items.extend([first, item("update", ["x"], 1, 3), item("keyframe", [], None, 1)])
        one._items.extend([item("update", ["x"], 2, 4), item("update", ["image"], ANNOUNCED, 5)])
        one._place(first, LARGE + 1, LARGE.nbytes, one._items[-1].stamp[0])
        await one._drain()
    with open_log(file) as log:
        times, numbers = log[key()]["x"].history()
        assert numbers.tolist()[:3] == [0, 1, 2]
        late = [update.time for update in log.updates() if update.path == (key(), "image")][-1]
        assert [log[key()]["x"].at(time) for time in (times[1], times[2] - 1e-6, times[2], late)] == [1, 1, 2, 2]


async def test_a_key_that_cannot_be_read_is_told_of_once(key, raw, binterface, file, caplog):
    """And it does not keep the recording from ending."""
    raw.set(key(), "no document")
    begun = time.monotonic()
    async with Recorder(binterface, [key()], file, keyframe=0.1) as recorder:
        await asyncio.sleep(0.5)
    assert time.monotonic() - begun < 3
    assert len([record for record in caplog.records if "not recorded" in record.message]) == 1
    assert recorder.status.lost == 1
    with open_log(file) as log:
        assert log.metadata[f"not recorded: {key()}"] == "1"
    raw.delete(key())


async def test_numbers_of_a_long_list_are_updated(key, apspace, akvs, binterface, file, tmp_path):
    """A list of more than 64 numbers is a message of its own; its items are as good as those of others."""
    await apspace[key()].write({"l": [0.0] * 100})
    async with Recorder(binterface, [key()], file, keyframe=60) as recorder:
        for number in range(40):
            await apspace[key()]["l"][number].write(1.0)
        before = recorder.status.messages
        await aeventually(lambda: recorder.status.messages >= before)
        recorder._keyframe_of_all()
        await apspace[key()]["l"][50].write(5)
        await apspace[key()]["l"].append(7.5)
        await apspace[key()]["l"][0].delete()
        whole = await akvs[key()].read()
    assert recorder.status.lost == 0
    with open_log(file) as log:
        updates = [update for update in log.updates() if len(update.path) == 3]
        sums = [math.fsum(log[key()]["l"].at(update.time)) for update in updates[:40]]
        assert sums == list(range(1, 41))
        assert [len(log[key()]["l"].history()[0]), log[key()]["l"][60].at(log.start)] == [44, 0.0]
        numbers = log[key()]["l"][50].history()[1].tolist()
        assert (numbers[0], 5 in numbers, numbers[-1]) == (0.0, True, 0.0)  # what follows the deleted one has moved
        assert_same(log[key()].at(log.end), whole)
        assert [channel.messages for channel in log.channels() if channel.role == "keyframe"] == [2]
        await apspace[key()].delete()
        await Replayer(binterface, log, rate=100).play()
    assert_same(await akvs[key()].read(), whole)


async def test_an_index_from_the_end_counts_at_each_instant(key, apspace, binterface, file):
    async with Recorder(binterface, [key()], file):
        await apspace[key()].write({"l": [1, 2, 3]})
        await apspace[key()]["l"][2].write(9)
        await apspace[key()]["l"].append(10)
    with open_log(file) as log:
        assert log[key()]["l"][-1].at(log.end) == 10
        assert log[key()]["l"][-1].history()[1].tolist() == [3, 9, 10]


async def test_a_sampled_list_that_shrinks(key, akvs, binterface, file):
    """Behind an item that is not there, there is none: the next one must not move into its place."""
    await akvs[key()].write({"l": [10, 20]})
    samples = {f"{key()}.l[0]": 0.05, f"{key()}.l[1]": 0.05}
    async with Recorder(binterface, [], file, sample=samples) as recorder:
        await aeventually(lambda: recorder.status.messages >= 4)
        await akvs[key()]["l"].write([])
        before = recorder.status.messages
        await aeventually(lambda: recorder.status.messages > before)
        await asyncio.sleep(0.2)
    with open_log(file) as log:
        assert set(log[key()]["l"][0].history()[1].tolist()) == {10}
        assert log[key()].at(log.end) == {"l": []}
        await akvs[key()].delete()
        await Replayer(binterface, log, rate=100).play()
    assert await akvs[key()].read() == {"l": []}


async def test_parts_of_keys_have_their_parents(key, apspace, akvs, binterface, file):
    """A recording, or a replay, of a part ends as the whole does, as far as the part goes."""
    await apspace[key()].write({})
    async with Recorder(binterface, [f"{key()}.b.v"], file):
        for number in range(3):
            await apspace[key()]["b"].write({"v": number, "w": 1})
        await apspace[key()]["b"].write({"w": 2})
    with open_log(file) as log:
        assert [log[key()].at(update.time) for update in log.updates() if update.path == (key(), "b")] == [
            {"b": {"v": 0}},
            {"b": {"v": 1}},
            {"b": {"v": 2}},
            {"b": {}},
        ]
        status = await Replayer(binterface, log, rate=100, patterns=[f"{key()}.b.v"]).play()
    assert status.refused == 0
    assert await akvs[key()].read() == {"b": {}}


def test_only_a_dict_on_the_way_stays_empty():
    patterns = parse_pattern("a.b"), parse_pattern("a.*.c")
    assert pruned({"x": 1, "y": {"z": 1}}, ("a",), patterns) == {"y": {}}


@pytest.mark.parametrize("clock", [5.0, -1e9, 2e10, 1e300, math.inf, math.nan])
async def test_any_clock_of_a_publisher_can_be_recorded(key, akvs, binterface, file, clock):
    await akvs[key()].write(1)
    async with Recorder(binterface, [key()], file) as recorder:
        event = Event((key(),), 1, deleted=False, size=10, time=clock, received=time.time(), publisher="p", sequence=1)
        recorder._feed(key()).on_event(event)
    with open_log(file) as log:
        (update,) = [update for update in log.updates() if update.kind == "pub"]
        assert (update.value, update.published) == (1, published(clock) / 1e9)
