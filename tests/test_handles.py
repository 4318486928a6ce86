"""Handles answer as a user of dicts expects, or say what to type; what a handle is not is said at once."""

from __future__ import annotations

import contextlib
import copy
import operator
import pickle
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import numpy as np
import pytest
from conftest import PLAIN, assert_no_orphans, assert_same, commands_run

import reem
import reem_async
from reem import BadKey, BadType, BadValue, Conflict, MissingKey, PathRefused, WriteOnly, WrongType
from reem_async.plan.paths import parse, show

MISTAKES = {
    "a number": lambda handle: handle == 1,
    "a number before it": lambda handle: 1 == handle,  # noqa: SIM300 - in this order
    "not a number": lambda handle: handle != 1,
    "True": lambda handle: handle == True,  # noqa: E712 - the mistake itself
    "None": lambda handle: handle == None,  # noqa: E711
    "a list": lambda handle: handle == [1],
    "an array": lambda handle: handle == np.arange(3),
    "an array before it": lambda handle: np.arange(3) == handle,
    "a numpy scalar before it": lambda handle: np.float64(1) == handle,
    "its truth": bool,
    "not": lambda handle: not handle,
    "less": lambda handle: handle < 3,
    "more or equal": lambda handle: handle >= 3,
    "plus": lambda handle: handle + 1,
    "plus, after": lambda handle: 1 + handle,
    "times a numpy scalar": lambda handle: np.float64(2) * handle,
    "divided": lambda handle: handle / 2,
    "minus": lambda handle: -handle,
    "an array of it": np.asarray,
    "a mean": np.mean,
    "float": float,
    "int": int,
    "round": round,
    "a range": range,
    "an item of a list": lambda handle: [1, 2][handle],
    "a number format": lambda handle: f"{handle:.2f}",
}


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=list(MISTAKES))
def test_a_handle_taken_for_its_value_says_how_to_read(kvs, pspace, akvs_handle, key, mistake):
    """A TypeError, in both fronts, of a publish space and of a subscriber's copy too; nothing is sent for it."""
    local = reem.SilentSubscriber(key(), kvs.interface)["n"]
    for handle, remedy in [
        (kvs[key()]["n"], "with .read()"),
        (akvs_handle, "with await handle.read()"),
        (pspace[key()]["n"], "with a KeyValueStore"),
        (local, "with .read()"),
    ]:
        with pytest.raises(TypeError, match="a handle is a place in the dictionary, not the value") as caught:
            mistake(handle)
        assert str(caught.value).startswith(f"{key()}.n: ")
        assert str(caught.value).endswith(remedy)


@pytest.fixture
def akvs_handle(server_url, key):
    return reem_async.KeyValueStore(reem_async.RedisInterface(server_url))[key()]["n"]


@pytest.mark.parametrize("name", ["items", "values", "shape", "battery"])
def test_an_attribute_that_the_value_would_have_says_how_to_read(kvs, akvs_handle, key, name):
    """An AttributeError, so that `hasattr` works; names that only programs ask for are refused without more."""
    for handle, remedy in [(kvs[key()]["n"], r"\.read\(\)"), (akvs_handle, r"await handle\.read\(\)")]:
        assert not hasattr(handle, name)
        with pytest.raises(
            AttributeError, match=rf"\.n: a handle is a place.* no '{name}'; .* {remedy}, or .*\['{name}'\]"
        ):
            getattr(handle, name)
        with pytest.raises(AttributeError, match=r"Accessor' object has no attribute '_repr_png_'$"):
            handle._repr_png_  # noqa: B018


def test_a_slice_says_to_read_the_whole_first(kvs, akvs_handle, key):
    """Of arrays and lists, where a user of numpy types it."""
    for handle in (kvs[key()]["n"], akvs_handle):
        for wrong in (np.s_[0:1], np.s_[0, 1]):
            with pytest.raises(BadType, match=r"\.n: an index names one item.*; read the whole first"):
                handle[wrong]


def test_handles_of_one_place_are_equal_and_of_others_not(kvs, pspace, akvs_handle, key):
    """In sets, dicts and lists; what knows handles only as objects is let alone."""
    handle = kvs[key()]["n"]
    assert handle == kvs[key()]["n"]
    assert handle != kvs[key()]["m"]
    assert handle != kvs[key()]
    assert handle != pspace[key()]["n"]
    assert handle != akvs_handle
    assert {handle: 5}[kvs[key()]["n"]] == 5
    assert len({handle, kvs[key()]["n"], kvs[key()]}) == 2
    assert handle in [kvs[key()], kvs[key()]["n"]]
    assert handle is not None
    assert handle == mock.ANY
    assert handle != object()
    assert copy.copy(handle) == handle
    assert kvs["m.a"] != kvs["m"]["a"]
    called = mock.Mock()
    called(handle)
    called.assert_called_once_with(kvs[key()]["n"])
    kvs[key()] = {"n": 3}
    assert pickle.loads(pickle.dumps(handle)).read() == 3


def test_printing_a_handle_says_what_it_is(kvs, pspace, akvs_handle, key):
    assert str(kvs[key()]["n"]) == f"<Accessor {key()}.n: read its value with .read()>"
    assert f"{akvs_handle}" == f"<Accessor {key()}.n: read its value with await handle.read()>"
    assert repr(pspace[key()]) == f"<PublishAccessor {key()}: read its value with a KeyValueStore>"


def test_what_a_dict_user_types(kvs, key, raw):
    """`in`, `for` and `keys` look without fetching a value."""
    kvs[key()] = {"a": 1, "image": np.zeros((480, 640, 3), np.uint8), "d": {"\u4e00": {}}}
    place = kvs[key()]
    before = commands_run(raw)
    assert "a" in place
    assert "x" not in place
    assert place.keys() == list(place) == ["a", "image", "d"]
    assert "\u4e00" in place["d"]
    assert place["d"]["\u4e00"].keys() == []
    ran = commands_run(raw)
    if not PLAIN:  # there the document is one string
        assert not [name for name in ran if name in ("get", "json.get") and ran[name] != before.get(name)]
    assert key() in kvs
    assert key() in list(kvs)
    for wrong in (place["a"], place["image"]):
        for call in (wrong.keys, lambda wrong=wrong: "x" in wrong, lambda wrong=wrong: list(wrong)):
            with pytest.raises(WrongType, match=r"not a dict.*\.read\(\)"):
                call()
    for missing in (kvs[key("none")], place["none"], kvs[key("none")]["\u4e00"]):
        for call in (missing.keys, lambda missing=missing: "x" in missing):
            with pytest.raises(MissingKey):
                call()
    with pytest.raises(BadKey, match="keys of a dict are str"):
        assert 5 in place
    with pytest.raises(TypeError):
        reversed(place)


def test_pop_removes_and_returns(kvs, key, raw):
    kvs[key()] = {"n": 1, "image": np.arange(6), "l": [1, np.arange(2), 3], "deep": {"x": np.ones(2)}}
    assert kvs[key()].pop("n") == 1
    assert_same(kvs[key()].pop("image"), np.arange(6))
    assert kvs[key()]["l"].pop() == 3
    assert_same(kvs[key()]["l"].pop(-1), np.arange(2))
    assert kvs[key()]["l"].pop(0) == 1
    assert kvs[key()].pop("gone", None) is None
    assert kvs[key()]["l"].pop(-1, "empty") == "empty"
    with pytest.raises(KeyError):
        kvs[key()].pop("gone")
    assert_no_orphans(raw, key())
    assert_same(kvs.pop(key()), {"l": [], "deep": {"x": np.ones(2)}})
    assert kvs.pop(key(), 7) == 7
    with pytest.raises(MissingKey):
        kvs.pop(key())
    with pytest.raises(TypeError, match="one default"):
        kvs.pop(key(), 1, 2)
    assert_no_orphans(raw, key())


def test_of_many_who_pop_one_gets_each(kvs, key, server_url):
    kvs[key()] = list(range(40))
    got: list[int] = []

    def take(_):
        with contextlib.closing(reem.RedisInterface(server_url)) as interface:
            place = reem.KeyValueStore(interface)[key()]
            while True:
                try:
                    item = place.pop(0, None)
                except Conflict:
                    continue
                if item is None:
                    return
                got.append(item)

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(take, range(3)))
    assert sorted(got) == list(range(40))


def test_update_stores_all_or_none_in_one_transaction(kvs, key, raw):
    kvs[key()] = {"n": 1, "stays": 2, "image": np.arange(3)}
    kvs[key()].update({"n": 2, "image": "none"}, force=np.ones(3), t=(1, 2))
    assert_same(kvs[key()].read(), {"n": 2, "stays": 2, "image": "none", "force": np.ones(3), "t": [1, 2]})
    kvs[key()].update([("n", 3)])
    kvs[key()].update({})
    before = commands_run(raw).get("exec", 0)
    kvs[key()].update(n=4, force=np.zeros(3))
    assert commands_run(raw)["exec"] == before + 1
    for bad, kind in [({"n": 5, "x": {1}}, BadType), ({"n": 5, 6: 7}, BadKey), ({"n": 5, "x": float("nan")}, BadValue)]:
        with pytest.raises(kind):
            kvs[key()].update(bad)
    assert_same(kvs[key()]["n"].read(), 4)
    assert_no_orphans(raw, key())


def test_update_where_there_is_no_dict_stores_nothing(kvs, key, raw):
    kvs[key()] = {"n": 1, "l": [{"x": 1}, np.arange(2)]}
    for place in (kvs[key("none")], kvs[key()]["n"], kvs[key()]["none"], kvs[key()]["l"]):
        for values in ({"a": 1, "b": 2}, {"a": 1, "b": np.ones(2)}, {"a": 1}, {"b": np.ones(2)}):
            with pytest.raises(PathRefused):
                place.update(values)
    kvs[key()]["l"][0].update(x=2, y=3)
    assert_same(kvs[key()].read(), {"n": 1, "l": [{"x": 2, "y": 3}, np.arange(2)]})
    kvs[key()]["l"][0]["image"] = np.arange(4)
    with pytest.raises(BadType, match=r"one by one, or use edit\(\)"):
        kvs[key()]["l"][0].update(image=1, y=4)
    with pytest.raises(BadType, match="one by one"):
        kvs[key()]["l"][-2].update(x=1, y=4)
    assert_same(kvs[key()]["l"][0].read(), {"x": 2, "y": 3, "image": np.arange(4)})
    assert_no_orphans(raw, key())
    assert_no_orphans(raw, key("none"))


def test_an_update_is_published_value_by_value(kvs, pspace, key):
    pspace[key()] = {}
    with kvs[key()].watch(reem.Last(10)) as updates:
        assert next(updates).initial
        with pytest.raises(PathRefused):
            pspace[key()]["none"].update(a=1, b=2)
        pspace[key()].update(a=1, force=np.ones(3))
        first = next(updates)
        while first.path != f"{key()}.a":  # what was refused is told of by a look at what is there
            first = next(updates)
        second = next(updates)
        assert second.path == f"{key()}.force"
        assert_same(second.data, {"a": 1, "force": np.ones(3)})
        assert second.sequence == first.sequence + 1
        assert not second.gap


def test_a_store_is_updated_key_by_key_after_all_was_looked_at(kvs, pspace, key):
    kvs.update({key(): {"n": 1}}, **{key("image"): np.ones(2)})
    assert_same(kvs[key("image")].read(), np.ones(2))
    with pytest.raises(BadType):
        kvs.update({key(): 2, key("image"): {1}})
    with pytest.raises(BadKey):
        kvs.update({key(): 2, "": 1})
    assert kvs[key()].read() == {"n": 1}
    pspace.update({key(): 3})
    assert kvs[key()].read() == 3


def test_a_publish_space_refuses_what_would_read(open_front, key):
    front = open_front("PublishSpace")
    space, at = front.kvs, front.kvs[key()]["n"]
    calls = (
        *(at.read, at.get, at.length, at.type, at.keys, at.outline, at.edit, at.mirror, at.watch, at.pop),
        lambda: at.contains("x"),
        lambda: at.setdefault("x", 1),
        lambda: at.parameter("p", 1),
        lambda: at.reader,
        lambda: space.get(f"{key()}.n"),
        lambda: space.pop(key()),
        lambda: space.setdefault(key(), 1),
        space.watch,
    )
    for call in calls:
        with pytest.raises(WriteOnly) as caught:
            front.wait(call())
        assert isinstance(caught.value, NotImplementedError)


async def test_what_cannot_wait_says_what_to_await(akvs, key):
    place = akvs[key()]
    for call, remedy in [
        (lambda: operator.setitem(akvs, key(), 1), f"await store['{key()}'].write(value)"),
        (lambda: operator.setitem(place, "a", 1), "await accessor['a'].write(value)"),
        (lambda: operator.delitem(place, "a"), "await accessor['a'].delete()"),
        (lambda: list(place), "await accessor.keys()"),
        (lambda: "a" in place, "await accessor.contains('a')"),
        (lambda: list(akvs), "await store.keys()"),
        (lambda: "a" in akvs, "await store.contains('a')"),
        (lambda: len(place), "await accessor.length()"),
        (
            lambda: operator.iadd(place, 1),
            "await accessor.increment(number), or of a list await accessor.extend(items)",
        ),
        (lambda: operator.isub(place, 1), "await accessor.increment(-number)"),
        (lambda: operator.imul(place, 2), "await accessor.multiply(number)"),
        (lambda: operator.itruediv(place, 2), "await accessor.divide(number)"),
    ]:
        with pytest.raises(TypeError) as caught:
            call()
        assert remedy in str(caught.value)


def test_a_key_with_a_dot_is_shown_quoted(kvs, key):
    """So that it cannot be taken for a path, and what is shown can be typed."""
    for path in [("m.a",), ("m.a", "x"), ("a[0]",), ('a"b', 3), ("plain", "x"), (".x",), ("a b", "c.d")]:
        assert parse(show(path)) == path
    assert show(("m.a", "x")) == '["m.a"].x'
    dotted = key("m.a")
    kvs[dotted] = 5
    assert kvs.get(f'["{dotted}"]') == 5
    with pytest.raises(MissingKey):
        kvs.get(dotted)
    with pytest.raises(MissingKey, match=r'nothing is stored at \["'):
        kvs[dotted]["x"].read()


def test_ipython_is_offered_the_keys(kvs, pspace, key):
    """After `kvs["` and `kvs["foo"]["`; nothing where there are none."""
    kvs[key()] = {"a": 1, "b": 2}
    assert key() in kvs._ipython_key_completions_()
    assert kvs[key()]._ipython_key_completions_() == ["a", "b"]
    assert kvs[key()]["a"]._ipython_key_completions_() == []
    assert pspace[key()]._ipython_key_completions_() == []


WHOLE = "image is an array, and arrays are read whole: read it, then take \\[0\\]"
REFUSALS = [
    (lambda at: at["image"][0].write(3), PathRefused, "write an array as a whole"),
    (lambda at: at["image"][7].write(3), PathRefused, r"\[7\]: "),
    (lambda at: at["l"][1].write(1), PathRefused, "the list index is out of range; a list only grows by appending$"),
    (lambda at: at["d"][0].write(1), PathRefused, r"\.d is of type object and has no element 0"),
    (lambda at: at["s"][0].write(1), PathRefused, r"\.s is an array, or text, and has no element 0"),
    (lambda at: at["n"][0].write(1), PathRefused, r"\.n is of type integer and has no element 0"),
]
OF_STORES = [
    (lambda at: at.write({"x": at["n"]}), BadType, r"\.read\(\)"),
    (lambda at: at["m"].write(at["n"]), BadType, r"\.read\(\)"),
    (lambda at: at["image"][0].read(), MissingKey, WHOLE),
    (lambda at: at["image"][0][1].read(), MissingKey, "nothing is stored at"),
    (lambda at: at["l"][5].read(), MissingKey, "nothing is stored at"),
    (lambda at: at["none"][0].read(), MissingKey, "nothing is stored at"),
]


@pytest.mark.parametrize(("space", "call", "error", "match"), [
    *(("pspace", *row) for row in REFUSALS), *(("kvs", *row) for row in REFUSALS + OF_STORES),
])  # fmt: skip
def test_what_cannot_be_done_at_a_place_says_what_is_there_or_what_to_do(request, kvs, key, space, call, error, match):
    value = {"d": {"x": 1}, "s": "text", "n": 5, "l": [1], "image": np.zeros((2, 2))}
    kvs[key()] = value
    with pytest.raises(error, match=match):
        call(request.getfixturevalue(space)[key()])
    assert_same(kvs[key()].read(), value)
