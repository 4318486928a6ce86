"""Presence: which programs are connected, and who joins and leaves within a second, however that comes."""

import asyncio
import contextlib
import json
import logging
import os
import signal
import time

import pytest
import redis
from chaos.proxy import Proxy
from chaos.servers import PrivateServer
from clikit import environment, running
from conftest import FRONTS, PATIENCE, eventually, python, url_of_user
from own_servers import own_server
from test_startup import cluster_port  # noqa: F401 - a fixture

import reem
import reem_async
from reem_async.concurrency.queues import EMPTY

SOON = 1.5
"""Seconds within which it is known that a program has left: one, and what a busy machine adds."""

PROGRAM = """
import sys, time, reem
with reem.RedisInterface(sys.argv[1], name="planner", timeout=0.3) as interface:
    space = reem.PublishSpace(interface, outage="drop")
    space["plan"] = 1
    print("up", flush=True)
    time.sleep(1000)
"""


@contextlib.contextmanager
def program(url, code=PROGRAM):
    with python(code, url, start=True) as process:
        try:
            assert process.stdout.readline().strip() == "up"
            yield process
        finally:
            process.kill()


class Events:
    def __init__(self, front, interface):
        self.front, self.watch = front, interface.watch_nodes()
        front.wait(self.watch.listen())

    def next(self):
        return self.front.take(self.watch)[0]

    def expect(self, kind, name="planner"):
        begin = time.monotonic()
        event = self.next()
        assert (event.kind, event.node.name) == (kind, name)
        assert event.initial or time.monotonic() - begin < SOON
        return event.node


@pytest.fixture
def named(server_url, key):
    """Opens interfaces of either front with a name, in a namespace of the test's own."""
    with contextlib.ExitStack() as stack:

        def open_as(kind, name, url=server_url):
            return stack.enter_context(contextlib.closing(FRONTS[kind](url, namespace=f"{key.prefix}:", name=name)))

        yield open_as


def test_nodes_are_listed_with_what_they_do_until_they_close(named, raw, key, cli):
    """In the order of their names; two may have one name. No tool takes them for data, and nothing is left."""
    one, other, unnamed = named("blocking", "planner"), named("blocking", "planner"), named("blocking", None)
    reem.PublishSpace(one.interface)["plan"] = [1]
    activities = one.interface._direct.session.activities
    for name in ("policy", "policy", "map"):
        activities.add_service(name)
    activities.remove_service("policy")
    activities.remove_service("nothing")

    nodes = unnamed.interface.nodes
    eventually(lambda: sorted(node.publishes for node in nodes()) == [(), ("plan",)])
    first, second = sorted(nodes(), key=lambda node: not node.publishes)
    assert (first.name, second.name, first.pid, second.pid) == ("planner", "planner", os.getpid(), os.getpid())
    assert first.id != second.id
    assert first.host == second.host
    assert 0 <= first.since < PATIENCE
    assert (first.serves, first.owns) == (("map", "policy"), ())
    events = Events(unnamed, unnamed.interface)
    assert {events.next().node.id, events.next().node.id} == {first.id, second.id}

    assert cli("ls").stdout.split()[0] == "plan"
    assert cli("snapshot", "save", os.devnull, "--force").stderr.count("_nodes") == 0
    table = cli("nodes").stdout.splitlines()
    assert len(table) == 2
    assert any(line.split("\t")[4:] == ["plan", "map,policy", "-"] for line in table)
    listed = [json.loads(line) for line in cli("nodes", "--json").stdout.splitlines()]
    assert {node["id"] for node in listed} == {first.id, second.id}

    other.wait(other.interface.close())
    assert events.expect("left").id == second.id
    one.wait(one.interface.close())
    assert cli("nodes").returncode == 3
    eventually(lambda: not list(raw.scan_iter(match=f"*{key.prefix}:_nodes*")))


@pytest.mark.parametrize("kind", FRONTS)
def test_a_key_is_listed_with_its_owner_while_it_is_owned(named, kind):
    one, other = named(kind, "joystick"), named("blocking", None)

    def owned():
        if kind == "asyncio":
            one.run(asyncio.sleep(0.02))
        return [node.owns for node in other.interface.nodes()]

    cmd = one.kvs["cmd"].own(ttl=1.5, name="joystick")
    one.wait(cmd.acquire())
    eventually(lambda: owned() == [("cmd",)])
    eventually(lambda: owned() == [()])  # it was not renewed
    one.wait(cmd.acquire())
    eventually(lambda: owned() == [("cmd",)])
    one.wait(cmd.release())
    eventually(lambda: owned() == [()])


@pytest.mark.parametrize("front", FRONTS)
@pytest.mark.parametrize("fault", ["killed", "stopped", "cut"])
def test_who_leaves_without_a_word_is_gone_within_a_second(server, front, fault):
    """And joins again as the same node, if it was only stopped or cut off."""
    with (
        Proxy(server.port) as link,
        program(link.url) as process,
        contextlib.closing(FRONTS[front](server.url)) as watcher,
        redis.Redis.from_url(server.url) as raw,
    ):
        events = Events(watcher, watcher.interface)
        there = events.expect("joined")
        assert there.pid == process.pid
        time.sleep(0.3)
        {
            "killed": process.kill,
            "stopped": lambda: os.kill(process.pid, signal.SIGSTOP),
            "cut": link.black_hole,
        }[fault]()
        assert events.expect("left").id == there.id
        if fault == "killed":
            eventually(lambda: not list(raw.scan_iter(match="*_nodes*")))
            return
        os.kill(process.pid, signal.SIGCONT)
        link.heal()
        again = events.expect("joined")
        assert again.id == there.id
        assert again.since > there.since


ROLES = """
import sys, time, reem
with reem.RedisInterface(sys.argv[1], name="planner") as interface:
    kvs = reem.KeyValueStore(interface)
    kp = kvs["control"].parameter("kp", 1.0)
    with kvs["command"].mirror(ttl=0.5) as command:
        print("up", flush=True)
        while True:
            print(kp.value, command.value(default="silent"), kvs["double"].call(number=2), flush=True)
            time.sleep(0.05)
"""


def test_a_program_that_was_stopped_goes_on_in_each_role(server):
    """It calls, follows commands and has a parameter: afterwards it gets present values, and its call its answer."""
    with reem.RedisInterface(server.url) as interface:
        kvs, space = reem.KeyValueStore(interface), reem.PublishSpace(interface)

        def last_line_is(*words):
            space["command"] = words[1]
            return process.stdout.readline().split() == [*map(str, words)]

        with kvs["double"].serve(lambda number: 2 * number), program(server.url, ROLES) as process:
            eventually(lambda: last_line_is(1.0, 7, 4))
            os.kill(process.pid, signal.SIGSTOP)
            eventually(lambda: not interface.nodes())
            kvs["control"]["kp"] = 3.0
            os.kill(process.pid, signal.SIGCONT)
            eventually(lambda: last_line_is(3.0, 8, 4))
            eventually(interface.nodes)


@pytest.mark.parametrize(
    "keep", [pytest.param(True, marks=pytest.mark.long, id="with its data"), pytest.param(False, id="without")]
)
def test_nodes_are_back_within_a_second_after_a_restart(keep):
    """And none is reported to have left, since it has not, also one that takes a moment longer."""
    with (
        PrivateServer(keep=keep) as server,
        reem.RedisInterface(server.url, name="planner"),
        program(server.url) as slow,
        reem.RedisInterface(server.url, timeout=0.3) as watcher,
    ):
        eventually(lambda: len(watcher.nodes()) == 2)
        with watcher.watch_nodes() as watch:
            assert [next(watch).node.name for _ in range(2)] == ["planner"] * 2
            slow.send_signal(signal.SIGSTOP)
            server.kill()
            time.sleep(1.2)
            server.start()
            begin = time.monotonic()
            eventually(lambda: contextlib.suppress(reem.ReemError) and watcher.nodes())
            assert time.monotonic() - begin < SOON
            time.sleep(0.25)  # a watch has asked by now
            slow.send_signal(signal.SIGCONT)
            time.sleep(1.3)
            assert watch._core.queue.take() is EMPTY
            assert len(watcher.nodes()) == 2


@pytest.mark.parametrize("kind", ["cluster", pytest.param("sentinel", marks=pytest.mark.long)])
def test_nodes_of_several_servers(kind, request):
    if kind == "cluster":
        url = f"redis+cluster://127.0.0.1:{request.getfixturevalue('cluster_port')}"
    else:
        url = request.getfixturevalue("watched").url
    with contextlib.closing(reem.RedisInterface(url)) as watcher, program(url) as process:
        with watcher.watch_nodes() as watch:
            assert next(watch).node.pid == process.pid
            process.kill()
            begin = time.monotonic()
            assert next(watch).kind == "left"
            assert time.monotonic() - begin < SOON
        assert watcher.nodes() == []


async def test_many_nodes(server):
    async with contextlib.AsyncExitStack() as stack:
        watcher = await stack.enter_async_context(reem_async.RedisInterface(server))
        watch = await stack.enter_async_context(watcher.watch_nodes())
        names = [f"node{number:02}" for number in range(50)]
        interfaces = [await stack.enter_async_context(reem_async.RedisInterface(server, name=name)) for name in names]
        async with asyncio.timeout(PATIENCE):
            assert sorted([(await anext(watch)).node.name for _ in names]) == names
        assert [node.name for node in await watcher.nodes()] == names
        for interface in interfaces:
            await interface.close()
        assert await watcher.nodes() == []
        async with asyncio.timeout(SOON):
            assert sorted([(await anext(watch)).node.name for _ in names]) == names


@pytest.mark.parametrize("front", FRONTS)
def test_a_user_without_the_rights_is_told_once_and_works_on(front, caplog):
    with own_server() as process, process.admin() as admin:
        admin.execute_command("ACL", "SETUSER", "robot", "on", ">pw", "~foo", "~{foo}*", "&*", "+@all")
        caplog.set_level(logging.WARNING, "reem.presence")
        with contextlib.closing(FRONTS[front](url_of_user(process.url, "robot", "pw"), name="planner")) as robot:
            robot.write(["foo"], 1)
            robot.until(lambda: caplog.messages)
            assert robot.read(["foo"]) == 1
            later = time.monotonic() + 0.6
            robot.until(lambda: time.monotonic() > later)
            assert len(caplog.messages) == 1
            assert "_nodes" in caplog.messages[0]
            with pytest.raises(reem.NotAllowed, match="_nodes"):
                robot.wait(robot.interface.nodes())


def test_what_is_no_node_is_ignored(interface, raw, key):
    """Whatever other programs have stored there."""
    tag = f"{{{key.prefix}:_nodes}}:node"
    one = reem.RedisInterface(interface._direct._given[0], namespace=f"{key.prefix}:")
    good = {"name": "a", "host": "h", "pid": 1, "since": 1.0, "publishes": [], "serves": [], "owns": []}
    strange = [{"name": "a\x1b[2J"}, {"pid": "1"}, {"since": -1}, {"serves": [{}]}, {"host": "x" * 10**5}, {"owns": 5}]
    texts = [json.dumps(good), *(json.dumps(good | change) for change in strange), "[" * 10**5, "", "\xff", "null"]
    for number, text in enumerate(texts):
        raw.set(f"{tag}:{number:012x}", text)
        raw.sadd(f"{tag}s", f"{number:012x}", f"nonsense{number}")
    assert [node.id for node in one.nodes()] == ["0" * 12]
    raw.delete(f"{tag}s")
    raw.set(f"{tag}s", "a foreign value")
    with pytest.raises(redis.exceptions.ResponseError):
        one.nodes()
    one.close()


@pytest.mark.parametrize("name", ["", "a b", "a\n", "x" * 65, "\x1b[2J", "\u202e", 5, b"a"])
@pytest.mark.parametrize("package", [reem, reem_async])
def test_what_is_no_name_is_refused(package, name):
    with pytest.raises(reem.BadInput, match="name="):
        package.RedisInterface("localhost", name=name)


def test_a_forked_child_is_a_node_of_its_own_once_it_calls(server):
    with reem.RedisInterface(server, name="planner") as interface, reem.KeyValueStore(interface)["cmd"].own(ttl=60):
        reem.KeyValueStore(interface)["plan"].serve(lambda: None)
        eventually(interface.nodes)
        child = os.fork()
        if not child:
            with contextlib.suppress(BaseException):
                interface.nodes()
                time.sleep(1000)
            os._exit(1)
        try:
            roles = {(os.getpid(), ("plan",), ("cmd",)), (child, (), ())}
            eventually(lambda: {(node.pid, node.serves, node.owns) for node in interface.nodes()} == roles)
        finally:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        eventually(lambda: [node.pid for node in interface.nodes()] == [os.getpid()])


def test_the_command_prints_who_joins_and_leaves(server):
    host = os.uname().nodename
    with (
        reem.RedisInterface(server, name="first") as first,
        running("nodes", "--watch", env=environment(REEM_URL=server.url)) as command,
    ):
        eventually(first.nodes)
        assert f"there   first  {host}  pid {os.getpid()}" in command.stdout.readline()
        with program(server.url) as process:
            assert f"joined  planner  {host}  pid {process.pid}" in command.stdout.readline()
        assert f"left    planner  {host}  pid {process.pid}" in command.stdout.readline()
        command.send_signal(signal.SIGINT)
        assert command.wait(PATIENCE) == 0
