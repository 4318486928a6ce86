"""Recordings that another tool has rewritten are read as they were, refused, or reported as damaged; never differently.

A generator draws the variants: all that MCAP leaves optional. A failure names its seed.
"""

import contextlib
import io
import itertools
import json
import os
import random
import struct
import zlib

import mcap.reader
import mcap.writer
import numpy as np
import orjson
import pytest
from conftest import eventually, sized
from test_recording_file import starts

import reem
import reem.recording
from reem_async.errors import BadData, MissingKey
from reem_async.tools.browser.logsource import LogSource
from reem_async.tools.recording import DamagedRecording, Replayer, open_log
from reem_async.tools.recording.container import Container, Ref
from reem_async.tools.recording.export import export

IMAGE = np.arange(40 * 30 * 3, dtype=np.uint8).reshape(40, 30, 3)


@pytest.fixture(scope="module")
def recorded(server_url, tmp_path_factory):
    file, name = tmp_path_factory.mktemp("rewritten") / "run.mcap", f"rewritten{os.getpid()}"
    arm, base, note = f"{name}arm", f"{name}base", f"{name}note"
    with reem.RedisInterface(server_url) as interface:
        space, store = reem.PublishSpace(interface), reem.KeyValueStore(interface)
        with reem.recording.Recorder(interface, [f"{name}*"], file, keyframe=0.2) as recorder:
            for number in range(24):
                before = recorder.status.messages
                space[arm] = {"speed": 100 + number, "q": [1, 2, number], "image": IMAGE + np.uint8(number)}
                space[base] = {"speed": -number, "at": [[number] * 70, "x" * number]}
                if number % 4 == 1:
                    del space[arm]["q"][0]
                    del space[base]["at"]
                if number % 6 == 2:
                    store[note] = {"text": str(number), "image": IMAGE}
                eventually(lambda before=before: recorder.status.messages > before + 2)
                recorder._core._sink._closed_at -= number % 3 == 0
            eventually(lambda: note in recorder._core.writer_thread._trees)  # what is only stored is found later
            del space[arm], space[base], store[note]
    return file, name


@pytest.fixture(scope="module")
def original(recorded):
    with open_log(recorded[0]) as log:
        assert (log.verify(), log.indexed) == (0, True)
        assert {it.role for it in log.channels()} >= {"update", "part", "delete", "keyframe"}
        instants = np.linspace(log.start - 0.01, log.end + 0.01, 9).tolist()
        return records(recorded[0]), instants, contents(log, instants)


def plain(it):
    """A value as one that compares by `==`, types included; arrays by their checksum."""
    if isinstance(it, np.ndarray):
        return it.dtype.str, it.shape, zlib.crc32(it.tobytes())
    if isinstance(it, dict):
        return {key: plain(value) for key, value in it.items()}
    return [plain(each) for each in it] if isinstance(it, list | tuple) else repr(it)


def contents(log, instants):
    found = {}
    for name in log.names():
        updates = log.updates(patterns=[name])
        paths = [path for path in log.paths() if path[0] == name]
        trees = [log.readable_at(name, instant) for instant in instants]
        told = [(it.time, it.path, it.value, it.deleted, it.published, it.sequence, it.kind) for it in updates]
        histories = [list(log[path].values()) for path in [(name,), (name, "speed"), (name, "q", 0), *paths]]
        counts = [(it.path, it.role, it.kind, it.messages, it.first, it.last) for it in log.channels()]
        mine = [it for it in counts if it[0].startswith(name)]
        found |= {(name, number): plain(it) for number, it in enumerate((told, trees, histories, sorted(mine)))}
    return found


def assert_equal(found, whole):
    assert not [each for each in found if found[each] != whole.get(each)]


def records(file):
    with file.open("rb") as stream:
        reader = mcap.reader.make_reader(stream)
        return list(reader.iter_messages(log_time_order=False)), list(reader.iter_metadata())


def rewritten(original, rng, chosen, *, metadata):
    """The records in another file, each optional part of the format drawn: its bytes."""
    messages, notes = original
    kinds, stream = mcap.writer.IndexType, io.BytesIO()
    options = ("repeat_channels", "repeat_schemas", "use_chunking", "use_statistics", "use_summary_offsets",
               "enable_crcs", "enable_data_crcs")  # fmt: skip
    writer = mcap.writer.Writer(
        stream,
        chunk_size=rng.choice([1, 3000, 50_000, 1 << 30]),
        compression=rng.choice(list(mcap.writer.CompressionType)),
        index_types=rng.choice([kinds.ALL, kinds.ALL, kinds(rng.randrange(32))]),
        **{option: rng.random() < 0.7 for option in options},
    )
    writer.start("", "another tool")
    wanted = [each for each in messages if chosen(each[1])]
    match rng.choice(["as it was", "reversed", "backwards", "shuffled", "by channel"]):
        case "reversed":
            size = rng.choice([1, 7, 50])
            blocks = [wanted[start : start + size] for start in range(0, len(wanted), size)]
            wanted = [each for block in reversed(blocks) for each in block]
        case "shuffled":
            rng.shuffle(wanted)
        case "by channel":
            wanted.sort(key=lambda each: each[1].topic)
        case "backwards":
            wanted.reverse()
    channels = list({channel.id: (schema, channel) for schema, channel, _ in wanted}.values())
    rng.shuffle(channels)
    schemas, numbers = {}, {}
    for schema, channel in channels:
        if schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        parts = channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
        numbers[channel.id] = writer.register_channel(*parts)
    early = rng.random() < 0.5
    for each in notes if metadata and early else ():
        writer.add_metadata(each.name, each.metadata)
    if rng.random() < 0.3:
        writer.add_attachment(1, 1, "map.png", "image/png", b"a picture")
    for _, channel, message in wanted:
        times = message.log_time, message.data, message.publish_time, message.sequence
        writer.add_message(numbers[channel.id], *times)
    for each in notes if metadata and not early else ():
        writer.add_metadata(each.name, each.metadata)
    writer.finish()
    return stream.getvalue()


def test_whatever_is_optional_it_is_read_equal(original, file):
    source, instants, whole = original
    for seed in range(sized(25, 60)):
        rng = random.Random(seed)
        file.write_bytes(rewritten(source, rng, lambda _: True, metadata=rng.random() < 0.7))
        try:
            with open_log(file) as log:
                assert log.indexed
                found = contents(log, instants)
                assert found.keys() == whole.keys()
                assert_equal(found, whole)
                assert (log.damaged, log.unreadable, log.verify()) == (0, 0, 0)
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise


def test_filtered_it_is_equal_where_nothing_is_missing_or_else_reported(original, recorded, file):
    """Whole keys may go; of a key whose deletions or keyframes went, the rest would tell something else."""
    source, instants, whole = original
    equal = reported = 0
    for seed in range(40):
        rng = random.Random(seed)
        topics = sorted({channel.topic for _, channel, _ in source[0]})
        keys = [f"{recorded[1]}{each}" for each in ("arm", "base", "note") if rng.random() < 0.6]
        left, metadata = set(topics), rng.random() < 0.7
        if rng.random() < 0.5:  # without any metadata, only that all topics of REEM's own are gone is noticed
            own = [topic for topic in topics if topic.startswith("/_reem/")]
            left -= set(rng.sample(topics, len(topics) // 2) if metadata else own)

        def chosen(channel, left=left, keys=keys):
            path = json.loads(channel.metadata.get("reem.path", "[null]"))
            return channel.topic in left and (path[0] in keys or path[0] is None)

        data = rewritten(source, rng, chosen, metadata=metadata)
        file.write_bytes(data)
        try:
            with open_log(file) as log:
                found = contents(log, instants)
                if log.damaged:
                    reported += 1
                    assert log.unreadable
                else:
                    equal += 1
                    assert_equal(found, whole)
        except DamagedRecording:  # nothing of REEM is left
            assert not metadata
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise
    assert min(equal, reported) > 5


def test_cut_at_every_record_it_is_equal_or_reported(original, file):
    source, instants, whole = original
    known = [it for (_, part), told in whole.items() if part == 0 for it in told]
    for seed in range(sized(2, 5)):
        rng = random.Random(seed)
        data = rewritten(source, rng, lambda _: True, metadata=rng.random() < 0.7)
        places = starts(data)
        places = rng.sample(places, min(len(places), 25)) + [rng.randrange(8, len(data)) for _ in range(10)]
        for place in places:
            tail = rng.choice([b"", bytes(rng.randrange(99)), b"\x06" + bytes(8)])  # a file system may leave zeros
            file.write_bytes(data[:place] + tail)
            try:
                with open_log(file) as log:
                    found = contents(log, instants)
                    unknown = {
                        it[0] for (_, part), told in found.items() if part == 0 for it in told if it not in known
                    }
                    # The tail may complete one message that has no checksum; what the tail has more is reported.
                    last, end = next(it for it in itertools.pairwise([*starts(data), len(data)]) if place < it[1])
                    unsure = data[last] == 5 or (data[last] == 6 and not any(data[last + 33 : last + 37]))
                    told = log.damaged or (place + len(tail) == end and not log.indexed)
                    assert len(unknown) <= bool(tail and unsure and told)
                    if log.indexed and not log.damaged:
                        assert found == whole
            except DamagedRecording:
                assert place < len(data)
            except BaseException as error:
                error.add_note(f"seed {seed}, cut at {place}")
                raise


NOTES = [
    [["a"], "stored", "numpy", ["k", ["x"]], 5, 5, "", "", None],
    [["a"], "stored", "numpy", ["k", None], 5, 5, "", "", None],
    [["a"], "stored", "list", [], 5, 5, "", "", [[1]]],
    [["a"], "stored", "list", ["k", "a"], 10**17, 5, "x", "y", [-1]],
    [["a", -1], "array", "<f8", [2**62], "AAAA"],
    [["a"], "array", "<f99", [1], None],
    [["a"], "int"],
    [[], "stored", "numpy", [0], 5, 5, "", "", None],
    5,
]
PLACES = [
    '["k"]',
    '["k","a"]',
    '["k","l",0]',
    '["k","l",-7]',
    '["k","l",99999999]',
    "[1]",
    "[]",
    '["k",true]',
    "x",
    '{"k":1}',
]


def made_up(rng):
    """A recording of which most channels and messages are made up: its bytes. Each third update is sound."""
    stream = io.BytesIO()
    writer = mcap.writer.Writer(stream)
    writer.start("", "")
    json_schema = writer.register_schema("reem.event", "jsonschema", b"{}")
    schemas = [
        json_schema,
        0,
        *[writer.register_schema(name, "protobuf", b"") for name in ("reem.NdArray", "reem.Blob")],
    ]
    whole = {"reem.path": '["k"]', "reem.role": "update", "reem.kind": "pub"}
    sound = writer.register_channel("/k", "json", json_schema, whole)
    for number in range(30):
        roles = ["update", "delete", "state", "keyframe", "gap", "skip", "part", "none"]
        metadata = {"reem.path": rng.choice(PLACES), "reem.role": rng.choice(roles)}
        metadata |= {"reem.kind": rng.choice(["pub", "stored", "kvs"])}
        metadata |= {
            key: rng.choice(["1", "list", "numpy"]) for key in ("reem.wrapped", "reem.ship") if rng.random() < 0.3
        }
        encoding = rng.choice(["json", "json", "protobuf", "cbor"])
        channel = writer.register_channel("/x", encoding, rng.choice(schemas), metadata)
        note = orjson.dumps(rng.sample(NOTES, rng.randint(1, 2))).decode()
        value = rng.choice(
            [{"l": [1, 2], "a": {"b": 1}}, [1], 5, None, {"a": 1, "$ship": note}, {"a": [1], "$ship": note}]
        )
        data = orjson.dumps(rng.choice([value, {"value": value, "key": "k"}]))
        deep = b'{"a":' * rng.choice([200, 500, 900]) + b"1"
        data = rng.choice([data, data, data, b"", b"\xff", data[:-1], deep + b"}" * deep.count(b"{")])
        writer.add_message(channel, 10**18 + number * 10**9, data, 5, number)
        if number % 3 == 0:
            writer.add_message(sound, 10**18 + number * 10**9 + 1000, orjson.dumps({"n": number}), 5, number)
    writer.add_metadata("reem", {"format": "1"})
    texts = ["[]", "5", '{"a":1}', "[5]", "[[1]]", '[["x",1,null,"y",[]]]', "x"]
    writer.add_metadata("reem.channels", {"channels": rng.choice(texts), "crc32": "0"})
    writer.finish()
    return stream.getvalue()


def test_made_up_messages_are_left_out(file, tmp_path):
    for seed in range(60):
        file.write_bytes(made_up(random.Random(seed)))
        try:
            with open_log(file) as log:
                read = [it.value for it in log.updates(patterns=["k"], partial=True)]
                assert all({"n": number} in read for number in range(0, 30, 3))
                log.gaps(), log.skipped(), log.verify()
                contents(log, [log.start, log.end])
                for instant in np.linspace(log.start, log.end, 7):
                    for ask in (log.tree_at, lambda it, log=log: log.value_at("k", it)):
                        with contextlib.suppress(BadData, MissingKey):
                            ask(instant)
                for kind in ("csv", "npz"):
                    export(log, kind, tmp_path / "out", overwrite=True)
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise


async def test_play_export_and_the_page_read_it_too(original, recorded, akvs, binterface, file, tmp_path):
    source = original[0]
    file.write_bytes(rewritten(source, random.Random(1), lambda _: True, metadata=False))
    with open_log(recorded[0]) as log:
        last = max(update.time for update in log.updates() if log.tree_at(update.time).keys() == set(log.names()))
    texts, states, pages = [], [], []
    for each in (recorded[0], file):
        with open_log(each) as log:
            target = tmp_path / "run.csv"
            assert export(log, "csv", target, overwrite=True).unreadable == 0
            texts.append(target.read_text())
            status = await Replayer(binterface, log, rate=1000, end=last).play()
            assert (status.refused, status.unreadable) == (0, 0)
            states.append([await akvs[name].read() for name in log.names()])
            for name in log.names():
                await akvs.pop(name, None)
        page = LogSource(each)
        try:
            value = await page.value((f"{recorded[1]}arm", "image"), last)
            pages.append((value, [await page.children((name,), 0, 10, last) for name in log.names()]))
        finally:
            await page.close()
    assert texts[0] == texts[1]
    assert plain(states[0]) == plain(states[1])
    assert plain(pages[0]) == plain(pages[1])


def test_records_that_mcap_does_not_know_are_skipped(original, recorded, file):
    """A program may add its own, with opcodes from 0x80 on; later versions of MCAP others."""
    data, (_, instants, whole) = recorded[0].read_bytes(), original
    summary = int.from_bytes(data[-28:-20], "little")
    for opcode in (0x10, 0x80, 0xFF):
        added = bytes([opcode]) + (5).to_bytes(8, "little") + b"hello"
        file.write_bytes(data[:8] + added + data[8:summary])
        with open_log(file) as log:
            assert (log.indexed, log.damaged) == (False, 0)
            assert contents(log, instants) == whole


def test_messages_outside_of_chunks(file):
    """What is before a cut is read."""
    stream = io.BytesIO()
    writer = mcap.writer.Writer(stream, use_chunking=False)
    writer.start("", "")
    metadata = {"reem.path": '["k"]', "reem.role": "update", "reem.kind": "pub"}
    channel = writer.register_channel("/k", "json", writer.register_schema("s", "jsonschema", b"{}"), metadata)
    writer.add_metadata("reem", {"format": "1"})
    for number in (1, 2, 3):
        writer.add_message(channel, number * 10**18, b'{"n": %d}' % number, 1)
    writer.finish()
    data = stream.getvalue()
    cut = data[: data.index(b'{"n": 3}') + 3]
    for content, numbers, damaged in ((data, [1, 2, 3], 0), (cut, [1, 2], 1)):
        file.write_bytes(content)
        with open_log(file) as log:
            assert [it.value["n"] for it in log.updates()] == numbers
            assert (log.verify(), log.verify()) == (damaged, damaged)


# --- what a container notices by itself -------------------------------------------------------------


def two_channels(path, **options):
    """A file with one message in each of two channels, both in one chunk unless the options say otherwise."""
    options = {"compression": mcap.writer.CompressionType.NONE, "enable_crcs": False, **options}
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, **options)
        writer.start("", "another tool")
        for number in (1, 2):
            channel = writer.register_channel(f"/topic{number}", "json", 0)
            writer.add_message(channel, number, b'{"value": %d}' % number, number)
        writer.finish()
    return path.read_bytes()


def test_a_channel_number_with_two_meanings_is_damage(file):
    data = bytearray(two_channels(file, use_chunking=False))
    places = starts(data)
    seconds = [[place for place in places if data[place] == opcode][1] for opcode in (4, 5)]  # channel and message
    end = next(place for place in places if data[place] == 15)  # without a summary it is read from record to record
    for number, damaged in ((2, 0), (1, 1)):
        for place in seconds:
            data[place + 9] = number
        file.write_bytes(data[:end])
        with contextlib.closing(Container(file)) as container:
            assert container.damaged == damaged


def test_fewer_messages_than_the_file_says_are_damage(file):
    data = two_channels(file, use_chunking=False, index_types=mcap.writer.IndexType.NONE, use_summary_offsets=False)
    places = starts(data)
    at = next(place for place in places if data[place] == 5)
    length = places[places.index(at) + 1] - at
    footer = places[-1] if data[places[-1]] == 2 else next(place for place in places if data[place] == 2)
    (summary,) = struct.unpack_from("<Q", data, footer + 9)
    for lost, damaged in ((b"", 0), (data[at : at + length], 1)):
        cut = data[:at] + data[at + len(lost) :]
        moved = bytearray(cut)
        struct.pack_into("<Q", moved, footer - len(lost) + 9, summary - len(lost))
        file.write_bytes(moved)
        with contextlib.closing(Container(file)) as container:
            assert container.damaged == damaged


def test_an_index_that_names_another_message_is_damage(file):
    two_channels(file)
    with contextlib.closing(Container(file)) as container:
        (info,) = container.every_chunk
        index = container.index(info)
        channel, time, offset = (int(each[0]) for each in (index.channels, index.times, index.offsets))
        assert container.message(Ref(time, info, offset, channel)).data == b'{"value": 1}'
        assert container.message(Ref(time, info, offset, channel + 1)) is None
        assert container.damaged == 1
