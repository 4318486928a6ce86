"""What is not there: what reads as None, what raises, how to ask; and the names by which old programs catch it."""

import contextlib

import numpy as np
import pytest
import redis
from conftest import assert_no_orphans, assert_same, eventually

import reem
import reem_async
from reem_async.errors import BadType, MissingKey, NotFinite, Overflow, PathRefused, TooDeep, WrongType


def test_a_program_that_must_know_asks(front, key, raw):
    """`key in store`, `await store.contains(key)`: None that is stored counts, what others stored does not."""
    assert not front.contains(key())
    front.write([key()], None)
    assert front.contains(key())
    assert front.read([key()]) is None
    raw.set(key("other"), 1)
    assert not front.contains(key("other"))
    front.delete([key()])
    assert not front.contains(key())
    with pytest.raises(reem.BadKey):
        front.contains(5)


def test_defaults_and_every_other_call_stay_as_they_are(front, key):
    """`get` tells what is missing from what is None; `store.get` without a default raises."""
    absent = key("absent")
    assert front.get(f"{absent}.x", 5) == front.get(absent, 5) == 5
    calls = (
        front.delete,
        front.length,
        front.type,
        lambda path: front.append(path, 1),
        lambda path: front.get(path[0]),
    )
    for call in calls:
        with pytest.raises(MissingKey, match=absent):
            call([absent])


def test_the_reader_of_one_key_does_the_same(interface, key):
    reader = reem.Reader(key(), interface)
    assert reader.read_from_redis(".") is None
    assert reader.read_from_redis(".a.b") is None
    reem.Writer(key(), interface).send_to_redis(".", {"a": {}})
    with pytest.raises(MissingKey):
        reader.read_from_redis(".a.b")


def test_accessors_get_with_a_default(kvs, key):
    assert kvs[key()].get(5) == 5
    assert kvs[key()].get() is None
    assert kvs[key()].get("element", 5) == 5
    with pytest.raises(MissingKey), kvs[key()]:
        pytest.fail("the block ran")


@pytest.mark.parametrize("value", [np.arange(3.0), np.zeros(20_000), b"bytes"], ids=["small", "large", "bytes"])
@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
def test_a_single_array_makes_the_top_level_dict(open_front, key, raw, space, value):
    """As `kvs["read_frame_rate_test"]["subkey"] = arr` of the manual (5.1.2) needs it."""
    front, reader = open_front(space), open_front()
    front.write([key(), "subkey"], value)
    assert_same(reader.read([key()]), {"subkey": value})
    front.write([key(), "other"], value)
    assert_same(reader.read([key()]), {"subkey": value, "other": value})
    front.delete([key()])
    front.write([key(), "subkey"], value)
    assert_same(reader.read([key()]), {"subkey": value})
    assert_no_orphans(raw, key())


def test_followers_see_the_dict_that_an_array_made(interface, pspace, key):
    mirrors = [reem.SilentSubscriber(name, interface) for name in (key(), f"{key()}.image")]
    with contextlib.ExitStack() as stack:
        for mirror in mirrors:
            stack.enter_context(mirror)
        pspace[key()]["image"] = np.arange(4)
        eventually(lambda: mirrors[0].value() is not None and mirrors[1].value() is not None)
        assert_same(mirrors[0].value(), {"image": np.arange(4)})
        assert_same(mirrors[1].value(), np.arange(4))


def test_errors_have_the_classes_by_which_programs_of_before_catch_them():
    for error in (MissingKey, NotFinite, Overflow, PathRefused, TooDeep, WrongType):
        assert issubclass(error, redis.exceptions.ResponseError)
        assert issubclass(error, reem.ReemError)
    assert issubclass(WrongType, BadType)
    assert issubclass(NotFinite, reem.BadValue)
    assert reem.WrongType is reem_async.WrongType
