"""What cannot be stored is refused before anything is sent, by the right error, which names the path."""

from __future__ import annotations

import array
import collections
import dataclasses
import datetime
import decimal
import enum
import fractions
import pathlib
import uuid

import numpy as np
import pytest
from conftest import assert_no_orphans, assert_same, commands_run, nothing_sent

import reem
from reem_async.errors import (
    BadInput,
    BadKey,
    BadType,
    BadValue,
    InterfaceClosed,
    Overflow,
    PathRefused,
    ReemError,
    TooDeep,
    WrongKind,
)


class Colour(enum.Enum):
    RED = "red"


@dataclasses.dataclass
class Pose:
    x: float = 0.0


def nest(levels, inner=1):
    for _ in range(levels):
        inner = [inner]
    return inner


def circle():
    around = {"a": [1]}
    around["a"].append(around)
    return around


VALUES = {
    "nan": (BadValue, float("nan")),
    "inf": (BadValue, float("inf")),
    "minus inf": (BadValue, float("-inf")),
    "numpy nan": (BadValue, np.float64("nan")),
    "float32 inf": (BadValue, np.float32("inf")),
    "int above": (BadValue, 2**64),
    "int below": (BadValue, -(2**63) - 1),
    "int far above": (BadValue, 10**40),
    "lone surrogate": (BadValue, "a\ud800b"),
    "set": (BadType, {1, 2}),
    "frozenset": (BadType, frozenset([1])),
    "complex": (BadType, 1 + 2j),
    "decimal": (BadType, decimal.Decimal("1.5")),
    "fraction": (BadType, fractions.Fraction(1, 3)),
    "object": (BadType, object()),
    "function": (BadType, len),
    "class": (BadType, dict),
    "generator": (BadType, (n for n in [1])),
    "datetime": (BadType, datetime.datetime(2019, 5, 23)),
    "date": (BadType, datetime.date(2019, 5, 23)),
    "time": (BadType, datetime.time(1, 2)),
    "uuid": (BadType, uuid.UUID(int=5)),
    "enum": (BadType, Colour.RED),
    "dataclass": (BadType, Pose()),
    "array.array": (BadType, array.array("d", [1])),
    "object array": (BadType, np.array([1, "a", None], object)),
    "0-d object array": (BadType, np.array(None, object)),
    "struct with object": (BadType, np.zeros(2, [("n", "i4"), ("o", "O")])),
    "nested struct with object": (BadType, np.zeros(2, [("n", [("o", "O")])])),
    "masked array": (BadType, np.ma.masked_array([1, 2], [True, False])),
    "masked constant": (BadType, np.ma.masked),
    "key int": (BadKey, {1: "one"}),
    "key None": (BadKey, {None: 1}),
    "key bool": (BadKey, {True: 1}),
    "key float": (BadKey, {1.5: 1}),
    "key tuple": (BadKey, {("a", "b"): 1}),
    "key bytes": (BadKey, {b"a": 1}),
    "key enum": (BadKey, {Colour.RED: 1}),
    "key that would collide": (BadKey, {1: "one", "1": "eins"}),
    "key lone surrogate": (BadInput, {"\udfff": 1}),
    "nan beside an array": (BadValue, {"a": np.arange(2), "n": float("nan")}),
    "nan beside None": (BadValue, {"a": None, "n": [None, float("nan")], "s": "N"}),
    "minus infinity beside None": (BadValue, [None, -float("inf")]),
    "set beside an array": (BadType, [np.arange(2), {1}]),
    "101 levels": (TooDeep, nest(101)),
    "2000 levels": (TooDeep, nest(2000)),
    "100000 levels": (TooDeep, nest(100_000)),
    "circle": (TooDeep, circle()),
}
if np.dtype(np.longdouble) != np.dtype(np.float64):
    VALUES["longdouble scalar"] = (BadType, np.longdouble(1))
    VALUES["longdouble"] = (BadType, np.zeros(2, np.longdouble))
    VALUES["clongdouble"] = (BadType, np.zeros(2, np.clongdouble))
    VALUES["struct with longdouble"] = (BadType, np.zeros(2, [("n", "i4"), ("x", np.longdouble)]))
if hasattr(np.dtypes, "StringDType"):
    VALUES["StringDType"] = (BadType, np.array(["a", "b"], np.dtypes.StringDType()))


@pytest.fixture
def stored(front, key):
    document = {"outer": {"inner": [0, 1, 2]}, "n": 1, "image": np.arange(4)}
    front.write([key()], document)
    yield document
    assert_same(front.read([key()]), document)


# --- values ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("row", VALUES)
def test_a_value_that_cannot_be_stored_is_refused_wherever_it_is(front, key, raw, stored, row):
    """As the root, deep inside a document, and at a path; the class is also the builtin one."""
    error, value = VALUES[row]
    with nothing_sent(raw):
        with pytest.raises(error) as caught:
            front.write([key()], value)
        assert key() in str(caught.value)
        with pytest.raises(error) as deep:
            front.write([key(), "outer"], {"neighbour": 1, "left": [0, {"right": value}]})
        with pytest.raises(error):
            front.append([key(), "outer", "inner"], value)
        with pytest.raises(error):
            front.extend([key(), "outer", "inner"], [1, value])
        with pytest.raises(error):
            front.set(key() + ".outer", value)
    assert isinstance(caught.value, ReemError)
    assert isinstance(caught.value, (ValueError, TypeError))
    assert len(str(caught.value)) < 1000, "a long value must be shortened"
    if "levels" not in row:
        text = str(deep.value)
        assert -1 not in [text.find(part) for part in (key(), "outer", "left", "1", "right")], text
        assert "neighbour" not in text, "only the path is named, not the neighbours"


@pytest.mark.parametrize("row", ["array.array", "longdouble", "longdouble scalar", "clongdouble"])
def test_the_line_to_write_for_other_numbers_can_be_stored(front, key, row):
    """Each message ends with it; `x` is the value."""
    if row not in VALUES:
        pytest.skip("long double is float64 on this machine")
    with pytest.raises(BadType) as caught:
        front.write([key()], VALUES[row][1])
    remedies = {
        "np.asarray(x)": np.asarray,
        "float(x)": float,
        "np.asarray(x, np.float64)": lambda x: np.asarray(x, np.float64),
        "np.asarray(x, np.complex128)": lambda x: np.asarray(x, np.complex128),
    }
    front.write([key()], remedies[str(caught.value).partition("use ")[2]](VALUES[row][1]))


def test_a_circle_is_called_circular(front, key):
    with pytest.raises(TooDeep, match=r"(?i)circular|itself"):
        front.write([key()], circle())


def test_depth_counts_from_the_root_of_the_document(front, key, raw):
    """What could not be written whole cannot be built step by step either."""
    named = {}
    for _ in range(60):
        named = {"d": named}
    front.write([key()], named)
    with nothing_sent(raw), pytest.raises(TooDeep):
        front.write([key(), *["d"] * 60, "e"], nest(60))
    assert_same(front.read([key()]), named)


# --- what the server holds -------------------------------------------------------------------------


@pytest.mark.parametrize("value", [1, np.arange(3), {"a": [np.arange(3), b"x"]}], ids=["plain", "array", "mixed"])
def test_a_write_that_has_no_parent_is_refused_and_leaves_nothing(front, key, raw, stored, value):
    """A missing parent, a scalar or an array as parent, an index out of range; no arrays are left behind."""
    before = set(raw.scan_iter(match=f"*{key()}*"))
    for path, named in [
        ([key("absent"), "a", "b"], key("absent")),
        ([key("absent"), 0], key("absent")),
        ([key(), "gone", "a"], "gone"),
        ([key(), "gone", "a", "b"], "gone"),
        ([key(), "n", "a"], "n"),
        ([key(), "n", 0], "n"),
        ([key(), "image", "a"], "image"),
        ([key(), "image", 0], "image"),
        ([key(), "outer", "inner", 3], "inner"),
        ([key(), "outer", "inner", "a"], "inner"),
        ([key(), "outer", 0], "outer"),
    ]:
        with pytest.raises(PathRefused) as caught:
            front.write(path, value)
        assert isinstance(caught.value, KeyError)
        assert path[0] in str(caught.value)
        assert named in str(caught.value)
    assert set(raw.scan_iter(match=f"*{key()}*")) == before
    assert_no_orphans(raw, key())


@pytest.mark.parametrize("kind", ["string", "list", "hash"])
def test_a_key_of_a_foreign_type_is_named_and_left_alone(front, key, raw, kind):
    """Whoever put it there did not expect it to be overwritten."""
    put = {
        "string": lambda: raw.set(key(), "x"),
        "list": lambda: raw.rpush(key(), "x"),
        "hash": lambda: raw.hset(key(), "x", 1),
    }
    put[kind]()
    writes = [lambda: front.write([key()], 1), lambda: front.write([key()], np.arange(3))]
    for call in (lambda: front.read([key()]), lambda: front.write([key(), "a"], 1), *writes):
        with pytest.raises(WrongKind, match=kind) as caught:
            call()
        assert key() in str(caught.value)
    assert raw.type(key()) == kind
    assert set(raw.scan_iter(match=f"*{key()}*")) == {key()}


@pytest.mark.parametrize(
    ("start", "method", "operand"),
    [
        (2**63 - 1, "increment", 1),
        (2**63 - 5, "increment", 2**62),
        (-(2**63), "increment", -1),
        (2**62, "multiply", 2),
        (2**62, "multiply", 4),
        (3_037_000_500, "multiply", 3_037_000_500),
        (2**64 - 1, "increment", 1),
        (1e308, "multiply", 100.0),
    ],
)
def test_arithmetic_out_of_range_is_an_overflow_and_changes_nothing(front, key, start, method, operand):
    """The server itself would wrap around or turn to float."""
    front.write([key()], {"n": start})
    with pytest.raises(Overflow) as caught:
        getattr(front, method)([key(), "n"], operand)
    assert isinstance(caught.value, OverflowError)
    assert key() in str(caught.value)
    assert_same(front.read([key()]), {"n": start})


def test_the_server_never_calculates_near_the_end_of_its_range(front, key, raw):
    """It would wrap around, and everybody could read that until it is put right."""
    path = [key(), "n"]
    for start, step in ((2**63 - 3, 2), (-(2**63), 1), (2**62, 1), (0, 2**62)):
        front.write([key()], {"n": start})
        before = commands_run(raw).get("json.numincrby", 0)
        front.increment(path, step)
        with pytest.raises(Overflow):
            front.increment(path, 2**63 - 1 if start >= 0 else -(2**63))
        assert commands_run(raw).get("json.numincrby", 0) == before
        assert front.read(path) == start + step
    front.write([key()], {"n": 0})
    for _ in range(5):
        front.increment(path, 2)
    assert commands_run(raw).get("json.numincrby", 0) == before + 4
    assert front.read(path) == 10


@pytest.mark.parametrize(("method", "operand"), [("increment", 5), ("multiply", 10)])
def test_a_number_that_others_made_large_meanwhile_is_put_back(front, open_front, key, method, operand):
    """The interface last saw a small one, so it has the server calculate."""
    path, other = [key(), "n"], open_front()
    for large in (2**63 - 1, 2**64 - 1):
        front.write([key()], {"n": 1})
        for _ in range(2):
            front.multiply(path, 2)
        other.write(path, large)
        with pytest.raises(Overflow, match=str(large)):
            getattr(front, method)(path, operand)
        assert_same(other.read(path), large)


# --- the interface ---------------------------------------------------------------------------------


def test_a_closed_interface_says_so(open_front, key):
    front = open_front()
    front.write([key()], 1)
    for _ in range(2):
        front.wait(front.interface.close())
        for call in (lambda: front.read([key()]), lambda: front.write([key()], 2)):
            with pytest.raises(InterfaceClosed):
                call()


def test_a_wrong_option_is_a_type_error():
    with pytest.raises(TypeError):
        reem.RedisInterface("localhost", no_such_option=1).initialize()


def test_housekeeping_is_all_that_is_not_counted(front, key, raw):
    before = commands_run(raw)
    front.write([key()], 1)
    assert commands_run(raw) != before


@dataclasses.dataclass
class Pose:
    x: float = 1.0


def of_library(module, name):
    """An object of a class of that name, as a library has it, or one derived from it."""
    return type("Derived", (type(name, (), {"__module__": module}),), {"__module__": "mine"})()


def typed(name):
    return f"or use kvs[...].of({name}).write(value), which .of({name}).read() reads back"


@pytest.mark.parametrize(
    ("value", "instead"),
    [
        (Pose(), f"use dataclasses.asdict(value); {typed('Pose')}"),
        (pathlib.Path("/x"), f"use str(value); {typed('pathlib.Path')}"),
        (uuid.uuid4(), f"use str(value); {typed('UUID')}"),
        (memoryview(b"abc"), "use bytes(value), or np.asarray(value)"),
        (range(3), "use list(value)"),
        (collections.UserDict(a=1), "use dict(value)"),
        (of_library("PIL.Image", "Image"), "use np.asarray(value)"),
        (of_library("pandas.core.frame", "DataFrame"), "use value.to_dict('list'), or value.to_numpy()"),
        (of_library("polars.dataframe.frame", "DataFrame"), "use value.to_dict(as_series=False), or value.to_numpy()"),
        (of_library("torch", "Tensor"), "use value.numpy(force=True)"),
        (Pose, "convert it to plain values, or write a ship for this type (see SpecialDatatypeShip)"),
    ],
    ids=lambda it: type(it).__name__,
)
def test_a_refusal_says_the_line_to_write(kvs, key, value, instead):
    with pytest.raises(BadType) as caught:
        kvs[key()] = {"a": [value]}
    assert str(caught.value).endswith(f"cannot be stored; {instead}")
