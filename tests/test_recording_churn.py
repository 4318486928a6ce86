"""Recording keys that come and go, under ever new names or the same ones."""

import asyncio
import random
import time

import pytest
from conftest import aeventually, sized
from test_recording_stored import news

from reem_async.tools.recording import Recorder, open_log


async def test_nothing_is_kept_of_keys_that_came_and_went(key, apspace, akvs, binterface, file):
    """Under ever new names there were a recorder and a tree of each for ever; one that comes again is recorded anew."""
    async with Recorder(binterface, [key("job*"), key("asked")], file, keyframe=0.1) as recorder:
        for number in range(30):
            await apspace[key(f"job{number}")].write({"n": number})
            await akvs[key(f"job{number}s")].write({"n": number})
            await akvs[key(f"job{number}s")].delete()
            await apspace[key(f"job{number}")].delete()
        recorders, trees = recorder._keys._recorders, recorder.writer_thread._trees
        await aeventually(lambda: set(recorders) == {key("asked")} and not trees)
        await apspace[key("job3")].write({"n": -3})
        await apspace[key("job3")]["m"].write(1)
        await akvs[key("job4")].write({"n": -4})
        await aeventually(lambda: set(trees) == {key("job3"), key("job4")})
        await akvs[key("job4")]["m"].write(2)
        await asyncio.sleep(0.5)
    with open_log(file) as log:
        assert log.value_at("", log.end) == {key("job3"): {"n": -3, "m": 1}, key("job4"): {"n": -4, "m": 2}}
        assert [value["n"] for number in range(30) for _, value in log[key(f"job{number}")].values()][:3] == [0, 1, 2]
    assert news(file, key("job4"))[-2:] == [(key("job4"), "stored", {"n": -4}), (key("job4.m"), "stored", 2)]


@pytest.mark.parametrize("pause", sized([0.02], [0.0, 0.02, 0.15]))
async def test_a_key_that_comes_again_loses_nothing_at_whatever_instant(key, apspace, binterface, file, pause):
    """What was kept of it is let go of at keyframes, here all the time."""
    rng, sent = random.Random(5), {key(f"job{number}"): [] for number in range(3)}

    async def come_and_go(name):
        end = time.monotonic() + 2
        while time.monotonic() < end:
            for path, value in ((), {"n": len(sent[name])}), (("m",), 1), (("big",), "x" * 50), ((), None):
                accessor = apspace[name]["m"] if path == ("m",) else apspace[name]["big"] if path else apspace[name]
                await (accessor.delete() if value is None else accessor.write(value))
                sent[name].append(((name, *path), value))
            await asyncio.sleep(rng.uniform(0, 2 * pause))

    async with Recorder(binterface, [key("job*")], file, keyframe=0.05) as recorder:
        await asyncio.gather(*map(come_and_go, sent))
    status = recorder.status
    assert (status.dropped, status.skipped, status.gaps, status.lost) == (0, 0, 0, 0)
    with open_log(file) as log:
        for name, all_of_it in sent.items():
            updates = list(log.updates(patterns=[name]))
            assert [(each.path, each.value) for each in updates] == all_of_it
            assert {each.kind for each in updates} == {"pub"}
            tree = None
            for each in updates:
                tree = each.value if len(each.path) == 1 else {**tree, each.path[1]: each.value}
                assert (log[name].at(each.time) if tree is not None else None) == tree
