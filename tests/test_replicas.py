"""Reading from replicas: what goes there, what never does, and what becomes of reads when one is gone."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pickle
import re
import signal
import threading
import time

import numpy as np
import pytest
from clusterkit import Move, kill_primary, owner, raw_of, whole_again
from conftest import FRONTS, ROOT, aeventually, assert_same, commands_run, eventually
from sentinelkit import Watched

import reem
import reem_async
from reem_async.errors import BadType, BadValue, InterfaceClosed, MissingKey, NotAllowed, NotConnected
from reem_async.server.cluster import EmbeddedCluster

DOCUMENT = {"n": 1, "l": [1, 2, 3], "s": "text", "image": np.arange(20.0)}
READING = {"json.get", "json.type", "json.objlen", "json.arrlen", "get", "smembers", "watch", "scan", "type"}
"""Commands that a replica only sees if somebody reads from it; those that change something come from its primary."""


class Clustered:
    """Three primaries with a replica each."""

    def __init__(self, stack, directory):
        self.cluster = stack.enter_context(EmbeddedCluster(primaries=3, replicas=1, node_timeout=1.5))
        self.url = self.cluster.url
        self.dead = []
        for node in self.cluster.nodes:
            with raw_of(node) as raw:  # replicas go where the tests send them, not where one is missing
                raw.config_set("cluster-allow-replica-migration", "no")
        for client in self.primaries():  # nodes do not name a replica that has got nothing yet
            client.set(of_node(self.cluster, client, "first"), 1)
        eventually(self.known)

    def primaries(self):
        return self._of("master")

    def replicas(self):
        return self._of("slave")

    def _of(self, role):
        clients = [raw_of(node) for node in self.cluster.nodes if node not in self.dead]
        return [client for client in clients if client.info("replication")["role"] == role]

    def replica_of(self, name):
        port = owner(self.cluster, name).port
        return next(each for each in self.replicas() if each.info("replication")["master_port"] == port)

    def pid(self, port):
        return next(node.pid for node in self.cluster.nodes if node.port == port)

    def known(self):
        """Whether every node names all replicas, each with its primary."""
        truth = {(each.info("replication")["master_port"], port_of(each)) for each in self.replicas()}
        return all(truth == named_by(each) for each in (*self.primaries(), *self.replicas()))

    def pair(self):
        """Two primaries, each with its replica: plain clients."""
        pairs = []
        for replica in self.replicas():
            port = replica.info("replication")["master_port"]
            pairs.append((next(each for each in self.primaries() if port_of(each) == port), replica))
        return pairs[:2]


class Guarded(Watched):
    """A primary and a replica that sentinels watch."""

    def primaries(self):
        return [self.now()]

    def replicas(self):
        return [self.standby()]

    def replica_of(self, name):
        return self.standby()

    def known(self):
        """Whether every sentinel takes the replica for one that is up."""
        rows = [row for each in self.sentinels for row in each.sentinel_slaves("mymaster")]
        return all(row["flags"] == "slave" and row["master-link-status"] == "ok" for row in rows)


def port_of(client):
    return client.connection_pool.connection_kwargs["port"]


def named_by(client):
    """The ports of all replicas that a node names, each with that of its primary."""
    rows = client.execute_command("CLUSTER", "SLOTS")
    return {(primary[1], replica[1]) for _, _, primary, *replicas in rows for replica in replicas}


def of_node(cluster, client, word):
    """A key that a node has."""
    return next(name for name in map(f"{word}{{}}".format, range(1000)) if owner(cluster, name).port == port_of(client))


def caught_up(world):
    """Wait until replicas have all that primaries have."""
    for replica in world.replicas():
        port = replica.info("replication")["master_port"]
        primary = next(each for each in world.primaries() if port_of(each) == port)
        eventually(
            lambda primary=primary, replica=replica: (
                replica.info("replication")["slave_repl_offset"] >= primary.info("replication")["master_repl_offset"]
            )
        )


def questions_of(nodes):
    """How often these nodes were asked for the layout of their cluster."""
    rows = [raw_of(node).info("commandstats").get("cmdstat_cluster|slots", {}) for node in nodes]
    return sum(row.get("calls", 0) for row in rows)


def reads_of(clients):
    """How many reading commands these servers have run."""
    return sum(count for each in clients for name, count in commands_run(each).items() if name in READING)


@pytest.fixture(scope="module")
def clustered():
    with contextlib.ExitStack() as stack:
        yield Clustered(stack, None)


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    with contextlib.ExitStack() as stack:
        started = Guarded(tmp_path_factory.mktemp("sentinels"), stack)
        eventually(started.known)
        yield started


@pytest.fixture(params=["clustered", "guarded"])
def world(request):
    """Both kinds of servers that have replicas."""
    return request.getfixturevalue(request.param)


@pytest.fixture(params=list(FRONTS))
def opened(request):
    """Opens a front that reads from replicas."""
    with contextlib.ExitStack() as stack:

        def open_(url, timeout=10.0, **options):
            front = FRONTS[request.param](url, read_from_replicas=True, timeout=timeout, **options)
            return stack.enter_context(contextlib.closing(front))

        yield open_


# --- the option -------------------------------------------------


@pytest.mark.parametrize("package", [reem, reem_async])
@pytest.mark.parametrize("url", ["localhost", "redis://user:secret@127.0.0.1:7000", "unix:///tmp/reem.sock"])
def test_one_server_has_no_replicas_that_could_be_found(package, url):
    """It says what to connect to instead; no password is shown."""
    with pytest.raises(BadValue, match=r"redis\+cluster://.*redis\+sentinel://") as refusal:
        package.RedisInterface(url, read_from_replicas=True)
    assert "secret" not in str(refusal.value)
    package.RedisInterface(url, read_from_replicas=False)


def test_the_option_is_a_bool():
    """Nothing else is taken for one."""
    with pytest.raises(BadType, match="read_from_replicas='no'"):
        reem.RedisInterface("redis+cluster://127.0.0.1:7000", read_from_replicas="no")


def test_a_pickled_interface_keeps_the_option(clustered):
    """Handles too."""
    with reem.RedisInterface(clustered.cluster, read_from_replicas=True) as interface:
        reem.KeyValueStore(interface)["pickled"] = 1
        copied = pickle.loads(pickle.dumps(reem.KeyValueStore(interface)["pickled"]))
        caught_up(clustered)
        before = reads_of(clustered.replicas())
        assert copied.read() == 1
        assert reads_of(clustered.replicas()) > before


# --- where things go -------------------------------------------------


def test_what_a_user_reads_comes_from_replicas(world, opened):
    """Values, arrays, types, lengths, defaults; primaries are not even asked."""
    front = opened(world.url)
    names = [f"read{number}" for number in range(6)]
    for name in names:
        front.write([name], DOCUMENT)
    caught_up(world)
    primaries, replicas = reads_of(world.primaries()), reads_of(world.replicas())
    for name in names:
        assert_same(front.read([name]), DOCUMENT)
        assert_same(front.get(f"{name}.image"), DOCUMENT["image"])
        assert front.read([name, "l", -1]) == 3
        assert (front.length([name]), front.length([name, "l"]), front.length([name, "image"])) == (4, 3, 20)
        assert (front.type([name, "n"]), front.type([name, "image"])) == (int, np.ndarray)
    assert reads_of(world.primaries()) == primaries
    assert reads_of(world.replicas()) >= replicas + 8 * len(names)


def test_everything_else_stays_with_primaries(world, opened):
    """What writes look at first, edit(), arithmetic, what is deleted; replicas are not even asked."""
    front = opened(world.url)
    for name in ("other1", "other2", "other3"):
        front.write([name], {})
        before = reads_of(world.replicas())
        front.write([name], DOCUMENT)
        front.write([name, "l", -1], np.zeros(3))
        front.append([name, "l"], np.ones(2))
        front.increment([name, "n"], 2)
        front.divide([name, "n"], 2)
        front.write([name, "image"], 5)
        front.delete([name, "l", -2])
        if isinstance(front.interface, reem.RedisInterface):
            with front.at([name]).edit() as value:
                value["l"][-1][0] = 7
            assert name in front.kvs.keys()  # noqa: SIM118 - a store, not a dict
        assert reads_of(world.replicas()) == before
        front.delete([name])


async def test_followers_stay_with_primaries(world):
    """Their snapshots must be in order with the notices."""
    async with reem_async.RedisInterface(world.url, read_from_replicas=True) as interface:
        space, kvs = reem_async.PublishSpace(interface), reem_async.KeyValueStore(interface)
        await space["followed"].write({"n": 0, "image": np.zeros(20_000)})
        before = reads_of(world.replicas())
        mirror = reem_async.SilentSubscriber("followed", interface)
        await mirror.listen()
        async with kvs["followed"]["image"].watch() as updates:
            assert (await anext(updates)).initial
            await space["followed"].write({"n": 1, "image": np.ones(20_000)})
            await aeventually(lambda: mirror.value()["n"] == 1)
            assert (await anext(updates)).data[0] == 1
        assert reads_of(world.replicas()) == before


@pytest.fixture
def doctored(guarded):
    """The replica, open for changes of its own, so that an answer says who gave it."""
    replica = guarded.standby()
    replica.config_set("replica-read-only", "no")
    yield replica
    replica.config_set("replica-read-only", "yes")


def test_a_read_may_be_older_and_what_a_replica_lacks_is_asked_of_the_primary(guarded, doctored, opened):
    """Keys, parts of documents, arrays, items from the end; only what the primary lacks is missing."""
    front = opened(guarded.url)
    front.write(["old"], DOCUMENT)
    caught_up(guarded)
    doctored.execute_command("JSON.SET", "old", "$.n", "0")
    doctored.execute_command("JSON.DEL", "old", "$.s")
    doctored.execute_command("JSON.SET", "old", "$.l", "[7]")
    assert (front.read(["old", "n"]), front.read(["old"])["n"]) == (0, 0)
    assert (front.read(["old", "s"]), front.type(["old", "s"])) == ("text", str)
    assert (front.read(["old", "l", -1]), front.read(["old", "l", -3]), front.read(["old", "l", 2])) == (7, 1, 3)
    doctored.delete("{old}.image")
    assert_same(front.read(["old"]), DOCUMENT)
    doctored.delete("old")
    assert_same(front.read(["old"]), DOCUMENT)
    assert (front.length(["old"]), front.type(["old"])) == (4, dict)
    with pytest.raises(MissingKey):
        front.read(["old", "nothing"])
    assert front.get("nothing", 5) == 5


async def test_edit_compares_with_the_primary(guarded, doctored):
    """Otherwise it would write back what was."""
    async with reem_async.RedisInterface(guarded.url, read_from_replicas=True) as interface:
        kvs = reem_async.KeyValueStore(interface)
        await kvs["edited"].write({"l": [1, 2]})
        await asyncio.to_thread(caught_up, guarded)
        doctored.execute_command("JSON.SET", "edited", "$", '{"l": [3]}')
        assert await kvs["edited"].read() == {"l": [3]}
        async with kvs["edited"]["l"].edit() as value:
            value.append(3)
        assert guarded.now().json().get("edited") == {"l": [1, 2, 3]}


@pytest.mark.parametrize("wrong", ["custom", "write"])
def test_a_ship_that_writes_when_it_reads_goes_to_the_primary(world, opened, wrong):
    """Replicas refuse that, and are not left for it."""

    class Counted:
        def check_fit(self, value):
            return isinstance(value, complex)

        def write(self, key, value, client):
            client.rpush(key, repr(value), repr(value))

        def read(self, key, client):
            client.lrange(key, 0, 0) if wrong == "custom" else client.getex(key, ex=100)

        def interpret_read(self, responses):
            return complex(responses[0][0].decode())

        def get_label(self):
            return "counted"

    if wrong == "write":
        Counted.write = lambda _, key, value, client: client.set(key, repr(value))
        Counted.interpret_read = lambda _, responses: complex(responses[0].decode())
    front = opened(world.url, ships=[Counted()])
    front.write(["shipped"], {"c": 1 + 2j})
    caught_up(world)
    assert front.read(["shipped"]) == {"c": 1 + 2j}
    before = reads_of(world.replicas())
    assert front.read(["shipped", "c"]) == 1 + 2j
    assert reads_of(world.replicas()) > before


def test_document_and_arrays_of_a_read_belong_together_and_time_does_not_go_back(world, opened):
    """While somebody writes both in one transaction, again and again, with arrays coming and going."""
    stop = threading.Event()
    with reem.RedisInterface(world.url) as interface:
        reem.KeyValueStore(interface)["torn"] = {"n": 0, "image": np.zeros(2000)}
    caught_up(world)  # what a replica does not have yet is asked of the primary, which is ahead

    def write():
        with reem.RedisInterface(world.url) as interface:
            kvs, number = reem.KeyValueStore(interface), 0
            while not stop.is_set():
                number += 1
                array = np.full(2000, float(number))
                kvs["torn"] = {"n": number, "image": array, **({"more": array[:5]} if number % 3 else {})}

    writer = threading.Thread(target=write)
    writer.start()
    try:
        front = opened(world.url)
        before, last = reads_of(world.replicas()), 0
        for _ in range(400):
            value = front.read(["torn"])
            assert (value["image"] == value["n"]).all(), value["n"]
            assert "more" not in value or (value["more"] == value["n"]).all()
            assert value["n"] >= last
            last = value["n"]
        assert last > 1
        assert reads_of(world.replicas()) >= before + 400
    finally:
        stop.set()
        writer.join()


# --- users -------------------------------------------------


def test_a_user_needs_one_command_more_and_is_told_which(clustered, opened):
    """The rights in docs/fleet.md will do."""
    rights = re.search(r"```text\nuser r1 (.*?)```", (ROOT / "docs/fleet.md").read_text(), re.DOTALL)[1]
    rules = [rule for rule in rights.replace("\\\n", " ").split() if rule != "#HASH"]
    nodes = [raw_of(node) for node in clustered.cluster.nodes]
    for raw in nodes:
        raw.execute_command("ACL", "SETUSER", "r1", *rules, ">word")
    url = clustered.url.replace("//", "//r1:word@")
    front = opened(url, namespace="robots/r1:")
    front.write(["a"], DOCUMENT)
    caught_up(clustered)
    before = reads_of(clustered.replicas())
    assert_same(front.read(["a"]), DOCUMENT)
    assert reads_of(clustered.replicas()) > before
    for raw in nodes:
        raw.execute_command("ACL", "SETUSER", "r1", "-readonly")
    with pytest.raises(NotAllowed, match="readonly"):
        opened(url, namespace="robots/r1:").read(["a"])
    for raw in nodes:
        raw.acl_deluser("r1")


# --- replicas that are not there -------------------------------------------------


def test_without_replicas_reads_go_to_primaries(cluster, opened):
    """As if the option were not set; the layout is not asked for again and again."""
    front = opened(cluster)
    before = questions_of(cluster.nodes)
    end, number = time.monotonic() + 0.5, 0
    while time.monotonic() < end:
        number += 1
        front.write([f"alone{number % 20}"], number)
        assert front.read([f"alone{number % 20}"]) == number
    for number in range(20):
        front.delete([f"alone{number}"])
    assert questions_of(cluster.nodes) - before <= 3


def test_closing_ends_the_connections_to_replicas_too(world, opened):
    """And nothing is read any more."""
    before = {port_of(each): len(each.client_list(_type="normal")) for each in world.replicas()}
    front = opened(world.url)
    for number in range(4):
        front.write([f"closed{number}"], np.zeros(20_000))
        front.read([f"closed{number}"])
    if isinstance(front.interface, reem.RedisInterface):
        front.interface.close()
    else:
        front.run(front.interface.close())
    eventually(lambda: all(len(each.client_list(_type="normal")) <= before[port_of(each)] for each in world.replicas()))
    for name in ("closed0", "closed9"):
        with pytest.raises(InterfaceClosed):
            front.read([name])


@pytest.mark.alone
def test_a_replica_that_stands_still_is_left_within_the_time_limit(world, opened):
    """Its primary is asked with the other half of it, and at once from then on."""
    front = opened(world.url, timeout=1.6)
    front.write(["still"], DOCUMENT)
    caught_up(world)
    assert_same(front.read(["still"]), DOCUMENT)
    pid = world.pid(port_of(world.replica_of("still")))
    os.kill(pid, signal.SIGSTOP)
    try:
        began = time.monotonic()
        for _ in range(10):
            assert_same(front.read(["still"]), DOCUMENT)
        assert time.monotonic() - began < 1.6
        assert front.interface.state == "connected"
    finally:
        os.kill(pid, signal.SIGCONT)
    eventually(world.known)


def test_a_slot_that_moves_takes_no_value_out_of_sight(clustered, opened):
    """Its keys leave the replicas of the old node one by one; reads find them all the same."""
    front = opened(clustered.url)
    front.write(["moving"], DOCUMENT)
    caught_up(clustered)
    move = Move(clustered.cluster, "moving").begin()
    stages = [lambda: None, lambda: move.take("{moving}.image"), lambda: move.take("moving"), move.finish]
    for stage in stages:
        stage()
        caught_up(clustered)
        if stage != stages[1]:  # in between, a transaction over both waits for the end
            assert_same(front.read(["moving"]), DOCUMENT)
        assert front.read(["moving", "n"]) == 1
    before = reads_of(clustered.replicas())
    for _ in range(3):
        assert_same(front.read(["moving"]), DOCUMENT)
    assert reads_of(clustered.replicas()) > before
    front.delete(["moving"])


@pytest.fixture
def both():
    """Opens both fronts, where a server can be killed only once."""
    with contextlib.ExitStack() as stack:

        def open_(url):
            opened = [kind(url, read_from_replicas=True, timeout=10.0) for kind in FRONTS.values()]
            return [stack.enter_context(contextlib.closing(front)) for front in opened]

        yield open_


def test_reads_go_on_while_there_is_no_primary(clustered, both):
    """Killed -9: its replica answers before, while and after it becomes the primary."""
    fronts = both(clustered.url)
    fronts[0].write(["orphan"], DOCUMENT)
    caught_up(clustered)
    for front in fronts:
        assert_same(front.read(["orphan"]), DOCUMENT)
    heir, reads = clustered.replica_of("orphan"), 0
    victim = kill_primary(clustered.cluster, "orphan")
    clustered.dead.append(victim)
    with (
        contextlib.closing(FRONTS["blocking"](clustered.url, read_from_replicas=True, timeout=0.2)) as late,
        pytest.raises(NotConnected),  # whoever comes now finds a replica out of touch
    ):
        late.read(["orphan"])
    while heir.info("replication")["role"] == "slave":
        for front in fronts:
            assert_same(front.read(["orphan"]), DOCUMENT)
        reads += 1
    assert reads > 20, "they waited for a primary"
    whole_again(clustered.cluster, victim)
    for front in fronts:
        assert_same(front.read(["orphan"]), DOCUMENT)
        front.write(["orphan", "n"], 2)
        eventually(lambda front=front: front.read(["orphan", "n"]) == 2)
        front.delete(["orphan"])
        front.write(["orphan"], DOCUMENT)


def test_reads_go_on_when_the_replica_is_killed(guarded, both):
    """To the primary, without an error."""
    fronts = both(guarded.url)
    fronts[0].write(["killed"], DOCUMENT)
    caught_up(guarded)
    for front in fronts:
        assert_same(front.read(["killed"]), DOCUMENT)
    os.kill(guarded.pid(port_of(guarded.standby())), signal.SIGKILL)
    for front in fronts:
        for _ in range(50):
            assert_same(front.read(["killed"]), DOCUMENT)
        assert front.interface.state == "connected"


def test_one_of_two_replicas_is_kept_to_and_the_other_taken_when_it_is_killed(clustered, both):
    """And a replica that was given to another primary says so to those who read the old one's keys from it."""
    cluster = clustered.cluster
    (first, one), (second, two) = clustered.pair()
    name, orphan = of_node(cluster, first, "kept"), of_node(cluster, second, "kept")
    fronts = both(clustered.url)
    for key in (name, orphan):
        fronts[0].write([key], DOCUMENT)
        caught_up(clustered)
        for front in fronts:
            assert_same(front.read([key]), DOCUMENT)

    two.execute_command("CLUSTER", "REPLICATE", first.execute_command("CLUSTER", "MYID"))
    eventually(lambda: two.info("replication")["master_port"] == port_of(first))
    eventually(lambda: two.info("replication")["master_link_status"] == "up")
    fronts[0].write([orphan, "n"], 2)
    for front in fronts:
        assert front.read([orphan, "n"]) == 2
    eventually(clustered.known)
    for front in fronts:
        assert front.read([orphan, "n"]) == 2
        before = reads_of([two])
        assert [front.read([orphan, "n"]) for _ in range(5)] == [2] * 5
        assert reads_of([two]) == before

    for front in both(clustered.url):
        before = [reads_of([one]), reads_of([two])]
        for _ in range(20):
            assert_same(front.read([name]), DOCUMENT)
        counts = [reads_of([each]) - count for each, count in zip((one, two), before, strict=True)]
        assert min(counts) == 0
        assert max(counts) >= 20
    chosen, other = (one, two) if counts[0] else (two, one)
    before = reads_of([other])
    os.kill(clustered.pid(port_of(chosen)), signal.SIGKILL)
    for _ in range(20):
        assert_same(front.read([name]), DOCUMENT)
    assert reads_of([other]) - before >= 19
