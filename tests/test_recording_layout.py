"""What a recording is made of, without a server: JSON with notes, schemas, protobuf messages, times, key files."""

import importlib
import struct
import weakref

import google.protobuf.descriptor_pb2 as descriptors
import google.protobuf.message_factory as factory
import hypothesis.strategies as st
import numpy as np
import orjson
import pytest
from conftest import assert_same
from google.protobuf.descriptor_pool import DescriptorPool
from hypothesis import example, given, settings
from test_values import mixed

from reem_async.errors import BadData, BadInput, BadValue
from reem_async.plan.paths import parse_pattern
from reem_async.plan.trees import MISSING
from reem_async.ships.registry import Ships, default_ships
from reem_async.tools.recording.layout import decode, encode, from_json, schema_bytes, to_json
from reem_async.tools.recording.log import stacked
from reem_async.tools.recording.sample import read_key_file
from reem_async.tools.recording.sink import OPEN, fits, schema_of
from reem_async.tools.recording.stored import Content, Reference, extract, planted, pruned, resolve
from reem_async.tools.recording.times import AFTER, STEP, nanoseconds, seconds
from reem_async.transport.protocol import CommandRecorder

SHIPS = Ships(default_ships(), CommandRecorder)
TIME = 1_700_000_000_123_456_000


def message_class(schema):
    """The class that a viewer makes of what the file has: the schema's descriptors."""
    pool = DescriptorPool()
    for file in descriptors.FileDescriptorSet.FromString(schema_bytes(schema)).file:
        pool.Add(file)
    return factory.GetMessageClass(pool.FindMessageTypeByName(schema))


RawImage, CompressedImage = message_class("foxglove.RawImage"), message_class("foxglove.CompressedImage")


def there_and_back(value):
    """A value through messages, as the writer and the reader do it."""
    kept = {}

    def store(label, path, data):
        encoded = encode(label, data, "some.path", TIME)
        kept[path] = label, encoded
        return Reference(label, path, TIME, 0)

    document = to_json(extract(value, ("top",), store))
    orjson.loads(document.text)

    def load(stored):
        label, encoded = kept[stored.path]
        return decode(encoded.schema, encoded.channels, label, b"".join(encoded.pieces), SHIPS)

    return resolve(from_json(document.text, wrapped=document.wrapped), load)


@settings(max_examples=100, deadline=None)
@given(value=mixed)
def test_any_tree_comes_back_equal(value):
    assert_same(there_and_back(value), value)


@pytest.mark.parametrize(
    "value",
    [
        {"$ship": 1, "a": np.arange(3)},
        {"value": 1},
        {"a": {"$ship": "[]", "b": 2**60}},
        [1.5, "$ship", {"$ship": None}],
        2**64 - 1,
        -(2**63),
        [float(number) for number in range(65)],
        list(range(2**53, 2**53 + 65)),
        [2**64 - 1] * 65,
        [True] * 65,
        [1, 2.5] * 40,
        -0.0,
        {},
        [],
        None,
        "",
        np.array(-0.0),
        np.frombuffer(struct.pack("<2Q", 0x7FF8000000000123, 0xFFF0000000000000)),
        np.array([2**53 + 1, -(2**63)]),
        np.array([2**64 - 1], np.uint64),
        np.zeros((0, 3), ">f4"),
        np.array([1.5, -2], ">f2"),
        np.array("2024-01-01T00:00", "M8[s]"),
        b"",
        b"\xff\xd8\xff\xe0 not really",
    ],
)
def test_what_json_and_viewers_cannot_hold(value):
    assert_same(there_and_back(value), value)


def test_viewers_see_numbers_where_they_are():
    tree = {
        "q": np.array([0.5, np.nan]),
        "n": 2**53 + 1,
        "image": Reference("numpy", ("a", "b"), 5, 12, "", "uint8", (3, 4)),
    }
    shown = to_json(tree).tree
    assert shown["q"] == [0.5, None]
    assert shown["n"] == "9007199254740993"
    assert shown["image"] == {"$ship": "numpy", "topic": "/a/b", "size": 12, "dtype": "uint8", "shape": (3, 4)}
    assert type(shown["$ship"]) is str  # numbers in notes would be plotted
    assert to_json(3.5).tree == {"value": 3.5}


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b"5",
        b'{"$ship": 5}',
        b'{"$ship": "5"}',
        b'{"$ship": "[[[\\"a\\"], \\"int\\"]]"}',
        b'{"a": "x", "$ship": "[[[\\"a\\"], \\"int\\"]]"}',
        b'{"a": [1], "$ship": "[[[\\"a\\"], \\"array\\", \\"O\\", [1], null]]"}',
        b'{"a": [1], "$ship": "[[[\\"a\\"], \\"array\\", \\"<f8\\", [2], null]]"}',
        b'{"a": [1], "$ship": "[[[\\"a\\"], \\"array\\", \\"<f8\\", [1], \\"AAAA\\"]]"}',
        b'{"a": [1], "$ship": "[[[\\"a\\"], \\"array\\", \\"<f8\\", [-9223372036854775808], null]]"}',
        b'{"a": 1, "$ship": "[[[\\"a\\"], \\"stored\\", 1, 2, 3]]"}',
        b'{"a": 1, "$ship": "[[[\\"a\\"], \\"what\\"]]"}',
    ],
)
def test_what_reem_did_not_write_is_refused(text):
    with pytest.raises(BadData):
        from_json(text, wrapped=False)


PICTURES = {
    "mono8": np.arange(20 * 30, dtype=np.uint8).reshape(20, 30),
    "rgb8": np.arange(20 * 30 * 3, dtype=np.uint16).astype(np.uint8).reshape(20, 30, 3),
    "rgba8": np.arange(20 * 30 * 4, dtype=np.uint16).astype(np.uint8).reshape(20, 30, 4),
    "mono16": np.arange(20 * 30, dtype="<u2").reshape(20, 30),
    "32FC1": np.linspace(0, 1, 20 * 30, dtype="<f4").reshape(20, 30),
}


@pytest.mark.parametrize("encoding", PICTURES)
def test_pictures_are_foxglove_s(encoding):
    picture = PICTURES[encoding]
    encoded = encode("numpy", picture, "cam.image", TIME)
    assert encoded.schema == "foxglove.RawImage"
    image = RawImage.FromString(b"".join(encoded.pieces))
    assert (image.height, image.width, image.encoding, image.frame_id) == (20, 30, encoding, "cam.image")
    assert image.step * image.height == len(image.data) == picture.nbytes
    assert image.timestamp.seconds * 10**9 + image.timestamp.nanos == TIME
    assert image.data == picture.tobytes()
    assert_same(decode(encoded.schema, encoded.channels, "numpy", b"".join(encoded.pieces), SHIPS), picture)


@pytest.mark.parametrize(
    "array",
    [PICTURES["mono8"][..., None], PICTURES["rgb8"][::-1, 4:28], np.asfortranarray(PICTURES["32FC1"])],
)
def test_pictures_of_other_layouts_keep_their_shape(array):
    encoded = encode("numpy", array, "cam", TIME)
    assert encoded.schema == "foxglove.RawImage"
    assert_same(decode(encoded.schema, encoded.channels, "numpy", b"".join(encoded.pieces), SHIPS), array)


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (b"\xff\xd8\xff\xe0abc", "jpeg"),
        (b"\x89PNG\r\n\x1a\nabc", "png"),
    ],
)
def test_compressed_pictures_are_foxglove_s(data, name):
    encoded = encode("bytes", data, "cam", TIME)
    image = CompressedImage.FromString(b"".join(encoded.pieces))
    assert (encoded.schema, image.format, image.data) == ("foxglove.CompressedImage", name, data)


@pytest.mark.parametrize("name", ["RawImage", "CompressedImage"])
def test_the_schemas_are_those_that_foxglove_publishes(name):
    pytest.importorskip("google.protobuf", "5.29.6", "Foxglove's package does not say so, and needs that release")
    module = importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")
    published = descriptors.FileDescriptorProto()
    module.DESCRIPTOR.CopyToProto(published)
    assert descriptors.FileDescriptorSet.FromString(schema_bytes(f"foxglove.{name}")).file[-1] == published


def test_other_arrays_carry_their_schema():
    encoded = encode("numpy", np.array([1.0, 2.0, 6.0]), "a", TIME)
    message = message_class("reem.NdArray").FromString(b"".join(encoded.pieces))
    assert (list(message.shape), message.dtype, message.min, message.max, message.mean) == ([3], "float64", 1, 6, 3)
    assert message.npy.startswith(b"\x93NUMPY")


@pytest.mark.parametrize(
    ("schema", "data"),
    [
        ("foxglove.RawImage", b"\xff"),
        ("foxglove.RawImage", RawImage(width=3, height=3, encoding="mono8", data=b"12").SerializeToString()),
        ("foxglove.RawImage", RawImage(width=1, height=1, encoding="yuyv", data=b"12").SerializeToString()),
        ("reem.NdArray", b""),
        ("reem.NdArray", b"\x22\x03abc"),
        ("sensor_msgs/Image", b""),
    ],
)
def test_damaged_messages_are_refused(schema, data):
    with pytest.raises(BadData):
        decode(schema, "", "numpy", data, SHIPS)


def test_a_value_of_an_unknown_ship_names_it():
    encoded = encode("pose", b"abc", "a", TIME)
    with pytest.raises(BadData, match="'pose'"):
        decode(encoded.schema, "", "pose", b"".join(encoded.pieces), SHIPS)


def test_a_schema_fits_until_a_type_changes():
    known = schema_of({"a": 1, "b": {"c": "x"}, "l": [1.5, 2]})
    for fitting in ({"a": 2.5}, {"b": {"c": "", "d": 1}, "new": 1}, {"a": None}, {"l": []}, {"l": [1]}, {}):
        assert fits(schema_of(fitting), known)
        assert fits(schema_of(fitting), OPEN)
    for other in ({"a": "1"}, {"a": True}, {"b": 1}, {"l": ["x"]}, {"l": {}}, {"b": {"c": 1}}):
        assert not fits(schema_of(other), known)
        assert fits(schema_of(other), OPEN)


def test_a_schema_is_one_that_viewers_take():
    schema = schema_of({"n": 1, "s": "", "o": {"x": None}, "l": [{"y": True}], "mixed": [1, ""]})
    assert schema["type"] == "object"

    def check(node):
        assert node["type"] in ("object", "array", "number", "string", "boolean")
        if node["type"] == "object":
            assert node["additionalProperties"] is True
            for child in node["properties"].values():
                check(child)
        elif "items" in node:
            check(node["items"])

    check(schema)
    assert schema["properties"]["l"]["items"]["properties"]["y"] == {"type": "boolean"}
    assert "mixed" not in schema["properties"]


@given(st.integers(0, 4_000_000_000_000_000 // STEP * 1000))
@example(1_431_320_107_923_054)  # in 2060, where a product with a million is rounded up
def test_seconds_tell_log_times_apart(number):
    for ns in (number * STEP, number * STEP + AFTER):
        assert nanoseconds(seconds(ns)) == ns
        assert nanoseconds(np.datetime64(ns, "ns")) == ns


@pytest.mark.parametrize("instant", ["now", True, None, float("nan"), 1.8e18, [1]])
def test_what_is_no_instant(instant):
    with pytest.raises(BadInput):
        nanoseconds(instant)


@pytest.mark.parametrize(
    ("values", "dtype", "shape"),
    [
        ([1, 2], "int64", (2,)),
        ([1, 2.5], "float64", (2,)),
        ([True, False], "bool", (2,)),
        ([2**64 - 1, 0], "uint64", (2,)),
        ([[1, 2], [3, 4]], "int64", (2, 2)),
        ([[1, 2], [3.5, 4]], "float64", (2, 2)),
        ([np.zeros((2, 3), np.uint8)] * 4, "uint8", (4, 2, 3)),
        ([], "float64", (0,)),
    ],
)
def test_histories_are_stacked(values, dtype, shape):
    array = stacked(values)
    assert (str(array.dtype), array.shape) == (dtype, shape)


@pytest.mark.parametrize(
    "values",
    [
        ["a"],
        [1, None],
        [1, "a"],
        [[1], [1, 2]],
        [{}],
        [[1, "a"]],
        [2**64 - 1, -1],
        [2**60, 0.5],
        [True, 1],
        [np.zeros(2), np.zeros(3)],
    ],
)
def test_what_cannot_be_stacked_exactly_stays_a_list(values):
    assert stacked(values) is values


def test_only_what_patterns_name_is_kept():
    tree = {"left": {"battery": 5, "pose": 1}, "right": {"battery": 6}, "n": 1}
    patterns = [parse_pattern("robot.*.battery")]
    assert pruned(tree, ("robot",), patterns) == {"left": {"battery": 5}, "right": {"battery": 6}}
    assert pruned(5, ("robot", "left", "battery"), patterns) == 5
    assert pruned(tree, ("robot",), [parse_pattern("robot")]) is tree
    assert pruned({"x": 1}, ("robot",), patterns) == {}  # an update of robot.left needs it
    assert pruned({"left": 1}, ("robot",), patterns) == {}
    assert pruned(1, ("robot",), patterns) is MISSING
    assert pruned(tree, ("arm",), patterns) is MISSING
    dicts_stay = parse_pattern("a.b"), parse_pattern("a.*.c")  # only a dict on the way stays empty
    assert pruned({"x": 1, "y": {"z": 1}}, ("a",), dicts_stay) == {"y": {}}
    long, image = (Reference(label, ("robot", "left"), 0, 9) for label in ("list", "numpy"))
    assert pruned({"left": long, "right": image}, ("robot",), patterns) == {"left": long}  # as a short list


def test_samples_make_their_parents():
    assert planted(MISSING, ("a", "b"), 1) == {"a": {"b": 1}}
    assert planted({"a": {"c": 2}}, ("a", "b"), 1) == {"a": {"c": 2, "b": 1}}
    assert planted({"a": 5}, ("a", 2, "b"), 1) == {"a": [None, None, {"b": 1}]}
    assert planted([1, 2], (0,), 9) == [9, 2]


def test_a_key_file(tmp_path):
    file = tmp_path / "keys.csv"
    file.write_text('path, seconds\n\n# a comment\nfoo.bar, 0.1\nfoo.tiles[2],2 # slow\n"x.y z" , 1e-3\n')
    assert [(each.path, each.seconds) for each in read_key_file(file)] == [
        (("foo", "bar"), 0.1),
        (("foo", "tiles", 2), 2.0),
        (("x", "y z"), 0.001),
    ]


@pytest.mark.parametrize(
    "line", ["foo", "foo, 0", "foo, -1", "foo, nan", "foo, x", "a..b, 1", "foo[-1], 1", "a, 1, 2", ""]
)
def test_a_key_file_that_cannot_be(tmp_path, line):
    file = tmp_path / "keys.csv"
    file.write_text(f"good, 1\n{line}\n" if line else "\n")
    with pytest.raises(BadValue, match="line 2" if line else "names no path"):
        read_key_file(file)
    with pytest.raises(BadValue, match="cannot be read"):
        read_key_file(tmp_path / "none.csv")


def test_of_a_value_written_only_the_digest_is_kept_once_there_is_one():
    """By these the recorder tells later whether a value has changed."""
    body = np.array([1.0, 2.0])
    same, gone = Content(b"<f8[2]", memoryview(body).cast("B")), weakref.ref(body)
    del body
    assert Content(b"<f8[2]", np.array([1.0, 2.0]).tobytes()).digest() == same.digest()
    for head, items in ((b"<f8[2]", [1.0, -2.0]), (b"<i8[2]", [1.0, 2.0])):
        assert Content(head, np.array(items).tobytes()).digest() != same.digest()
    assert gone() is None
