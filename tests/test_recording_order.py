"""What is recorded while values overtake each other, in lists of numbers, of samples, and by parts of keys."""

import asyncio
import math
import random
import time

import numpy as np
import pytest
import redis
from conftest import PATIENCE, Remembering, aeventually, assert_same, url_of_user

import reem
import reem_async
from reem_async.pubsub.monitor import Event
from reem_async.tools.recording import Recorder, Replayer, open_log
from reem_async.tools.recording.times import published

LARGE = np.zeros((300, 300))


def news(file, path):
    """What was recorded of a path: True for each deletion, else the value."""
    with open_log(file) as log:
        return [update.deleted or update.value for update in log.updates(patterns=[path])]


async def test_what_is_stored_beside_what_is_published_is_seen(key, apspace, akvs, binterface, file):
    await apspace[key()].write({"x": 0, "y": 0, "z": 0})
    async with Recorder(binterface, [key()], file, keyframe=60) as recorder:
        stored = recorder.writer_thread.stored = Remembering()
        await akvs[key()]["y"].write(5)
        deadline = time.monotonic() + PATIENCE
        while key() not in stored.ever:
            assert time.monotonic() < deadline
            await apspace[key()]["x"].increment()
            await asyncio.sleep(0.01)
        seen = time.time()
        await akvs[key()]["z"].write(7)
    with open_log(file) as log:
        assert log[key()]["y"].at(seen) == 5
        assert {update.shown for update in log.updates() if update.kind == "stored"} == {f"{key()}.y", f"{key()}.z"}
        assert_same(log[key()].at(log.end), await akvs[key()].read())
        assert log[key()]["z"].at(log.end) == 7


async def test_a_frame_that_is_changed_inside_before_it_is_fetched_is_skipped(key, far_space, akvs, binterface, file):
    async with Recorder(binterface, [key()], file) as recorder:
        for number in range(10):
            await far_space[key()].write({"image": LARGE + number, "n": number, "state": "raw", "box": [1, 2, 3]})
            await far_space[key()]["state"].write("done")
            await far_space[key()]["box"][0].delete()
            await far_space[key()]["score"].write(number / 2)
            await recorder.fence()
            await recorder._keys.settled(PATIENCE)
        whole = await akvs[key()].read()
    with open_log(file) as log:
        updates = [update for update in log.updates() if update.kind == "pub"]
        assert [update.sequence for update in updates] == sorted({update.sequence for update in updates})
        recorded = {update.sequence for update in updates}
        skipped = {number: path for _, path, number in log.skipped()}
        assert recorded.isdisjoint(skipped)
        assert recorded | skipped.keys() == set(range(1, 41))
        assert set(skipped.values()) == {key()}
        assert len(skipped) == recorder.status.skipped > 0
        for update in updates:
            frame = (update.sequence - 1) // 4
            state = log.value_at((key(),), update.time)
            assert (state["n"], int(state["image"][0, 0])) == (frame, frame)
            if update.path == (key(),):
                assert update.value["state"] == "raw"
            elif update.path == (key(), "score"):
                score = {"n": frame, "state": "done", "box": [2, 3], "score": frame / 2}
                assert {name: item for name, item in state.items() if name != "image"} == score
            elif update.path == (key(), "state"):
                assert state["state"] == "done"
        assert_same(log[key()].at(log.end), whole)
        await far_space[key()].delete()
        await Replayer(binterface, log, rate=100).play()
    assert_same(await akvs[key()].read(), whole)


async def test_a_key_that_is_gone_was_not_deleted_by_a_publisher(key, apspace, akvs, binterface, file):
    await apspace[key()].write({"x": 1})
    async with Recorder(binterface, [key()], file, keyframe=0.1) as recorder:
        await akvs[key()].delete()
        await aeventually(lambda: recorder._keys.of(key()).absent)
        await apspace[key()].write({"x": 2})
        await apspace[key()].delete()
        await asyncio.sleep(0.3)
    with open_log(file) as log:
        assert [(update.kind, update.deleted, update.sequence) for update in log.updates()] == [
            ("kvs", False, 0),
            ("stored", True, 0),
            ("pub", False, 2),
            ("pub", True, 3),
        ]


@pytest.mark.alone
async def test_a_key_that_cannot_be_read_is_told_of_once(key, raw, server, file, caplog):
    with redis.Redis.from_url(server.url) as client, reem.RedisInterface(server.url) as owner:
        reem.KeyValueStore(owner)[key()] = {"x": 1}
        client.execute_command("ACL", "SETUSER", "guest", "on", ">pw", "~other*", "&*", "+@all")
    url = url_of_user(server.url, "guest", "pw")
    begun = time.monotonic()
    async with reem_async.RedisInterface(url) as guest, Recorder(guest, [key()], file, keyframe=0.1) as recorder:
        await asyncio.sleep(0.5)
    assert time.monotonic() - begun < 3
    assert len([record for record in caplog.records if "not recorded" in record.message]) == 1
    assert recorder.status.lost == 1
    with open_log(file) as log:
        assert log.metadata[f"not recorded: {key()}"] == "1"


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
        await recorder.fence()
        await recorder._keys.settled(3.0)  # the append is fetched before the next change
        await apspace[key()]["l"][0].delete()
        whole = await akvs[key()].read()
    assert recorder.status.lost == 0
    with open_log(file) as log:
        updates = [update for update in log.updates() if len(update.path) == 3]
        sums = [math.fsum(log[key()]["l"].at(update.time)) for update in updates[:40]]
        assert sums == list(range(1, 41))
        instants = log[key()]["l"].history()[0].tolist()
        assert len(instants) == len(set(instants)) == 44, "one value for each instant"
        assert log[key()]["l"][60].at(log.start) == 0.0
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
        await aeventually(lambda: recorder.writer_thread._trees[key()] == {"l": []})
    with open_log(file) as log:
        assert set(log[key()]["l"][0].history()[1].tolist()) == {10}
        assert log[key()].at(log.end) == {"l": []}
        await akvs[key()].delete()
        await Replayer(binterface, log, rate=100).play()
    assert await akvs[key()].read() == {"l": []}


async def test_parts_of_keys_have_their_parents(key, apspace, akvs, binterface, file):
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


@pytest.mark.parametrize("clock", [5.0, -1e9, 2e10, 1e300, math.inf, math.nan])
async def test_any_clock_of_a_publisher_can_be_recorded(key, akvs, binterface, file, clock):
    await akvs[key()].write(1)
    async with Recorder(binterface, [key()], file) as recorder:
        event = Event((key(),), 1, deleted=False, size=10, time=clock, received=time.time(), publisher="p", sequence=1)
        recorder._keys.of(key()).on_event(event)
    with open_log(file) as log:
        (update,) = [update for update in log.updates() if update.kind == "pub"]
        assert (update.value, update.published) == (1, published(clock) / 1e9)


async def test_a_clock_that_jumps_while_it_is_recorded(key, apspace, binterface, file, monkeypatch):
    jump, now, now_ns = 0.0, time.time, time.time_ns
    monkeypatch.setattr(time, "time", lambda: now() + jump)
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + int(jump * 1e9))
    rng, begun = random.Random(25), now()
    async with Recorder(binterface, [key()], file) as recorder:
        for number in range(150):
            jump = rng.choice([jump, rng.choice([0.0, 3600.0, -3600.0, 1e8, -1e8, 0.002, -0.002])])
            await apspace[key()].write({"n": number, "array": np.full(3, number)})
            if number % 10 == 0:
                await asyncio.sleep(0.02)
        await asyncio.sleep(0.1)
    assert (recorder.status.dropped, recorder.status.gaps) == (0, 0)
    jump, passed = 0.0, now() - begun
    with open_log(file) as log:
        updates = list(log.updates(patterns=[key()]))
        assert [update.value["n"] for update in updates] == list(range(150))
        times = [update.time for update in updates]
        assert times == sorted(set(times))
        assert log.duration <= passed + 0.1
        for update in updates:
            assert_same(log.value_at(key(), update.time)["array"], np.full(3, update.value["n"]))
        again = await asyncio.wait_for(Replayer(binterface, log, remap={key(): key("again")}).play(), passed + 10)
    assert again.published >= 150
    assert_same(await reem_async.KeyValueStore(binterface)[key("again")].read(), {"n": 149, "array": np.full(3, 149)})
