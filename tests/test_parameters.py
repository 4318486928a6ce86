"""Parameters: declared with type and bounds, read without a round trip, safe from what other programs write."""

import contextlib
import json
import logging
import threading

import numpy as np
import pytest
from chaos.proxy import Proxy
from chaos.servers import PrivateServer
from conftest import (
    FRONTS,
    PLAIN,
    aeventually,
    assert_same,
    eventually,
    nothing_sent,
    python,
    server_without_right,
    sized,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import reem
import reem_async
from reem_async.coordination.parameters import SPECIFICATIONS, prepared, stored_parameters
from reem_async.coordination.specification import as_json, equal, from_stored, specified
from reem_async.errors import BadData, BadInput, ConnectionLost, NotAllowed, NotConnected, PathRefused

GOOD = [
    (True, {}, [False, np.bool_(True)], [1, 0.0, "true", None]),
    (3, {"low": 0, "high": 9}, [9, np.int64(4), np.uint8(0)], [10, -1, 2.0, True, "3", 2**70, [3]]),
    (3, {"low": 0.5}, [1, 2**63 - 1], [0, 2**63]),
    (2.0, {"low": 0.0, "high": 10.0}, [10, np.float32(0.5), 0.0], [10.1, -1e-9, float("nan"), "2", True, 10**400]),
    (2.0, {"high": 3}, [-1e308], [float("inf"), 3.5, np.zeros(1)]),
    ("left", {"choices": ["left", "right"]}, ["right"], ["up", 1, None]),
    (2, {"choices": (1, 2)}, [np.int8(1)], [3, 1.0, True]),
    ("any", {}, ["", "é" * 1000], ["x" * 1001, b"any"]),
    ([0.5, 1], {"low": 0, "high": [1, 2]}, [(1, 2), np.zeros(2)], [[1, 3], [1], [1, 2, 3], [[1, 2]], np.eye(2), 1.0]),
    (np.arange(3), {"low": [0, 0, 0]}, [[5, 5, 5]], [[1, 2, -1], [1, 2, 3.5], [1, 2, True], "abc", {}]),
]


@pytest.mark.parametrize(("default", "options", "good", "bad"), GOOD)
def test_values_of_the_type_and_in_range_are_taken_and_no_others(default, options, good, bad):
    """What is stored of a specification gives an equal one, also after JSON."""
    specification = specified("p", default, unit="m", help="It is what it is.", **options)
    assert from_stored("p", json.loads(json.dumps(specification.stored()))) == specification
    for value in (default, *good):
        checked = specification.checked("p", value)
        assert equal(checked, specification.checked("p", as_json(checked)))
        json.dumps(as_json(checked))
    for value in bad:
        with pytest.raises(BadInput, match=r"^p: "):
            specification.checked("p", value)


@pytest.mark.parametrize(
    ("default", "options"),
    [
        *[
            (bad, {})
            for bad in (None, b"x", {}, {1}, [], ["a"], [True], [1, "a"], [0] * 65, np.eye(2), np.array(1.0), 1j)
        ],
        (2.0, {"low": 3.0}),
        (2.0, {"low": "0"}),
        (2.0, {"low": float("nan")}),
        (2.0, {"high": float("inf")}),
        (2.0, {"low": [0.0]}),
        ([1.0, 2.0], {"low": [0.0]}),
        (True, {"low": 0}),
        ("a", {"high": "b"}),
        ("a", {"choices": []}),
        ("a", {"choices": "abc"}),
        ("a", {"choices": ["b"]}),
        (1, {"choices": [1, 2.0]}),
        (1, {"choices": [1], "low": 0}),
        (True, {"choices": [True]}),
        ([1], {"choices": [1]}),
        (1, {"choices": range(1000)}),
        (1, {"unit": 5}),
        (1, {"unit": "m" * 41}),
        (1, {"help": "m" * 501}),
        (1, {"on_change": 5}),
    ],
)
def test_what_cannot_be_declared_is_refused_before_anything_is_sent(default, options, raw, kvs, key):
    with nothing_sent(raw), pytest.raises(BadInput, match=f"{key()}.p: "):
        kvs[key()].parameter("p", default, **options)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
FIELDS = st.sampled_from(["type", "default", "low", "high", "unit", "help", "choices"])


@settings(max_examples=sized(150, 3000), deadline=None)
@given(JSON | st.dictionaries(FIELDS, JSON | st.sampled_from(["int", "float[2]", "str"])))
def test_what_another_program_has_stored_is_a_specification_or_bad_data(data):
    try:
        specification = from_stored("p", data)
    except BadData:
        return
    assert specification.checked("p", specification.default) == specification.default


class Declared:
    """One front in the namespace of the test; `kp` is a parameter from 0 to 10."""

    def __init__(self, front):
        self.front = front

    def __call__(self, path, name, default, **options):
        return self.front.wait(self.front.at(path).parameter(name, default, **options))

    def kp(self, **options):
        return self(["control"], "kp", 2.0, **{"low": 0.0, "high": 10.0, "unit": "1/s", **options})


@pytest.fixture
def namespace(key):
    return {"namespace": f"{key.prefix}:"}


@pytest.fixture
def declared(open_front, namespace):
    return lambda: Declared(open_front(**namespace))


@pytest.fixture
def store(server_url, namespace):
    with reem.RedisInterface(server_url, **namespace) as interface:
        yield reem.KeyValueStore(interface)


@pytest.fixture
def warnings(caplog):
    caplog.set_level(logging.WARNING, "reem.parameters")
    return lambda: [each.getMessage() for each in caplog.records if each.name == "reem.parameters"]


def test_a_parameter_is_read_from_memory_and_follows_every_program(declared, store, raw):
    it = declared()
    kp = it.kp()
    assert store["control"].read() == {"kp": 2.0}
    with nothing_sent(raw):
        assert (kp.value, float(kp), int(kp), bool(kp), str(kp), f"{kp:.2f}") == (2.0, 2.0, 2, True, "2.0", "2.00")
    with reem.SilentSubscriber("control", store.interface) as published:
        it.front.wait(kp.write(3))
        assert (kp.value, type(kp.value), store["control"]["kp"].read()) == (3.0, float, 3.0)
        eventually(lambda: published.value() == {"kp": 3.0})
    store["control"]["kp"] = 4.5
    it.front.until(lambda: kp.value == 4.5)
    store["control"] = {"kp": 5, "more": np.zeros(10000)}
    it.front.until(lambda: kp.value == 5.0)
    reem.PublishSpace(store)["control"]["kp"] = 6.5
    it.front.until(lambda: kp.value == 6.5)
    for bad in (99, "x", None, float("nan")):
        with pytest.raises(BadInput, match=r"control\.kp: "):
            it.front.wait(kp.write(bad))
    assert store["control"]["kp"].read() == 6.5
    with pytest.raises(TypeError, match="value"):
        assert kp == 6.5
    with pytest.raises(TypeError, match="pickled"):
        kp.__reduce__()


def test_a_value_is_assigned_in_plain_programs_alone(declared):
    it = declared()
    kp = it.kp()
    if isinstance(it.front, FRONTS["asyncio"]):
        with pytest.raises(TypeError, match=r"await parameter\.write"):
            kp.value = 3.0
        return
    kp.value = 3
    assert kp.value == 3.0


@pytest.mark.parametrize("stored", [99, -1, "high", None, True, [2.0], {"a": 1}, np.zeros(3), b"x"])
def test_what_other_programs_store_out_of_range_is_ignored_and_reported_once(declared, store, warnings, stored):
    it, seen = declared(), []
    kp = it.kp(on_change=seen.append)
    it.front.wait(kp.write(3.0))
    for _ in range(3):
        store["control"]["kp"] = stored
        it.front.until(lambda: kp.invalid)
        assert (kp.value, kp.invalid[:11]) == (3.0, "control.kp:")
        reem.PublishSpace(store)["control"]["kp"] = 4.0
        it.front.until(lambda: kp.value == 4.0 and seen[-1:] == [4.0])
        assert not kp.invalid
        it.front.wait(kp.write(3.0))
    it.front.until(lambda: seen and seen[-1] == 3.0)
    assert set(seen) == {3.0, 4.0}
    assert len([each for each in warnings() if "is ignored" in each]) == 1
    # A program that starts now uses the default, and leaves what is stored.
    store["control"]["kp"] = stored
    kp = declared().kp()
    assert kp.value == 2.0
    assert kp.invalid
    assert_same(store["control"]["kp"].read(), stored)


def test_a_stored_value_survives_the_program_and_a_later_declaration_replaces_the_earlier(declared, store, warnings):
    first = declared()
    first.front.wait(first.kp().write(7.0))
    again = declared()
    assert again.kp().value == 7.0
    assert warnings() == []
    assert store[SPECIFICATIONS].read() == {
        "control.kp": {"type": "float", "default": 2.0, "low": 0.0, "high": 10.0, "unit": "1/s"}
    }
    later = declared()
    assert later.kp(high=5.0).value == 2.0
    assert ["declared it differently" in each for each in warnings()].count(True) == 1
    assert store[SPECIFICATIONS]["control.kp"]["high"].read() == 5.0
    assert again.kp().value == 7.0


def test_a_parameter_declared_twice_in_a_program_is_one(declared):
    it = declared()
    one, other = it.kp(), it.kp()
    assert one == other
    it.front.wait(one.write(5.0))
    assert other.value == 5.0
    with pytest.raises(ValueError, match=r"declared twice.*10\.0.*5\.0"):
        it.kp(high=5.0)


def test_places_in_dicts_can_have_parameters_and_items_of_lists_cannot(declared, store):
    """Dicts that are missing are made; what is there stays."""
    it = declared()
    store["arm"] = {"speed": 1}
    deep = it(["arm", "left"], "a.b", np.arange(3.0), low=-1)
    assert_same(store["arm"].read(), {"speed": 1, "left": {"a.b": [0.0, 1.0, 2.0]}})
    it.front.wait(deep.write([3, 4, 5]))
    assert_same(deep.value, np.array([3.0, 4.0, 5.0]))
    store["arm"]["left"]["a.b"] = np.ones(3)
    it.front.until(lambda: deep.value[0] == 1.0)
    listed = it(["arm"], "names", [1, 2])
    listed.value.append(3)
    assert listed.value == [1, 2]
    store["list"] = [{}]
    for path, name in [(["list", 0], "p"), ([SPECIFICATIONS], "p"), (["arm"], 5), (["arm"], "a\\b"), (["arm"], "it's")]:
        with pytest.raises(BadInput):
            it(path, name, 1)
    store["number"] = 5
    with pytest.raises(PathRefused):
        it(["number"], "p", 1)


def test_of_programs_that_start_at_once_the_first_stores_its_default(server_url, namespace, store):
    results, together = [], threading.Barrier(6)

    def start(default):
        with reem.RedisInterface(server_url, **namespace) as interface:
            together.wait()
            kp = reem.KeyValueStore(interface)["control"].parameter("kp", default)
            results.append((kp.value, kp.invalid))

    threads = [threading.Thread(target=start, args=[float(number)]) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(results) == {(store["control"]["kp"].read(), "")}


def test_on_change_is_called_with_each_good_value_wherever_it_comes_from(declared, store, caplog):
    it, seen = declared(), []

    def failing(value):
        raise ZeroDivisionError

    it.kp(on_change=failing)
    kp = it.kp(on_change=seen.append)
    if isinstance(it.front, FRONTS["asyncio"]):

        async def later(value):
            seen.append(value)

        it.kp(on_change=later)
    calls = len(seen) + (2 if isinstance(it.front, FRONTS["asyncio"]) else 1)
    for value in (3.0, 3.0, 4.0):
        it.front.wait(kp.write(value))
        it.front.until(lambda value=value: value in seen)
    store["control"]["kp"] = 5.0
    it.front.until(lambda: seen.count(5.0) == calls)
    assert seen == [value for value in (3.0, 4.0, 5.0) for _ in range(calls)]
    assert caplog.text.count("Traceback") == 1


@pytest.mark.parametrize("keep", [True, False])
@pytest.mark.parametrize("kind", FRONTS)
def test_an_outage_leaves_the_value_and_a_server_without_data_gets_the_default(kind, keep, warnings):
    with PrivateServer(keep=keep) as server, contextlib.closing(FRONTS[kind](server.url)) as front:
        it, seen = Declared(front), []
        kp, other = it.kp(on_change=seen.append), it(["deep", "er"], "n", 3)
        it.front.wait(kp.write(7.0))
        if keep:  # as if another program had stored the value again, after a restart without data
            it.front.wait(it.front.at((SPECIFICATIONS,)).delete())
        server.kill()
        it.front.until(lambda: it.front.interface.state != "connected")
        assert (kp.value, other.value) == (7.0, 3)
        with pytest.raises((NotConnected, ConnectionLost)):
            it.front.wait(kp.write(8.0))
        assert kp.value == 7.0
        server.start()
        with reem.RedisInterface(server.url) as interface:
            kvs = reem.KeyValueStore(interface)
            it.front.until(lambda: kvs.get("control.kp", None) == (7.0 if keep else 2.0) == kp.value)
            it.front.until(lambda: kvs.get("deep.er.n", None) == 3)
            it.front.until(lambda: len(kvs.get(SPECIFICATIONS, ())) == 2)
            kvs["control"]["kp"] = 9.0
            it.front.until(lambda: kp.value == 9.0)
        assert ("is gone from the server" in "".join(warnings())) == (not keep)
        it.front.until(lambda: seen and seen[-1] == 9.0)


def test_a_slow_link_delays_values_and_loses_none(server_url, key):
    with PrivateServer() as server, Proxy(server.port) as proxy, reem.RedisInterface(proxy.url) as interface:
        kp = reem.KeyValueStore(interface)["control"].parameter("kp", 0)
        proxy.delay = 0.05
        for value in range(5):
            kp.write(value)
            assert kp.value == value


async def test_without_the_right_to_write_the_value_is_readable_and_the_error_names_the_right(warnings):
    async with (
        server_without_right("set" if PLAIN else "json.set") as (kvs, url),
        reem_async.RedisInterface(url) as poor,
    ):
        mine = reem_async.KeyValueStore(poor)["control"]
        kp = await mine.parameter("kp", 2.0)
        assert kp.value == 2.0
        assert ["cannot be stored" in each for each in warnings()] == [True, False]
        assert "will not know" in warnings()[1]
        await kvs["control"].write({"kp": 3.5})
        assert (await mine.parameter("kp", 2.0)) == kp
        await aeventually(lambda: kp.value == 3.5)
        with pytest.raises(NotAllowed, match=r"'(json\.)?set'"):
            await kp.write(4.0)
    async with server_without_right("subscribe") as (kvs, url), reem_async.RedisInterface(url) as poor:
        with pytest.raises(NotAllowed, match="subscribe"):
            await reem_async.KeyValueStore(poor)["control"].parameter("kp", 2.0)


def test_a_forked_child_declares_its_parameters_itself(server_url, namespace):
    code = """
        import os, sys, reem
        interface = reem.RedisInterface(sys.argv[1], namespace=sys.argv[2])
        control = reem.KeyValueStore(interface)["control"]
        kp = control.parameter("kp", 2.0, on_change=lambda value: None)
        if not os.fork():
            try:
                kp.value
            except reem.Stale as error:
                print(error, flush=True)
            again = control.parameter("kp", 2.0)
            again.value = 3.5
            print(again.value, flush=True)
            os._exit(0)
        os.wait()
        while kp.value != 3.5:
            pass
        print(float(kp))
        interface.close()
        try:
            kp.value
        except reem.Stale as error:
            print(error)
    """
    done = python(code, server_url, namespace["namespace"], flags=("-W", "error"))
    assert done.stderr == ""
    first, *values, last = done.stdout.splitlines()
    assert "another process" in first
    assert values == ["3.5", "3.5"]
    assert "closed" in last


async def test_what_tools_read_of_specifications_is_checked_entry_by_entry(
    ainterface, store, key, server_url, namespace
):
    store["control"].parameter("kp", 2.0, low=0.0)
    store[SPECIFICATIONS].update({"x": {}, "a[0].b": {}, "control.ki": {"type": "float", "default": "x"}, "": 5})
    async with reem_async.RedisInterface(server_url, **namespace) as other:
        found, refused = await stored_parameters(other.session)
        assert [(each.name, each.value, each.invalid) for each in found.values()] == [("control.kp", 2.0, "")]
        assert len(refused) == 4
        store[SPECIFICATIONS] = [1, 2]
        assert await stored_parameters(other.session) == ({}, [f"{SPECIFICATIONS}: [1, 2] is not a dict; remove it"])
    with pytest.raises(PathRefused):
        store["control"].parameter("kd", 2.0)


def test_a_coroutine_function_needs_an_event_loop(kvs, key):
    async def on_change(value):
        raise AssertionError

    with pytest.raises(TypeError, match="reem_async"):
        kvs[key()].parameter("kp", 2.0, on_change=on_change)
    assert prepared(("a",), "b", 1, on_change=on_change).path == ("a", "b")
