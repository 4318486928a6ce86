"""Long recordings of many keys: what is asked of one does not read all of it."""

import contextlib
import os
import random

import numpy as np
import pytest
from conftest import sized
from recordkit import write_mixed

from reem_async.plan.paths import parse
from reem_async.tools.recording import open_log
from reem_async.tools.recording.container import Container
from reem_async.tools.recording.format import DamagedRecording, Kind, Role
from reem_async.tools.recording.layout import to_json
from reem_async.tools.recording.sink import Sink

KEYS, CHUNKS = 20, 400
START, STEP = 1_700_000_000_000_000_000, 250_000_000


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    file = tmp_path_factory.mktemp("long") / "run.mcap"
    sink = Sink(file, "zstd", {}, overwrite=False)
    sink.output.appear()
    for chunk in range(CHUNKS):
        now = START + chunk * STEP
        for key in [*range(KEYS), 0]:
            now += 1000
            sink.json((f"k{key}",), Role.UPDATE, Kind.PUBLISHED, to_json({"n": chunk}), (now, now, chunk + 1))
        if chunk == 100:
            sink.json(("rare",), Role.UPDATE, Kind.PUBLISHED, to_json({"n": chunk}), (now + 1, now, 1))
        sink._closed_at -= 1
        sink.tick()
    sink.finish({})
    return file


@pytest.fixture
def reads(monkeypatch):
    numbers, read = [], Container._read_index

    def noted(self, info):
        numbers.append(info.number)
        return read(self, info)

    monkeypatch.setattr(Container, "_read_index", noted)
    return numbers


def test_channels_are_counted_by_each_index_once(file, reads, tmp_path):
    killed, data, counts = tmp_path / "killed.mcap", file.read_bytes(), []
    killed.write_bytes(data[: data.rindex(b"reem.channels") - 13])
    for each in (file, killed):
        opened, chunks = [], []
        reads.clear()
        with open_log(each, progress=lambda *it, opened=opened: opened.append(it)) as log:
            assert log.indexed == (each == file)
            counts.append(log.channels(lambda *it, chunks=chunks: chunks.append(it)))
        assert opened == sorted(opened)
        assert [it[1] for it in opened[-1:]] == ([] if each == file else [killed.stat().st_size])
        assert chunks == [(number + 1, CHUNKS) for number in range(CHUNKS)]
        assert sorted(reads) == list(range(CHUNKS))
    assert counts[0] == counts[1]
    by_path = {each.path: each for each in counts[0]}
    assert (by_path["k0"].messages, by_path["k7"].messages, by_path["rare"].messages) == (2 * CHUNKS, CHUNKS, 1)


def test_an_instant_takes_the_index_of_its_own_chunk(file, reads):
    with open_log(file) as log:
        at = log.start + 200 * STEP / 1e9
        assert log["k3"]["n"].at(at + 0.1) == 200
        assert set(reads) == {200}
        assert log["k5"]["n"].at(at - 0.1) == 199
        assert set(reads) == {199, 200}
        assert log["rare"]["n"].at(log.end) == 100
        assert {name: tree["n"] for name, tree in log.tree_at(at + 0.1).items()} == {
            **{f"k{key}": 200 for key in range(KEYS)},
            "rare": 100,
        }
        assert set(reads) <= {100, 199, 200, CHUNKS - 1}
        reads.clear()
        assert [update.value for update in log.updates(patterns=["rare"])] == [{"n": 100}]
        assert set(reads) <= {100}
        assert next(log.updates(at)).value == {"n": 200}
        assert set(reads) <= {200, 201}
        whole = log.changes(log.start, log.end)
        assert whole == {("rare",), *[(f"k{key}",) for key in range(KEYS)]}
        assert set(reads) <= {0, 200, 201}


def test_what_the_index_says_is_what_there_is(file):
    with open_log(file) as log:
        assert len(log.news_times(("k0",))) == log.news_count(("k0",), log.start - 1, log.end) == 2 * CHUNKS
        assert len(log.news_times(())) == (KEYS + 1) * CHUNKS + 1
        assert (np.diff(log.news_times(())) >= 0).all()
        assert log.last_news(("rare",), log.end) == pytest.approx(log.start + 100 * STEP / 1e9, abs=0.01)
        assert log.last_news(("rare",), log.start) is None
        times, values = log["k0"]["n"].history()
        assert values.tolist() == [chunk for chunk in range(CHUNKS) for _ in range(2)]
        assert len(times) == 2 * CHUNKS


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    return write_mixed(tmp_path_factory.mktemp("mixed") / "run.mcap")


def test_numbers_are_read_without_the_pictures_between_them(mixed, monkeypatch):
    sizes, content = [], Container.content

    def noted(self, info):
        sizes.append(info.length)
        return content(self, info)

    monkeypatch.setattr(Container, "content", noted)
    for path, values in {
        "cam.t": range(40),
        "arm.q": [[step / 2] * 7 for step in range(40)],
        "arm.n": range(40),
        "arm.a": [[step] * 3 for step in range(40)],
        "arm.big": [2**60 + step for step in range(40)],
        "arm.mode": [f"m{step}" for step in range(40)],
    }.items():
        with open_log(mixed) as log:
            sizes.clear()
            times, found = log[path].history()
            assert np.array(found).tolist() == np.array(list(values)).tolist()
            assert times.tolist() == [time for time, _ in log[path].values()] == log.news_times(parse(path)).tolist()
            assert 10 <= len(sizes) <= 20 + 400 * (path == "arm.big")
            assert max(sizes) < 3000
            assert len(log._container.every_chunk) == 20
    with open_log(mixed) as log:
        assert [value["rgb"][0, 0] for _, value in log["cam"].values()] == list(range(40))
        assert log.verify() == 0


def test_a_damaged_history_has_what_following_each_change_has(mixed, tmp_path):
    """All of it; and more if only the index of other channels is damaged, which is not read."""
    damaged, data, found = tmp_path / "damaged.mcap", mixed.read_bytes(), 0
    for seed in range(sized(25, 300)):
        rng, changed = random.Random(seed), bytearray(data)
        for _ in range(rng.choice((1, 3))):
            changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        damaged.write_bytes(changed)
        for path in (("cam", "t"), ("arm", "q")):
            # The same changes one by one, in a log that was just opened, as the first must not know of the damage.
            with contextlib.suppress(DamagedRecording), open_log(damaged) as log, open_log(damaged) as other:
                changes = other._past.following(path, -1, 2**63 - 1)
                slow = [(refs[0].time, np.array(value).tolist()) for refs, repeats, value in changes if not repeats]
                quick = [(at, np.array(each).tolist()) for at, each, _ in log._past.values(path, -1, 2**63 - 1)]
                assert quick == slow or (len(quick) == 40 and log.damaged < other.damaged), seed
                assert all(value == (step := (at - START) // STEP) or value == [step / 2] * 7 for at, value in quick)
                found += len(slow) < 40
    assert found > 3


def test_wherever_a_recording_ends_a_number_has_its_picture(mixed, tmp_path):
    killed, data = tmp_path / "killed.mcap", mixed.read_bytes()
    with open_log(mixed) as log:
        ends = [info.index + info.index_length for info in log._container.every_chunk]
    for end in ends:
        killed.write_bytes(data[:end])
        with open_log(killed) as log:
            times, found = log["cam"]["t"].history() if "cam" in log.names() else ([], [])
            assert [log["cam"]["rgb"].at(time)[0, 0] for time in times] == list(found)
            assert len(found) in (0, *range(0, 41, 4))
            assert (log.unreadable, log.damaged) == (0, 0)


def test_cut_short_while_it_is_open_it_raises(file, tmp_path):
    """Mapped into memory, it would kill the process: the system has no page to give."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes())
    with open_log(cut) as log:
        os.truncate(cut, 3000)
        for ask in (
            lambda: log["k3"].at(log.end),
            lambda: list(log.updates()),
            log.verify,
            lambda: log.tree_at(log.end),
        ):
            with pytest.raises(OSError, match="cut short while it was being read") as caught:
                ask()
            assert caught.value.filename == str(cut)
