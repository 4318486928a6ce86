"""What cannot be recorded, or be read again: it alone is missing, and everything says so."""

import numpy as np
import pytest
from conftest import aeventually, assert_same
from test_recording_overload import Writing
from test_unreadable import Pose

import reem_async
from examples.custom_ship import Scan, ScanShip
from reem_async.plan.trees import MISSING
from reem_async.ships.registry import default_ships
from reem_async.tools.recording import Recorder, Replayer, open_log, sink
from reem_async.tools.recording.export import export
from reem_async.tools.recording.format import Kind, Role


def sweep():
    """A value whose ship makes no bytes of it: it is not recorded. Those of `Pose` are bytes."""
    return Scan("front", np.zeros((2, 3)))


@pytest.fixture
async def special(server_url):
    async with reem_async.RedisInterface(server_url, ships=[ScanShip(), Pose(), *default_ships()]) as it:
        yield it


def test_an_update_that_cannot_be_recorded_is_in_the_file_as_lost(file):
    """It left no trace: until the next keyframe the old value seemed to be there still."""
    writing = Writing(file)
    writing.put(Role.STATE, {"x": 5, "y": 1}, kind=Kind.READ)
    writing.put(Role.UPDATE, 6, "x")
    writing.put(Role.UPDATE, sweep(), "x")
    writing.put(Role.UPDATE, 2, "y")
    assert [place for place, _, _ in writing.told()] == ["a", "a.x", "a.y"]
    assert (writing.thread.counts.lost, writing.thread.counts.messages) == (1, 4)
    with open_log(file) as log:
        assert (log["a.x"].at(log.start + 0.001), log["a.y"].at(log.end)) == (6, 2)
        with pytest.raises(ValueError, match=r"a\.x: Scan, not recorded"):
            log["a.x"].at(log.end)
        assert log["a.x"].history()[1].tolist() == [5, 6]
        assert log.unreadable == 1
        assert log.readable_at("a", log.end) == {"y": 2}


def test_a_path_for_which_there_is_no_channel_any_more_is_not_taken_for_its_old_value(file, monkeypatch):
    """Keyframes repeated for ever what had been there before MCAP's channels ran out."""
    monkeypatch.setattr(sink, "_MOST_CHANNELS", 5)
    writing = Writing(file)
    writing.put(Role.STATE, {"x": 1, "y": 2, "z": 3, "u": 0}, kind=Kind.READ)
    writing.put(Role.KEYFRAME, None)
    writing.put(Role.UPDATE, 1, "u")
    writing.put(Role.UPDATE, np.zeros(100), "x")  # the channels of its array and of a text in its place
    writing.put(Role.UPDATE, "text", "x")
    writing.put(Role.UPDATE, np.zeros((40, 40), np.uint8), "x")  # a picture has another
    writing.put(Role.DELETE, None, "y")
    writing.put(Role.UPDATE, 4, "z")
    writing.put(Role.KEYFRAME, None)
    writing.told()
    counts = writing.thread.counts
    assert (counts.lost, counts.by_path) == (3, {"a.x": 1, "a.y": 1, "a.z": 1})
    with open_log(file) as log:
        assert log.readable_at("a", log.end - 0.001) == {"x": "text", "y": 2, "z": 3, "u": 1}
        assert log.readable_at("a", log.end) == {"z": 4, "u": 1}
        with pytest.raises(ValueError, match="not recorded: too many paths"):
            log["a.x"].at(log.end)


async def test_what_cannot_be_read_is_left_out_alone_when_it_is_played(key, special, akvs, ainterface, file):
    """The whole key was, and not counted: of a robot with one value of a custom type nothing was played."""
    space = reem_async.PublishSpace(special)
    await space[key("a")].write({"n": 0, "scan": sweep(), "pose": 1j, "list": [1, sweep(), 2]})
    await space[key("b")].write(sweep())
    async with Recorder(special, [key("*")], file) as recorder:
        await space[key("a")]["n"].write(1)
        await space[key("a")]["pose"].write(2j)
        await space[key("a")]["scan"].write(sweep())
        await aeventually(lambda: recorder.status.messages >= 6)
        await space[key("a")].write({"n": 2, "scan": sweep(), "image": np.arange(500)})
        await aeventually(lambda: recorder.status.messages >= 8)
    await akvs[key("a")].delete()
    await akvs[key("b")].delete()
    with open_log(file) as log:
        begun = next(update.time for update in log.updates() if update.kind == "pub") - 1e-6
    with open_log(file) as log:
        start = log.readable_at(key("a"), begun)
        assert (start, log.unreadable) == ({"n": 0, "list": [1, None, 2]}, 3)
        assert (log.readable_at(key("b"), begun), log.unreadable) == (MISSING, 4)
        assert (log.readable_at(key("c"), begun), log.unreadable) == (MISSING, 4)
    with open_log(file, ships=[Pose(), *default_ships()]) as log:
        assert log.readable_at(key("a"), begun)["pose"] == 1j
    with open_log(file) as log:
        replayer = Replayer(ainterface, log, rate=100, start=begun)
        while (update := await replayer.step()) is not None and update.path != (key("a"),):
            assert await akvs[key("a")].read() == start | {"n": 1}
        assert_same(update.value, {"n": 2, "image": np.arange(500)})
        assert_same(await akvs[key("a")].read(), update.value)
        assert await replayer.step() is None
        # At the start three values of a and all of b; then two updates, and one value of the last.
        assert replayer.status.unreadable == 7
        assert await akvs[key("b")].read() is None


async def test_a_value_of_an_unknown_ship_does_not_hide_what_is_beside_it(key, special, file):
    """One that was published by itself is a message of its own."""
    space = reem_async.PublishSpace(special)
    await space[key()].write({"n": 0})
    async with Recorder(special, [key()], file) as recorder:
        await space[key()]["pose"].write(2j)
        await aeventually(lambda: recorder.status.messages >= 2)
    with open_log(file) as log:
        assert log.readable_at(key(), log.end) == {"n": 0}
        assert log.tree_at(log.end)[key()]["pose"].label == "pose"
        with pytest.raises(ValueError, match="'pose'"):
            log[f"{key()}.pose"].at(log.end)
        assert log[f"{key()}.n"].at(log.end) == 0


def test_where_there_is_no_channel_any_more_it_is_said_once_and_the_file_stays_whole(file, monkeypatch, caplog):
    """Each new path had a schema all the same, which are numbered with 16 bits as channels are."""
    monkeypatch.setattr(sink, "_MOST_CHANNELS", 10)
    writing = Writing(file)
    for number in range(100):
        writing.put(Role.UPDATE, {"n": number}, f"p{number}")
        writing.put(Role.UPDATE, np.zeros(100), f"q{number}")
    writing.told()
    assert writing.thread.counts.lost > 150
    assert len(writing.thread._sink._schemas) < 15
    (said,) = [record.getMessage() for record in caplog.records if record.name == "reem.recording"]
    assert "as many channels as MCAP can have" in said
    with open_log(file) as log:
        assert (log.indexed, log.verify()) == (True, 0)


def test_an_export_of_arrays_has_each_value_at_its_time_beside_what_was_lost(file, tmp_path):
    """What keyframes repeat is no news because of it, whoever has read the recording before."""
    long = [float(number) for number in range(100)]
    writing = Writing(file)
    writing.put(Role.STATE, {"li": long}, kind=Kind.READ)
    writing.put(Role.UPDATE, long, "li")
    for number in (-1.0, -2.0):
        writing.put(Role.UPDATE, number, "li", 0)
        writing.put(Role.KEYFRAME, None)
    writing.put(Role.UPDATE, sweep(), "li")
    for number in (-3.0, -4.0):
        writing.put(Role.UPDATE, [number, *long[1:]], "li")
    writing.told()
    with open_log(file) as log:
        times, values = log["a.li"].history()
        assert values[:, 0].tolist() == [0, 0, -1, -2, -3, -4]
        assert np.array_equal(log["a.li"].history()[0], times)
        export(log, "npz", tmp_path / "a.npz", ["a.li"])
    with np.load(tmp_path / "a.npz") as exported:
        assert np.array_equal(exported["a.li.time"], times)
        assert_same(exported["a.li"], values)
