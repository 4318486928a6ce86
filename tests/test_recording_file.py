"""The file itself: read by others, cut short, damaged, on a full disk, after kill -9."""

import contextlib
import itertools
import os
import random
import signal
import sys
import time
import tracemalloc

import mcap.reader
import mcap.writer
import numpy as np
import pytest
from conftest import assert_same, eventually, python, sized
from test_recording import IMAGE

import reem
import reem.recording
from reem_async.errors import BadData, BadValue, MissingKey
from reem_async.tools.recording import DamagedRecording, Recorder, open_log
from reem_async.tools.recording import mcap_writer as recording_writer
from reem_async.tools.recording.format import Role
from reem_async.tools.recording.mcap_writer import McapWriter
from reem_async.tools.recording.output import Output
from reem_async.tools.recording.times import Arrivals


@pytest.fixture(scope="module")
def recorded(server_url, tmp_path_factory):
    """A file with a few chunks, and what was at a path at some instants; the names are those of `key` below."""
    file, seen, name = tmp_path_factory.mktemp("recorded") / "run.mcap", [], f"recorded{os.getpid()}"
    with reem.RedisInterface(server_url) as interface:
        space = reem.PublishSpace(interface)
        with reem.recording.Recorder(interface, [f"{name}*"], file, keyframe=0.2) as recorder:
            sink, written = recorder._core._sink, set()
            write = sink.json

            def json(path, role, kind, document, stamp):
                written.add((path, role, stamp[2]))
                return write(path, role, kind, document, stamp)

            sink.json = json
            for number in range(40):
                value = {"n": number, "image": IMAGE + np.uint8(number), "t": "x" * number}
                space[f"{name}a"] = value
                eventually(lambda update=((f"{name}a",), Role.UPDATE, number + 1): update in written)
                seen.append((time.time(), value))
                sink._closed_at -= number % 5 == 0  # a chunk for every few updates
                space[f"{name}b"] = number
                time.sleep(0.01)  # so that there are some keyframes, however fast this machine is
        del space[f"{name}a"], space[f"{name}b"]
    return file, seen, name


@pytest.fixture
def file_and_values(recorded):
    return recorded[:2]


@pytest.fixture
def names(recorded):
    return lambda name: recorded[2] + name


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_what_is_written_is_what_the_library_reads(compression, tmp_path):
    """Messages of any size, in chunks; with the index and without it, every checksum compared."""
    file, rng = tmp_path / "written.mcap", random.Random(1)
    sizes = [0, 1, 100, (1 << 16) - 1, 1 << 16, (1 << 16) + 1, 3 << 20, *(rng.randrange(3000) for _ in range(500))]
    output = Output(file, overwrite=False)
    output.appear()
    writer = McapWriter(output, compression, "test")
    schema = writer.register_schema("a schema", "jsonschema", b"{}")
    channels = [writer.register_channel(f"/topic{n}", "json", schema, {"key": "ä"}) for n in range(3)]
    sent = []
    for number, size in enumerate(sizes):
        data = rng.randbytes(size // 2) + bytes(size - size // 2)
        sent.append((channels[number % 3], 1000 + number, data, number))
        writer.add_message(channels[number % 3], 1000 + number, [data[:3], data[3:]], 7, number)
        if number % 50 == 0:
            writer.add_metadata(f"m{number}", {"a": "b"})
            writer.flush()
    whole_before_the_end = file.stat().st_size
    writer.finish()
    writer.close()
    output.close()
    with file.open("rb") as stream:
        reader = mcap.reader.make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        found = [(m.channel_id, m.log_time, m.data, m.sequence) for _, _, m in reader.iter_messages()]
        assert found == sent
        assert {m.name: m.metadata for m in reader.iter_metadata()}["m0"] == {"a": "b"}
    assert [channel.metadata for channel in summary.channels.values()] == [{"key": "ä"}] * 3
    assert summary.statistics.message_count == len(sizes)
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (1000, 999 + len(sizes))
    assert sum(index.uncompressed_size for index in summary.chunk_indexes) > sum(sizes)
    with file.open("rb") as stream:
        plain = mcap.reader.NonSeekingReader(stream, validate_crcs=True)
        assert [m.data for _, _, m in plain.iter_messages()] == [each[2] for each in sent]
    assert compression == "none" or file.stat().st_size < sum(sizes) * 0.7 < whole_before_the_end * 2


@pytest.mark.long
def test_memory_does_not_grow_with_the_length_of_a_recording(tmp_path, monkeypatch):
    """The index of chunks grows by ten bytes for each channel and chunk; it waits in a file, and is complete."""
    monkeypatch.setattr(recording_writer, "_INDEX_BYTES", 1 << 14)
    output = Output(tmp_path / "long.mcap", overwrite=False)
    output.appear()
    writer = McapWriter(output, "none", "test")
    schema = writer.register_schema("a schema", "jsonschema", b"{}")
    channels = [writer.register_channel(f"/topic{n}", "json", schema, {}) for n in range(100)]
    used = []
    tracemalloc.start()
    try:
        for number in range(300):
            for channel in channels:
                writer.add_message(channel, 1000 * number + channel, [b"{}"], 7, number)
            writer.flush()
            if number % 100 == 99:
                used.append(tracemalloc.get_traced_memory()[0])
        writer.finish()
    finally:
        tracemalloc.stop()
        writer.close()
        output.close()
    assert used[2] - used[1] < 50_000
    with (tmp_path / "long.mcap").open("rb") as stream:
        summary = mcap.reader.make_reader(stream, validate_crcs=True).get_summary()
    assert [len(index.message_index_offsets) for index in summary.chunk_indexes] == [100] * 300
    times = summary.statistics.message_start_time, summary.statistics.message_end_time
    assert times == (channels[0], 299_000 + channels[-1])
    assert list(tmp_path.iterdir()) == [tmp_path / "long.mcap"]


def test_arrivals_do_not_tell_that_updates_were_taken_together():
    """Three arrive 1 ms apart and are taken at once; whatever the clocks, nothing is off by more than the patience."""
    for offset in (0.0, 5.0, -5.0):
        arrivals = Arrivals(0.004)
        assert arrivals.of("p", 100.0 + offset, 100.0003) == pytest.approx(100.0003, abs=0.0004)
        told = [arrivals.of("p", 101.0 + offset + n / 1000, 101.0025) for n in range(3)]
        assert told == pytest.approx([101.0, 101.001, 101.002], abs=0.0005)
        set_back = arrivals.of("p", 90.0, 102.0)
        assert 101.996 <= set_back <= 102.0
        assert arrivals.of("q", 200.0, 103.0) == 103.0


def test_metadata_says_who_when_and_what_is_missing(names, file_and_values):
    with open_log(file_and_values[0]) as log:
        said = log.metadata
        assert said["patterns"] == names("*")
        assert said["dropped"] == said["lost"] == said["gaps"] == "0"
        assert {"host", "user", "server", "version", "began", "ended", "numpy"} <= said.keys()
        assert "password" not in str(said)
        a = next(each for each in log.channels() if each.topic == f"/{names('a')}")
        assert (a.messages, a.path, a.role, a.kind) == (40, names("a"), "update", "pub")
        assert a.rate > 0


def middle_chunk(log, path):
    """The one in the middle of the chunks that have updates of a path."""
    (number,) = [it.id for it in log._container.channels.values() if it.topic == "/" + path.replace(".", "/")]
    chunks = [info for info in log._container.chunks if number in info.channels]
    return chunks[len(chunks) // 2]


def check(file, names, seen):
    """Whatever can be read is what was written, and what is missing is counted; returns how many of the values can."""
    found = 0
    with open_log(file) as log:
        values = {value["n"]: value for _, value in seen}
        for update in log.updates(patterns=[names("a")]):
            assert_same(update.value, values[update.value["n"]])
            found += 1
        unreadable = log.unreadable
        for instant, _ in seen[::5]:
            with contextlib.suppress(MissingKey, DamagedRecording):
                value = log.value_at(names("a"), instant)
                assert_same(value, values[value["n"]])
        with contextlib.suppress(DamagedRecording):
            log.value_at("", log.end)
        log.channels()
        return found, log.damaged, unreadable


def test_cut_anywhere_it_opens(names, file_and_values, tmp_path):
    file, seen = file_and_values
    data = file.read_bytes()
    rng = random.Random(5)
    cut, counts = tmp_path / "cut.mcap", []
    places = sorted({*rng.sample(range(8, len(data)), 60), 8, 9, 30, len(data) - 1, len(data) - 8, len(data) - 9})
    for place in places:
        cut.write_bytes(data[:place])
        if place < 1000:  # so short that not even its first record may be there
            with contextlib.suppress(DamagedRecording):
                assert check(cut, names, seen)[0] == 0
        else:
            counts.append(check(cut, names, seen)[0])
    assert counts == sorted(counts)
    assert counts[-1] == len(seen)
    for place in range(8):
        cut.write_bytes(data[:place])
        with pytest.raises(DamagedRecording):
            open_log(cut)


def starts(data):
    places, position = [], 8
    while position + 9 <= len(data):
        places.append(position)
        position += 9 + int.from_bytes(data[position + 1 : position + 9], "little")
    return places


def test_cut_in_its_index_a_chunk_is_read_whole(names, file_and_values, tmp_path):
    """What is there of the index does not tell that the rest of it is missing."""
    data = file_and_values[0].read_bytes()
    indexes = [here for before, here in itertools.pairwise(starts(data)) if data[before] == data[here] == 0x07]
    assert len(indexes) > 3
    cut = tmp_path / "cut.mcap"
    for index in (indexes[0], indexes[len(indexes) // 2], indexes[-1]):
        counts = []
        for more in range(13):
            cut.write_bytes(data[: index + more])
            counts.append(check(cut, names, file_and_values[1])[0])
        assert len(set(counts)) == 1, counts


@pytest.mark.parametrize("heads", [False, True], ids=["anywhere", "heads of records"])
def test_a_flipped_bit_is_counted_if_it_costs_something(names, file_and_values, tmp_path, heads):
    """Also in the head of a record, where it makes another kind of record of it, which may hide what follows."""
    file, seen = file_and_values
    data, rng = file.read_bytes(), random.Random(7)
    damaged, worst, noticed, places = tmp_path / "damaged.mcap", len(seen), 0, starts(data)
    for _ in range(sized(60, 400) if heads else 80):
        place = rng.choice(places) + rng.randrange(3) if heads else rng.randrange(8, len(data) - 200)
        is_whole = rng.random() < 0.5
        broken = bytearray(data if is_whole else data[: -rng.randrange(100, 200)])
        if place >= len(broken) - 8:
            continue
        broken[place] ^= 1 << rng.randrange(8)
        damaged.write_bytes(broken)
        with contextlib.suppress(DamagedRecording):
            found, count, unreadable = check(damaged, names, seen)
            worst = min(worst, found if is_whole else worst)
            noticed += count > 0
            assert count or found + unreadable == len(seen), f"bit {place}"
    assert heads or worst >= len(seen) // 2, "one byte must not cost more than a chunk or two"
    assert noticed > (20 if heads else 40)


def test_a_record_that_covers_the_records_behind_it_is_counted(names, file_and_values, tmp_path):
    file, seen = file_and_values
    data, damaged = file.read_bytes()[:-150], tmp_path / "damaged.mcap"
    places = starts(data)
    for number in range(1, len(places) - 4, sized(5, 1)):
        for further in (2, 3, 5):
            if number + further < len(places):
                place, end = places[number], places[number + further]
                broken = bytearray(data)
                broken[place + 1 : place + 9] = (end - place - 9).to_bytes(8, "little")
                damaged.write_bytes(broken)
                with contextlib.suppress(DamagedRecording):
                    found, count, unreadable = check(damaged, names, seen)
                    assert count or found + unreadable == len(seen), (place, further)


def mutated(data, rng):
    broken = bytearray(data)
    for _ in range(rng.choice([1, 1, 5])):
        start = rng.randrange(len(broken))
        end = start + rng.choice([1, 8, 60, 500])
        kind = rng.randrange(6)
        if kind == 0:
            broken[start] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del broken[start:end]
        elif kind == 2:
            broken[start:start] = broken[start:end]
        elif kind == 3:
            broken[start:end] = rng.randbytes(min(end, len(broken)) - start)
        elif kind == 4:
            broken[start : start + 8] = rng.choice([b"\xff" * 8, bytes(8), (2**40).to_bytes(8, "little")])
        else:
            del broken[-rng.randrange(1, 300) :]
    return bytes(broken)


def test_altered_at_random_nothing_wrong_is_returned(names, file_and_values, tmp_path):
    file, seen = file_and_values
    data, rng, broken = file.read_bytes(), random.Random(11), tmp_path / "broken.mcap"
    for number in range(sized(40, 150)):
        broken.write_bytes(mutated(data, rng))
        try:
            found, damaged, _ = check(broken, names, seen)
        except DamagedRecording:
            continue  # its very beginning
        with open_log(broken) as log:
            list(log.updates())
            assert found == len(seen) or damaged or log.unreadable or not log.indexed, number
            log.verify()


@pytest.mark.long
def test_a_damaged_index_of_messages_is_found_and_not_trusted(names, file_and_values, tmp_path):
    """Any bit of a log time: either what is told is right, or `verify` says that something is damaged."""
    file, seen = file_and_values
    whole, damaged = file.read_bytes(), tmp_path / "damaged.mcap"
    with open_log(file) as log:
        places = [info for info in log._container.chunks if info.index_length][-2:]
    for info in places:
        for offset in range(info.index, info.index + info.index_length):
            data = bytearray(whole)
            data[offset] ^= 1 << random.Random(offset).randrange(8)
            damaged.write_bytes(data)
            with open_log(damaged) as log:
                assert log.verify() >= 1
                assert log.channels()
                with contextlib.suppress(DamagedRecording):  # the whole chunk is left out
                    value = log[names("a")].at(seen[-1][0])
                    assert_same(value, seen[value["n"]][1])


def test_history_goes_on_from_a_keyframe_behind_what_is_damaged(names, file_and_values, tmp_path):
    file, _ = file_and_values
    with open_log(file) as log:
        info = middle_chunk(log, names("a"))
        whole = log[names("a")]["t"].history()
    damaged, data = tmp_path / "damaged.mcap", bytearray(file.read_bytes())
    data[info.offset + info.length - 5] ^= 1
    damaged.write_bytes(data)
    with open_log(damaged) as log:
        _, texts = log[names("a")]["t"].history()
        assert log.unreadable > 0
        assert 0 < len(set(texts)) < len(set(whole[1]))
        assert texts[-1] == log[names("a")]["t"].at(log.end) == whole[1][-1]


async def test_a_file_that_is_read_may_be_replaced(key, apspace, binterface, file, tmp_path):
    """Its reader goes on with the old one; cut short under him, it would kill his process."""
    async with Recorder(binterface, [key()], file):
        await apspace[key()].write({"image": IMAGE, "text": "x" * 100_000})
    with open_log(file) as log:
        async with Recorder(binterface, ["nothing_there"], file, overwrite=True):
            assert log[key()]["text"].at(log.end) == "x" * 100_000
            assert_same(log[key()]["image"].at(log.end), IMAGE)
    with open_log(file) as log:
        assert log.names() == []
    with pytest.raises(BadValue, match="cannot be written: not a file"):
        Recorder(binterface, [key()], tmp_path, overwrite=True)


async def test_what_is_no_recording(tmp_path, recorded):
    for data in (b"", b"\x89MCAP0\r\n", b"PK\x03\x04" * 100, recorded[0].read_bytes()[100:]):
        other = tmp_path / "other"
        other.write_bytes(data)
        with pytest.raises(BadData, match="other"):
            open_log(other)
    empty = tmp_path / "empty.mcap"
    with empty.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start()
        writer.finish()
    with pytest.raises(BadData, match="without a channel"):
        open_log(empty)
    with pytest.raises(FileNotFoundError):
        open_log(tmp_path / "none.mcap")


RECORD = """
import asyncio, sys, reem_async
from reem_async.recording import Recorder
async def main(url, pattern, file):
    async with reem_async.RedisInterface(url) as interface, Recorder(interface, [pattern], file):
        print("up", flush=True)
        await asyncio.sleep(60)
asyncio.run(main(*sys.argv[1:]))
"""


# Beside other tests the writing thread, which is nicer than other programs, may not get the processor in time.
@pytest.mark.parametrize("seconds", [2.0, pytest.param(1.0, marks=pytest.mark.alone)])
def test_killed_with_9_all_but_the_last_second_is_there(key, server_url, pspace, tmp_path, seconds):
    file, sent = tmp_path / "run.mcap", []
    process = python(RECORD, server_url, key("*"), file, start=True)
    try:
        assert process.stdout.readline() == "up\n", process.stderr.read()
        begun = time.monotonic()
        while time.monotonic() - begun < seconds + 2.0:
            value = {"n": len(sent), "image": IMAGE + np.uint8(len(sent) % 256)} if len(sent) % 10 == 0 else len(sent)
            sent.append((time.time(), value))
            pspace[key("a" if len(sent) % 10 == 1 else "n")] = value
            time.sleep(0.004)  # not all that it can: the writing thread gives way to other programs
        killed = time.time()
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    with open_log(file) as log:
        assert not log.indexed
        old = [(instant, value) for instant, value in sent if instant < killed - seconds]
        assert len(old) > 100
        assert (
            log[key("n")].history()[1].tolist()[: len(old) // 2]
            == [value for _, value in sent if type(value) is int][: len(old) // 2]
        )
        assert log.end > killed - seconds
        newest = max((value for instant, value in old if type(value) is int))
        assert log[key("n")].at(log.end) >= newest
        known = {value["n"]: value for _, value in sent if type(value) is dict}
        for update in log.updates(patterns=[key("a")]):
            assert_same(update.value, known[update.value["n"]])
        assert any(value["n"] == log[key("a")].at(log.end)["n"] for _, value in sent if type(value) is dict)


FULL = """
import asyncio, resource, signal, sys, numpy, reem_async
from reem_async.errors import ReemError
from reem_async.recording import Recorder, RecordingFailed
async def main(url, key, file):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_500_000, 2_500_000))
    rng = numpy.random.default_rng(0)
    async with reem_async.RedisInterface(url) as interface:
        space = reem_async.PublishSpace(interface)
        recorder = Recorder(interface, [key], file)
        try:
            async with recorder:
                for number in range(10_000):
                    await space[key].write({"n": number, "noise": rng.integers(0, 255, 20_000, numpy.uint8)})
                    await asyncio.sleep(0.002)
                    if recorder.writer_thread.failure:
                        await recorder.wait()
        except RecordingFailed as error:
            print(number, error, flush=True)
asyncio.run(main(*sys.argv[1:]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")
def test_a_full_disk_ends_the_recording_and_leaves_a_file_that_can_be_read(key, server_url, file):
    """A limit of the process stands in for the disk: writing fails in the middle of a chunk."""
    run = python(FULL, server_url, key("a"), file, flags=("-W", "error"))
    assert run.stderr == ""
    assert "could not be written any further" in run.stdout
    assert "can be read" in run.stdout
    assert file.stat().st_size <= 2_500_000
    with open_log(file) as log:
        assert (log.damaged, log.indexed) == (0, False)
        numbers = log[key("a.n")].history()[1].tolist()
        assert numbers == sorted(set(numbers))
        assert 30 < len(numbers) < 130
        assert log.verify() == 0
