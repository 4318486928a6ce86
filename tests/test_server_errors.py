"""What the server refuses comes as an error of its own class, which says what to do; nothing is half written."""

import contextlib
import time

import numpy as np
import pytest
import redis
from conftest import FRONTS, PLAIN, eventually
from own_servers import caller, connect, free_port, own_server

import reem
from reem_async.plan.replies import refusal

both = pytest.mark.parametrize("name", list(FRONTS))


@pytest.fixture(scope="module")
def server():
    with own_server() as process:
        yield process


@pytest.fixture
def admin(server):
    with server.admin() as client:
        yield client
        client.config_set("maxmemory", 0)
        client.flushall()


@contextlib.contextmanager
def opened(name, url, space="KeyValueStore", **options):
    with contextlib.closing(FRONTS[name](url, space, **options)) as front:
        yield front


def edit(front, key):
    if isinstance(front.interface, reem.RedisInterface):
        with front.kvs[key] as value:
            value["n"] += 1
        return

    async def change():
        async with front.kvs[key].edit() as value:
            value["n"] += 1

    front.run(change())


def content(admin):
    found = {}
    for name in admin.scan_iter():
        kind = admin.type(name)
        if kind == "string":
            found[name] = admin.dump(name)
        elif kind == "set":
            found[name] = admin.smembers(name)
        elif kind != "none":  # expired meanwhile
            found[name] = admin.execute_command("JSON.GET", name)
    return {name: value for name, value in found.items() if not name.endswith(":last")}


@contextlib.contextmanager
def refused(kind, *words):
    """The error that is due: of this class, of redis-py's, and with these words in its text."""
    with pytest.raises(kind) as caught:
        yield
    assert isinstance(caught.value, reem.ReemError)
    assert isinstance(caught.value, redis.exceptions.RedisError)
    for word in words:
        assert word in str(caught.value), str(caught.value)
    assert str(caught.value)[:40] in repr(caught.value), "the text shows in logs too"


CHANGES = {
    "a scalar": lambda front: front.write(["foo", "n"], 2),
    "a document": lambda front: front.write(["foo"], {"n": 3}),
    "an array": lambda front: front.write(["foo", "image"], np.ones(9)),
    "a document with arrays": lambda front: front.write(["foo"], {"a": np.ones(3), "image": np.ones(3)}),
    "a sum": lambda front: front.increment(["foo", "n"], 1),
    "a product": lambda front: front.multiply(["foo", "n"], 2),
    "a quotient": lambda front: front.divide(["foo", "n"], 2),
    "an item": lambda front: front.append(["foo", "l"], 3),
    "items and arrays": lambda front: front.extend(["foo", "l"], [3, np.ones(3)]),
}
IN_PLACE = ("a sum", "a product", "a quotient")
"""What takes no memory."""


def write_bar(front):
    front.write(["bar"], {"image": np.ones(3)})


def assert_changes_are_refused(name, url, admin, kind, *words, changes=CHANGES):
    before = content(admin)
    listener = admin.pubsub()
    listener.psubscribe("*")
    eventually(lambda: listener.get_message(timeout=1.0))
    for space in ("KeyValueStore", "PublishSpace"):
        with opened(name, url, space) as front:
            for change in changes.values():
                with refused(kind, *words):
                    change(front)
    with opened(name, url) as front, refused(kind, *words):
        edit(front, "foo")
    assert content(admin) == before
    assert listener.get_message(timeout=0.02) is None
    listener.close()


@pytest.fixture
def stored(server, admin):
    with reem.RedisInterface(server.url) as interface:
        reem.KeyValueStore(interface)["foo"] = {"n": 1, "l": [1, 2], "image": np.zeros(9)}


# --- logging in ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def locked():
    with own_server() as process, process.admin() as client:
        client.execute_command("ACL", "SETUSER", "guest", "off", ">wr0ng")
        client.config_set("requirepass", "s3cret%41+pass")  # this connection is logged in and stays so
        yield process, client


@pytest.mark.alone
@both
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, ["needs a password", "password="]),
        ({"password": "wr0ng"}, ["refused"]),
        ({"username": "nobody", "password": "wr0ng"}, ["refused"]),
        ({"username": "guest", "password": "wr0ng"}, ["refused"]),
        ({"username": "default"}, ["password"]),
    ],
)
def test_a_refused_login_is_told_at_once_and_not_tried_again(locked, name, options, words):
    process, client = locked

    def attempts():
        stats = client.info("commandstats")
        return sum(stats.get(f"cmdstat_{command}", {"calls": 0})["calls"] for command in ("hello", "auth"))

    with caller(name, process.url, **options) as made:
        for call in made.calls:
            before, begun = attempts(), time.monotonic()
            with refused(reem.LoginRefused, f"127.0.0.1:{process.port}", *words):
                made(call)
            assert time.monotonic() - begun < 0.5
            assert attempts() - before == 1
    assert issubclass(reem.LoginRefused, redis.exceptions.AuthenticationError)


# --- rights ----------------------------------------------------------------------------------------


@pytest.fixture
def robot(server, admin):
    def make(*rules):
        admin.execute_command("ACL", "SETUSER", "robot", "reset", "on", ">secret", *rules)
        return server.url.replace("//", "//robot:secret@")

    yield make
    admin.execute_command("ACL", "DELUSER", "robot")


@both
def test_without_the_right_to_use_json_one_hears_of_it_on_connecting(robot, name):
    """That one key is out of bounds, on the other hand, means nothing then."""
    assert issubclass(reem.NotAllowed, redis.exceptions.NoPermissionError)
    with refused(reem.NotAllowed, "json.type"):
        connect(name, robot("~*", "&*", "+@all", "-json.type"))
    connect(name, robot("~elsewhere", "&*", "+@all"))


# --- states of the server ----------------------------------------------------------------------------


@both
def test_nothing_is_written_to_a_full_server(server, stored, admin, name):
    admin.config_set("maxmemory", 1)
    growing = {title: change for title, change in CHANGES.items() if title not in IN_PLACE}
    assert_changes_are_refused(name, server.url, admin, reem.ServerFull, "foo", "maxmemory", changes=growing)
    with opened(name, server.url, "PublishSpace") as front:
        for title in IN_PLACE:
            with refused(reem.ServerFull, "foo"):  # the notice needs room
                CHANGES[title](front)
    with opened(name, server.url) as front:
        with refused(reem.ServerFull, "bar"):
            write_bar(front)
        assert front.read(["foo", "l"]) == [1, 2]
        if PLAIN:  # a part is deleted by writing the rest
            with refused(reem.ServerFull, "foo"):
                front.delete(["foo", "l"])
        else:
            front.delete(["foo", "l"])
        if admin.info("server").get("server_name") != "valkey":  # Redis queues nothing at all then
            admin.config_set("maxmemory", 0)
        assert front.read(["foo"])["n"] == 1
        if not PLAIN:
            front.delete(["foo", "image"])
        front.delete(["foo"])
        assert not content(admin)
        admin.config_set("maxmemory", 0)
        front.write(["foo"], {"n": 2})
        assert front.read(["foo"]) == {"n": 2}


@both
def test_an_array_that_does_not_fit_leaves_the_old_one_in_its_place(server, stored, admin, name):
    """Its bytes are what fills the memory, in the midst of the transaction."""
    with opened(name, server.url) as front:
        front.write(["foo", "image"], np.arange(9))
        admin.config_set("maxmemory", int(admin.info("memory")["used_memory"]) + (4 << 20))
        with refused(reem.ServerFull, "foo"):
            front.write(["foo", "image"], np.zeros(1 << 20))
        admin.config_set("maxmemory", 0)
        assert front.read(["foo", "image"]).tolist() == list(range(9))


@both
def test_a_replica_takes_no_writes(server, stored, admin, name):
    """It can be read, and what its primary would refuse is not told as a fault of the value."""
    admin.replicaof("127.0.0.1", free_port())
    try:
        assert_changes_are_refused(name, server.url, admin, reem.ServerReadOnly, "replica", "primary")
        with opened(name, server.url) as front:
            assert front.read(["foo", "n"]) == 1
            with refused(reem.ServerReadOnly, "foo"):
                front.delete(["foo"])
        admin.config_set("replica-serve-stale-data", "no")
        with refused(reem.ServerNotReady, "primary"):
            connect(name, server.url)
    finally:
        admin.config_set("replica-serve-stale-data", "yes")
        admin.replicaof("NO", "ONE")


@both
def test_a_server_that_lacks_replicas_or_cannot_save_takes_no_writes(server, stored, admin, name):
    admin.config_set("min-replicas-to-write", 1)
    try:
        assert_changes_are_refused(name, server.url, admin, reem.ServerReadOnly, "min-replicas-to-write")
    finally:
        admin.config_set("min-replicas-to-write", 0)
    blocker = server.directory / "dump.rdb"
    blocker.mkdir(exist_ok=True)  # so that the server cannot put its file there
    admin.config_set("save", "3600 1000000")
    try:
        admin.bgsave()
        eventually(lambda: admin.info("persistence")["rdb_last_bgsave_status"] == "err")
        assert_changes_are_refused(name, server.url, admin, reem.ServerReadOnly, "disk")
    finally:
        blocker.rmdir()
        admin.config_set("save", "")


@pytest.fixture(scope="module")
def slow_to_load(tmp_path_factory):
    """A directory with so much data that a server takes its time, if it is told to."""
    directory = tmp_path_factory.mktemp("data")
    with own_server(directory=directory) as process, process.admin() as client, client.pipeline(False) as pipe:
        for number in range(4000):
            pipe.set(f"k{number}", "x" * 400)
        pipe.execute()
        client.save()
    for file in [*directory.glob("appendonlydir/*"), *directory.glob("*.lock")]:
        file.unlink()
    return directory


def test_a_server_that_is_loading_says_so(slow_to_load):
    lines = ("appendonly no", "key-load-delay 500", "loading-process-events-interval-bytes 1024")
    with own_server(*lines, directory=slow_to_load, wait=False) as process:
        for name in FRONTS:
            with caller(name, process.url) as made:
                for call in made.calls:
                    with refused(reem.ServerNotReady, "loading"):
                        made(call)
        assert process.ask("PING").startswith(b"-LOADING"), "it was still loading all the while"
        with process.admin() as client, caller("blocking", process.url, wait=30) as patient:
            client.config_set("key-load-delay", 0)
            patient(patient.calls[1])
            eventually(lambda: process.ask("PING") == b"+PONG\r\n")
        with opened("blocking", process.url) as front:
            front.write(["foo"], 1)
    assert issubclass(reem.ServerNotReady, redis.exceptions.BusyLoadingError)


def test_a_node_of_a_cluster_is_told_apart():
    lines = ("cluster-enabled yes", "cluster-node-timeout 500", "cluster-announce-ip 127.0.0.1")
    with own_server(*lines) as one, own_server(*lines) as other, one.admin() as first, other.admin() as second:
        for name in FRONTS:
            with refused(reem.ClusterNode, "redis+cluster://"):
                connect(name, one.url)
        first.execute_command("CLUSTER", "ADDSLOTSRANGE", 0, 8191)
        second.execute_command("CLUSTER", "ADDSLOTSRANGE", 8192, 16383)
        second.execute_command("CLUSTER", "MEET", "127.0.0.1", one.port)
        ok = "cluster_state:ok"
        eventually(lambda: all(ok in str(node.execute_command("CLUSTER", "INFO")) for node in (first, second)))
        slot_of = lambda key: first.execute_command("CLUSTER", "KEYSLOT", key)  # noqa: E731
        here = next(f"k{n}" for n in range(99) if slot_of(f"k{n}") < 8192)
        there = next(f"k{n}" for n in range(99) if slot_of(f"k{n}") >= 8192)
        holder = one if slot_of("reem") < 8192 else other
        here, there = (here, there) if holder is one else (there, here)
        for name in FRONTS:
            with opened(name, holder.url) as front:
                front.write([here], {"image": np.arange(3)})
                assert front.read([here, "image"]).tolist() == [0, 1, 2]
                for change in (lambda: front.write([there], 1), lambda: front.write([there], np.zeros(3))):
                    with refused(reem.ClusterNode, there, "Cluster"):
                        change()
                with refused(reem.ClusterNode, there):
                    front.read([there])
                with refused(reem.ClusterNode, there):
                    front.wait(front.kvs[there].watch().listen())


def test_the_code_alone_decides():
    """Not words further on in the text, which may be a user's."""
    assert refusal("ERR unknown command 'X', with args beginning with: 'OOM ', 'NOPERM'") is None
    assert refusal("BUSYGROUP Consumer Group name already exists") is None
    assert refusal("") is None
    assert len(str(refusal("OOM " + "x" * 10**6))) < 500
