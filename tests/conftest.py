"""Fixtures and small tools shared by all tests.

The fast run (`make test`) leaves out tests that are marked `long` or `alone`, runs a test of both fronts on one of
them (the test's name decides which), and tries fewer seeds and examples (`sized`). `--long` or REEM_TEST_LONG=1 is the
long run.

The server is `$REEM_TEST_URL` if set, else an `EmbeddedServer`, else a `redis:8` container; with
`REEM_TEST_SERVER=cluster` it is an `EmbeddedCluster` of three primaries, with `REEM_TEST_SERVER=plain` no server
that a test starts has the JSON module. It is not flushed: every test
names its keys through the `key` fixture, and what carries its prefix is unlinked.
"""

import asyncio
import contextlib
import itertools
import operator
import os
import re
import select
import signal
import struct
import subprocess
import sys
import textwrap
import threading
import time
import uuid
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import redis

# Started in the background, this process ignores Ctrl-C, and so would every program that it starts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests start hundreds of programs. Where the environment forbids to keep bytecode, each of them would compile all of
# REEM anew, which takes longer than most tests.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

ROOT = Path(__file__).resolve().parents[1]

# Set in the environment too: the workers of pytest-xdist and the programs that tests start read it there.
if "--long" in sys.argv:
    os.environ["REEM_TEST_LONG"] = "1"

LONG = bool(os.environ.get("REEM_TEST_LONG"))
"""Whether this is the long run: every test, on both fronts, at full size."""


def sized(fast, long):
    """Return how much a test does in this run: seeds, examples, updates or seconds."""
    return long if LONG else fast


EXAMPLES = int(os.environ.get("REEM_TEST_EXAMPLES", sized(300, 2000)))
"""How many documents (and a fifth of it, arrays) the property tests try; the full promise is 100000."""

PATIENCE = 30.0
"""Seconds after which something that must happen is given up on."""


PLAIN = os.environ.get("REEM_TEST_SERVER") == "plain"
if PLAIN:
    import plainkit

    os.environ["REEM_SERVER_PLAIN"] = "1"  # for the servers of other processes too
    plainkit.teach(redis.Redis)


# --- the server -------------------------------------------------


@contextlib.contextmanager
def _container():
    """A redis:8 in Docker; not exercised where Docker does not run."""
    from testcontainers.redis import RedisContainer

    with RedisContainer("redis:8") as box:
        yield f"redis://{box.get_container_host_ip()}:{box.get_exposed_port(6379)}/0"


@pytest.fixture(scope="session")
def cluster():
    from reem_async.server.cluster import EmbeddedCluster

    with EmbeddedCluster(replicas=0) as running:
        yield running


@pytest.fixture(scope="session")
def server_url(request):
    given = os.environ.get("REEM_TEST_URL")
    if given:
        yield given
        return
    if os.environ.get("REEM_TEST_SERVER") == "cluster":
        yield request.getfixturevalue("cluster").url
        return
    from reem_async.errors import ServerMissing
    from reem_async.server import EmbeddedServer

    with contextlib.ExitStack() as stack:
        try:
            url = stack.enter_context(EmbeddedServer()).url
        except ServerMissing:
            url = stack.enter_context(_container())
        yield url


@pytest.fixture
def server():
    from reem_async.server import EmbeddedServer

    with EmbeddedServer() as own:
        yield own


@contextlib.contextmanager
def stopped(server):
    os.kill(server.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(server.pid, signal.SIGCONT)


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """A primary and a replica that sentinels watch."""
    from sentinelkit import Watched

    with contextlib.ExitStack() as stack:
        yield Watched(tmp_path_factory.mktemp("sentinels"), stack)


ONE_SERVER = {
    "test_a_forked_childs_loop_does_not_wait_for_its_parents_tasks": "in a cluster it takes a second",
    "test_all_subscribers_of_an_interface_share_one_connection": "counts connections: in a cluster, one for each node",
    "test_connections_of_redis_py_have_the_attributes": "takes the URL of one server apart",
    "test_a_plain_client_of_the_same_server": "the plain client is for one server",
    "test_a_plain_client_for_asyncio": "the same",
    "test_the_state_server_of_a_robot": "the same",
    "test_a_server_on_the_port_is_named": "the same",
    "test_an_event_loop_that_ends_sends_what_was_published": "each node's connection ends by itself then",
    "test_a_store_and_its_transport_keep_a_bounded_number_of_keys": "looks into the transport of one server",
    "test_a_large_array_waits_for_small_calls_that_are_under_way": "the same",
    "test_what_is_stored_is_of_one_instant_though_another_task_comes_first": "the same",
}
"""Tests of what only one server has, and why."""


WITH_MODULE = {
    "test_the_page_of_the_wire_format_is_what_servers_hold_and_receive": "compares a server of each kind",
    "test_the_server_never_calculates_near_the_end_of_its_range": "counts commands of the module",
    "test_a_server_takes_the_sample_configuration": "its file of users names commands of the module",
    "test_compose_starts_the_server_with_these_files": "the same",
    "test_another_namespace": "the same",
    "test_nobody_gets_in_without_a_password": "the same",
    "test_outline_tells_what_is_there_without_fetching_arrays": "counts GET",
    "test_a_write_that_loses_the_server_before_its_last_step_says_so": "without it there is no such step",
    "test_the_servers_own_text_would_not_do": "shows how the module reads numbers",
    "test_a_client_that_may_not_read_the_document_removes_no_array_of_it": "may ask for the type of a document alone",
    "test_without_the_right_to_use_json_one_hears_of_it_on_connecting": "the same",
    "test_each_short_key_of_odd_characters_is_addressed_exactly_or_refused": "tries how the module reads paths",
    "test_each_character_first_last_or_alone_is_addressed_exactly_or_refused": "the same",
    "test_everything_security_md_says_to_type_works": "the same",
    "test_migration.py": "what REEM 0.1 has stored are documents of the module, in a layout of their own",
    "test_reem_server_with_json": "hands the module to a server",
    "test_path_is_tried_in_order_and_passed_over_without_json": "the same",
    "test_a_plain_client_of_the_same_server": "calls the module; test_plain.py has what it says without",
    "test_a_plain_client_for_asyncio": "the same",
    "test_the_state_server_of_a_robot": "the same",
    "test_an_event_loop_that_ends_sends_what_was_published": "a write takes a generator, which an ending loop warns of",
}
"""Tests, and files of tests, of what only a server with the JSON module does, and why."""


def pytest_addoption(parser):
    parser.addoption("--long", action="store_true", help="every test, on both fronts, at full size")


def _waits_for_the_long_run(item):
    """Return whether the fast run leaves out a test: it is marked, or the same test runs on the other front."""
    if item.get_closest_marker("long") or item.get_closest_marker("alone"):
        return True
    params = item.callspec.params.values() if hasattr(item, "callspec") else ()
    fronts = {"blocking", "asyncio"}.intersection(value for value in params if isinstance(value, str))
    if len(fronts) != 1:
        return False
    chosen = zlib.crc32(re.sub("blocking|asyncio", "front", item.nodeid).encode()) % 2
    return fronts != {("blocking", "asyncio")[chosen]}


FIRST = {"docs", "migration", "hunt", "local_mailboxes", "exit", "recording_file", "cli", "cli_odd", "cli_record"}
FIRST |= {"fork", "presence", "hostile", "slot_moves", "local_memory", "browser_page", "expiry", "watch_model", "demo"}
"""Files that take longest, begun first: else the processes wait for one of them at the end."""


def pytest_collection_modifyitems(config, items):
    """In the fast run, leave out long tests and one of two fronts, and begin with the files that take longest.

    On a cluster, keep the tests of the shared server, but skip what only one server has; on a plain server, skip what
    only the module does.
    """
    if not LONG:
        config.hook.pytest_deselected(items=[item for item in items if _waits_for_the_long_run(item)])
        items[:] = [item for item in items if not _waits_for_the_long_run(item)]
        items.sort(key=lambda item: item.path.stem.removeprefix("test_") not in FIRST)
    if PLAIN:
        for item in items:
            reason = WITH_MODULE.get(item.originalname) or WITH_MODULE.get(item.path.name)
            if reason:
                item.add_marker(pytest.mark.skip(reason=reason))
    if os.environ.get("REEM_TEST_SERVER") == "cluster":
        config.hook.pytest_deselected(items=[item for item in items if "server_url" not in item.fixturenames])
        items[:] = [item for item in items if "server_url" in item.fixturenames]
        for item in items:
            if item.originalname in ONE_SERVER:
                item.add_marker(pytest.mark.skip(reason=ONE_SERVER[item.originalname]))


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session, exitstatus):
    """With REEM_TEST_AGAIN=N, which `.ci/run` sets: run up to N failed tests again, with nothing beside them.

    A test that passes then is still listed with its failure, but the run passes.
    """
    most = int(os.environ.get("REEM_TEST_AGAIN", 0))
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if hasattr(session.config, "workerinput") or reporter is None or exitstatus != pytest.ExitCode.TESTS_FAILED:
        return
    failed = sorted({report.nodeid for kind in ("failed", "error") for report in reporter.stats.get(kind, ())})
    if not 0 < len(failed) <= most:
        return
    command = [sys.executable, "-m", "pytest", "-q", *["--long"] * LONG, *failed]
    again = subprocess.run(command, cwd=ROOT, env=os.environ | {"REEM_TEST_AGAIN": "0"}, check=False)
    reporter.write_line(f"failed, then run alone with exit code {again.returncode}: {', '.join(failed)}", yellow=True)
    if again.returncode == 0:
        session.exitstatus = pytest.ExitCode.OK


class RawCluster(redis.RedisCluster):
    """A plain client of a cluster that answers for all primaries where one server answers for itself."""

    def info(self, section=None):
        answers = super().info(section, target_nodes=redis.RedisCluster.PRIMARIES)
        if section != "commandstats":
            return next(iter(answers.values()))
        total = {}
        for rows in answers.values():
            for label, row in rows.items():
                sums = total.setdefault(label, {})
                for name, number in row.items():
                    sums[name] = sums.get(name, 0) + number
        return total

    def client_list(self, **options):
        answers = super().client_list(target_nodes=redis.RedisCluster.PRIMARIES, **options)
        return [row | {"id": f"{node} {row['id']}"} for node, rows in answers.items() for row in rows]

    def client_kill_filter(self, _id=None, **options):
        if _id is None:
            return super().client_kill_filter(target_nodes=redis.RedisCluster.PRIMARIES, **options)
        node, number = _id.split(" ")
        return super().client_kill_filter(_id=number, target_nodes=self.get_node(node_name=node), **options)

    def execute_command(self, *words, **options):
        if PLAIN and (words[0] == "TYPE" or words[0].startswith("JSON.")):
            return self.get_node_from_key(words[1]).redis_connection.execute_command(*words, **options)
        if words[0] == "ACL":
            options.setdefault("target_nodes", redis.RedisCluster.PRIMARIES)
        return super().execute_command(*words, **options)

    def pubsub_numpat(self):
        return sum(node.redis_connection.pubsub_numpat() for node in self.get_primaries())

    def publish(self, channel, message):
        return self.spublish(channel, message)


@pytest.fixture(scope="session")
def raw(server_url):
    if server_url.startswith("redis+cluster://"):
        first = server_url.replace("redis+cluster://", "redis://").split(",")[0]
        with contextlib.closing(RawCluster.from_url(first, decode_responses=True)) as client:
            yield client
        return
    with redis.Redis.from_url(server_url, decode_responses=True) as client:
        yield client


def url_of_user(url, name, password):
    scheme, _, rest = url.partition("://")
    return f"{scheme}://{name}:{password}@{rest.rpartition('@')[2]}"


@contextlib.asynccontextmanager
async def server_without_right(right):
    """A server of its own: a store there, and the address of a user who lacks one right."""
    import reem_async
    from reem_async.server import EmbeddedServer

    async with EmbeddedServer() as server, reem_async.RedisInterface(server) as interface:
        with redis.Redis.from_url(server.url) as client:
            client.execute_command("ACL", "SETUSER", "robot", "on", ">pw", "~*", "&*", "+@all", f"-{right}")
        yield reem_async.KeyValueStore(interface), url_of_user(server.url, "robot", "pw")


class Keys:
    """Makes names that no other test uses: `key("foo")` and `key("foobar")` share their beginning."""

    def __init__(self):
        self.prefix = f"t{uuid.uuid4().hex[:10]}"

    def __call__(self, name="foo"):
        return self.prefix + name


@pytest.fixture
def key(raw):
    keys = Keys()
    yield keys
    left = list(raw.scan_iter(match=f"*{keys.prefix}*", count=1000))
    if left:
        raw.unlink(*left)


# --- the two fronts -------------------------------------------------


@pytest.fixture
def interface(server_url, key):
    import reem

    with contextlib.closing(reem.RedisInterface(server_url)) as opened:
        yield opened


@pytest.fixture
def kvs(interface):
    import reem

    return reem.KeyValueStore(interface)


@pytest.fixture
def pspace(interface):
    import reem

    return reem.PublishSpace(interface)


@pytest.fixture
async def ainterface(server_url, key):
    import reem_async

    async with reem_async.RedisInterface(server_url) as opened:
        yield opened


@pytest.fixture
async def binterface(server_url):
    """Another interface to the same server, such as a recorder has."""
    import reem_async

    async with reem_async.RedisInterface(server_url) as opened:
        yield opened


@pytest.fixture
def file(tmp_path):
    return tmp_path / "run.mcap"


@pytest.fixture
def cli(server_url, key):
    """The command line, in a namespace of the test's own."""
    from clikit import CommandLine

    return CommandLine(server_url, f"{key.prefix}:")


@pytest.fixture
async def akvs(ainterface):
    import reem_async

    return reem_async.KeyValueStore(ainterface)


@pytest.fixture
async def apspace(ainterface):
    import reem_async

    return reem_async.PublishSpace(ainterface)


@pytest.fixture
async def far_space(server_url):
    """Publishes as a program of another host: large updates have to be fetched."""
    import reem_async

    async with reem_async.RedisInterface(server_url, local="off") as interface:
        yield reem_async.PublishSpace(interface)


def _of_place(name):
    return lambda self, path, *given: self.wait(getattr(self.at(path), name)(*given))


def _of_store(name):
    return lambda self, *given: self.wait(getattr(self.kvs, name)(*given))


def _with_syntax(operation):
    return lambda self, path, value: operation(self.at(path), value)


class Front:
    def at(self, path):
        handle = self.kvs
        for element in path:
            handle = handle[element]
        return handle

    read, write, delete, length, type = map(_of_place, ("read", "write", "delete", "length", "type"))
    append, extend, increment = map(_of_place, ("append", "extend", "increment"))
    multiply, divide = map(_of_place, ("multiply", "divide"))
    set, get, contains = map(_of_store, ("set", "get", "contains"))


class BlockingFront(Front):
    def __init__(self, url, space="KeyValueStore", **options):
        import reem

        self.interface = reem.RedisInterface(url, **options)
        self.interface.initialize()
        self.kvs = getattr(reem, space)(self.interface)

    def wait(self, result):
        return result

    def until(self, condition):
        eventually(condition)

    def take(self, updates, count=1):
        """The next updates, or a failure in place of waiting for ever."""
        return ThreadPoolExecutor(1).submit(lambda: [next(updates) for _ in range(count)]).result(PATIENCE)

    def write(self, path, value):
        self.at(path[:-1])[path[-1]] = value

    def delete(self, path):
        del self.at(path[:-1])[path[-1]]

    def length(self, path):
        return len(self.at(path))

    extend = increment = _with_syntax(operator.iadd)
    multiply, divide = map(_with_syntax, (operator.imul, operator.itruediv))

    def contains(self, name):
        return name in self.kvs

    def close(self):
        self.interface.close()


class AsyncFront(Front):
    """`reem_async`, each call run to its end on a loop of its own."""

    def __init__(self, url, space="KeyValueStore", **options):
        import reem_async

        self.runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
        self.interface = reem_async.RedisInterface(url, **options)
        self.run(self.interface.initialize())
        self.kvs = getattr(reem_async, space)(self.interface)

    def run(self, awaitable):
        async def wait():
            return await awaitable

        return self.runner.run(wait())

    wait = run

    def until(self, condition):
        """Wait, and have the event loop go on meanwhile; the condition may use it, too."""
        eventually(lambda: condition() or self.run(asyncio.sleep(0.005)))

    def take(self, updates, count=1):
        async def taken():
            return [await asyncio.wait_for(anext(updates), PATIENCE) for _ in range(count)]

        return self.run(taken())

    def close(self):
        try:
            self.run(self.interface.close())
        finally:
            self.runner.close()


FRONTS = {"blocking": BlockingFront, "asyncio": AsyncFront}


class Loop:
    """A loop over updates of either front, one by one."""

    def __init__(self, front, watch):
        self.front, self.watch = front, watch
        front.wait(watch.listen())

    def next(self):
        return self.front.take(self.watch)[0]

    def told(self):
        """What the next update says: origin, path, value and whether something is gone."""
        update = self.next()
        return str(update.origin), update.path, update.value, update.deleted

    def close(self):
        self.front.wait(self.watch.close())


@pytest.fixture(params=list(FRONTS))
def open_front(request, server_url, key):
    with contextlib.ExitStack() as stack:

        def open_(space="KeyValueStore", url=server_url, **options):
            return stack.enter_context(contextlib.closing(FRONTS[request.param](url, space, **options)))

        yield open_


@pytest.fixture
def front(open_front):
    return open_front()


# --- comparing -------------------------------------------------


def same_bits(one, other):
    """Equal shape, dtype and content, bit by bit; padding between fields does not count."""
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    if one.dtype.names:
        return all(same_bits(one[name], other[name]) for name in one.dtype.names)
    return one.tobytes() == other.tobytes()


def assert_same(read, written, where="value"):
    """What was read is what was written: type by type and bit by bit; a tuple has become a list."""
    if isinstance(written, np.ndarray):
        assert isinstance(read, np.ndarray), f"{where}: {type(read)} in place of an array"
        assert same_bits(read, written), f"{where}: {read!r} in place of {written!r}"
    elif isinstance(written, dict):
        assert type(read) is dict, f"{where}: {read!r}"
        assert set(read) == set(written), f"{where}: keys {set(read) ^ set(written)!r} differ"
        for name in written:
            assert_same(read[name], written[name], f"{where}[{name!r}]")
    elif isinstance(written, (list, tuple)):
        assert type(read) is list, f"{where}: {read!r}"
        assert len(read) == len(written), f"{where}: {len(read)} items in place of {len(written)}"
        for index, item in enumerate(written):
            assert_same(read[index], item, f"{where}[{index}]")
    elif isinstance(written, float):
        assert type(read) is float, f"{where}: {read!r} in place of {written!r}"
        assert struct.pack("<d", read) == struct.pack("<d", written), f"{where}: {read!r} is not {written!r}"
    else:
        assert type(read) is type(written), f"{where}: {read!r} in place of {written!r}"
        assert read == written, f"{where}: {read!r} in place of {written!r}"


# --- looking behind the scenes -------------------------------------------------

HOUSEKEEPING = {"info", "ping", "hello", "auth", "select", "client", "command"}


def commands_run(raw):
    """How many commands of each name the server has run or turned down, but for housekeeping."""
    counts = {}
    for label, row in raw.info("commandstats").items():
        name = label.removeprefix("cmdstat_").lower()
        if name.split("|")[0] not in HOUSEKEEPING:
            counts[name] = row["calls"] + row.get("rejected_calls", 0)
    return counts


LOOKING = {"scan", "ssubscribe", "cluster|slots"}
"""What a monitor sends in a cluster to find keys and follow them. One server has patterns for that."""


def _sent_since(raw, before):
    return {name: count - before.get(name, 0) for name, count in commands_run(raw).items() if count != before.get(name)}


@contextlib.contextmanager
def nothing_sent(raw):
    """Fails if the server saw any command inside the block."""
    before = commands_run(raw)
    yield
    sent = _sent_since(raw, before)
    assert not sent, f"the server was sent {sent}"


@contextlib.contextmanager
def nothing_fetched(raw):
    """As `nothing_sent`, but in a cluster keys may be looked for and followed."""
    before = commands_run(raw)
    yield
    sent = _sent_since(raw, before)
    assert not sent.keys() - (LOOKING if isinstance(raw, RawCluster) else set()), f"the server was sent {sent}"


def keys_of(raw, top_key):
    return {name for name in raw.scan_iter(match=f"*{top_key}*", count=1000) if name.startswith("{" + top_key + "}")}


def placeholders(node):
    """Every placeholder in a document as the server holds it."""
    if isinstance(node, str):
        return [node] if node.startswith("$ship ") else []
    if isinstance(node, dict):
        node = list(node.values())
    return [found for child in node for found in placeholders(child)] if isinstance(node, list) else []


def assert_no_orphans(raw, top_key):
    """Arrays, registry and placeholders of a top-level key name each other exactly; nothing else exists."""
    import json

    text = raw.execute_command("JSON.GET", top_key)
    found = placeholders(json.loads(text)) if text is not None else []
    registry = "{" + top_key + "}:ships"
    last = "{" + top_key + "}:last"  # which notice was the last: expires by itself
    assert raw.ttl(last) in range(-2, 61), "the note of the last notice must expire"
    assert raw.ttl(last) != -1
    arrays = {name.removeprefix("{" + top_key + "}") for name in keys_of(raw, top_key) - {registry, last}}
    members = set(raw.smembers(registry))
    assert members == arrays, f"registry and arrays differ by {members ^ arrays}"
    assert len(found) == len(arrays), f"placeholders {found} but arrays {arrays}"
    for name in arrays:
        assert any(name in text for text in found), f"no placeholder for {name} among {found}"


class Remembering(set):
    """What is put in can be taken out by somebody else before a test looks.

    Attributes:
        ever: All that was put in since it was last taken from here.
    """

    def __init__(self):
        super().__init__()
        self.ever = set()

    def add(self, item):
        self.ever.add(item)
        super().add(item)


def subscribed(raw):
    """The ids of the connections that are subscribed to anything."""
    rows = raw.client_list()
    return {row["id"] for row in rows if any(int(row.get(kind, 0)) for kind in ("sub", "psub", "ssub"))}


def homes(raw, names):
    """On how many servers these top-level keys are: whoever follows all of them has one connection to each."""
    return len({raw.get_node_from_key(name).name for name in names}) if isinstance(raw, RawCluster) else 1


def subscriptions(raw):
    """How many channels and patterns all connections together are subscribed to."""
    return sum(int(row.get(kind, 0)) for row in raw.client_list() for kind in ("sub", "psub", "ssub"))


# --- waiting and other processes -------------------------------------------------


def eventually(condition, timeout=PATIENCE):
    """Wait until the condition holds; returns its last value."""
    deadline = time.monotonic() + timeout
    while not (value := condition()) and time.monotonic() < deadline:
        time.sleep(0.005)
    assert value, f"did not come true within {timeout} s"
    return value


async def aeventually(condition, timeout=PATIENCE):
    deadline = time.monotonic() + timeout
    while not (value := condition()) and time.monotonic() < deadline:
        await asyncio.sleep(0.005)
    assert value, f"did not come true within {timeout} s"
    return value


@contextlib.contextmanager
def repeated(work, pause=0.0):
    """Call `work` in a thread of its own with 1, 2, 3 and so on, until the block ends."""
    over = threading.Event()

    def run():
        for number in itertools.count(1):
            if over.wait(pause):
                return
            work(number)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def line_of(descriptor, patience=60.0):
    """The next line that a process says, "" at its end: what comes after stays in the pipe, for `communicate`.

    A `readline` may take more than its line into a buffer that `communicate` does not look into.
    """
    line, deadline = b"", time.monotonic() + patience
    while not line.endswith(b"\n"):
        assert select.select([descriptor], [], [], max(deadline - time.monotonic(), 0))[0], f"silent, but for {line}"
        if not (byte := os.read(descriptor, 1)):
            break
        line += byte
    return line.decode()


def python(code, *arguments, flags=("-X", "dev", "-W", "error"), start=False, **changes):
    """Run code in another Python; returns the finished process, or with `start` the running one."""
    command = [sys.executable, *flags, "-c", textwrap.dedent(code), *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"} | changes
    if start:
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    done.stderr = SLOW_MACHINE.sub("", done.stderr)
    return done


def assert_ends_well(*words, timeout=300):
    """Run a program of the tests, which tells what is wrong by its exit code."""
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, f"{command}\n{done.stdout[-6000:]}\n{done.stderr[-6000:]}"


SLOW_MACHINE = re.compile(r"^Executing <.* took \d+\.\d+ seconds\n", re.MULTILINE)
"""What asyncio's debug mode says of a machine that is busy with something else."""
