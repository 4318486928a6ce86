"""Large arrays get through beside programs that never rest: they are sent before the transaction that is watched."""

import contextlib
import threading
import time

import numpy as np
import pytest
from conftest import Keys, RawCluster, assert_no_orphans, assert_same, keys_of

import reem
from reem_async.errors import Conflict, NotAllowed
from reem_async.plan.keys import keys_of as keys_of_name
from reem_async.plan.shapes import ShapeCache
from reem_async.plan.sizes import STAGED, are_missing, looks_at, stage
from reem_async.plan.writes import _WatchedChange, set_change

SHAPE = (1000, 1000)
TIMES = 5


class Place:
    """One server or a cluster: a neighbour that writes to a key without a pause, and a look behind the scenes."""

    def __init__(self, url, raw):
        self.url, self.raw = url, raw
        self.name = Keys()("robot")
        self._over = threading.Event()

    def received(self):
        """Bytes that all nodes have received."""
        if isinstance(self.raw, RawCluster):
            nodes = [node.redis_connection for node in self.raw.get_primaries()]
        else:
            nodes = [self.raw]
        return sum(node.info("stats")["total_net_input_bytes"] for node in nodes)

    def waiting(self):
        """The names of what was sent and is not in its place."""
        return [name for name in keys_of(self.raw, self.name) if STAGED in name]

    def _write(self, failures):
        try:
            with reem.RedisInterface(self.url) as interface:
                space, number = reem.PublishSpace(interface), 0
                while not self._over.is_set():
                    number += 1
                    space[self.name]["n"] = number
        except BaseException as failure:
            failures.append(failure)

    @contextlib.contextmanager
    def restless(self):
        failures = []
        thread = threading.Thread(target=self._write, args=(failures,))
        thread.start()
        try:
            yield
        finally:
            self._over.set()
            thread.join()
        assert not failures

    def assert_in_order(self):
        """Nothing is left over, and what is there stays."""
        assert_no_orphans(self.raw, self.name)
        arrays = keys_of(self.raw, self.name) - {f"{{{self.name}}}:last", f"{{{self.name}}}:ships"}
        assert {self.raw.ttl(name) for name in arrays} == {-1}


@pytest.fixture(params=["server", "cluster"])
def place(request):
    with contextlib.ExitStack() as stack:
        if request.param == "cluster":
            url = request.getfixturevalue("cluster").url
            first = url.replace("redis+cluster://", "redis://").split(",")[0]
            raw = stack.enter_context(contextlib.closing(RawCluster.from_url(first, decode_responses=True)))
        else:
            url, raw = request.getfixturevalue("server_url"), request.getfixturevalue("raw")
        place = Place(url, raw)
        yield place
        raw.unlink(place.name, *keys_of(raw, place.name))


def publish(interface, name, array):
    reem.PublishSpace(interface)[name]["image"] = array


def publish_an_item(interface, name, array):
    reem.PublishSpace(interface)[name]["list"][0] = array


def write_an_item(interface, name, array):
    reem.KeyValueStore(interface)[name]["list"][0] = array


def edit(interface, name, array):
    with reem.KeyValueStore(interface)[name]["list"].edit() as value:
        value[0] = array


WRITES = {
    publish: lambda value: value["image"],
    publish_an_item: lambda value: value["list"][0],
    write_an_item: lambda value: value["list"][0],
    edit: lambda value: value["list"][0],
}


@pytest.mark.parametrize("write", WRITES)
def test_beside_a_program_that_never_rests_it_is_sent_twice_at_most(place, write):
    with reem.RedisInterface(place.url, timeout=30) as interface:
        kvs = reem.KeyValueStore(interface)
        kvs[place.name] = {"n": 0, "image": np.zeros(3), "list": [np.zeros(3), 1]}
        with place.restless():
            before = place.received()
            for number in range(TIMES):
                array = np.full(SHAPE, float(number))
                write(interface, place.name, array)
                assert_same(WRITES[write](kvs[place.name].read()), array)
            received = place.received() - before
        assert received < 2.5 * TIMES * array.nbytes
    place.assert_in_order()


@pytest.mark.parametrize(
    ("place", "write"),
    [("cluster", write) for write in WRITES] + [("server", write) for write in WRITES if write is not publish],
    indirect=["place"],
)
def test_what_was_lost_before_it_was_put_in_its_place_is_sent_again(place, write):
    """Evicted, or forgotten since its sender was too slow. On one server nothing is watched to publish."""
    lost, over = [], threading.Event()

    def lose():
        while len(lost) < 3 and not over.is_set():
            lost.extend(name for name in place.waiting() if place.raw.unlink(name))

    with reem.RedisInterface(place.url, timeout=30) as interface, contextlib.ExitStack() as stack:
        kvs = reem.KeyValueStore(interface)
        kvs[place.name] = {"n": 0, "image": np.zeros(3), "list": [np.zeros(3), 1]}
        stack.enter_context(place.restless())
        thread = threading.Thread(target=lose)
        thread.start()
        number, end = 0, time.monotonic() + 20
        try:
            while len(lost) < 3 and time.monotonic() < end:
                number += 1
                array = np.full(SHAPE, float(number))
                write(interface, place.name, array)
                assert_same(WRITES[write](kvs[place.name].read()), array)
        finally:
            over.set()
            thread.join()
    assert len(lost) >= 3
    place.assert_in_order()


@pytest.mark.parametrize("right", ["rename", "persist"])
def test_a_user_who_may_not_put_it_in_its_place_is_told(cluster, right):
    """The way of a large array through a cluster needs it; nothing is applied."""
    place = Keys()("robot")
    admins = cluster.nodes
    rules = ["on", ">pw", "~*", "&*", "+@all", f"-{right}"]
    try:
        for node in admins:
            node.say("ACL", "SETUSER", "narrow", *rules)
        url = cluster.url.replace("redis+cluster://", "redis+cluster://narrow:pw@")
        with reem.RedisInterface(url) as interface:
            space, kvs = reem.PublishSpace(interface), reem.KeyValueStore(interface)
            space[place] = {"image": np.zeros(3)}
            with pytest.raises(NotAllowed, match=right):
                space[place]["image"] = np.zeros(SHAPE)
            assert_same(kvs[place].read(), {"image": np.zeros(3)})
            del kvs[place]
    finally:
        for node in admins:
            node.say("ACL", "DELUSER", "narrow")


def test_only_large_values_go_first():
    small, large = ("SET", "{a}.s", b"x"), ("SET", "{a}.l", (b"h" * 10, memoryview(bytes(70_000))))
    other = ("JSON.SET", "a", "$", b"x" * 100_000)
    moving, coming = stage([small, large, other], "{a}", "u")
    (it,) = coming
    assert it.name.startswith("{a}" + STAGED)
    assert it.upload[:3] == ("SET", it.name, large[2])
    assert it.upload[3] == "EX"
    assert moving == [small, ("PERSIST", it.name), ("RENAME", it.name, "{a}.l"), other]


def test_an_edit_that_meets_a_conflict_leaves_nothing_on_the_server():
    keys, memory = keys_of_name("a"), ShapeCache()
    _, coming = stage([("SET", "{a}[0]", bytes(70_000))], "{a}", "u")
    it = set_change(keys, (0,), b"1", ())
    plan = _WatchedChange(it, memory, [("JSON.GET", "a", "$[0]")], (b"[1]",), coming).plan()
    after = plan.decode([b"OK", b"[[1]]", b"[1]", [], b"[2]", b"string"])
    assert after.commands == [("UNLINK", coming[0].name)]
    with pytest.raises(Conflict):
        after.decode([1])


def test_nothing_large_changes_nothing():
    commands = [("SET", "{a}.s", b"x"), ("UNLINK", "{a}.s")]
    assert stage(commands, "{a}", "u") == (commands, [])


def test_what_is_there_is_told_from_what_is_not():
    _, coming = stage([("SET", "{a}.l", bytes(70_000)), ("SET", "{a}.m", bytes(70_000))], "{a}", "u")
    assert [command[0] for command in looks_at(coming)] == ["TYPE", "TYPE"]
    assert are_missing([b"string", b"none"])
    assert not are_missing([b"string", b"string"])
    assert not are_missing([])
