"""What programs of REEM 0.0.x and 0.1.x import, and the ways in which they call it."""

import enum
import functools
import importlib
import pickle
import time

import numpy as np
import pytest
import redis
from conftest import assert_no_orphans, assert_same, eventually, python

import reem
import reem_async
from reem.convenience import TolerantKeyValueStore
from reem_async.errors import BadKey, BadType

# --- names ------------------------------------------------------------------------------------------------

NAMES = {
    "reem": "RedisInterface KeyValueStore TolerantKeyValueStore PublishSpace CallbackSubscriber SilentSubscriber",
    "reem.connection": "RedisInterface KeyValueStore PublishSpace SilentSubscriber CallbackSubscriber Writer Reader "
    "PublishWriter NumpyMarshaller SpecialDatatypeMarshaller NumpyShip SpecialDatatypeShip",
    "reem.datatypes": "KeyValueStore PublishSpace SilentSubscriber CallbackSubscriber Writer Reader Publisher",
    "reem.marshalling": "NumpyMarshaller SpecialDatatypeMarshaller",
    "reem.ships": "NumpyShip SpecialDatatypeShip",
    "reem.convenience": "TolerantKeyValueStore TolerantKVSVar TolerantKVSVarSubkey",
    "reem.accessors": "KeyAccessor WriteOnlyKeyAccessor ActiveSubscriberKeyAccessor",
    "reem.utilities": "ROOT_PATH path_to_key_sequence key_sequence_to_path key_sequence_to_path_ext append_to_path "
    "check_valid_key_name check_valid_key_name_ext extract_object insert_into_dictionary filter_paths_by_prefix "
    "copy_dictionary_without_paths",
}


@pytest.mark.parametrize("module", NAMES)
def test_each_name_is_where_it_was(module):
    """In all modules that 0.0.11, 0.1.2 or 0.1.3 had for programs."""
    found = importlib.import_module(module)
    for name in NAMES[module].split():
        assert getattr(found, name), name
    with pytest.raises(AttributeError, match="nonsense"):
        found.nonsense  # noqa: B018


@pytest.mark.parametrize(
    ("module", "without"),
    [("reem.connection", ""), ("reem.datatypes", "check_valid_key_name_ext key_sequence_to_path_ext")],
)
def test_all_of_a_module_by_an_asterisk(module, without):
    """`reem.connection` had all of 0.1.x; of `reem.datatypes` chapter 5 of the manual uses a function on paths."""
    given = {}
    exec(f"from {module} import *", given)
    names = {*NAMES[module].split(), *NAMES["reem.utilities"].split()}
    assert names - given.keys() == set(without.split())


def test_they_are_the_very_classes_of_today():
    connection = importlib.import_module("reem.connection")
    for name in ("KeyValueStore", "PublishSpace", "SilentSubscriber", "CallbackSubscriber", "Writer", "Reader"):
        assert getattr(connection, name) is getattr(reem, name)
    assert reem.TolerantKeyValueStore is TolerantKeyValueStore
    assert importlib.import_module("reem.accessors").KeyAccessor is type(reem.KeyValueStore()["foo"])


def test_a_new_program_imports_nothing_of_it():
    program = (
        "import sys, reem, reem.connection, reem.datatypes, reem_async\n"
        "reem.KeyValueStore('localhost')['a'], reem.PublishSpace, reem.CallbackSubscriber\n"
        "old = ('legacy', 'marshalling', 'convenience', 'accessors', 'utilities')\n"
        "assert not [each for each in old if f'reem.{each}' in sys.modules]\n"
    )
    assert python(program).returncode == 0


def test_paths_as_text_and_nested_dicts():
    from reem import utilities

    assert utilities.path_to_key_sequence(".") == []
    assert utilities.path_to_key_sequence(".a.b") == ["a", "b"]
    assert utilities.key_sequence_to_path(["a", "b"]) == ".a.b"
    assert utilities.key_sequence_to_path([]) == utilities.key_sequence_to_path_ext([]) == utilities.ROOT_PATH
    assert utilities.key_sequence_to_path_ext(["a", 2, "b"]) == ".a[2].b"
    assert utilities.append_to_path(utilities.append_to_path(".", "a"), "b") == ".a.b"
    assert [utilities.check_valid_key_name(name) for name in ("a", "a.b", "*", 5)] == [True, False, False, False]
    assert utilities.check_valid_key_name_ext(5)
    tree = {"a": {"b": 1, "c": 2}, "d": 3}
    assert utilities.extract_object(tree, ["a", "c"]) == 2
    assert utilities.copy_dictionary_without_paths(tree, [["a", "b"], ["d"]]) == {"a": {"c": 2}}
    utilities.insert_into_dictionary(tree, ["x", "y"], 5)
    assert tree["x"] == {"y": 5}
    assert utilities.filter_paths_by_prefix([".a.b", ".c"], ".a") == ([".a.b"], [".b"])
    assert utilities.filter_paths_by_prefix([".a.b", ".c"], ".") == ([".a.b", ".c"], [".a.b", ".c"])


# --- the tolerant store of 0.1.3 --------------------------------------------------------------------------


@pytest.fixture
def tolerant(interface):
    return TolerantKeyValueStore(interface)


def test_the_tolerant_store_takes_both_kinds_of_paths(tolerant, key, raw):
    tolerant.set([key(), "a", "b"], 1)
    tolerant.set(f"{key()}.c.image", np.arange(3))
    assert tolerant.get(f"{key()}.a.b") == tolerant.get([key(), "a", "b"]) == 1
    tolerant.set([key(), "a", "l"], [1, {"x": 2}])
    assert tolerant.get([key(), "a", "l", 1, "x"]) == 2
    assert_same(tolerant.get(key()), {"a": {"b": 1, "l": [1, {"x": 2}]}, "c": {"image": np.arange(3)}})
    with pytest.raises(KeyError):
        tolerant.get([key(), "a", "gone"])
    assert tolerant.get([key(), "a", "gone"], 5) == 5
    assert tolerant.get(key("absent")) is None
    assert_no_orphans(raw, key())


def test_all_of_a_tolerant_store_takes_paths(tolerant, key, raw):
    """What it has from dicts too, or `update` would store where `[]` does not look."""
    tolerant.update({f"{key()}.a.b": 1, (key(), "a", "image"): np.arange(3)})
    assert tolerant[f"{key()}.a.b"].read() == 1
    found = [path in tolerant for path in (f"{key()}.a.b", [key(), "a", "c"], f"{key('no')}.a")]
    assert found == [True, False, False]
    assert tolerant.setdefault(f"{key()}.x.y", 2) == tolerant.setdefault([key(), "x", "y"], 3) == 2
    assert tolerant.setdefault(f"{key('new')}.x.y", 4) == tolerant.get(key("new"))["x"]["y"] == 4
    assert_same(tolerant.pop([key(), "a", "image"]), np.arange(3))
    assert tolerant.pop(f"{key()}.a.image", None) is None
    with pytest.raises(KeyError):
        tolerant.pop(f"{key()}.a.image")
    with pytest.raises(BadType):
        tolerant.update({f"{key()}.first": 1, f"{key()}.second": {1, 2}})
    assert tolerant.get(key()) == {"a": {"b": 1}, "x": {"y": 2}}
    assert_no_orphans(raw, key())


@pytest.mark.parametrize("path", [[], (), 5, None, b"foo", {"foo": 1}], ids=repr)
def test_what_is_no_path_is_refused_in_words(tolerant, path):
    for call in (tolerant.get, tolerant.var, tolerant.pop, lambda path: tolerant.set(path, 1)):
        with pytest.raises((BadType, BadKey), match=r"names no key|is no path"):
            call(path)


def test_a_pickled_tolerant_store_keeps_its_refresh_rate(interface):
    copy = pickle.loads(pickle.dumps(TolerantKeyValueStore(interface, refreshRate=2)))
    assert copy.defaultVarRefreshRate == 2
    copy.interface.close()


def test_a_variable_has_the_syntax_of_a_dict(tolerant, key):
    it = tolerant.var(f"{key()}.robot.count")
    it.set(1)
    it += 4
    it *= 6
    it -= 3
    assert (it.get(), it.type(), str(it)) == (27, int, f"{key()}.robot.count=27")
    it /= 3
    assert it.get() == 9
    robot = tolerant.var([key(), "robot"])
    robot["joints"] = [0.0]
    robot["joints"].append(0.5)
    robot["joints"] += [1.0]
    robot["count"] += 1
    robot["new"]["deep"] = {"x": 1}
    assert robot["joints"].get() == [0.0, 0.5, 1.0]
    assert robot["new"]["deep"]["x"].get() == 1
    assert (len(robot), len(robot["joints"]), robot["joints"].type()) == (3, 3, list)
    del robot["new"]["deep"]
    assert robot.get() == {"count": 10.0, "joints": [0.0, 0.5, 1.0], "new": {}}
    with pytest.raises(KeyError):
        robot["gone"].get()


def test_a_variable_keeps_what_it_read_for_its_time(interface, kvs, key):
    store = TolerantKeyValueStore(interface, refreshRate=3600)
    kvs[key()] = {"n": 1, "l": [1]}
    kept, fresh = store.var(key()), store.var(key(), refreshRate=0)
    assert kept.get() == fresh.get() == {"n": 1, "l": [1]}
    kvs[key()]["n"] = 2
    assert (kept.get()["n"], kept["n"].get(), len(kept["l"]), fresh["n"].get()) == (1, 1, 1, 2)
    kept.get()["n"] = "changed in a copy"
    assert kept["n"].get() == 1
    with pytest.raises(KeyError):
        kept["gone"].get()
    kept["l"].append(2)
    assert kept.get() == {"n": 2, "l": [1, 2]}
    short = store.var(key(), refreshRate=0.02)
    assert short["n"].get() == 2
    kvs[key()]["n"] = 3
    time.sleep(0.03)
    assert short["n"].get() == 3


# --- options of the interface -----------------------------------------------------------------------------


def where(interface):
    return interface.hostname


@pytest.mark.parametrize("package", [reem, reem_async])
def test_ways_to_name_a_server(package, monkeypatch):
    monkeypatch.delenv("REEM_URL", raising=False)
    make, store = package.RedisInterface, package.KeyValueStore
    assert where(make("localhost:7400")) == where(make("localhost", 7400)) == "localhost:7400"
    assert where(make("localhost", port=7400)) == where(store("localhost", port=7400).interface) == "localhost:7400"
    assert where(package.PublishSpace("localhost", port=7400).interface) == "localhost:7400"
    assert where(make("[::1]:7400")) == "::1:7400"
    assert where(make("::1")) == "::1:6379"
    assert where(make()) == where(store().interface) == "localhost:6379"
    monkeypatch.setenv("REEM_URL", "redis://localhost:7401/2")
    assert where(make()) == where(store().interface) == where(package.PublishSpace().interface) == "localhost:7401"
    assert where(package.SilentSubscriber("c").interface) == "localhost:7401"
    assert where(make("localhost")) == "localhost:6379"
    for wrong in ("localhost:", "localhost:x", "localhost:99999", "localhost:0", "[::1]:x", "a/b:1"):
        with pytest.raises(reem.BadValue, match="host"):
            make(wrong)
    with pytest.raises(reem.BadType, match="port"):
        store(make("localhost"), port=7400)


@pytest.mark.parametrize("package", [reem, reem_async])
def test_socket_timeout_is_the_time_limit(package):
    def limit(*given, **options):
        interface = package.RedisInterface(*given, **options)
        return getattr(interface, "_direct", interface).session.options.timeout

    assert limit("localhost") == 1
    assert limit("localhost", socket_timeout=7) == 7
    assert limit("redis://localhost?socket_timeout=3") == 3
    assert limit("localhost", socket_timeout=None) == 1e6
    for wrong in (0, -1, "5", True):
        with pytest.raises(reem.BadInput, match="timeout"):
            limit("localhost", socket_timeout=wrong)


# --- attributes -------------------------------------------------------------------------------------------


def test_a_plain_client_of_the_same_server(interface, kvs, key):
    """redis-py's, with rejson-py's names too; made once."""
    kvs[key()] = {"a": {"foo": 3}}
    client = interface.client
    assert isinstance(client, redis.Redis)
    assert interface.client is client
    assert client.json().get(key(), ".a.foo") == client.jsonget(key(), ".a.foo") == 3
    client.jsonset(key(), ".a.foo", 4)
    assert kvs[key()]["a"]["foo"].read() == 4
    with pytest.raises(redis.exceptions.ResponseError):
        client.jsonset(key("absent"), ".a.foo", 4)
    client.set(key("text"), "text")
    assert client.get(key("text")) == "text"
    interface.close()
    with pytest.raises(reem.InterfaceClosed):
        interface.client  # noqa: B018


async def test_a_plain_client_for_asyncio(ainterface, akvs, key):
    await akvs[key()].write({"a": 5})
    assert isinstance(ainterface.client, redis.asyncio.Redis)
    assert await ainterface.client.json().get(key(), ".a") == 5


def test_the_plain_client_is_for_one_server():
    with pytest.raises(reem.Misuse, match="RedisCluster"):
        reem.RedisInterface("redis+cluster://localhost:7000").client  # noqa: B018


def test_accessors_have_path_reader_and_writer(interface, kvs, pspace, key):
    kvs[key()] = {"a": [1, 2]}
    place = kvs[key()]["a"][0]
    assert (kvs[key()].path, place.path) == ([], ["a", 0])
    assert place.reader.read_from_redis(".a") == [1, 2]
    place.writer.send_to_redis(".b", 5)
    assert (place.reader.top_key_name, place.writer.top_key_name) == (key(), key())
    with reem.SilentSubscriber(key(), interface) as mirror:
        pspace[key()].writer.send_to_redis(".b", 6)
        eventually(lambda: mirror.local_copy == {"a": [1, 2], "b": 6})
    with pytest.raises(NotImplementedError):
        pspace[key()].reader  # noqa: B018


def test_a_named_default_of_get(kvs, key):
    kvs[key()] = {"a": 1}
    assert kvs[key()].get("a", default_value=5) == 1
    assert kvs[key()].get("b", default_value=5) == 5
    assert kvs[key()]["b"].get(default_value=5) == 5
    assert kvs[key()].get("b", default_value=None) is None


def test_a_subscribers_local_copy(interface, pspace, key):
    with reem.SilentSubscriber(key(), interface) as mirror:
        assert mirror.local_copy == {}
        pspace[key()] = {"a": 1}
        eventually(lambda: mirror.local_copy == {"a": 1})


class Mode(enum.IntEnum):
    IDLE = 3


class Name(str, enum.Enum):  # noqa: UP042 - as programs before Python 3.11 write it
    LEFT = "left"


class Side(enum.StrEnum):
    RIGHT = "right"


def test_enums_that_are_numbers_or_text_are_stored_as_these(front, key):
    front.write([key()], {"a": Mode.IDLE, "b": [Name.LEFT, Side.RIGHT], "image": np.arange(3)})
    assert_same(front.read([key()]), {"a": 3, "b": ["left", "right"], "image": np.arange(3)})
    front.write([key()], Mode.IDLE)
    assert_same(front.read([key()]), 3)


# --- callbacks --------------------------------------------------------------------------------------------


CALLBACKS = {
    "in order": lambda data, updated_path, extra: (data, updated_path, extra),
    "turned": lambda updated_path, data, extra: (data, updated_path, extra),
    "all by name": lambda **given: (given["data"], given["updated_path"], given["extra"]),
    "data by name": lambda data, **given: (data, given["updated_path"], given["extra"]),
    "only by name": lambda *, extra, updated_path, data: (data, updated_path, extra),
    "other names": lambda value, where, extra: (value, where, extra),
    "path first": lambda updated_path, value, extra: (value, updated_path, extra),
    "data last": lambda where, data, extra: (data, where, extra),
    "all by place": lambda *given, extra: (*given, extra),
    "rest by name": lambda value, where, **given: (value, where, given["extra"]),
}


@pytest.mark.parametrize("function", CALLBACKS.values(), ids=CALLBACKS)
def test_a_callback_gets_what_it_names(interface, pspace, key, function):
    """0.1 gave data and path by name; other names are given by position, as the manual says."""
    told = []

    class Told:
        def it(self, data, updated_path, extra):
            told.append((data, updated_path, extra))

    method = reem.CallbackSubscriber(key(), interface, Told().it, {"extra": 5})
    plain = reem.CallbackSubscriber(key(), interface, lambda *a, **k: None, {"extra": 5})
    wrapped = reem.CallbackSubscriber(key(), interface, _telling(function, told), {"extra": 5})
    for each in (method, plain, wrapped):
        each.listen()
    pspace[key()] = {"n": 1}
    eventually(lambda: len(told) == 2)
    assert told == [({"n": 1}, key(), 5)] * 2


def _telling(function, told):
    @functools.wraps(function)
    def tell(*values, **names):
        told.append(function(*values, **names))

    return tell


@pytest.mark.parametrize("package", [reem, reem_async])
@pytest.mark.parametrize(
    ("function", "kwargs"),
    [
        (lambda: None, {}),
        (lambda data: None, {}),
        (lambda data, updated_path: None, {"extra": 5}),
        (CALLBACKS["in order"], {}),
    ],
)
def test_a_callback_that_cannot_be_called_so_is_refused_at_once(package, function, kwargs):
    with pytest.raises(TypeError, match="callback_function cannot be called"):
        package.CallbackSubscriber("c", package.RedisInterface("localhost"), function, kwargs)


# --- programs of a real robot -----------------------------------------------------------------------------


class StateServer(reem.KeyValueStore):
    """What TRINA's programs make of a store: made by a host, dotted paths through the plain client, missing parents."""

    def __init__(self, host="localhost"):
        self.host = host.host if isinstance(host, StateServer) else host
        super().__init__(self.host)

    def get(self, path):
        if not isinstance(path, str):
            place = self[path[0]]
            for element in path[1:]:
                place = place[element]
            return place.read()
        name, _, below = path.partition(".")
        return self.interface.client.jsonget(name, f".{below}")

    def set(self, path, item):
        name, *below = path.split(".")
        try:
            if isinstance(item, np.ndarray):
                raise redis.exceptions.ResponseError("has to go the other way")
            self.interface.client.jsonset(name, f".{'.'.join(below)}", item)
        except redis.exceptions.ResponseError:
            self._assign(self, [name, *below], item)

    def _assign(self, node, path, value):
        """Assign to the deepest place that takes it; returns what is still to be assigned, or None."""
        if len(path) > 1:
            value = self._assign(node[path[0]], path[1:], value)
            if value is None:
                return None
        try:
            node[path[0]] = value
        except redis.exceptions.ResponseError:
            return {path[0]: value}
        return None


def test_the_state_server_of_a_robot(server_url, key, raw):
    """It catches redis-py's ResponseError where a parent is missing, and goes one level up."""
    state = StateServer(server_url)
    assert StateServer(state).get(key()) is None
    state.set(key(), {"a": {"foo": 3, "bar": [6, 8]}, "b": 5})
    assert state.get(f"{key()}.a.bar") == state.get([key(), "a", "bar"]) == [6, 8]
    assert state.get([key(), "a", "bar", 1]) == 8
    state.set(f"{key()}.c.deep.foo", 1)
    assert state.get(f"{key()}.c") == {"deep": {"foo": 1}}
    state.set(f"{key('new')}.x.y", 2)
    assert state.get(key("new")) == {"x": {"y": 2}}
    state.set(f"{key()}.image", np.arange(3))
    state.set(f"{key()}.d.image", np.arange(4))
    state.set(f"{key('pictures')}.image", np.arange(5))
    assert_same(state.get([key(), "d", "image"]), np.arange(4))
    assert_same(state[key("pictures")].read(), {"image": np.arange(5)})
    again = pickle.loads(pickle.dumps(state))
    assert (type(again), again.get([key(), "b"])) == (StateServer, 5)
    for each in (state, again):
        each.interface.close()
