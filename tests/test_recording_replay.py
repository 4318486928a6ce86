"""Replaying: pace, start in the middle, loops, names, and what an export holds."""

import ast
import asyncio
import contextlib
import csv
import os
import time

import numpy as np
import pytest
from conftest import PATIENCE, aeventually, assert_same
from test_recording import FRAME, IMAGE

import reem
import reem.recording
import reem_async
from reem_async.concurrency.queues import Every
from reem_async.errors import BadInput, BadValue
from reem_async.tools.recording import Recorder, Replayer, open_log
from reem_async.tools.recording.export import FORMATS, export
from reem_async.tools.recording.format import Kind, Role
from reem_async.tools.recording.layout import encode, to_json
from reem_async.tools.recording.sink import Sink


@pytest.fixture(scope="module")
def made(server_url, tmp_path_factory):
    """Half a second: a counter, a picture for each tenth, a key that comes and goes."""
    file, name = tmp_path_factory.mktemp("replay") / "run.mcap", f"replay{os.getpid()}"
    with reem.RedisInterface(server_url) as interface:
        space = reem.PublishSpace(interface)
        space[f"{name}arm"] = {"n": 0, "image": IMAGE}
        with reem.recording.Recorder(interface, [f"{name}*"], file) as recorder:
            for number in range(1, 26):
                space[f"{name}arm"]["n"] = number
                if number % 10 == 0:
                    space[f"{name}arm"]["image"] = IMAGE + np.uint8(number)
                if number == 5:
                    space[f"{name}late"] = [1.5, {"frame": FRAME}]
                if number % 5 == 0:  # what is large is fetched before it is replaced or deleted
                    interface._wait(recorder._core.fence())
                    interface._wait(recorder._core._keys.settled(PATIENCE))
                if number == 15:
                    del space[f"{name}late"]
                time.sleep(0.02)
        del space[f"{name}arm"]
    return file, name


@pytest.fixture
def names(made):
    return lambda name: made[1] + name


@pytest.fixture
def log(made):
    with open_log(made[0]) as opened:
        yield opened


async def test_a_subscriber_sees_it_again_at_the_same_pace(names, key, log, akvs, binterface):
    target = key("again")
    seen = []

    async def follow(watch):
        async for update in watch:
            when = time.monotonic()
            seen.append((when, update.path, update.data))

    async with akvs[target].watch(Every(1000)) as watch:
        following = asyncio.create_task(follow(watch))
        status = await Replayer(binterface, log, patterns=[names("arm")], remap={names("arm"): target}).play()
        await aeventually(lambda: seen and seen[-1][2]["n"] == 25)
        following.cancel()
    assert (status.refused, status.rounds, status.published) == (0, 1, 1 + 25 + 2)
    times = {data["n"]: when for when, path, data in seen if path.endswith(".n")}
    assert sorted(times) == list(range(1, 26))
    recorded = log[names("arm.n")].history()[0]
    lasted = times[25] - times[1]
    assert lasted == pytest.approx(recorded[-1] - recorded[1], abs=0.15 + status.most_lag)
    assert_same(await akvs[target].read(), log[names("arm")].at(log.end))


@pytest.mark.alone
@pytest.mark.parametrize("rate", [10.0, 1e6])
async def test_faster(names, key, log, akvs, binterface, rate):
    begun = time.monotonic()
    status = await Replayer(binterface, log, rate=rate, remap={names("arm"): key("b"), names("late"): key("c")}).play()
    assert time.monotonic() - begun < log.duration + status.most_lag
    assert status.lag <= status.most_lag
    assert status.position == log.end
    assert_same(await akvs[key("b")].read(), log[names("arm")].at(log.end))
    assert await akvs.get(key("c"), "gone") == "gone"


async def test_from_the_middle_the_state_comes_first(names, key, log, akvs, binterface):
    middle = log[names("arm.n")].history()[0][10]  # n was 10 then, and the other key there
    replayer = Replayer(
        binterface, log, start=middle, end=middle, remap={names("arm"): key("b"), names("late"): key("c")}
    )
    await replayer.play()
    assert_same({"b": await akvs[key("b")].read()}, {"b": log[names("arm")].at(middle)})
    assert_same(await akvs[key("c")].read(), log[names("late")].at(middle))


async def test_step_by_step(names, key, log, akvs, binterface):
    replayer = Replayer(binterface, log, patterns=[names("arm.n")], remap={names("arm"): key("b")})
    for number in range(1, 26):
        update = await replayer.step()
        assert (update.path, update.value) == ((names("arm"), "n"), number)
        assert await akvs[key("b")].read() == {"n": number}
    assert await replayer.step() is None
    assert replayer.status.rounds == 1


async def test_loops_begin_with_what_was_there(names, key, log, akvs, binterface):
    replayer = Replayer(binterface, log, rate=50, loop=True, remap={names("arm"): key("b"), names("late"): key("c")})
    playing = asyncio.create_task(replayer.play())
    await aeventually(lambda: replayer.status.rounds >= 2)
    playing.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await playing
    assert replayer.status.published > 2 * 28
    assert (await akvs[key("b")].read()).keys() == {"n", "image"}


async def test_what_the_server_refuses_is_counted(key, apspace, akvs, binterface, file):
    await akvs[key("a")].write({"x": {"y": 1}})
    async with Recorder(binterface, [key("a.x.*")], file):
        await apspace[key("a")]["x"]["y"].write(2)
    with open_log(file) as log:
        after = log[key("a.x.y")].history()[0][0] + 1e-4
        status = await Replayer(binterface, log, start=after, remap={key("a"): key("b")}).play()
        assert (status.refused, await akvs[key("b")].read()) == (0, {"x": {"y": 2}})
        replayer = Replayer(binterface, log, remap={key("a"): key("c")})
        await replayer.step()  # the start, and the one update
        await akvs[key("c")].write(5)
        replayer._updates = iter(log.updates(after))
        await replayer._publish(next(log.updates(log.start + 1e-4)))
        assert replayer.status.refused == 1


async def test_bad_arguments(log, binterface):
    for arguments in (
        {"rate": 0},
        {"rate": float("inf")},
        {"start": log.end, "end": log.start},
        {"remap": {"a.b": "c"}},
        {"remap": {"a": "c.d"}},
        {"remap": {"a": "{c}"}},
        {"patterns": ["a{"]},
        {"start": "now"},
    ):
        with pytest.raises(BadInput):
            Replayer(binterface, log, **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"patterns": ["nobody"]}, r"nothing is played of nobody; recorded are .*arm"),
        ({"remap": {"nobody": "b"}}, r"nothing is played of nobody; recorded are .*arm"),
        ({"patterns": ["ARM"], "remap": {"LATE": "b"}}, r"nothing is played of .*late"),
        ({"remap": {"ARM": "LATE"}}, r"both .*arm and .*late would be played as .*late"),
        ({"remap": {"ARM": "b", "LATE": "b"}}, r"both .*arm and .*late would be played as b;"),
    ],
)
async def test_names_that_mean_nothing_or_two_things(names, log, binterface, arguments, message):
    text = repr(arguments).replace("ARM", names("arm")).replace("LATE", names("late"))
    with pytest.raises(BadValue, match=message):
        Replayer(binterface, log, **ast.literal_eval(text))


async def test_keys_may_swap_names(names, log, akvs, binterface):
    swapped = {names("arm"): names("late"), names("late"): names("arm")}
    await Replayer(binterface, log, rate=1e6, remap=swapped).play()
    assert_same(await akvs[names("late")].read(), log[names("arm")].at(log.end))
    assert await akvs.get(names("arm"), "gone") == "gone"  # as the other one is at the end
    await akvs[names("late")].delete()


async def test_samples_replay_with_their_parents(key, akvs, binterface, file):
    await akvs[key("a")].write({"x": {"y": 1, "z": 2}})
    async with Recorder(binterface, [], file, sample={key("a.x.y"): 0.01}) as recorder:
        await aeventually(lambda: recorder.status.messages > 5)
    with open_log(file) as log:
        await Replayer(binterface, log, remap={key("a"): key("b")}).play()
    assert await akvs[key("b")].read() == {"x": {"y": 1}}


def test_export_csv(names, log, tmp_path):
    result = export(log, "csv", tmp_path / "a.csv", [names("arm")])
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == f"time,{names('arm')}.n"
    assert [line.split(",")[1] for line in lines[1:]] == [str(number) for number in range(26)]
    assert float(lines[1].split(",")[0]) == pytest.approx(log.start, abs=1e-3)
    assert result.left_out.keys() == {f"{names('arm')}.image"}
    assert result.rows == 26
    with pytest.raises(BadValue, match="there already"):
        export(log, "csv", tmp_path / "a.csv")
    with pytest.raises(BadValue, match="none of csv"):
        export(log, "xls", tmp_path / "a.xls")
    with pytest.raises(BadValue, match="nothing"):
        export(log, "csv", tmp_path / "b.csv", ["nobody"])
    assert not (tmp_path / "b.csv").exists()


def test_export_npz(names, log, tmp_path):
    export(log, "npz", tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        times, images = log[names("arm.image")].history()
        assert_same(arrays[f"{names('arm')}.image"], images)
        assert_same(arrays[f"{names('arm')}.image.time"], times)
        assert arrays[f"{names('arm')}.n"].tolist() == list(range(26))
        assert_same(arrays[f"{names('late')}[1].frame"], FRAME[None])


@pytest.mark.parametrize("kind", ["csv", "parquet"])
async def test_deletions_and_what_is_empty_have_rows(key, apspace, binterface, file, tmp_path, kind):
    name = key("k")
    async with Recorder(binterface, [name], file):
        for value in ({"a": 1, "b": 2, "deleted": 0}, {}, {"a": 3, "b": []}, []):
            await apspace[name].write(value)
        await apspace[name].write({"a": 4})
        await apspace[name]["a"].delete()
        await apspace[name].delete()
    target = tmp_path / f"a.{kind}"
    with open_log(file) as log:
        result = export(log, kind, target)
        npz = export(log, "npz", tmp_path / "a.npz")
    assert (result.rows, result.deleted) == (7, "deleted")
    assert {name, f"{name}.a (deleted)", f"{name} (deleted)"} <= npz.left_out.keys()
    if kind == "csv":
        rows = list(csv.DictReader(target.read_text().splitlines()))
    else:
        rows = pytest.importorskip("pyarrow.parquet").read_table(target).to_pylist()
    found = [{column: str(value) for column, value in row.items() if value not in ("", None)} for row in rows]
    for row in found:
        del row["time"]
    assert found == [
        {f"{name}.a": "1", f"{name}.b": "2", f"{name}.deleted": "0"},
        {name: "{}"},
        {f"{name}.a": "3", f"{name}.b": "[]"},
        {name: "[]"},
        {f"{name}.a": "4"},
        {"deleted": f"{name}.a"},
        {"deleted": name},
    ]


LONG = 2**62 + 1
"""An integer that no float64 holds."""


@pytest.fixture
async def mixed(key, apspace, binterface, file):
    async with Recorder(binterface, [key()], file):
        for long, short, flags, item in ((LONG, 1, True, [LONG, 0.5]), (0.5, 0.5, 1, [1, 0.5]), (1, 2, 0, [2, 1])):
            await apspace[key()].write({"long": long, "short": short, "flags": flags, "item": item, "text": "abc\0"})
    with open_log(file) as log:
        yield log


def test_npz_has_no_number_that_is_not_exact(key, mixed, tmp_path):
    result = export(mixed, "npz", tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert_same(arrays[f"{key()}.short"], np.array([1, 0.5, 2]))
        assert sorted(arrays) == [f"{key()}.short", f"{key()}.short.time"]
    assert sorted(result.left_out) == [f"{key()}.{name}" for name in ("flags", "item", "long", "text")]
    assert "exactly" in result.left_out[f"{key()}.long"]


def test_parquet_has_no_number_that_is_not_exact(key, mixed, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    export(mixed, "parquet", tmp_path / "a.parquet")
    table = parquet.read_table(tmp_path / "a.parquet")
    assert table[f"{key()}.long"].to_pylist() == [str(LONG), "0.5", "1"]
    assert table[f"{key()}.short"].to_pylist() == [1.0, 0.5, 2.0]
    assert table[f"{key()}.item[0]"].to_pylist() == [LONG, 1, 2]


def test_export_parquet(names, log, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    export(log, "parquet", tmp_path / "a.parquet")
    table = parquet.read_table(tmp_path / "a.parquet")
    numbers = [value for value in table[f"{names('arm')}.n"].to_pylist() if value is not None]
    assert numbers == list(range(26))
    assert str(table.schema.field(f"{names('late')}[0]").type) == "double"
    assert str(table.schema.field("time").type) == "timestamp[us, tz=UTC]"


async def test_a_key_called_time_does_not_take_the_place_of_the_instants(key, server_url, file, tmp_path):
    async with reem_async.RedisInterface(server_url, namespace=key("foo:")) as interface:
        space = reem_async.PublishSpace(interface)
        async with Recorder(interface, ["*"], file):
            await space["time"].write(1.5)
            await space["_time"].write(2.5)
    with open_log(file) as log:
        for kind in ("csv", "parquet"):
            assert export(log, kind, tmp_path / f"run.{kind}").time == "__time"
        begun, ended = log.start, log.end
    rows = (tmp_path / "run.csv").read_text().splitlines()
    assert rows[0] == "__time,time,_time"
    assert all(begun - 1e-5 <= float(row.split(",")[0]) <= ended + 1e-5 for row in rows[1:])
    table = pytest.importorskip("pyarrow.parquet").read_table(tmp_path / "run.parquet")
    assert table.column_names == ["__time", "time", "_time"]
    assert [value for value in table["time"].to_pylist() if value is not None] == [1.5]
    assert table["__time"][0].as_py().timestamp() == pytest.approx(begun, abs=1e-5)


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_an_export_that_is_broken_off_leaves_nothing(log, tmp_path, kind, monkeypatch):
    target = tmp_path / "run.out"

    def broken_off(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("reem_async.tools.recording.log.LogPath.values", broken_off)
    monkeypatch.setattr("csv.writer", broken_off)
    monkeypatch.setattr("reem_async.tools.recording.export._cell", broken_off)
    with pytest.raises(KeyboardInterrupt):
        export(log, kind, target)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_somebody_makes_while_it_is_exported_stays(log, tmp_path, monkeypatch):
    target, write = tmp_path / "run.csv", FORMATS["csv"]

    def meanwhile(*arguments):
        target.write_text("precious")
        write(*arguments)

    monkeypatch.setitem(FORMATS, "csv", meanwhile)
    with pytest.raises(BadValue, match=r"there already.*overwrite=True"):
        export(log, "csv", target)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["precious"]
    export(log, "csv", target, overwrite=True)
    assert target.read_text().startswith("time,")


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_what_cannot_be_read_is_counted_once_though_it_is_read_several_times(kind, file, tmp_path):
    sink = Sink(file, "none", {}, overwrite=False)
    sink.output.appear()
    for number in range(1, 4):
        sink.json(("a", "n"), Role.UPDATE, Kind.PUBLISHED, to_json(number), (number, number, number))
        blob = encode("no ship of this name", b"x", "", 0)
        sink.part(("a",), Role.UPDATE, Kind.PUBLISHED, "no ship of this name", blob, (10 + number,) * 3)
    sink.finish({})
    with open_log(file) as log:
        assert (len(list(log.updates())), log.unreadable) == (3, 3)
    with open_log(file) as log:
        result = export(log, kind, tmp_path / "out")
    assert (result.rows, result.unreadable) == (3, 3)


async def test_steps_of_a_recording_without_updates_end(key, akvs, binterface, file):
    await akvs[key()].write(5)
    async with Recorder(binterface, [key()], file):
        pass
    with open_log(file) as log:
        replayer = Replayer(binterface, log, start=log.end, loop=True)
        assert await replayer.step() is None
        assert (replayer.status.published, replayer.status.rounds) == (1, 1)
