"""What is read is what was written: every value REEM promises to hold, through both fronts."""

import time
from collections import OrderedDict, defaultdict

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from conftest import EXAMPLES, assert_no_orphans, assert_same
from hypothesis import HealthCheck, given, settings

BATCH = 10
"""Documents per round trip."""


def tried(examples):
    """How often a property is tried; slow examples and fixtures that serve all examples are fine here."""
    fine = ("function_scoped_fixture", "too_slow", "data_too_large", "large_base_example")
    checks = [getattr(HealthCheck, name) for name in fine]
    return settings(max_examples=max(20, examples), deadline=None, suppress_health_check=checks)


scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=20)
    | st.sampled_from(["$ship ", "$ship numpy", "$", "\\", "\"'", "\x00", "\u2028", "é"])
)
documents = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)
simple_dtypes = hnp.scalar_dtypes() | hnp.unicode_string_dtypes(max_len=5) | hnp.byte_string_dtypes(max_len=5)
dtypes = simple_dtypes | hnp.nested_dtypes(simple_dtypes, max_leaves=4, max_itemsize=400)
shapes = hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4)
arrays = dtypes.flatmap(lambda dtype: hnp.arrays(dtype, shapes))
mixed = st.recursive(
    scalars | st.binary(max_size=20) | arrays,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=5,
)


@tried(EXAMPLES // BATCH // 2)
@given(batch=st.lists(documents, min_size=BATCH, max_size=BATCH))
def test_any_json_document_comes_back_equal(front, key, batch):
    """Half of EXAMPLES documents per front, ten in one write."""
    front.write([key("docs")], batch)
    assert_same(front.read([key("docs")]), batch)


@tried(EXAMPLES // 5 // 4 // 2)
@given(batch=st.lists(arrays, min_size=4, max_size=4))
def test_any_array_comes_back_equal(front, key, batch):
    """A tenth of EXAMPLES arrays per front, of generated dtypes and shapes, four in one write."""
    document = {"in a list": batch[:2], "named": {"a": batch[2]}, "b": batch[3]}
    front.write([key("arrays")], document)
    assert_same(front.read([key("arrays")]), document)


@tried(EXAMPLES // 50)
@given(value=mixed)
def test_documents_with_arrays_anywhere_come_back_equal(front, key, raw, value):
    """Each write replaces the one before, and leaves none of its arrays behind."""
    front.write([key("mixed")], value)
    assert_same(front.read([key("mixed")]), value)


def test_a_great_many_random_floats_come_back_bit_equal(front, key):
    """Uniform, like time stamps, widened from float32, and of random bits: 40 per example."""
    seed = time.time_ns()
    print("seed", seed)
    rng = np.random.default_rng(seed)
    count = 5000
    for _ in range(max(1, EXAMPLES // 2000)):
        bits = rng.integers(0, 2**64, count, dtype=np.uint64).view(np.float64)
        numbers = {
            "uniform": rng.uniform(-1, 1, count).tolist(),
            "stamps": (1.7e9 + rng.random(count) * 1e8).tolist(),
            "widened": rng.standard_normal(count).astype(np.float32).astype(float).tolist(),
            "bits": bits[np.isfinite(bits)].tolist(),
        }
        front.write([key("floats")], numbers)
        assert_same(front.read([key("floats")]), numbers)


FLOATS = [
    *(0.9374604873776271, -0.9374604873776271, 0.0, -0.0, 5e-324, -5e-324, 2.2250738585072014e-308),
    *(2.225073858507201e-308, 1.7976931348623157e308, -1.7976931348623157e308, 1e16, 1e22, 1e23),
    *(123456789012345678.0, 9007199254740993.0, 0.1, 0.2, 0.1 + 0.2, 100.0, 1.0, 1 / 3, 1700000000.1234567),
    *(3.141592653589793, 9223372036854775808.0, 1.8446744073709552e19),
]


def test_floats_keep_every_bit(front, key):
    """Also those that RedisJSON's own parser would change, wherever they are."""
    numbers = [*FLOATS, time.time(), time.time() / 3]
    front.write([key("deep")], {"a": {}})
    for value in (*numbers, dict(zip(map(str, numbers), numbers, strict=True)), [numbers, [numbers]]):
        for path in ([key()], [key("deep"), "a", "b"]):
            front.write(path, value)
            assert_same(front.read(path), value)


def test_floats_keep_every_bit_beside_arrays_and_through_append(front, key):
    """A document with a ship and an appended number are no exceptions."""
    number = 0.9374604873776271
    front.write([key()], {"n": number, "a": np.arange(3), "l": []})
    front.append([key(), "l"], number)
    front.extend([key(), "l"], [number, -number])
    assert_same(front.read([key()]), {"n": number, "a": np.arange(3), "l": [number, number, -number]})


def test_subclasses_of_dict_str_and_int_are_accepted(front, key):
    word = type("Word", (str,), {})("w")
    number = type("Number", (int,), {})(7)
    front.write([key()], OrderedDict(a=defaultdict(int, b=number), c=word))
    assert_same(front.read([key()]), {"a": {"b": 7}, "c": "w"})


POINT = np.dtype([("x", "<f8"), ("label", "<U3"), ("cov", ">f4", (2, 2)), ("inner", [("t", "<M8[ns]"), ("ok", "?")])])
BASE = np.arange(24, dtype=np.int32).reshape(4, 6)
ARRAYS = {
    "float image": np.linspace(0, 1, 60).reshape(5, 4, 3),
    "0-d": np.array(3.5),
    "empty": np.empty((0, 3), np.uint8),
    "empty 1-d": np.array([]),
    "empty struct": np.zeros((2, 0), POINT),
    "not contiguous": BASE[::2, 1::2],
    "negative strides": BASE[::-1, ::-2],
    "transposed": BASE.T,
    "F-order": np.asfortranarray(BASE),
    "broadcast": np.broadcast_to(np.arange(3), (4, 3)),
    "read-only": np.frombuffer(b"abcdefgh", "<u2"),
    "big-endian int": BASE.astype(">i4"),
    "big-endian float": np.linspace(0, 1, 5).astype(">f8"),
    "float16": np.array([1.5, np.nan, -0.0], np.float16),
    "complex": np.array([1 + 2j, np.nan * 1j], np.complex64),
    "bool": np.array([[True], [False]]),
    "unicode": np.array(["é", "", "🤖x"]),
    "big-endian unicode": np.array(["é", "ab"]).astype(">U2"),
    "bytes": np.array([b"a", b"bc\x00d"]),
    "void": np.frombuffer(bytes(range(24)), "V8"),
    "datetime": np.array(["2019-05-23T10:00:00.5", "NaT"], "M8[ms]"),
    "datetime big-endian": np.array(["2019-05-23"], ">M8[D]"),
    "datetime step": np.array([5, 7], "M8[25s]"),
    "timedelta": np.array([1, -1, "NaT"], "m8[us]"),
    "struct": np.array([(1.5, "abc", [[1, 2], [3, 4]], ("2020-01-01", True))], POINT),
    "struct of 0-d": np.zeros((), POINT),
    "struct aligned": np.ones(3, np.dtype([("a", "i1"), ("b", "f8")], align=True)),
    "struct with odd names": np.ones(2, np.dtype([("a b", "i1"), ("é.\"'\\", "f4"), (("a title", "t"), "u2")])),
    "nan payload": np.array([0x7FF8_DEAD_BEEF_0001, 0xFFF0_0000_0000_0000], np.uint64).view(np.float64),
    "max uint64": np.array([2**64 - 1, 0], np.uint64),
    "commands in pixels": np.frombuffer(b"\r\n*3\r\n$3\r\nSET\r\n$1\r\nx\r\n$1\r\ny\r\n" * 3, np.uint8).reshape(3, -1),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_keep_dtype_shape_and_every_bit(front, key, raw, name):
    """As the root, in a dict, in a list, and read alone by their path."""
    array = ARRAYS[name]
    front.write([key()], array)
    assert_same(front.read([key()]), array)
    document = {"a": {"array": array, "n": 1}, "l": [array, {"deep": [array]}]}
    front.write([key()], document)
    assert_same(front.read([key()]), document)
    assert_same(front.read([key(), "a", "array"]), array)
    assert_same(front.read([key(), "l", 1, "deep", 0]), array)
    assert_same(front.read([key(), "l"]), document["l"])
    assert_no_orphans(raw, key())


def test_arrays_read_are_read_only(front, key):
    front.write([key()], np.arange(3))
    with pytest.raises(ValueError, match="read-only"):
        front.read([key()])[0] = 5


def test_a_write_takes_the_array_as_it_is_at_the_call(front, key):
    """Changing it after the write has returned changes nothing that is stored."""
    image = np.zeros((200, 300, 3))
    front.write([key()], {"image": image})
    image += 1
    assert front.read([key(), "image"]).max() == 0


def test_strings_that_look_like_placeholders_are_strings(front, key, raw):
    """Also an exact copy of a placeholder that the server holds."""
    front.write([key()], {"a": np.arange(3)})
    copied = raw.execute_command("JSON.GET", key())
    placeholder = copied[copied.index("$ship ") : copied.rindex('"')].replace('\\"', '"').replace("\\\\", "\\")
    words = ["$ship ", "$ship", "$ship x", "$ship $ship y", "$$ship ", "$", placeholder]
    document = {"a": np.arange(3), "words": words, "d": {word: word for word in ["$ship ", "$ship k"]}}
    front.write([key()], document)
    assert_same(front.read([key()]), document)
    for word in words:
        front.write([key(), "word"], word)
        assert_same(front.read([key(), "word"]), word)
    front.write([key("root")], placeholder)
    assert_same(front.read([key("root")]), placeholder)


def test_a_document_of_a_hundred_levels_is_held(front, key):
    nested, named = 1, 1
    for _ in range(100):
        nested, named = [nested], {"d": named}
    for value in (nested, named):
        front.write([key()], value)
        assert_same(front.read([key()]), value)


def test_the_document_is_readable_in_redis_cli(front, key, raw):
    front.write([key()], {"stamp": 12, "image": np.zeros((4, 5, 3), np.uint8), "blob": b"1234567"})
    text = raw.execute_command("JSON.GET", key())
    assert '"stamp":12' in text
    assert "uint8" in text or "u1" in text
    for told in ("$ship ", "4", "5", "3", "60"):
        assert told in text
    assert "{" + key() + "}.image" in {*raw.scan_iter(match=f"*{key()}*")}


def test_bytes_that_look_like_the_protocol_are_read_wherever_a_buffer_ends(front, key):
    """A buffer that begins with them was taken for the beginning of a reply that is too large."""
    for number in range(28):
        value = {"b": b"$99999999999\r\n" * 4000, "pad": "x" * (100_000 + number * 997)}
        front.write([key()], value)
        for _ in range(2):
            assert front.read([key()]) == value
