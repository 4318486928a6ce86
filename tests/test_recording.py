"""Recording a real server, and looking into what was recorded."""

import asyncio
import contextlib
import time

import hypothesis.strategies as st
import numpy as np
import pytest
from conftest import aeventually, assert_same, eventually, sized
from hypothesis import HealthCheck, given, settings
from test_values import mixed

import reem
import reem.recording
import reem_async
from reem_async.errors import BadInput, BadKey, BadValue, MissingKey
from reem_async.pubsub.manager import manager_of
from reem_async.tools.recording import ArrayHandle, Recorder, Replayer, open_log
from reem_async.tools.recording.key_recorder import KeyReader
from reem_async.tools.recording.recorder import _TICK
from reem_async.tools.recording.times import HURRIED, PATIENCE

IMAGE = np.arange(48 * 64 * 3, dtype=np.uint16).astype(np.uint8).reshape(48, 64, 3)
FRAME = np.arange(480 * 640 * 3, dtype=np.uint32).astype(np.uint8).reshape(480, 640, 3)


async def test_it_looks_more_often_once_large_updates_come_fast(key, far_space, binterface, file):
    """Else the next one would have replaced what was announced; where few come, publishers are spared."""
    name = key("cam")

    def paces():
        return {wire.pace for wire in manager_of(binterface.session.raw)._wires.values()}

    async with Recorder(binterface, [key("*")], file) as recorder:
        for number in range(3):
            await far_space[name].write({"image": FRAME, "n": number})
            await aeventually(lambda n=number: recorder.status.messages > n)
            await asyncio.sleep(0.04)
        assert paces() == {PATIENCE}
        async with asyncio.timeout(10):
            while paces() != {HURRIED}:
                await far_space[name].write({"image": FRAME, "n": 0})
                await asyncio.sleep(0.008)


async def test_trees_without_their_arrays(key, apspace, binterface, file):
    async with Recorder(binterface, [key("a")], file):
        await apspace[key("a")].write({"image": FRAME, "q": np.arange(3.0), "list": list(range(100)), "t": "é"})
    with open_log(file) as log:
        tree = log.tree_at(log.end)[key("a")]
        handle = tree["image"]
        assert type(handle) is ArrayHandle
        found = handle.label, handle.dtype, handle.shape, handle.size, handle.summary
        assert found == ("numpy", "uint8", (480, 640, 3), FRAME.nbytes, "uint8[480,640,3]")
        assert_same(handle.read(), FRAME)
        assert_same(tree["q"], np.arange(3.0))
        assert tree["list"].read() == list(range(100))
        assert (tree["list"].label, tree["list"].summary, tree["list"].size) == ("list", "int64[100]", 800)
        assert tree["t"] == log.tree_at(np.datetime64(round(log.end * 1e6), "us"))[key("a")]["t"] == "é"


@settings(max_examples=sized(6, 12), deadline=None, suppress_health_check=list(HealthCheck))
@given(batch=st.lists(st.tuples(mixed, st.sampled_from(["whole", "inside", "delete"])), min_size=3, max_size=8))
def test_anything_recorded_replays_to_the_same(server_url, tmp_path_factory, batch):
    asyncio.run(_recorded_and_replayed(server_url, tmp_path_factory.mktemp("any") / "run.mcap", batch))


async def _recorded_and_replayed(url, file, batch):
    name = f"any{time.time_ns()}"
    async with reem_async.RedisInterface(url) as one, reem_async.RedisInterface(url) as two:
        kvs, space = reem_async.KeyValueStore(one), reem_async.PublishSpace(one)
        other = reem_async.KeyValueStore(two)
        seen = []
        await space[name].write({"first": 1})
        async with Recorder(two, [name], file) as recorder:
            for value, how in batch:
                if how == "whole":
                    await space[name].write({"x": value, "y": 1})
                elif how == "inside":
                    await space[name]["first"].write(value)
                else:
                    with contextlib.suppress(MissingKey):
                        await space[name]["first"].delete()
                    await space[name].write({"first": [value]})
                there = await kvs[name].read()
                await asyncio.sleep(0.003)
                await recorder.fence()
                seen.append((recorder.clock.stamp() / 1e9, there))  # behind all log times so far, ahead of all later
        with open_log(file) as log:
            for instant, value in seen:
                assert_same(log.value_at(name, instant), value)
            replayed = f"{name}again"
            await Replayer(two, log, rate=1000, remap={name: replayed}).play()
            assert_same(await other[replayed].read(), seen[-1][1])
        await kvs[name].delete()
        await kvs[replayed].delete()


async def test_samples(key, akvs, binterface, file, tmp_path):
    keys = tmp_path / "keys.csv"
    keys.write_text(
        f"{key('arm')}.joint, 0.02\n{key('arm')}.image, 0.1\n{key('arm')}.list[1], 0.05\n{key('no')}, 0.05\n"
    )
    await akvs[key("arm")].write({"joint": 0.5, "image": IMAGE, "list": [1, 2]})
    async with Recorder(binterface, [], file, sample=keys) as recorder:
        await aeventually(lambda: recorder.status.messages >= 40)
        await akvs[key("arm")]["joint"].delete()
        await aeventually(lambda: "joint" not in recorder.writer_thread._trees[key("arm")])
    with open_log(file) as log:
        times, values = log[key("arm.joint")].history()
        assert set(values.tolist()) == {0.5}
        assert len(times) >= 15
        off = (times - times[0]) / 0.02
        assert np.median(np.abs(off - np.round(off))) < 0.4  # on the grid of the period, however late some are
        assert_same(log.value_at("", times[-1]), {key("arm"): {"joint": 0.5, "image": IMAGE, "list": [None, 2]}})
        assert "joint" not in log[key("arm")].at(log.end)
        assert log.metadata["samples failed"] == "0"
        assert {update.kind for update in log.updates()} == {"kvs"}


async def test_a_full_queue_drops_and_says_so(key, apspace, akvs, binterface, file):
    async with Recorder(binterface, [key("*")], file, queue_bytes=200_000) as recorder:
        for number in range(300):
            await apspace[key("big")].write({"n": number, "a": np.full(1900, number)})
        await aeventually(lambda: recorder.writer_thread.waiting == 0)
        last = await akvs[key("big")].read()
        await aeventually(lambda: not recorder.writer_thread.behind)
    assert recorder.status.dropped + recorder.status.messages // 2 >= 300
    with open_log(file) as log:
        assert_same(log[key("big")].at(log.end), last)
        if recorder.status.dropped:
            assert log.metadata[f"not recorded: {key('big')}"] == str(recorder.status.dropped + recorder.status.skipped)


async def test_what_was_dropped_is_in_the_file_though_it_is_just_being_read_when_the_recording_ends(
    key, apspace, akvs, binterface, file, monkeypatch
):
    """The recorder reads keys anew from time to time: what that has begun is waited for."""
    whole, name = KeyReader.whole, key("big")

    async def slowly(reader):
        await asyncio.sleep(0.3)
        return await whole(reader)

    async with Recorder(binterface, [key("*")], file) as recorder:
        await apspace[name].write({"n": 1})
        await aeventually(lambda: recorder.status.messages)
        monkeypatch.setattr(KeyReader, "whole", slowly)
        put, refused = recorder.writer_thread.put, []

        def full_once(operation, size):
            if operation.role == "update" or (operation.role == "state" and "state" not in refused):
                refused.append(operation.role)
                recorder.writer_thread.behind.add(name)
                if operation.role == "state":
                    asyncio.get_running_loop().call_later(_TICK / 20, recorder._catch_up)  # it looks by itself, too
                return False
            return put(operation, size)

        monkeypatch.setattr(recorder.writer_thread, "put", full_once)
        await apspace[name].write({"n": 2})
    assert refused
    with open_log(file) as log:
        assert log[name].at(log.end) == {"n": 2}


async def test_bad_arguments(key, binterface, file, tmp_path):
    for arguments, error in (
        ({"patterns": []}, BadValue),
        ({"patterns": ["a{b"]}, BadKey),
        ({"sample": {"": 1}}, BadInput),
        ({"sample": tmp_path / "none.csv"}, BadValue),
        ({"path": tmp_path / "no" / "run.mcap"}, BadValue),
    ):
        with pytest.raises(error):
            Recorder(binterface, **{"path": file, **arguments})
        assert not file.exists(), arguments
    file.write_bytes(b"precious")
    with pytest.raises(BadValue, match="overwrite=True"):
        Recorder(binterface, path=file)
    assert file.read_bytes() == b"precious"
    async with Recorder(binterface, [key("a")], file, overwrite=True):
        pass
    with open_log(file) as log:
        assert (log.names(), log.duration >= 0) == ([], True)


def test_the_blocking_front(key, server_url, pspace, kvs, interface, file):
    with reem.RedisInterface(server_url) as other:
        with reem.recording.Recorder(other, [key("a")], file) as recorder:
            pspace[key("a")] = {"image": IMAGE, "n": 1}
            eventually(lambda: recorder.status.messages >= 2)
            pspace[key("a")]["n"] = 2
            recorder.wait(0.05)
        with reem.recording.open_log(file) as log:
            assert log[key("a")]["n"].history()[1].tolist() == [1, 2]
            replayer = reem.recording.Replayer(other, log, rate=100, remap={key("a"): key("b")})
            assert replayer.play().published == 3 - 1
            assert_same(kvs[key("b")].read(), {"image": IMAGE, "n": 2})
            assert replayer.step().path == (key("a"), "n")
