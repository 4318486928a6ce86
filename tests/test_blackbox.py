"""The black box: the last seconds in memory, saved once something has happened."""

import asyncio
import errno
import json
import signal
import time

import numpy as np
import pytest
from browserkit import client_of, live, served
from clikit import begins, finished, started
from conftest import aeventually, eventually, python

import reem
import reem.recording
from reem_async import BadData, BadValue, Jpeg, Misuse
from reem_async.tools.browser.trees import Frame
from reem_async.tools.recording import Recorder, RecordingFailed, open_log
from reem_async.tools.recording.output import Output

LARGE = np.random.default_rng(1).integers(0, 256, (100, 100, 3), np.uint8)


async def test_what_is_saved_equals_a_recording_made_beside_it(key, akvs, apspace, binterface, tmp_path):
    """Updates of all kinds, among them what was there before the last seconds: stored, in lists, deleted, pictures."""
    arm, cam, old = key("arm"), key("cam"), key("old")
    await akvs[old].write({"map": LARGE, "list": [1, {"x": 2}], "t": 0.1})
    await apspace[arm].write({"q": [0.0, -0.0], "n": 0, "gone": 1})
    beside = Recorder(binterface, [key("*")], tmp_path / "beside.mcap", keyframe=0.2)
    box = Recorder(binterface, [key("*")], last=0.5, keyframe=0.2)
    async with beside, box:
        for number in range(60):
            await apspace[arm]["n"].write(number)
            if number % 5 == 0:
                await apspace[cam].write({"rgb": Jpeg(LARGE), "raw": LARGE + np.uint8(number), "n": number})
                await apspace[arm]["q"].write([number / 7, 1e300])
            if number == 20:
                await akvs[old]["t"].write(0.7)  # only stored
                await apspace[arm]["gone"].delete()
            await asyncio.sleep(0.02)
        saving = asyncio.ensure_future(box.save(tmp_path / "crash.mcap", after=1.0))
        for number in range(60, 70):
            await apspace[arm]["n"].write(number)
            await asyncio.sleep(0.02)
        assert not (tmp_path / "crash.mcap").exists()
        assert await saving == tmp_path / "crash.mcap"
        assert 0 < box.status.messages < 150
        assert box.status.rate > 0
        await apspace[arm]["n"].write(99)  # not in it
    with open_log(tmp_path / "crash.mcap") as saved, open_log(tmp_path / "beside.mcap") as whole:
        assert 0.5 < saved.duration < 3
        assert saved.indexed
        assert saved.verify() == saved.unreadable == 0
        first = min(it.time for it in saved.updates(patterns=[arm, cam]) if it.kind == "pub")
        start, until = first - 1e-6, 70
        mine = [(it.path, repr(it.value), it.published, it.sequence) for it in saved.updates(start) if it.kind == "pub"]
        others = [(it.path, repr(it.value), it.published, it.sequence) for it in whole.updates() if it.kind == "pub"]
        assert mine == others[others.index(mine[0]) : others.index(mine[0]) + len(mine)]
        assert mine[-1][1] == str(until - 1)
        assert saved.end - saved.start < 2
        names = (arm, cam, old)
        held = {name: saved[name].at(start) for name in names}
        assert repr(held) == repr({name: whole[name].at(others_time(whole, mine[0]) - 1e-6) for name in names})
        assert np.array_equal(saved[old]["map"].at(saved.end), LARGE)


def others_time(log, update):
    return next(it.time for it in log.updates() if (it.path, it.published, it.sequence) == (update[0], *update[2:]))


ROBOT = """
import sys, time
import numpy as np
from reem import Jpeg, PublishSpace, RedisInterface

url, key, what, rate, seconds = *sys.argv[1:4], float(sys.argv[4]), float(sys.argv[5])
frame = np.add.outer(np.arange(480), np.arange(640))[..., None] // 4
frame = (frame + np.random.default_rng(1).integers(0, 40, (480, 640, 3))).astype(np.uint8)
with RedisInterface(url) as interface:
    place, begin, n = PublishSpace(interface)[key], time.monotonic(), 0
    while time.monotonic() < begin + seconds:
        image = np.roll(frame, n, 1) if what != "state" else None
        value = {"state": n / 7, "raw": image, "jpeg": image is not None and Jpeg(image)}[what]
        place.write({"n": n, what: value})
        n += 1
        time.sleep(max(0.0, begin + n / rate - time.monotonic()))
"""
RATES = {"raw": 30, "jpeg": 30, "state": 200}  # frames of 0.92 MB, JPEG of 90 KB


@pytest.mark.long
@pytest.mark.alone
async def test_a_minute_before_a_fault_equals_a_recording_made_beside_it(key, server_url, binterface, tmp_path):
    last, after = 60, 5.0
    beside = Recorder(binterface, [key("*")], tmp_path / "beside.mcap")
    box = Recorder(binterface, [key("*")], last=last, memory=4 << 30)
    async with beside, box:
        words = [(key(what), what, rate, last + 2 * after) for what, rate in RATES.items()]
        robot = [python(ROBOT, server_url, *each, flags=(), start=True) for each in words]
        await asyncio.sleep(last + after)
        await box.save(tmp_path / "crash.mcap", after=after)
        assert [await asyncio.to_thread(each.communicate) for each in robot] == [("", "")] * 3
        assert (box.status.dropped, box.status.gaps, beside.status.dropped, beside.status.gaps) == (0, 0, 0, 0)
    with open_log(tmp_path / "crash.mcap") as saved, open_log(tmp_path / "beside.mcap") as whole:
        for what, rate in RATES.items():
            mine, others = news_of(saved, key(what)), news_of(whole, key(what))
            skips = [{number for _, path, number in log.skipped() if path == key(what)} for log in (saved, whole)]
            numbers = range(min(mine), max(mine) + 1)
            assert len(numbers) > (last + after - 2) * rate
            assert mine.keys() | skips[0] >= {*numbers}
            assert others.keys() | skips[1] >= {*numbers}
            assert all(mine[number] == others[number] for number in mine.keys() & others.keys())
            assert len(mine.keys() & others.keys()) >= len(numbers) - len(skips[0] | skips[1])


def news_of(log, name):
    """Return the published updates of a key by their numbers: the time, and the value's bytes."""

    def plain(it):
        return it.data if isinstance(it, Jpeg) else it.tobytes() if isinstance(it, np.ndarray) else repr(it)

    updates = [it for it in log.raw.updates(patterns=[name]) if it.kind == "pub"]
    return {it.sequence: (it.published, hash(tuple(plain(each) for each in it.value.values()))) for it in updates}


async def test_memory_is_bounded_and_what_goes_is_counted(key, apspace, binterface, tmp_path):
    name, memory = key("cam"), 400_000
    async with Recorder(binterface, [key("*")], last=60, memory=memory) as box:
        for number in range(40):
            await apspace[name].write({"raw": LARGE + np.uint8(number), "n": number})
            await asyncio.sleep(0.01)
        assert box._box.bytes + sum(box._box._weights.values()) <= memory + 2 * LARGE.nbytes
        assert box.status.dropped > 15
        await box.save(tmp_path / "short.mcap")
        await apspace[key("huge")].write(np.zeros(memory, np.uint8))
        await aeventually(lambda: box.status.lost == 1)
        await box.save(tmp_path / "lost.mcap")
    with open_log(tmp_path / "short.mcap") as log:
        numbers = [it.value["n"] for it in log.updates() if it.kind == "pub"]
        assert numbers == list(range(numbers[0], 40))
    with open_log(tmp_path / "lost.mcap") as log, pytest.raises(BadData, match="the black box may take 400000 bytes"):
        log[key("huge")].at(log.end)


async def test_a_full_disk_leaves_no_file_and_goes_on(key, apspace, binterface, tmp_path, monkeypatch):
    async with Recorder(binterface, [key("*")], last=60) as box:
        await apspace[key("a")].write({"raw": LARGE})
        await aeventually(lambda: box.status.messages)
        flush, full = Output.flush, []

        def limited(self):
            full.append(self._waiting)
            if len(full) > 1:  # the first is of the metadata
                raise OSError(errno.ENOSPC, "No space left on device")
            flush(self)

        monkeypatch.setattr(Output, "flush", limited)
        with pytest.raises(RecordingFailed, match=r"No space left on device.*nothing is left of it"):
            await box.save(tmp_path / "a.mcap", after=5)
        assert list(tmp_path.iterdir()) == []
        monkeypatch.undo()
        saving = asyncio.ensure_future(box.save(tmp_path / "b.mcap", after=30))
        await asyncio.sleep(0.1)
        saving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await saving
        assert list(tmp_path.iterdir()) == []
        await box.save(tmp_path / "a.mcap")
        with pytest.raises(BadValue, match="is there already"):
            await box.save(tmp_path / "a.mcap")
        await box.save(tmp_path / "a.mcap", overwrite=True)
        ending = asyncio.ensure_future(box.save(tmp_path / "end.mcap", after=60))
        await asyncio.sleep(0.1)
    await ending  # the end of the recorder ends it, whole
    for name in ("a.mcap", "end.mcap"):
        with open_log(tmp_path / name) as log:
            assert np.array_equal(log[key("a")]["raw"].at(log.end), LARGE)
    with pytest.raises(Misuse, match="between start"):
        await box.save(tmp_path / "c.mcap")


def test_the_blocking_front_saves(key, interface, pspace, tmp_path):
    with reem.recording.Recorder(interface, [key("a")], last=60) as box:
        pspace[key("a")] = {"n": 1}
        eventually(lambda: box.status.messages)
        begun = time.monotonic()
        assert box.save(tmp_path / "a.mcap", after=0.2) == tmp_path / "a.mcap"
        assert time.monotonic() - begun >= 0.2
    with reem.recording.open_log(tmp_path / "a.mcap") as log:
        assert log[key("a")]["n"].at(log.end) == 1
    for wrong in ({"last": 0}, {"last": 1, "memory": 0}):
        with pytest.raises(BadValue, match=r"last|memory"):
            reem.recording.Recorder(interface, [key("a")], **wrong)
    with reem.recording.Recorder(interface, [key("a")], tmp_path / "file.mcap") as recorder, pytest.raises(Misuse):
        recorder.save(tmp_path / "b.mcap")


def test_the_command_saves_each_time_a_path_becomes_true(key, server_url, pspace, tmp_path):
    pspace[key("fault")] = {"active": True}  # it was true before: that is no edge
    options = ["--last", "60", "--after", "0.2", "-o", "crash-{time}.mcap", "--json"]
    with started(server_url, tmp_path, "record", key("*"), "--on", f"{key('fault')}.active", *options) as process:
        begins(process, as_json=True)
        for number in range(3):
            pspace[key("arm")] = {"n": number}
            if number:
                pspace[key("fault")]["active"] = False
                pspace[key("fault")]["active"] = True
                pspace[key("fault")]["active"] = 1  # still true
                eventually(lambda n=number: len(list(tmp_path.glob("crash-*.mcap"))) == n)
                time.sleep(1.1)  # the names have seconds
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")
    files = sorted(tmp_path.glob("crash-*.mcap"))
    assert [json.loads(line)["saved"] for line in out.splitlines() if "saved" in line] == [each.name for each in files]
    for number, file in enumerate(files, 1):
        with open_log(file) as log:
            assert log[key("arm")]["n"].history()[1].tolist()[-number:] == list(range(1, number + 1))
            assert log[key("fault")]["active"].at(log.end) == 1


def test_the_command_saves_at_ctrl_c(key, server_url, pspace, tmp_path):
    with started(server_url, tmp_path, "record", key("*"), "--last", "60", "-o", "crash.mcap") as process:
        begins(process)
        pspace[key("arm")] = {"n": 7}
        time.sleep(0.3)
        assert not (tmp_path / "crash.mcap").exists()
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=20)
    assert (process.returncode, out[:16], errors) == (0, "saved crash.mcap", "")
    with open_log(tmp_path / "crash.mcap") as log:
        assert log[key("arm")]["n"].at(log.end) == 7
    again = finished("record", "--last", "60", "-o", str(tmp_path / "crash.mcap"), REEM_URL=server_url)
    assert (again.returncode, "is there already" in again.stderr) == (2, True)


def test_on_needs_last(server_url, tmp_path):
    answer = finished("record", "--on", "fault", REEM_URL=server_url)
    assert (answer.returncode, "--on needs --last" in answer.stderr) == (2, True)


def test_the_page_saves_what_its_slider_holds(key, server_url, kvs, pspace, tmp_path):
    """Each instant of the file is as the slider shows it."""
    pspace[key("arm")] = {"q": [0.5, 1.5], "n": 0}
    with served(live(server_url)) as (address, source), client_of(address) as ask:
        eventually(lambda: not source._follower.unread)
        for number in range(1, 6):
            pspace[key("arm")]["n"] = number
            pspace[key("cam")] = {"rgb": Jpeg(LARGE), "n": number}
            time.sleep(0.05)
        kvs[key("arm")]["q"] = [7.5]  # only stored
        del pspace[key("cam")]["n"]
        ends = {"n": 5, "q": [7.5]}
        eventually(lambda: source.history.tree((key("arm"),), source.history.clock.now()) == ends)
        eventually(
            lambda: isinstance(source.history.tree((key("cam"), "rgb"), source.history.clock.now()), Frame | Jpeg)
        )
        answer = ask.ask("recording")
        assert (answer.status_code, "reem-" in answer.headers["content-disposition"]) == (200, True)
        (tmp_path / "past.mcap").write_bytes(answer.content)
        with open_log(tmp_path / "past.mcap") as log:
            assert log.indexed
            assert log[key("arm")].at(log.start) == {"n": 0, "q": [0.5, 1.5]}
            assert log[key("arm")].at(log.end) == ends
            assert log[key("arm")]["n"].history()[1].tolist()[:6] == [0, 1, 2, 3, 4, 5]
            assert log.raw[key("cam")].at(log.end) == {"rgb": Jpeg(LARGE)}
            for instant in np.linspace(log.start, log.end, 20):
                assert log[key("arm")].at(instant) == source.history.tree((key("arm"),), instant + 1e-6)
