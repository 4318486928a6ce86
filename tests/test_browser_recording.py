"""A recording in the browser: the same pages, over the time it was made."""

import asyncio
import json
import threading
import time

import httpx
import numpy as np
import pytest
from browserkit import client_of, served
from conftest import PATIENCE, aeventually, eventually, python
from recordkit import write_mixed

import reem_async
from reem_async.errors import ReadOnly
from reem_async.plan.keys import keys_of
from reem_async.server import EmbeddedServer
from reem_async.tools.browser import logsource
from reem_async.tools.browser.logsource import LogSource
from reem_async.tools.recording import Recorder
from reem_async.tools.recording.container import Container
from reem_async.tools.recording.format import DamagedRecording

pytest.importorskip("mcap", reason="mcap is not installed: pip install 'reem-async[tools]'")


async def record(path):
    times = []
    with EmbeddedServer() as server:
        async with reem_async.RedisInterface(server) as interface:
            pspace = reem_async.PublishSpace(interface)
            await pspace["arm"].write({"q": [0.0, 0.0], "mode": "idle", "fixed": 7})
            async with Recorder(interface, ["*"], path) as recorder:
                for step in range(1, 6):
                    before = recorder.status.messages
                    await pspace["arm"]["q"].write([float(step), 0.5])
                    await pspace["cam"].write({"image": np.full((40, 50), 10 * step, np.uint8), "step": step})
                    await aeventually(lambda before=before: recorder.status.messages > before + 1)
                    await asyncio.sleep(0.05)
                    times.append(asyncio.get_running_loop().time())
                interface.session.stamp(keys_of("arm"))  # an update that is lost
                await pspace["arm"]["mode"].write("done")
                await pspace["cam"].delete()
                await asyncio.sleep(0.1)
    return times


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    asyncio.run(record(path))
    return path


@pytest.fixture(scope="module")
def ask(run):
    with served(lambda: LogSource(run)) as (address, _), client_of(address) as client:
        yield client


@pytest.fixture(scope="module")
def steps(ask):
    series = ask.json("series", path="cam.step")
    values = dict(zip(series["lines"][0], series["times"], strict=True))
    return [values[float(step)] + 0.01 for step in range(1, 6)]


def test_every_instant_is_shown_as_it_was(ask, steps):
    for step, at in enumerate(steps, 1):
        assert ask.rows("arm", at=at)["q"]["text"] == f"[{step}, 0.5]"
        assert ask.rows("arm", at=at)["mode"]["text"] == '"idle"'
        assert ask.rows("cam", at=at)["image"]["text"] == "uint8[40,50]"
        assert ask.json("table", path="cam.image", at=at)["cells"][0][0] == str(10 * step)
    assert list(ask.rows()) == ["arm"], "the camera was deleted at the end"
    assert ask.rows("arm")["mode"]["text"] == '"done"'


def test_the_span_and_the_changes_in_it(ask, steps):
    said = ask.json("tree", open="10:0:", at=steps[2], since=steps[1])
    assert said["start"] < steps[0] < steps[4] < said["end"]
    marks = {row["label"]: row["mark"] for row in said["branches"][0]["nodes"]}
    assert marks == {"arm": "inside", "cam": "inside"}, "cam was published as a whole, and all of it is another value"
    rows = ask.rows("arm", at=steps[2], since=steps[1])
    assert {label: row["mark"] for label, row in rows.items()} == {"q": "changed", "mode": "", "fixed": ""}
    assert steps[1] < rows["q"]["time"] <= steps[2]
    assert sum(ask.json("activity", bins=20, path="arm.mode")["counts"]) >= 1
    assert sum(ask.json("activity", bins=20, path="")["counts"]) >= 11


def test_series_and_search(ask, steps):
    assert ask.json("series", path="arm.q")["lines"][0][-5:] == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert [row["address"] for row in ask.json("search", q="q")["found"]] == ["arm.q", "arm.q[0]", "arm.q[1]"]


def test_lost_updates_are_marked_in_series(ask, steps):
    said = ask.json("series", path="arm.q")
    ((start, end, missed),) = said["losses"]
    last = said["times"][said["lines"][0].index(5.0)]
    assert start == last < end <= said["end"]
    assert missed == 1
    assert ask.json("series", path="cam.step")["losses"] == []
    part = ask.json("series", path="arm.q", start=steps[1], end=steps[3])
    assert (part["start"], part["end"], part["losses"]) == (steps[1], steps[3], [])
    assert part["lines"][0] == [2.0, 3.0, 4.0]


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    return write_mixed(tmp_path_factory.mktemp("mixed") / "run.mcap", 400)


def test_what_no_page_waits_for_is_not_read_on_and_others_are_answered_meanwhile(mixed, monkeypatch):
    content, read = Container.content, []

    def slow(self, info):
        read.append(info)
        time.sleep(0.02)
        return content(self, info)

    with served(lambda: LogSource(mixed)) as (address, source), client_of(address) as ask:
        chunks = len(source.log._container.every_chunk)
        assert ask.rows("cam").keys() == {"t", "rgb"}
        monkeypatch.setattr(Container, "content", slow)
        with pytest.raises(httpx.ReadTimeout):
            ask.http.get("/api/series", params={"path": "arm.n"}, timeout=0.3)
        assert ask.rows("arm")["n"]["text"] == "399"
        eventually(lambda: source.status().part == 1.0)
        assert len(read) < chunks / 4
        monkeypatch.setattr(Container, "content", content)
        series = ask.json("series", path="arm.n")
        assert (series["lines"][0][0], series["lines"][0][-1], source.status().part) == (0, 399, 1)


def test_numbers_over_time_are_read_once_and_parts_of_them_as_they_are(mixed, monkeypatch):
    with served(lambda: LogSource(mixed)) as (address, source), client_of(address) as ask:
        start, end = source.log.start, source.log.end
        part = ask.json("series", path="arm.n", start=start + 10.1, end=start + 11.1)
        assert part["lines"] == [[40, 41, 42, 43, 44]]
        assert part["times"][0] == start + 10.1, "with what was there already"
        whole = ask.json("series", path="arm.n")
        assert whole["lines"] == [list(range(400))]
        vectors = ask.json("series", path="arm.q")
        assert (vectors["names"][6], vectors["lines"][6][-1]) == ("[6]", 199.5)
        counts = ask.json("activity", bins=10, path="arm")["counts"]
        content = Container.content
        monkeypatch.setattr(Container, "content", None)
        assert ask.json("series", path="arm.n", start=start + 10.1, end=start + 11.1) == part
        assert ask.json("activity", bins=10, path="arm")["counts"] == counts
        assert sum(counts) == 400
        assert ask.json("series", path="arm.n", start=end + 5, end=end + 6)["lines"] == [[399]]
        assert source._series[("arm", "q")].bytes == 400 * 8 * 8
        monkeypatch.setattr(Container, "content", content)
        monkeypatch.setattr(logsource, "_SERIES_BYTES", 5000)
        monkeypatch.setattr(logsource, "_THINNED", 50)
        some = ask.json("series", path="arm.a")
        assert (some["lines"][0][0], some["lines"][2][-1]) == (0, 399)
        assert source._series.keys() == {("arm", "a")}
        assert source._series[("arm", "a")].bytes < 5000
        assert ask.json("series", path="arm.a", start=start + 10.1, end=start + 11.1)["lines"] == part["lines"] * 3


def test_the_page_is_there_before_a_long_file_is_open(mixed, tmp_path, monkeypatch):
    """Its recorder was killed: it is read from record to record first."""
    killed, go_on, opening = tmp_path / "killed.mcap", threading.Event(), logsource.open_log
    killed.write_bytes(mixed.read_bytes()[:-100])

    def slow(files, ships, progress):
        def noted(done, every):
            progress(done, every)
            assert done < every / 2 or go_on.wait(PATIENCE)

        return opening(files, ships, progress=noted)

    monkeypatch.setattr(logsource, "open_log", slow)
    monkeypatch.setattr(logsource, "_AT_ONCE", 0)
    with served(lambda: LogSource(killed)) as (address, source), client_of(address) as ask:
        eventually(lambda: 0.4 < source.status().part < 1)
        with pytest.raises(httpx.ReadTimeout):
            ask.http.get("/api/tree", params={"open": "100:0:"}, timeout=0.2)
        with ask.http.stream("GET", "/api/events") as stream:
            line = next(line for line in stream.iter_lines() if line.startswith("data: "))
        assert json.loads(line[6:]) | {"paths": [], "part": 0} == {
            "start": 0, "end": 0, "lost": "", "note": "", "part": 0, "paths": [], "more": False,
        }  # fmt: skip
        go_on.set()
        assert ask.rows("arm")["n"]["text"] == "399"
        assert "not ended properly" in ask.json("tree", open="100:0:")["note"]
    go_on.clear()
    source = LogSource(killed)
    eventually(lambda: source.status().part < 1)

    async def close():
        closing = asyncio.create_task(source.close())
        await asyncio.sleep(0)
        go_on.set()
        await closing

    asyncio.run(close())
    assert isinstance(source._opening.exception(), logsource._Closed), "a page that ends does not read on"
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no recording")
    monkeypatch.undo()
    with pytest.raises(DamagedRecording):
        LogSource(broken)


def test_the_snippet_reads_that_very_instant(ask, steps):
    (code,) = ask.json("node", path="arm.q", at=steps[1])["snippets"].values()
    done = python(code + "print(value, len(times))")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("[2.0, 0.5] ")


def test_it_cannot_be_written(run):
    with served(lambda: LogSource(run), allow_write=True) as (address, source), client_of(address) as ask:
        answer = ask.http.post("/api/write", json={"path": "arm.mode", "value": 1}, headers={"origin": address})
        assert answer.status_code == 403
        with pytest.raises(ReadOnly):
            asyncio.run(source.write(("arm",), 1))


def test_events_go_on_so_that_the_page_knows_all_is_well(ask):
    with ask.http.stream("GET", "/api/events") as stream:
        assert next(line for line in stream.iter_lines() if line.startswith("data: ")).count('"paths":[]') == 1


def test_the_rate_near_the_start_is_of_the_time_there_was(run):
    """Not of five seconds, four of which were before the recording."""
    source = LogSource(run)
    log = source.log
    count = log.news_count(("cam",), log.start, log.end)
    assert count == 6
    assert source._rate("cam", log.end) == pytest.approx(count / max(log.duration, 1.0), rel=0.01)
    source.log.close()
