"""What the manual of the first REEM documents works, and so do scripts of 0.1.2."""

import numpy as np
import pytest
from conftest import assert_no_orphans, assert_same, eventually
from test_ships import Pose, PoseShip

import reem
from reem.connection import RedisInterface
from reem.datatypes import CallbackSubscriber, KeyValueStore, PublishSpace, SilentSubscriber
from reem.ships import SpecialDatatypeShip


@pytest.fixture
def opened(server_url, key):
    interfaces = []

    def open_(**options):
        interfaces.append(RedisInterface(host=server_url, **options))
        return interfaces[-1]

    yield open_
    for interface in interfaces:
        interface.close()


def test_the_tutorial(opened, key):
    """A store, a publish space, a local variable that follows, and a function that is called; no sleep is needed."""
    interface = opened()
    interface.initialize()
    server, publisher, told = KeyValueStore(interface), PublishSpace(interface), []
    server[key("foo")] = {"number": 100.0, "string": "REEM"}
    numbers = np.random.default_rng().random((3, 4))
    server[key("foo")]["numpy"] = numbers
    assert_same(server[key("foo")].read(), {"number": 100.0, "string": "REEM", "numpy": numbers})
    assert server[key("foo")]["number"].read() == 100.0

    def callback(data, updated_path, foo):
        told.append(f"Foo = {foo}, Updated Path = {updated_path}, Data = {data}")

    subscriber = SilentSubscriber(channel=key("channel"), interface=interface)
    called = CallbackSubscriber(
        channel=key("channel"), interface=interface, callback_function=callback, kwargs={"foo": 5}
    )
    subscriber.listen()
    called.listen()
    publisher[key("channel")] = {"number": 5, "string": "REEM"}
    eventually(lambda: subscriber.value() == {"number": 5, "string": "REEM"} and told)
    publisher[key("channel")]["number"] = 6
    eventually(lambda: len(told) == 2)
    assert told[1] == f"Foo = 5, Updated Path = {key('channel')}.number, Data = {{'number': 6, 'string': 'REEM'}}"
    publisher[key("channel")] = 5
    eventually(lambda: subscriber.value() == 5)
    assert isinstance(publisher, KeyValueStore)
    with pytest.raises(NotImplementedError):
        publisher[key("channel")].read()


class HashShip(SpecialDatatypeShip):
    """Arrays as the manual's ship keeps them: a hash of bytes and of what is needed to rebuild them."""

    def check_fit(self, value):
        return isinstance(value, np.ndarray)

    def write(self, key, value, client):
        client.hset(key, "content", value.tobytes())
        client.hset(key, "kind", value.dtype.str)
        client.hset(key, "extent", ",".join(map(str, value.shape)))

    def get_label(self):
        return "hash_of_bytes"

    def read(self, key, client):
        client.hgetall(key)

    def interpret_read(self, responses):
        fields = responses[0]
        assert all(type(name) is bytes for name in fields), "as redis-py gives them"
        extent = [int(part) for part in fields[b"extent"].decode().split(",") if part]
        return np.frombuffer(fields[b"content"], fields[b"kind"].decode()).reshape(extent)


def test_a_ship_written_like_the_manuals(opened, key, raw):
    """In place of the default one: only arrays are taken, at any place."""
    server = KeyValueStore(opened(ships=[HashShip()]))
    document = {"a": np.arange(6.0).reshape(2, 3), "l": [np.arange(3), np.array(2.5)], "n": 1}
    server[key("foo")] = document
    assert_same(server[key("foo")].read(), document)
    server[key("foo")]["l"][0] = np.zeros((0, 2))
    assert_same(server[key("foo")]["l"][0].read(), np.zeros((0, 2)))
    assert "hash_of_bytes" in raw.execute_command("JSON.GET", key("foo"))
    assert_no_orphans(raw, key("foo"))


def test_a_script_of_reem_0_1_2(server_url, key):
    """List indexes, del, augmented assignment, append, len, type, get: on accessors and on the store."""
    kvs = reem.KeyValueStore(server_url)
    top = key("robot")
    kvs[top] = {"joints": [0.0, 0.5, 1.0], "count": 1, "name": "arm", "cfg": {"gain": 2.5}}
    kvs[top]["joints"][1] = 0.75
    kvs[top]["joints"].append(1.25)
    kvs[top]["joints"] += [1.5, 1.75]
    del kvs[top]["joints"][0]
    assert kvs[top]["joints"].read() == [0.75, 1.0, 1.25, 1.5, 1.75]
    assert len(kvs[top]["joints"]) == 5
    kvs[top]["count"] += 5
    kvs[top]["count"] -= 2
    kvs[top]["count"] *= 3
    kvs[top]["count"] /= 4
    assert kvs[top]["count"].read() == 3
    assert kvs[top]["joints"].type() is list
    assert kvs[top].type() is dict
    assert len(kvs[top]) == 4
    held = kvs[top]["cfg"]
    gain = held["gain"]
    gain.write(3.5)
    assert held.read() == {"gain": 3.5}
    assert held.get("gain", 1) == 3.5
    assert held.get("absent", 1) == 1
    assert kvs.get(f"{top}.cfg.gain") == 3.5
    kvs.set(f"{top}.cfg.gain", 4.5)
    assert kvs.get(f"{top}.cfg") == {"gain": 4.5}
    with kvs[top] as robot:
        robot["name"] = robot["name"].upper()
    del kvs[top]["cfg"]
    assert kvs[top].read() == {"joints": [0.75, 1.0, 1.25, 1.5, 1.75], "count": 3, "name": "ARM"}
    del kvs[top]
    assert kvs[top].read() is None
    kvs.interface.close()


def test_marshallers_are_ships_by_their_old_names(opened, key):
    """`reem.marshalling` and `marshallers=`."""
    from reem.marshalling import NumpyMarshaller, SpecialDatatypeMarshaller

    assert issubclass(NumpyMarshaller, SpecialDatatypeMarshaller)
    assert issubclass(NumpyMarshaller, SpecialDatatypeShip)

    class PoseMarshaller(PoseShip, SpecialDatatypeMarshaller):
        pass

    server = KeyValueStore(opened(marshallers=[NumpyMarshaller(), PoseMarshaller()]))
    server[key()] = {"pose": Pose(20.5, 1.0), "image": np.arange(3)}
    assert server[key()]["pose"].read() == Pose(20.5, 1.0)
    assert_same(server[key()]["image"].read(), np.arange(3))


def test_the_documented_classes_have_the_documented_attributes(opened, key):
    """`interface` and `top_key_name`; subscribers are built with keywords or by position."""
    interface = opened()
    assert KeyValueStore(interface).interface is interface
    for low in (reem.datatypes.Writer, reem.datatypes.Reader, reem.datatypes.Publisher):
        made = low(top_key_name=key(), interface=interface)
        assert (made.top_key_name, made.interface) == (key(), interface)
    CallbackSubscriber(key(), interface, lambda data, updated_path: None, {})
    SilentSubscriber(key(), interface)
    reem.datatypes.Writer(key(), interface).send_to_redis(set_path=".", set_value={"a": np.arange(2)})
    assert_same(reem.datatypes.Reader(key(), interface).read_from_redis(read_path=".a"), np.arange(2))
    reem.datatypes.Publisher(key(), interface).send_to_redis(".a", 1)
    assert KeyValueStore(interface)[key()].read() == {"a": 1}
    KeyValueStore(interface).track_schema_changes(set_value=False, keys=[key()])
    PublishSpace(interface).track_schema_changes(False)
