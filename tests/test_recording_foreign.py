"""Recordings of other programs: ROS 2, protobuf and JSON in MCAP files that REEM did not write."""

import base64
import io
import json
import struct
import tracemalloc

import lz4.frame
import mcap.reader
import mcap.writer
import numpy as np
import pytest
import zstandard
from clikit import invoked
from conftest import sized
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as RosWriter
from PIL import Image

from reem_async import KeyValueStore, PublishSpace
from reem_async.errors import BadData, BadType, BadValue
from reem_async.recording import DamagedRecording, Recorder, Replayer, open_log
from reem_async.ships import Jpeg
from reem_async.tools.browser.logsource import LogSource
from reem_async.tools.recording.cdr import compiled

BEGIN = 1_700_000_000_000_000_123
"""ns: what other programs write is not at whole microseconds."""
STAMP = "builtin_interfaces/Time stamp\nstring frame_id\n"
HEADER = f"===\nMSG: std_msgs/Header\n{STAMP}===\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
IMAGE = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
    "uint8[] data\n" + HEADER
)
STATE = (
    "# of joints\nstd_msgs/Header header\nint32 LEFT=1\nstring<=10[<=3] name # at most three\n"
    "float64[] position\nfloat32[3] force\nbool[] on\nuint8 mode 7\nPart[] parts\nDuration lasted\n"
    "===\nMSG: my_msgs/Part\nint64 id\nstring label \"x#y\"\nNothing nothing\n===\nMSG: my_msgs/Nothing\n"
    "===\nMSG: my_msgs/Duration\nint32 sec\nuint32 nanosec\n" + HEADER
)  # fmt: skip


def picture(height, width, channels=3):
    return np.arange(height * width * channels, dtype=np.uint8).reshape(height, width, channels)


def jpeg(array):
    file = io.BytesIO()
    Image.fromarray(array).save(file, "JPEG")
    return file.getvalue()


def state(number):
    return {
        "header": {"stamp": {"sec": number, "nanosec": 5}, "frame_id": "base"},
        "name": ["hip", "knee"],
        "position": [number + index / 7 for index in range(100)],
        "force": [1.5, -2.0, number],
        "on": [True, False],
        "mode": 3,
        "parts": [{"id": -number, "label": "größer", "nothing": {}}, {"id": 2**62, "label": "", "nothing": {}}],
        "lasted": {"sec": 1, "nanosec": 2},
    }


def image(array, encoding, **more):
    height, width = array.shape[:2]
    sizes = {"height": height, "width": width, "step": array.nbytes // height, "is_bigendian": 0}
    head = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "eye"}
    return {"header": head, **sizes, "encoding": encoding, "data": array.tobytes(), **more}


@pytest.fixture
def ros(tmp_path):
    """A file that mcap-ros2-support has written: ten messages each of a state, pictures, and a compressed picture."""
    path = tmp_path / "ros.mcap"
    with path.open("wb") as file:
        writer = RosWriter(file)
        states = writer.register_msgdef("my_msgs/msg/State", STATE)
        images = writer.register_msgdef("sensor_msgs/msg/Image", IMAGE)
        files = writer.register_msgdef("sensor_msgs/msg/CompressedImage", "string format\nuint8[] data")
        for number in range(10):
            at = BEGIN + number * 10_000_001
            times = {"log_time": at, "publish_time": at - 1000, "sequence": number}
            frame = picture(20, 24) + np.uint8(number)
            writer.write_message("/arm/state", states, state(number), **times)
            writer.write_message("/eye/bgr", images, image(frame, "bgr8"), **times)
            padded = np.zeros((20, 32), np.uint8)
            padded[:, :24] = frame[:, :, 0]
            writer.write_message("/eye/mono", images, image(padded, "mono8", width=24), **times)
            writer.write_message("/eye/jpeg", files, {"format": "jpeg", "data": jpeg(frame)}, **times)
            writer.write_message("/eye/odd", images, image(frame, "rgb8", height=900), **times)
        writer.finish()
    return path


def test_what_ros_has_written(ros):
    with open_log(ros) as log:
        assert log.foreign
        assert log.names() == ["arm/state", "eye/bgr", "eye/jpeg", "eye/mono", "eye/odd"]
        for number, update in enumerate(log.updates(patterns=["arm/*"])):
            assert update.path == ("arm/state",)
            assert (update.sequence, update.kind) == (number, "pub")
            # Times of floats are exact to a microsecond; what they name is there.
            for value in (update.value, log["arm/state"].at(update.time)):
                plain = json.loads(json.dumps(value, default=lambda it: it.tolist()))
                assert plain == state(number)
            assert value["position"].dtype == np.float64
            assert value["force"].dtype == np.float32
        assert number == 9
        times, values = log["arm/state.position"].history()
        assert values.shape == (10, 100)
        assert abs(times[0] - BEGIN / 1e9) < 1e-6
        published, _ = log["arm/state.mode"].history(clock="publisher")
        assert np.allclose(times - published, 1e-6, atol=5e-7)
        assert len(log["arm/state.mode"].history(log.start, log.start)[0]) == 1
        frame = picture(20, 24) + np.uint8(9)
        assert (log["eye/bgr.data"].at(log.end) == frame[:, :, ::-1]).all()
        assert (log["eye/mono.data"].at(log.end) == frame[:, :, 0]).all()
        assert log["eye/odd.data"].at(log.end).shape == (frame.nbytes,), "its height is not that of its bytes"
        assert log["eye/jpeg.data"].at(log.end).shape == (20, 24, 3)
        assert type(log.raw["eye/jpeg"].at(log.end)["data"]) is Jpeg
        handle = log.tree_at(log.start)["eye/bgr"]["data"]
        assert (handle.summary, handle.read()[0, 0].tolist()) == ("uint8[20,24,3]", [2, 1, 0])
        block = log.align(["arm/state.mode", "eye/bgr.data"], on="arm/state").read()
        assert (len(block), block["eye/bgr.data"].shape) == (10, (10, 20, 24, 3))


def test_several_messages_of_one_instant(tmp_path):
    """Each is what it is, though they have one channel and one log time."""
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = RosWriter(file)
        images = writer.register_msgdef("sensor_msgs/msg/Image", IMAGE)
        for number in range(3):
            writer.write_message("eye", images, image(picture(20, 24) + np.uint8(number), "rgb8"), BEGIN)
        writer.finish()
    with open_log(path) as log:
        assert [update.value["data"][0, 0, 0] for update in log.updates()] == [0, 1, 2]
        assert log["eye.data"].at(log.end)[0, 0, 0] == 2


def test_protobuf_and_json(tmp_path):
    pytest.importorskip("foxglove_schemas_protobuf", reason="needs a newer protobuf than the lowest that REEM takes")
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

    path, frame = tmp_path / "proto.mcap", picture(20, 24)
    with path.open("wb") as file, ProtobufWriter(file) as writer:
        field = PackedElementField(name="x", offset=0, type=PackedElementField.FLOAT32)
        cloud = PointCloud(timestamp=Timestamp(seconds=3), fields=[field], point_stride=4, data=b"\0\0\x80?" * 100)
        raw = RawImage(width=24, height=20, step=72, encoding="rgb8", data=frame.tobytes())
        for topic, message in {
            "/cloud": cloud,
            "/raw": raw,
            "/jpeg": CompressedImage(format="jpeg", data=jpeg(frame)),
        }.items():
            writer.write_message(topic, message, BEGIN, BEGIN - 1)
        other = writer._writer  # plain messages in the same file
        with_schema = other.register_channel("/j", "json", other.register_schema("x", "jsonschema", b"{}"))
        for number in range(3):
            other.add_message(with_schema, BEGIN + number, json.dumps({"a": [number, None], "b": "x"}).encode(), BEGIN)
        image = {"format": "jpeg", "data": base64.b64encode(jpeg(frame)).decode()}
        picture_schema = other.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        pictures = other.register_channel("/j/jpeg", "json", picture_schema)
        other.add_message(pictures, BEGIN, json.dumps(image).encode(), BEGIN)
        other.add_message(pictures, BEGIN + 1, json.dumps(image | {"data": "no picture"}).encode(), BEGIN)
        channel = other.register_channel("j", "json", 0)
        other.add_message(channel, BEGIN, b"[1, 2]", BEGIN)
        for encoding in ("ros1", "cbor"):
            other.add_message(other.register_channel(f"/{encoding}", encoding, 0), BEGIN, b"abc", BEGIN)
        idl = other.register_schema("a/msg/B", "ros2idl", b"struct B {};")
        other.add_message(other.register_channel("/idl", "cdr", idl), BEGIN, b"\0\1\0\0", BEGIN)
        other.add_message(other.register_channel("/a{b}", "json", 0), BEGIN, b"1", BEGIN)
    with open_log(path) as log:
        found = log["cloud"].at(log.end)
        assert found["timestamp"] == {"seconds": 3, "nanos": 0}
        assert found["fields"] == [{"name": "x", "offset": 0, "type": "FLOAT32"}]
        assert found["data"] == cloud.data
        assert "pose" not in found
        assert (log["raw.data"].at(log.end) == frame).all()
        assert log["jpeg.data"].at(log.end).shape == frame.shape
        assert log["/j.a"].history()[1] == [[0, None], [1, None], [2, None]]
        assert log["j"].at(log.end) == [1, 2]
        first, second = [update.value["data"] for update in log.updates(patterns=["j/jpeg"])]
        assert (first.shape, second) == (frame.shape, "no picture")
        reasons = {each.topic: each.skipped for each in log.channels() if each.skipped}
        assert reasons.keys() == {"/ros1", "/cbor", "/idl", "/a{b}"}
        assert "'ros2idl'" in reasons["/idl"]
    out = invoked("log", "info", str(path)).stdout
    assert "1 message of /cbor: encoding 'cbor'" in out
    assert "by another program: " in out
    with open_log(path) as log:
        assert log.undecoded == reasons


HOSTILE = {
    "cut off": lambda data: data[: len(data) // 2],
    "counts": lambda data: data[:28] + b"\xff" * (len(data) - 28),
    "no CDR": lambda data: b"\1" + data[1:],
    "longer": lambda data: data + b"\0" * 16,
    "empty": lambda data: b"",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_messages_that_are_not_what_their_schema_says(ros, tmp_path, name):
    """Each is named where it is asked for, and the others are read."""
    path = tmp_path / "bad.mcap"
    with open_log(ros) as log, path.open("wb") as file:
        good = next(iter(log._container.message(ref).data for ref, _ in log._past.of_role("update")))
        writer = mcap.writer.Writer(file)
        writer.start()
        channel = writer.register_channel(
            "/s", "cdr", writer.register_schema("my_msgs/msg/State", "ros2msg", STATE.encode())
        )
        for number, data in enumerate((good, HOSTILE[name](good), good)):
            writer.add_message(channel, BEGIN + number * 10**9, data, BEGIN)
        writer.finish()
    with open_log(path) as log:
        assert [round(update.time - log.start) for update in log.updates()] == [0, 2]
        assert log.unreadable == 1
        with pytest.raises(DamagedRecording, match="a message of /s is not cdr my_msgs/msg/State"):
            log["s"].at(log.start + 1)
        assert len(log["s.mode"].history()[0]) == 2
        assert log["s.mode"].at(log.end) == 3
        assert "not cdr" in str(log.value_at("", log.start + 1)["s"])
    assert invoked("log", "export", str(path), "-o", str(tmp_path / "x.csv")).returncode == 1
    checked = invoked("log", "info", path, "--verify")
    assert (checked.returncode, "1 message cannot be decoded as its schema says" in checked.stdout) == (1, True)


LACKING = FileDescriptorSet(file=[{"name": "a", "dependency": ["b"]}])


def schema_of(cls):
    from mcap_protobuf.schema import build_file_descriptor_set

    return build_file_descriptor_set(cls)


@pytest.mark.parametrize(
    ("encoding", "described", "name", "schema"),
    [
        ("cdr", "ros2msg", "a/msg/B", b"this is no definition!"),
        ("cdr", "ros2msg", "a/msg/B", b"\xff\xfe"),
        ("cdr", "ros2msg", "a/msg/B", b"Other other"),
        ("cdr", "ros2msg", "a/msg/B", b"B inner"),
        ("cdr", "ros2msg", "a/msg/B", b"wstring x"),
        ("cdr", "ros2msg", "", b"int8 x\n===\nno name"),
        ("protobuf", "protobuf", "x.Y", b"garbage \xff\x00"),
        ("protobuf", "protobuf", "x.Y", b""),
        ("protobuf", "protobuf", "x.Y", schema_of(Timestamp).SerializeToString()),
        ("protobuf", "protobuf", "", schema_of(Timestamp).SerializeToString()),
        ("protobuf", "protobuf", "x.Y", LACKING.SerializeToString()),
    ],
)  # fmt: skip
def test_schemas_that_are_none(tmp_path, encoding, described, name, schema):
    path = tmp_path / "bad.mcap"
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start()
        channel = writer.register_channel("/s", encoding, writer.register_schema(name, described, schema))
        writer.add_message(channel, BEGIN, b"\0\1\0\0\xff\xff\xff\xff", BEGIN)
        writer.finish()
    with open_log(path) as log:
        assert log.names() == []
        (only,) = log.channels()
        assert f"the {described} schema {name!r} cannot be used" in only.skipped
    assert only.skipped[:30] in invoked("log", "info", str(path)).stdout


@pytest.mark.parametrize(
    "text",
    ["uint8[] x", "float64[] x", "string x", "string[] x", "Part[] x\n===\nMSG: a/Part\nuint8[1000000000] y",
     "uint8[4000000000] x", "Part[4000000000] x\n===\nMSG: a/Part\n", "Part[] x\n===\nMSG: a/Part\n"],
)  # fmt: skip
def test_huge_counts_take_no_memory(text):
    read = compiled("a/msg/B", text)
    tracemalloc.start()
    try:
        for count in (0xFFFFFFFF, 0x7FFFFFFF, 1000):
            with pytest.raises(ValueError, match="should follow"):
                read(b"\0\1\0\0" + count.to_bytes(4, "little") + b"\1" * 100)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_small_chunk_that_unpacks_to_much_takes_no_memory(tmp_path, compression):
    """Of a chunk that names 1000 bytes and holds a gigabyte, no more is unpacked than it names."""
    content, path = bytes(sized(64, 1024) << 20), tmp_path / "bomb.mcap"
    packed = {"zstd": zstandard.ZstdCompressor().compress, "lz4": lz4.frame.compress}[compression](content)
    name = struct.pack("<I", len(compression)) + compression.encode()
    body = struct.pack("<QQQI", 1, 1, 1000, 0) + name + struct.pack("<Q", len(packed)) + packed
    header = struct.pack("<BQII", 1, 8, 0, 0)
    path.write_bytes(b"\x89MCAP0\r\n" + header + struct.pack("<BQ", 6, len(body)) + body)
    tracemalloc.start()
    try:
        with pytest.raises(DamagedRecording, match="without a channel: what it holds is damaged"):
            open_log(path)
        assert tracemalloc.get_traced_memory()[1] < 4 * len(packed) + (1 << 20)
    finally:
        tracemalloc.stop()


def test_big_endian_and_types_without_a_definition():
    read = compiled("a/msg/B", "builtin_interfaces/Duration d\nint16[] x\ntime t\nHeader h\n" + HEADER)
    found = plain(read(bytes(4) + struct.pack(">iIIhhiIiII2s", -5, 6, 2, -300, 7, 8, 9, 1, 2, 2, b"k\0")))
    assert found == {
        "d": {"sec": -5, "nanosec": 6},
        "x": [-300, 7],
        "t": {"sec": 8, "nanosec": 9},
        "h": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "k"},
    }
    with pytest.raises(ValueError, match="not CDR: it begins with 00 07"):  # the second version of CDR
        read(b"\0\7\0\0" + bytes(50))


def test_messages_of_more_values_than_memory_holds():
    read = compiled("a/msg/B", "Part[] x\n===\nMSG: a/Part\n")
    with pytest.raises(ValueError, match="it holds over 4000000 values"):
        read(b"\0\1\0\0" + (5_000_000).to_bytes(4, "little") + bytes(5_000_000))


NUMBERS = {
    "bool": st.booleans(),
    "byte": st.integers(0, 255),
    "int8": st.integers(-128, 127),
    "uint16": st.integers(0, 2**16 - 1),
    "int32": st.integers(-(2**31), 2**31 - 1),
    "uint64": st.integers(0, 2**64 - 1),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
    "string": st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=5),
}


@st.composite
def definitions(draw, place="T"):
    """A message definition without nested types' texts, those, and a value of it."""
    lines, texts, value = [], [], {}
    for number in range(draw(st.integers(0, 4))):
        name, form = f"f{number}", draw(st.sampled_from(["", "[]", "[<=3]", "[2]"]))
        if len(place) < 3 and draw(st.booleans()):
            kind = f"{place}{number}"
            inner, inner_texts, one = draw(definitions(kind))
            texts += [f"===\nMSG: a/{kind}\n{inner}", *inner_texts]
            items = st.just(one)
        else:
            kind = draw(st.sampled_from(sorted(NUMBERS)))
            items = NUMBERS[kind]
        least, most = (2, 2) if form == "[2]" else (0, 3)
        value[name] = draw(st.lists(items, min_size=least, max_size=most) if form else items)
        lines.append(f"{kind}{form} {name}")
    return "\n".join(lines), texts, value


def plain(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, bytes):
        return list(value)
    if isinstance(value, list):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    return value


@settings(max_examples=sized(60, 2000), deadline=None)
@given(definitions())
def test_cdr_equals_the_reference_implementation(given):
    text, texts, value = given
    text = "\n".join([text, *texts])
    file = io.BytesIO()
    writer = RosWriter(file)
    schema = writer.register_msgdef("a/msg/B", text)
    writer.write_message("/x", schema, value, BEGIN)
    data = writer._encoders[schema.id](value)
    theirs = DecoderFactory().decoder_for("cdr", schema)(data)
    assert plain(compiled("a/msg/B", text)(data)) == plain(theirs) == plain(value)
    for end in range(len(data)):
        with pytest.raises((ValueError, struct.error)):
            compiled("a/msg/B", text)(data[:end])


async def test_played(ros, ainterface, key):
    """What is published is what the recording has: plain dicts."""
    prefix = key()
    with open_log(ros) as log:
        names = {name: f"{prefix}{name}" for name in log.names()}
        status = await Replayer(ainterface, log, rate=100, remap=names).play()
        assert (status.unreadable, status.refused) == (0, 0)
        stored = await KeyValueStore(ainterface)[names["arm/state"]].read()
        assert plain(stored) == state(9)
        frame = await KeyValueStore(ainterface)[names["eye/bgr"]]["data"].read()
        assert (frame == log["eye/bgr.data"].at(log.end)).all()


def split_up(ros, tmp_path):
    """Return the messages of a file in two others, as a recorder that splits would have written them."""
    files = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    with ros.open("rb") as source:
        rows = list(mcap.reader.make_reader(source).iter_messages())
    for file, part in zip(files, (rows[:23], rows[23:]), strict=True):
        with file.open("wb") as stream:
            writer = mcap.writer.Writer(stream, chunk_size=5000)
            writer.start()
            numbers = {}
            # In another order, so channels and schemas have other numbers in each file.
            for schema, channel, _ in sorted(part, key=lambda row: row[1].topic, reverse=file == files[1]):
                if channel.topic not in numbers:
                    about = writer.register_schema(schema.name, schema.encoding, schema.data)
                    numbers[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, about)
            for _, channel, it in part:
                writer.add_message(numbers[channel.topic], it.log_time, it.data, it.publish_time, it.sequence)
            writer.finish()
    return files


def rows_of(log):
    return [(it.time, it.published, it.sequence, it.shown, plain(it.value)) for it in log.updates()]


def test_several_files_as_one(ros, tmp_path):
    one, two = split_up(ros, tmp_path)
    with open_log(ros) as whole, open_log([two, one]) as log:
        assert log.files == [one, two]
        assert rows_of(log) == rows_of(whole)
        assert (log.start, log.end, log.names(), log.damaged) == (whole.start, whole.end, whole.names(), 0)
        for instant in np.linspace(log.start, log.end, 30):
            assert plain(log.value_at("", instant)) == plain(whole.value_at("", instant))
        assert [plain(it) for it in log["arm/state.position"].history()] == [
            plain(it) for it in whole["arm/state.position"].history()
        ]
        summaries = [[(it.topic, it.messages, it.first, it.last) for it in each.channels()] for each in (log, whole)]
        assert summaries[0] == summaries[1]
        assert log.verify() == 0
    out = invoked("log", "export", one, "--with", two, "eye/odd", "-o", tmp_path / "x.csv")
    assert "10 rows" in out.stdout
    damaged = bytearray(two.read_bytes())
    damaged[len(damaged) // 3] ^= 0xFF
    two.write_bytes(damaged)
    with open_log([one, two]) as log:
        assert log.verify() == log.damaged == 1
        assert 0 < len(list(log.updates())) < 50
        assert plain(log["arm/state"].at(log.start)) == state(0)
    with pytest.raises(BadValue, match=r"one\.mcap are one file"):
        open_log([one, one])
    with pytest.raises(BadData, match="not an MCAP file"):
        open_log([one, __file__])
    (pointer := tmp_path / "pointer.mcap").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(BadData, match="Git LFS"):
        open_log(pointer)
    for nothing in ([], 7, b"x"):
        with pytest.raises(BadType):
            open_log(nothing)
    out = invoked("log", "info", one, two, "--verify")
    assert (out.returncode, "in 5 channels" in out.stdout) == (1, True)


async def test_files_of_reem_and_of_others(ros, ainterface, key, tmp_path):
    """A recording of REEM beside one of ROS, though a key and a topic have one name."""
    name, file = key("arm"), tmp_path / "run.mcap"
    async with Recorder(ainterface, [f"{name}*"], file):
        space = PublishSpace(ainterface)
        await space[name].write({"q": [1.5], "image": picture(20, 24)})
        await space[name]["q"].write([2.5])
    with open_log([file, ros]) as log, open_log(file) as own:
        assert log.damaged == 0
        assert log.names() == sorted([name, "arm/state", "eye/bgr", "eye/jpeg", "eye/mono", "eye/odd"])
        assert [row for row in rows_of(log) if row[3].startswith(name)] == rows_of(own)
        assert plain(log[name].at(log.end)) == plain(own[name].at(own.end))
        assert plain(log["arm/state"].at(log.end)) == state(9)
        assert (log.metadata["host"], log.metadata["profile"]) == (own.metadata["host"], "ros2")
        assert {each.role for each in log.channels()} > {"update", "keyframe"}


def test_times_of_centuries_ahead(tmp_path):
    """They are counted as damaged, and the others are read; a publisher's clock may say anything."""
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start()
        channel = writer.register_channel("/x", "json", 0)
        for log_time, published in ((BEGIN, 2**64 - 1), (BEGIN + 10**9, 5), (2**64 - 2, 6)):
            writer.add_message(channel, log_time, b"1", published)
        writer.finish()
    with open_log(path) as log:
        assert log.damaged == 1
        assert log["x"].history(clock="publisher")[0].tolist() == [(2**64 - 1) / 1e9, 5e-9]
        assert [update.value for update in log.updates()] == [1, 1]
        assert log.tree_at(log.end) == {"x": 1}


async def test_on_the_page(ros, tmp_path):
    """Several files, and a topic that is left out."""
    path = tmp_path / "more.mcap"
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start()
        writer.add_message(writer.register_channel("/old", "ros1", 0), BEGIN, b"", BEGIN)
        writer.add_message(writer.register_channel("/a.b", "json", 0), BEGIN, b'{"n": 7}', BEGIN)
        writer.finish()
    source = LogSource([ros, path])
    try:
        await source.start()
        await source.opened()
        status = source.status()
        assert (source.title, status.note) == ("ros.mcap and 1 more", "1 topic is left out, see reem log info")
        page = await source.children((), 0, 100, None)
        assert [node.path[0] for node in page.nodes] == [
            "a.b",
            "arm/state",
            "eye/bgr",
            "eye/jpeg",
            "eye/mono",
            "eye/odd",
        ]
        (node,) = await source.nodes([("eye/bgr", "data")], None)
        assert node.text == "uint8[20,24,3]"
        assert (await source.value(("eye/bgr", "data"), None)).value.shape == (20, 24, 3)
        assert type((await source.value(("eye/jpeg", "data"), None)).value) is Jpeg
        series = await source.series(("arm/state", "force"), status.start, status.end)
        assert [len(line) for line in series.lines] == [10, 10, 10]
        assert repr(str(ros)) in source.snippets(("arm/state",), None)["recording"]
    finally:
        await source.close()
