"""Recording what is only stored: the server says which keys were changed, so nothing is asked for at rest."""

import asyncio
import contextlib
import csv
import logging
import random
import time

import numpy as np
import pytest
from conftest import PLAIN, RawCluster, Remembering, aeventually, assert_same, eventually, server_without_right, sized

import reem_async
from reem_async.tools.recording import Recorder, Replayer, open_log
from reem_async.tools.recording.export import export

FRAME = np.arange(480 * 640 * 3, dtype=np.uint32).astype(np.uint8).reshape(480, 640, 3)


def news(file, *patterns):
    """What was recorded: paths, how it came to be known, and values; True for a deletion."""
    with open_log(file) as log:
        return [
            (update.shown, update.kind, update.deleted or update.value)
            for update in log.updates(patterns=patterns or ("*",))
        ]


@contextlib.asynccontextmanager
async def recording(interface, patterns, file, **options):
    """A recorder that finds nothing by its keyframes, and how to wait until it has written what was stored."""
    options.setdefault("keyframe", 600)
    async with Recorder(interface, patterns, file, **options) as recorder:
        stored = recorder.writer_thread.stored = Remembering()

        async def written(name):
            await aeventually(lambda: name in stored.ever)
            stored.ever.discard(name)

        recorder.written = written
        yield recorder


def is_followed(recorder, name):
    """Whether a key was read, and the server tells of the next change."""
    reading = recorder._keys.of(name)
    return reading._reader.feed.tracked and not reading.busy


async def test_what_is_stored_is_recorded_a_moment_later_between_what_is_published(
    key, apspace, akvs, binterface, file
):
    await akvs[key()].write({"x": {"a": 0}, "y": 0})
    async with recording(binterface, [key()], file) as recorder:
        await akvs[key()]["x"]["a"].write(1)
        await recorder.written(key())
        await apspace[key()]["y"].write(2)
        await akvs[key()]["x"].write({"a": 1, "b": 3})
        await recorder.written(key())
        await akvs[key()]["x"]["a"].delete()
        await recorder.written(key())
        await apspace[key()]["y"].write(4)
        await akvs[key()].update({"x": 5, "y": 6})
        await recorder.written(key())
    assert news(file) == [
        (key(), "kvs", {"x": {"a": 0}, "y": 0}),
        (f"{key()}.x.a", "stored", 1),
        (f"{key()}.y", "pub", 2),
        (f"{key()}.x.b", "stored", 3),
        (f"{key()}.x.a", "stored", True),
        (f"{key()}.y", "pub", 4),
        (key(), "stored", {"x": 5, "y": 6}),
    ]
    with open_log(file) as log:
        trees = [log.value_at((key(),), update.time) for update in log.updates()]
        assert trees[3:] == [
            {"x": {"a": 1, "b": 3}, "y": 2},
            {"x": {"b": 3}, "y": 2},
            {"x": {"b": 3}, "y": 4},
            trees[-1],
        ]
        stored = next(update for update in log.updates() if update.kind == "stored")
        assert (stored.sequence, stored.published) == (0, pytest.approx(stored.time, abs=1))


async def test_what_others_store_and_several_changes_in_a_moment_are_seen(key, akvs, raw, binterface, file):
    await akvs[key()].write({"n": 0})
    async with recording(binterface, [key()], file) as recorder:
        reading = recorder._keys.of(key())
        waits = reading._reader._limit = asyncio.Semaphore(0)
        for number in range(1, 50):
            await akvs[key()]["n"].write(number)
        await aeventually(lambda: reading.busy)
        await akvs[key()]["n"].write(50)
        await asyncio.sleep(0.1)  # a look that is due would come, and find one on its way
        waits.release()
        await recorder.written(key())
        await aeventually(lambda: not reading.busy and not reading.looks.due)
        await akvs[key()]["n"].write(51)
        await recorder.written(key())
    assert [value for _, kind, value in news(file) if kind == "stored"] == [50, 51]


async def test_keys_come_and_go(key, akvs, raw, binterface, file):
    await akvs[key("old")].write(1)
    async with recording(binterface, [key("*")], file) as recorder:
        await akvs[key("old")].delete()
        await recorder.written(key("old"))
        await akvs[key("new")].write(2)
        await recorder.written(key("new"))
        await akvs[key("old")].write(3)
        await recorder.written(key("old"))
        raw.pexpire(key("new"), 1)
        await recorder.written(key("new"))
    assert news(file) == [
        (key("old"), "kvs", 1),
        (key("old"), "stored", True),
        (key("new"), "stored", 2),
        (key("old"), "stored", 3),
        (key("new"), "stored", True),
    ]


async def test_a_key_that_is_not_there_yet_is_heard_of_at_once(key, akvs, binterface, file):
    async with recording(binterface, [key()], file) as recorder:
        await aeventually(lambda: is_followed(recorder, key()))
        await akvs[key()].write(1)
        await recorder.written(key())
    assert news(file) == [(key(), "stored", 1)]


async def test_only_arrays_that_were_changed_are_fetched_again(key, apspace, akvs, raw, binterface, file):
    if isinstance(raw, RawCluster):
        pytest.skip("counts the bytes of one server")
    await akvs[key()].write({"map": FRAME, "image": FRAME, "n": 0})

    def sent():
        return int(raw.info("stats")["total_net_output_bytes"])

    async with recording(binterface, [key()], file) as recorder:
        before = sent()
        for number in range(1, 6):
            await akvs[key()]["n"].write(number)
            await recorder.written(key())
        assert sent() - before < FRAME.nbytes / 4
        before = sent()
        await akvs[key()]["map"].write(FRAME + np.uint8(1))
        await recorder.written(key())
        assert FRAME.nbytes < sent() - before < 1.5 * FRAME.nbytes
        await apspace[key()]["image"].write(FRAME + np.uint8(2))
        await recorder.fence()
        await aeventually(lambda: not recorder._keys.of(key()).busy)
        await akvs[key()]["n"].write(6)
        await recorder.written(key())
    assert [(path, kind) for path, kind, _ in news(file)][6:] == [
        (f"{key()}.map", "stored"),
        (f"{key()}.image", "pub"),
        (f"{key()}.n", "stored"),
    ]
    with open_log(file) as log:
        whole = {"map": FRAME + np.uint8(1), "image": FRAME + np.uint8(2), "n": 6}
        assert_same(log[key()].at(log.end), whole)
        assert_same(await akvs[key()].read(), whole)
        times, maps = log[f"{key()}.map"].history()
        assert (len(times), maps.shape) == (2, (2, *FRAME.shape))
        frames = [each for each in log.channels() if each.schema == "foxglove.RawImage"]
        assert sum(each.messages for each in frames) == 4


async def test_what_is_changed_right_behind_the_touch_is_not_in_what_is_read(key, akvs, server_url, raw, file):
    """Though the server's word of it arrives together with the answer: then the key has to be looked at again."""
    if isinstance(raw, RawCluster):
        pytest.skip("looks at the connections of one server")
    await akvs[key()].write({"a": FRAME})
    connect = reem_async.RedisInterface(server_url, client_name=key("recorder"))
    async with connect as other, recording(other, [key()], file) as recorder:
        await aeventually(lambda: is_followed(recorder, key()))
        reader, looks = recorder._keys.of(key())._reader, recorder._keys.of(key()).looks
        looks._pace = looks._pace._replace(notice_delay=60.0)
        touching = asyncio.create_task(reader._touch(reader.feed.arm(reader._plan((), {}))))
        await asyncio.sleep(0)
        # From here to the next await this program takes nothing in.
        eventually(lambda: any(row["name"] == key("recorder") and row["cmd"] == "type" for row in raw.client_list()))
        raw.set(f"{{{key()}}}.a", "")
        assert await touching
        await aeventually(lambda: looks.due)
        looks.cancel()


async def test_an_array_that_was_read_before_is_not_joined_with_a_newer_document(key, akvs, binterface, file):
    """The report of its change may come as late as the answer to a fence."""
    await akvs[key()].write({"n": 1, "image": np.full(100, 1.0)})
    async with recording(binterface, [key()], file) as recorder:
        await aeventually(lambda: is_followed(recorder, key()))
        monitor, reader, late = recorder._monitor, recorder._keys.of(key())._reader, []
        changed, fence = monitor.changed, reader._fence

        def hold(name):
            if name == binterface.session.keys(key()).document:
                changed(name)
            else:
                late.append(name)

        async def deliver():
            while late:
                changed(late.pop())
            await fence()

        monitor.changed, reader._fence = hold, deliver
        await akvs[key()].write({"n": 2, "image": np.full(100, 2.0)})
        await recorder.written(key())
        monitor.changed = changed
    assert [(place, kind) for place, kind, _ in news(file)] == [(key(), "kvs"), (key(), "stored")]


async def test_what_changed_its_place_or_type_is_right(key, akvs, binterface, file):
    values = [
        {"l": [FRAME[:9], FRAME[9:19]], "a": np.arange(100)},
        {"l": [FRAME[9:19]], "a": 5},
        {"l": [{"x": FRAME[9:19]}, FRAME[:9]], "a": b"x" * 100},
        np.arange(200.0),
        [1, 2],
        {"l": [0.0, 1.0] * 100, "a": np.arange(3)},
    ]
    await akvs[key()].write(values[0])
    async with recording(binterface, [key()], file) as recorder:
        await akvs[key()]["l"][0].delete()
        await recorder.written(key())
        for value in values[1:]:
            await akvs[key()].write(value)
            await recorder.written(key())
        await akvs[key()]["l"][150].write(7.0)
        await recorder.written(key())
    with open_log(file) as log:
        whole = [log.value_at((key(),), update.time) for update in log.updates()]
        assert_same(whole[0], values[0])
        assert_same(whole[1], {"l": [FRAME[9:19]], "a": np.arange(100)})
        assert_same(whole[2:-1], values[1:])
        assert_same(whole[-1]["l"][150], 7.0)


async def test_of_a_pattern_only_what_it_names(key, akvs, apspace, binterface, file):
    await akvs[key()].write({"a": {"x": 1, "y": 1}, "temp": 1.0})
    async with recording(binterface, [f"{key()}.a.x"], file, sample={f"{key()}.temp": 0.05}) as recorder:
        await akvs[key()]["a"]["y"].write(2)
        await akvs[key()]["temp"].write(2.0)
        await akvs[key()]["a"]["x"].write(3)
        await recorder.written(key())
        await akvs[key()]["a"].delete()
        await recorder.written(key())
        await aeventually(lambda: recorder.status.messages > 12)
    found = [each for each in news(file) if each[1] == "stored"]
    assert found in (
        [(f"{key()}.a.x", "stored", 3), (f"{key()}.a", "stored", True)],
        [(f"{key()}.a.x", "stored", 3), (f"{key()}.a.x", "stored", True)],
    )


async def test_nothing_is_read_at_rest(key, akvs, raw, binterface, file):
    if isinstance(raw, RawCluster):
        pytest.skip("counts the commands of one server")
    for number in range(20):
        await akvs[key(f"k{number}")].write({"n": number, "a": np.arange(100)})
    async with recording(binterface, [key("*")], file, keyframe=0.1) as recorder:
        await aeventually(lambda: recorder._keyframes > 2)

        def calls():
            found = {name: row["calls"] for name, row in raw.info("commandstats").items()}
            return {name: count for name, count in found.items() if name not in ("cmdstat_info", "cmdstat_ping")}

        before, frames = calls(), recorder._keyframes
        await aeventually(lambda: recorder._keyframes > frames + 12)
        # Where documents are text, the first byte of a string tells whether it is one.
        allowed = {"cmdstat_scan", "cmdstat_getrange"} if PLAIN else {"cmdstat_scan"}
        assert {name for name, count in calls().items() if count != before.get(name)} <= allowed


async def test_it_goes_on_after_a_broken_connection(key, akvs, server_url, raw, file):
    connect = reem_async.RedisInterface
    await akvs[key()].write({"n": 0, "a": FRAME})
    async with connect(server_url, client_name=key("recorder")) as other, recording(other, [key()], file) as recorder:
        await akvs[key()]["n"].write(1)
        await recorder.written(key())
        for row in raw.client_list():
            if row["name"] == key("recorder"):
                raw.client_kill_filter(_id=row["id"])
        await aeventually(lambda: recorder.status.gaps == 1)
        await aeventually(lambda: is_followed(recorder, key()))
        await akvs[key()]["a"].write(FRAME + np.uint8(1))
        await recorder.written(key())
        await akvs[key()]["n"].write(2)
        await recorder.written(key())
    with open_log(file) as log:
        assert [path for _, path, _ in log.gaps()] == [key()]
        assert_same(log[key()].at(log.end), {"n": 2, "a": FRAME + np.uint8(1)})
        stored = [(update.shown, update.kind) for update in log.updates()][1:]
        assert stored == [(f"{key()}.n", "stored"), (f"{key()}.a", "stored"), (f"{key()}.n", "stored")]


@pytest.mark.parametrize("right", ["client|tracking", "type"])
async def test_who_may_not_track_has_it_at_the_keyframes_and_is_warned_once(file, caplog, right):
    async with server_without_right(right) as (kvs, url), reem_async.RedisInterface(url) as other:
        await kvs["a"].write({"n": 1})
        with caplog.at_level(logging.WARNING, "reem"):
            async with recording(other, ["*"], file, keyframe=0.1) as recorder:
                before = recorder.status.messages
                await kvs["a"]["n"].write(2)
                await kvs["b"].write(3)
                frames = recorder._keyframes
                await aeventually(lambda: recorder._keyframes > frames + 2)
                assert recorder.status.messages > before
    (warning,) = [record.getMessage() for record in caplog.records if record.name.startswith("reem")]
    assert f"+{right}," in warning
    assert "keyframes" in warning
    found = news(file)
    assert found[0] == ("a", "kvs", {"n": 1})
    assert sorted(found[1:]) == [("a", "kvs", {"n": 2}), ("b", "kvs", 3)]


async def test_who_may_not_track_has_at_the_end_what_was_stored_last_and_keeps_nothing_of_it(file):
    large = np.zeros(1_000_000)
    async with server_without_right("client|tracking") as (kvs, url), reem_async.RedisInterface(url) as other:
        await kvs["a"].write({"n": 1, "large": large})
        async with recording(other, ["*"], file) as recorder:
            await aeventually(lambda: not recorder._keys.of("a").busy)
            assert recorder._keys.of("a")._reader.feed.attachments.raw is None
            await kvs["a"]["n"].write(2)
    with open_log(file) as log:
        assert_same(log["a"].at(log.end), {"n": 2, "large": large})


async def test_play_and_export_say_what_was_only_stored(key, akvs, apspace, binterface, file, tmp_path):
    await akvs[key("a")].write({"n": 0})
    async with recording(binterface, [key("a")], file) as recorder:
        await akvs[key("a")]["n"].write(1)
        await recorder.written(key("a"))
        await apspace[key("a")]["n"].write(2)
        await akvs[key("a")]["n"].delete()
        await recorder.written(key("a"))
    heard = []
    with open_log(file) as log:
        result = export(log, "csv", tmp_path / "x.csv")
        rows = list(csv.DictReader((tmp_path / "x.csv").read_text().splitlines()))
        path = f"{key('a')}.n"
        assert [(row[path], row[result.stored], row[result.deleted]) for row in rows] == [
            ("0", "", ""),
            ("1", path, ""),
            ("2", "", ""),
            ("", path, path),
        ]
        watch = akvs[key("b")].watch(reem_async.Every(100))
        await watch.listen()
        await Replayer(binterface, log, rate=100, remap={key("a"): key("b")}).play()
        while len(heard) < 4:
            heard.append(await anext(watch))
        await watch.close()
    assert [(update.origin, update.data) for update in heard] == [
        ("published", {"n": 0}),
        ("published", {"n": 1}),
        ("published", {"n": 2}),
        ("published", {}),
    ]


# --- recording keys that come and go, under ever new names or the same ones


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
