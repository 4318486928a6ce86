"""Recordings in several files: each is complete by itself, and all are read as one."""

import asyncio
import itertools
import os

import numpy as np
import pytest
from clikit import begins, finished, invoked, started
from conftest import assert_same, sized

from reem_async import KeyValueStore, PublishSpace
from reem_async.errors import BadType, BadValue
from reem_async.recording import Recorder, Replayer, open_log
from reem_async.ships import Jpeg
from reem_async.tools.recording.split import Split

FRAME = np.arange(60 * 80 * 3, dtype=np.uint8).reshape(60, 80, 3)


async def recorded(interface, name, path, rounds, split="1s", **options):
    """Record keys of all kinds into several files; return what was there, by the number of the round."""
    space, kvs = PublishSpace(interface), KeyValueStore(interface)
    await space[f"{name}static"].write(
        {"map": FRAME, "names": ["a", "b"], "long": list(range(200)), "jpeg": Jpeg(FRAME)}
    )
    await space[f"{name}arm"].write({"n": -1, "image": FRAME, "list": [float(n) for n in range(100)]})
    held = {}
    async with Recorder(interface, [f"{name}*"], path, split=split, keyframe=0.7, **options) as recorder:
        for number in range(rounds):
            await space[f"{name}arm"]["n"].write(number)
            await space[f"{name}arm"]["list"][3].write(number / 7)
            if number % 5 == 0:
                await space[f"{name}arm"]["image"].write(FRAME + np.uint8(number % 256))
            if number % 70 == 0:
                await kvs[f"{name}plain"].write({"stored": number, "big": FRAME[number % 50 :].copy()})
            elif number % 7 == 0:  # the array beside it is not read again
                await kvs[f"{name}plain"]["stored"].write(number)
            if number % 11 == 0:
                await space[f"{name}gone{number}"].write({"x": FRAME})
                await space[f"{name}gone{number}"].delete()
            held[number] = await kvs[f"{name}arm"].read()
            await asyncio.sleep(0.02)
        last = {each: await kvs[each].read() for each in (f"{name}static", f"{name}arm", f"{name}plain")}
    assert (recorder.status.dropped, recorder.status.lost, recorder.status.gaps) == (0, 0, 0)
    return recorder.files, held, last


async def test_each_file_by_itself_and_all_as_one(ainterface, key, tmp_path):
    name = key("split")
    files, held, last = await recorded(ainterface, name, tmp_path / "run.mcap", sized(70, 600))
    assert [file.name for file in files] == [f"run-{n:04}.mcap" for n in range(1, len(files) + 1)]
    assert len(files) >= sized(2, 4)
    seen = []
    for file, following in itertools.zip_longest(files, files[1:]):
        with open_log(file) as log:
            assert (log.damaged, log.indexed) == (0, True)
            assert log.verify() == 0
            # At its beginning, all is there, arrays too; the first file has read all keys before the first update.
            start = log.start + 0.001 if seen else log[f"{name}arm.n"].history()[0][1]
            begin = log.value_at("", start)
            assert {f"{name}static", f"{name}arm"} <= begin.keys()
            for instant in np.linspace(start, log.end, 7):
                tree = log.value_at("", instant)
                assert_same(tree[f"{name}static"], last[f"{name}static"])
                arm = tree[f"{name}arm"]
                if arm["n"] >= 0 and arm["list"][3] == arm["n"] / 7 and arm["n"] % 5:
                    assert_same(arm, held[arm["n"]])
            seen += [int(n) for n in log[f"{name}arm.n"].history()[1]]
            if following is None:
                assert_same(log.value_at("", log.end), last)
    assert list(dict.fromkeys(seen)) == [-1, *held], "each once, but for what a file begins with"
    assert len(seen) == len(held) + len(files)
    with open_log(files) as log:
        assert log.damaged == log.verify() == 0
        assert [int(n) for n in log[f"{name}arm.n"].history()[1]] == [-1, *held]
        for at, value in zip(*log[f"{name}arm"].history(), strict=True):
            assert_same(log[f"{name}arm"].at(at), value)
        stored = [(update.value, update.kind) for update in log.updates(patterns=[f"{name}plain.stored"])]
        assert {kind for _, kind in stored[1:]} == {"stored"}
        news = [update for update in log.updates() if update.path == (f"{name}static",)]
        assert len(news) == 1, "what a file begins with is no news"
        assert_same(log.value_at("", log.end), last)
    for given in (files, files[-1:]):
        said = (await asyncio.to_thread(invoked, "log", "info", *map(str, given))).stdout
        assert ("counted from the first file" in said) == (given != files)
    with open_log([files[0], files[-1]]) as log:  # what the last one begins with is news without those between
        assert_same(log.value_at("", log.end), last)


@pytest.mark.long
async def test_played_from_a_later_file(ainterface, key, tmp_path):
    name = key("split")
    files, _, last = await recorded(ainterface, name, tmp_path / "run.mcap", 110)
    for chosen in (files[-1:], files):
        with open_log(chosen) as log:
            status = await Replayer(ainterface, log, rate=50, remap={f"{name}arm": f"{name}again"}).play()
        assert (status.unreadable, status.refused) == (0, 0)
        assert_same(await KeyValueStore(ainterface)[f"{name}again"].read(), last[f"{name}arm"])


@pytest.mark.long
async def test_by_size(ainterface, key, tmp_path):
    name, noise = key("cam"), np.random.default_rng(1)
    space = PublishSpace(ainterface)
    async with Recorder(ainterface, [name], tmp_path / "run.mcap", split="1MB") as recorder:
        for number in range(60):
            await space[name].write({"n": number, "image": noise.integers(0, 256, (200, 200, 3), np.uint8)})
            await asyncio.sleep(0.05)
    sizes = [file.stat().st_size for file in recorder.files]
    assert len(sizes) >= 3
    assert 1e6 <= min(sizes[:-1]) <= max(sizes) < 6e6
    assert abs(recorder.status.file_bytes - sum(sizes)) < 1000
    with open_log(recorder.files) as log:
        assert log[f"{name}.n"].history()[1].tolist() == list(range(60))


@pytest.mark.long
async def test_a_recorder_that_is_killed(ainterface, server_url, key, tmp_path):
    """Complete files can be read, and the last one but for the last second."""
    name, space = key("k"), PublishSpace(ainterface)
    with started(server_url, tmp_path, "record", name, "-o", "run.mcap", "--split", "1s") as process:
        await asyncio.to_thread(begins, process)
        for number in itertools.count():
            await space[name].write({"n": number, "image": FRAME})
            await asyncio.sleep(0.02)
            if len(files := sorted(tmp_path.glob("run-*.mcap"))) >= 3:
                break
        process.kill()
    with open_log(files) as log:
        values = log[f"{name}.n"].history()[1].tolist()
        assert values == list(range(len(values)))
        assert len(values) > number - 60


async def test_what_is_refused(ainterface, server_url, tmp_path):
    path = tmp_path / "run.mcap"
    for text in ("", "1", "GB", "-1GB", "1e3MB", "1KB", "0.1s", "nan", "9" * 400 + "GB"):
        with pytest.raises(BadValue, match="split="):
            Split(text, path)
    for text in (1, 1.5, b"1GB", True):
        with pytest.raises(BadType, match="split="):
            Split(text, path)
    assert [Split(text, path).is_due(2 << 30) for text in ("1GB", "1.5 gb", "3min", "2h")] == [False] * 4
    with pytest.raises(BadValue, match="black box"):
        Recorder(ainterface, ["x"], path, split="1GB", last=3)
    (tmp_path / "run-0003.mcap").write_bytes(b"x")
    out = await asyncio.to_thread(finished, "record", "x", "-o", path, "--split", "1GB", "--url", server_url)
    assert (out.returncode, "run-0003.mcap is there already" in out.stderr) == (2, True)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "run-0003.mcap"]
    async with Recorder(ainterface, ["x"], path, split="1GB", overwrite=True):
        with pytest.raises(BadValue, match="is being recorded"):
            Recorder(ainterface, ["x"], path, split="1GB", overwrite=True)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "run-0001.mcap"], (
        "the file of the recording that it replaces is gone"
    )


@pytest.mark.long
async def test_files_that_are_moved_away(ainterface, key, tmp_path):
    """What a file begins with is read from the server then."""
    name, away, space = key("m"), tmp_path / "away", PublishSpace(ainterface)
    away.mkdir()
    await space[name].write({"n": -1, "image": FRAME})
    async with Recorder(ainterface, [name], tmp_path / "run.mcap", split="1s") as recorder:
        finish = recorder._sink.finish

        def finished_and_gone(metadata):
            finish(metadata)
            os.rename(recorder.files[0], away / "run-0001.mcap")

        recorder._sink.finish = finished_and_gone
        for number in range(80):
            await space[name]["n"].write(number)
            await asyncio.sleep(0.02)
    assert recorder.status.lost == 0
    assert len(recorder.files) >= 2
    with open_log([away / "run-0001.mcap", *recorder.files[1:]]) as log:
        assert_same(log[name].at(log.end), {"n": 79, "image": FRAME})
    with open_log(recorder.files[1]) as log:
        assert_same(log[name].at(log.end)["image"], FRAME)
