"""The parts that talk to nobody: paths, placeholders, floats, packing, parsing, trees."""

import math
import struct

import hiredis
import numpy as np
import orjson
import pytest
import redis.exceptions
from hypothesis import given
from hypothesis import strategies as st

from reem_async.errors import BadData, BadKey, BadValue, TooDeep
from reem_async.plan import placeholders, trees
from reem_async.plan.documents import encode
from reem_async.plan.floats import _as_parsed, exact_text, may_lose
from reem_async.plan.keys import keys_of
from reem_async.plan.paths import below, may_hold, parse, parse_shown, parse_suffix, show, suffix, to_jsonpath
from reem_async.plan.reads import read
from reem_async.plan.replies import decoded
from reem_async.plan.shapes import ShapeCache
from reem_async.ships import NumpyShip
from reem_async.ships.registry import Ships, default_ships
from reem_async.transport.protocol import MORE, CommandRecorder, LargeReader, SmallReader, pack

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
PATHS = st.lists(st.one_of(TEXT, st.integers(0, 99)), max_size=5).map(tuple)
FLOATS = st.floats(allow_nan=False, allow_infinity=False)


NOT_FINITE = [
    struct.unpack("<d", bits)[0]
    for exponent in (b"\xf0\x7f", b"\xf0\xff", b"\xf8\x7f", b"\xf8\xff", b"\xff\x7f", b"\xff\xff")
    for bits in (bytes(6) + exponent, b"\x01" + bytes(5) + exponent, b"\xff" * 6 + exponent)
]


def nested(levels, beside, ahead):
    value = 1
    for level in range(levels):
        if level % 2:
            value = [*beside, value] if ahead else [value, *beside]
        else:
            value = {"a": beside, "b": value} if ahead else {"a": value, "b": beside}
    return value


def depth(value):
    if not isinstance(value, dict | list):
        return 0
    return 1 + max(map(depth, value.values() if isinstance(value, dict) else value), default=0)


@pytest.mark.parametrize("ahead", [True, False])
@pytest.mark.parametrize(
    "beside",
    [(), ("}" * 300,), ("]" * 300,), ("{" * 300,), ("[" * 300,), ({"x": []},) * 3, ("}", {}, "[")],
    ids=["nothing", "}", "]", "{", "[", "containers", "all of it"],
)
def test_the_depth_is_seen_whatever_is_beside(beside, ahead):
    """Whether the deepest place comes early or late in the text; brackets in strings are none."""
    shapes = [nested(levels, list(beside), ahead) for levels in range(90, 102)]
    assert {100, 101} <= {depth(shape) for shape in shapes}
    for shape in shapes:
        if depth(shape) > 100:
            with pytest.raises(TooDeep):
                encode(shape, ("foo",), lambda _: None, str)
        else:
            assert orjson.loads(encode(shape, ("foo",), lambda _: None, str).text) == shape


@pytest.mark.parametrize("value", NOT_FINITE, ids=lambda value: struct.pack("<d", value).hex())
@pytest.mark.parametrize(
    "around",
    [
        lambda value: value,
        lambda value: [value, value],
        lambda value: {"full": 1, "a": [1, 2.5, {"b": (value,)}]},
        lambda value: [1.0] * 300 + [value],
        lambda value: {"u" * 200: value},
    ],
    ids=["alone", "twice", "inside", "last of many", "under a long name"],
)
def test_what_is_not_finite_is_seen_wherever_it_is(value, around):
    with pytest.raises(BadValue):
        encode(around(value), ("foo",), lambda _: None, str)


def test_none_is_stored_as_null():
    for value in (None, [None], {"N": None, "u": [1, (None, "null")]}, {"null": 1, "u": "N"}):
        assert orjson.loads(encode(value, ("foo",), lambda _: None, str).text) == orjson.loads(orjson.dumps(value))


@given(PATHS)
def test_the_text_of_a_path_leads_back_to_it(path):
    """Whatever the keys are made of; what follows a tilde is not part of it."""
    assert parse_suffix(suffix(path)) == path
    assert parse_suffix(suffix(path) + "~1f") == path


@given(TEXT.filter(bool), PATHS)
def test_the_text_that_a_path_is_shown_by_leads_back_to_it(top, path):
    """Be it one that the server's paths cannot address."""
    assert parse_shown(show((top, *path))) == (top, *path)


def test_paths_read_as_people_write_them():
    assert show(("foo", "bar", 0, "a.b", "x")) == 'foo.bar[0]["a.b"].x'
    assert parse("foo.bar[2].x") == ("foo", "bar", 2, "x")
    assert parse(".a.b") == ("a", "b")
    assert parse(".") == () == parse("")
    assert to_jsonpath(("a", 0, 'say "x"')) == '$["a"][0][\'say "x"\']'
    assert parse(show(("C:\\a.b", "x"))) == ("C:\\a.b", "x")
    for text in ("a..b", "a.", "a[b]", 'a["b', "a[1", 'a["\\\\"]', f"a[{'1' * 5000}]"):
        with pytest.raises(BadKey):
            parse(text)


def test_foo_is_not_a_part_of_foobar():
    """Paths are compared element by element; a list's items may have moved since they were named."""
    assert below(("foo", "bar"), ("foo",))
    assert not below(("foobar",), ("foo",))
    assert may_hold(("a", 0), ("a", 3, "b"))
    assert not may_hold(("a", "0"), ("a", 0))


@given(TEXT.filter(lambda it: it not in placeholders.INLINE_LABELS and it), TEXT, st.integers(0, 10**17), TEXT)
def test_a_placeholder_says_what_was_put_into_it(label, name, size, summary):
    """Labels and keys may have blanks in them."""
    it = placeholders.Placeholder(label, name, size, summary)
    assert placeholders.parse(str(it)) == it


@given(st.one_of(TEXT, TEXT.map(lambda it: placeholders.MARK + it)))
def test_a_text_that_looks_like_a_placeholder_stays_a_text(text):
    holder = [placeholders.inline_text(text)]
    assert placeholders.find(holder, "k") == []
    assert holder == [text]


@pytest.mark.parametrize(
    "text", ["$ship ", "$ship x", "$ship x y", "$ship x y -1", "$ship float zz", "$ship a b " + "9" * 30]
)
def test_a_broken_placeholder_is_bad_data(text):
    with pytest.raises(BadData):
        placeholders.find([text], "k")


@given(FLOATS)
def test_exact_text_is_parsed_to_the_very_float(value):
    """By RedisJSON's procedure and by a correctly rounding parser; where there is no text, it says so."""
    text = exact_text(value)
    if text is None:
        assert placeholders.parse(placeholders.inline_float(value)) == value
        return
    assert struct.pack("d", float(text)) == struct.pack("d", value)
    digits, _, exponent = text.decode().lstrip("-").partition("e")
    whole, _, fraction = digits.partition(".")
    assert _as_parsed(int(whole + fraction), int(exponent or 0) - len(fraction)) == abs(value)


def test_few_floats_have_no_text():
    generator = np.random.default_rng(5)
    without = sum(exact_text(float(value)) is None for value in generator.uniform(-1, 1, 20_000))
    assert without < 100


@given(FLOATS)
def test_a_float_that_could_be_changed_is_never_overlooked(value):
    """The quick search may cry wolf, but not the reverse."""
    text = orjson.dumps([value])
    if not may_lose(text):
        digits, _, exponent = text[1:-1].decode().lstrip("-").partition("e")
        whole, _, fraction = digits.partition(".")
        assert _as_parsed(int(whole + fraction), int(exponent or 0) - len(fraction)) == abs(value)


WORDS = st.one_of(st.binary(max_size=40), TEXT, st.integers(), st.sampled_from([8191, 8192, 9000, 40_000]).map(bytes))


@given(st.lists(st.lists(WORDS, min_size=1, max_size=4).map(tuple), min_size=1, max_size=4))
def test_packing_gives_what_hiredis_gives(commands):
    """With large buffers as pieces of their own, and with an argument in several pieces."""
    expected = b"".join(hiredis.pack_command(command) for command in commands)
    assert b"".join(bytes(piece) for piece in pack(commands)) == expected
    views = [tuple(memoryview(word) if type(word) is bytes else word for word in command) for command in commands]
    assert b"".join(bytes(piece) for piece in pack(views)) == expected
    split = [tuple((word[:3], word[3:]) if type(word) is bytes else word for word in command) for command in commands]
    assert b"".join(bytes(piece) for piece in pack(split)) == expected


def test_a_buffer_that_is_not_flat_bytes_is_never_sent():
    """Its len() is not its size, and the rest would be read as commands."""
    for array in (np.zeros((20, 9000), np.uint8), np.zeros(9000)):
        with pytest.raises(TypeError):
            pack([("SET", "k", memoryview(array))])


def encoded(value):
    if value is None:
        return b"_\r\n"
    if isinstance(value, bool):
        return b"#t\r\n" if value else b"#f\r\n"
    if isinstance(value, int):
        return b":%d\r\n" % value
    if isinstance(value, float):
        return b",%r\r\n" % value
    if isinstance(value, bytes):
        return b"$%d\r\n%b\r\n" % (len(value), value)
    if isinstance(value, dict):
        return b"%%%d\r\n" % len(value) + b"".join(encoded(key) + encoded(item) for key, item in value.items())
    return b"*%d\r\n" % len(value) + b"".join(map(encoded, value))


REPLIES = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(-(2**63), 2**63 - 1), st.binary(max_size=50), FLOATS,
        st.sampled_from([32_767, 32_768, 50_000, 140_000]).map(lambda size: b"\r\n" * (size // 2) + b"x" * (size % 2)),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.binary(max_size=5), inner, max_size=3)),
    max_leaves=6,
)  # fmt: skip


def received(reader, stream, sizes):
    """Return what a reader makes of a stream that arrives in slices."""
    replies, position, turn = [], 0, 0
    while True:
        reply = reader.gets()
        if reply is not MORE:
            replies.append(reply)
        elif position == len(stream):
            return replies
        else:
            target = reader.target()
            count = min(sizes[turn % len(sizes)], len(target), len(stream) - position)
            target[:count] = stream[position : position + count]
            reader.received(count)
            position, turn = position + count, turn + 1


@given(st.lists(REPLIES, min_size=1, max_size=4), st.lists(st.integers(1, 70_000), min_size=1, max_size=5))
def test_both_parsers_read_the_same_however_the_bytes_arrive(replies, sizes):
    stream = b"".join(map(encoded, replies))
    if len(stream) > 2000:
        sizes = [max(size, 300) for size in sizes]
    assert received(SmallReader(), stream, sizes) == replies
    assert received(LargeReader(), stream, sizes) == replies


def test_the_large_parser_knows_errors_pushes_and_nonsense():
    for reader in (SmallReader(), LargeReader()):
        stream = b"+OK\r\n-WRONGTYPE no\r\n>3\r\n$7\r\nmessage\r\n$1\r\nc\r\n$1\r\nx\r\n$-1\r\n*-1\r\n"
        ok, error, push, nothing, null = received(reader, stream, [7])
        assert (ok, nothing, null) == (b"OK", None, None)
        assert isinstance(error, redis.exceptions.ResponseError)
        assert type(push) is hiredis.PushNotification
        assert push == [b"message", b"c", b"x"]
        with pytest.raises(redis.exceptions.InvalidResponse):
            received(reader, b"!?\r\n", [7])


def test_an_array_is_an_npy_file(tmp_path):
    array = np.zeros(3, [("a", "<i4"), ("b", ">f8", (2,)), ("zeit/µs", "<M8[us]")])
    file = tmp_path / "array.npy"
    file.write_bytes(b"".join(NumpyShip().pack(array)))
    assert np.load(file).dtype == array.dtype
    np.save(file, array)
    assert NumpyShip().unpack(file.read_bytes()).dtype == array.dtype


def test_a_tree_is_replaced_as_the_server_would_and_never_changed():
    """A missing parent, a scalar on the way and an index out of range refuse; old holders see the old tree."""
    tree = {"a": {"b": 1}, "l": [1, {"x": 2}]}
    before = trees.copied(tree)
    assert trees.replaced(tree, ("a", "c"), 3) == {"a": {"b": 1, "c": 3}, "l": [1, {"x": 2}]}
    assert trees.replaced(tree, ("l", -1, "x"), 5)["l"] == [1, {"x": 5}]
    assert trees.removed(tree, ("l", 0))["l"] == [{"x": 2}]
    assert trees.removed(tree, ("q",)) is tree
    assert trees.removed(tree, ()) is trees.MISSING
    for path in (("q", "r"), ("a", "b", "c"), ("l", 2), ("l", "x"), ("a", 0)):
        with pytest.raises(trees.CannotApply):
            trees.replaced(tree, path, 0)
    assert tree == before
    assert math.isclose(trees.get(tree, ("l", 1, "x")), 2)


def test_a_document_and_its_arrays_are_asked_for_in_one_transaction():
    """A server that executes short pipelines at once would not show the difference."""
    keys, ships = keys_of("k"), Ships(default_ships(), CommandRecorder)
    plan = read(keys, (), ships, ShapeCache())
    assert not plan.atomic
    plan = decoded(plan, [orjson.dumps([str(placeholders.Placeholder("bytes", ".a", 5))])])
    assert (len(plan.commands), plan.atomic) == (2, True)
