"""What people do with the command line says and does the same on a cluster and behind sentinels."""

import contextlib
import json
import re
import signal
import threading

import httpx
import numpy as np
import pytest
from clikit import CommandLine, begins
from conftest import PATIENCE, PLAIN, assert_same, eventually
from sentinelkit import Watched
from test_cli_browse import address_in, browsing
from typer.testing import CliRunner

import reem
from reem_async.errors import ServerMissing
from reem_async.server.cluster import EmbeddedCluster
from reem_async.tools.cli import build

pytestmark = pytest.mark.long

SPACE = "fleet:"
NAMES = [f"k{number:02}" for number in range(36)]
"""Enough that every node of a cluster has some."""

STARTING = 60.0
"""Seconds for processes to start on a busy machine."""


def value_of(number):
    return {"n": number, "array": np.arange(number * 1000.0), "list": [1, "two", None]}


@pytest.fixture(scope="module", params=["cluster", "sentinels"])
def kind(request):
    """Several servers of some kind: what there is on one of them is tested in the files of each command."""
    return request.param


@pytest.fixture(scope="module")
def url(kind, request, tmp_path_factory):
    with contextlib.ExitStack() as stack:
        try:
            if kind == "sentinels":
                yield Watched(tmp_path_factory.mktemp("sentinels"), stack, json=not PLAIN).url
            elif PLAIN:
                yield stack.enter_context(EmbeddedCluster(replicas=0, json=False)).url
            else:
                yield request.getfixturevalue("cluster").url
        except ServerMissing as missing:
            pytest.skip(f"needs servers of its own: {missing}")


@pytest.fixture
def interface(url):
    """One whose keys are those of the test, and gone afterwards."""
    with reem.RedisInterface(url, namespace=SPACE) as opened:
        kvs = reem.KeyValueStore(opened)
        for number, name in enumerate(NAMES):
            kvs[name] = value_of(number)
        yield opened
        for name in sorted(kvs.keys()):
            del kvs[name]


@pytest.fixture
def command(url, tmp_path):
    """Runs a command to its end: exit code, output and errors, without what differs from server to server."""

    def run(*words, server=True):
        environment = CommandLine(url, SPACE).environment()
        done = CliRunner().invoke(
            build(), [*map(str, words), *(("--namespace", SPACE) if server else ())], None, environment
        )
        assert done.exception is None or isinstance(done.exception, SystemExit), repr(done.exception)
        texts = [text.replace(str(tmp_path), "HERE") for text in (done.stdout, done.stderr)]
        return done.returncode, *[re.sub(r"\d+\.\d+ s", "N s", text) for text in texts]

    return run


@pytest.fixture
def going_on(url):
    return CommandLine(url, SPACE).running


def lines(answer):
    code, said, errors = answer
    assert (code, errors) == (0, "")
    return said.splitlines()


def test_keys_and_values_are_listed_read_and_changed(interface, command):
    kvs = reem.KeyValueStore(interface)
    assert sorted(kvs.keys()) == NAMES
    assert sorted(kvs.keys("k1*")) == NAMES[10:20]
    rows = [json.loads(line) for line in lines(command("ls", "--json"))]
    assert [row["path"] for row in rows if "." not in row["path"]] == NAMES
    assert len(lines(command("ls", "k0*"))) == 10
    tree = lines(command("tree"))
    assert [name for name in NAMES if not any(line.startswith(name) for line in tree)] == []
    assert lines(command("get", "k07.n")) == ["7"]
    assert command("get", "nothing")[0] == command("del", "nothing")[0] == 3
    assert lines(command("set", "k07.n", "70")) == []
    assert lines(command("get", "k07.n")) == ["70"]
    assert lines(command("del", "k08")) == []
    assert lines(command("pub", "new", '{"a": [1]}')) == []
    assert sorted(kvs.keys()) == sorted({*NAMES, "new"} - {"k08"})
    assert kvs["new"].read() == {"a": [1]}


def test_snapshots_hold_everything_and_bring_it_back(interface, command, tmp_path):
    kvs, file = reem.KeyValueStore(interface), tmp_path / "all.zip"
    code, said, errors = command("snapshot", "save", file)
    assert (code, errors) == (0, "")
    assert said.startswith(f"HERE/all.zip: {len(NAMES)} keys, ")
    held = lines(command("snapshot", "list", file, server=False))
    assert [name for name in NAMES if not any(re.match(rf"{name}\b", line) for line in held)] == []
    lines(command("snapshot", "save", "--match", "k1*", tmp_path / "some.zip"))
    lines(command("snapshot", "restore", "--into", "old_", tmp_path / "some.zip"))
    assert sorted(kvs.keys("old_*")) == [f"old_{name}" for name in NAMES[10:20]]
    for name in NAMES:
        kvs[name] = 0
    assert command("snapshot", "restore", file)[0] == 1  # all are in the way
    lines(command("snapshot", "restore", "--replace", file))
    for number, name in enumerate(NAMES):
        assert_same(kvs[name].read(), value_of(number))


def test_whatever_is_published_is_heard_recorded_and_played(interface, command, going_on, tmp_path):
    kvs, space, file = reem.KeyValueStore(interface), reem.PublishSpace(interface), tmp_path / "run.mcap"
    with going_on("echo", "--json") as echo, going_on("record", "-o", file) as record:
        heard = Lines(echo)
        begins(record)
        eventually(lambda: _begun(space, heard), STARTING)
        for number in range(1, 4):
            for name in NAMES:
                space[name]["n"] = number
        wanted = {(f"{name}.n", number) for name in NAMES for number in (1, 2, 3)}
        eventually(lambda: wanted <= {(row["path"], row.get("value")) for row in heard.rows()})
        for process in (echo, record):
            process.send_signal(signal.SIGINT)
        said, _ = record.communicate(timeout=PATIENCE)
        assert (echo.wait(PATIENCE), record.returncode) == (0, 0)
    assert "0 dropped" in said
    for name in NAMES:
        del kvs[name]
    assert command("play", "--rate", "20", file)[0] == 0
    for number, name in enumerate(NAMES):
        assert_same(kvs[name].read(), {**value_of(number), "n": 3})


def test_the_page_shows_every_key(interface, url):
    with browsing("--url", url, "--namespace", SPACE, "--port", "0", "--no-open") as (_, said):
        answer = httpx.get(f"{address_in(said)}api/tree", params={"open": "100:0:"}, timeout=PATIENCE, trust_env=False)
        assert [name for name in NAMES if f'"{name}"' not in answer.text] == []


def test_the_doctor_is_content(interface, command):
    found = [json.loads(line) for line in command("doctor", "--json", "--no-write")[1].splitlines()]
    assert {row["status"] for row in found} <= {"ok", "warn", "unknown"}
    assert {"server", "json", "access", "small read", "clock", "memory", "eviction", "subscribers", "persistence"} <= {
        row["check"] for row in found
    }


def _begun(space, heard):
    """Whether the live command hears what is published; what it heard so far does not matter."""
    space["begin"] = 1
    return heard.rows()


class Lines:
    def __init__(self, process):
        self._rows = []
        threading.Thread(target=self._read, args=(process.stdout,), daemon=True).start()

    def _read(self, stream):
        for line in stream:
            self._rows.append(json.loads(line))

    def rows(self):
        return list(self._rows)
