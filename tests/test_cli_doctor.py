"""`reem doctor`: what it finds on servers that are as they should be, and on those that are not."""

import json
import re
import socket
import urllib.parse

import pytest
import redis
from clikit import CommandLine
from conftest import PLAIN

from reem_async import ClockOffset
from reem_async.server import EmbeddedServer
from reem_async.server.cluster import EmbeddedCluster
from reem_async.tools.cli import checks
from reem_async.tools.cli.checks import FAIL, OK, UNKNOWN, WARN, Facts


@pytest.fixture(scope="module")
def own():
    with EmbeddedServer() as server, redis.Redis.from_url(server.url, decode_responses=True) as admin:
        yield server.url, admin


def findings(run):
    rows = [json.loads(line) for line in run.stdout.splitlines()]
    assert all(set(row) == {"check", "status", "message", "remedy"} for row in rows)
    return {row["check"]: row for row in rows}


def test_a_server_as_it_should_be(own):
    url, admin = own
    run = CommandLine(url, "robot:")("doctor", "--json")
    assert run.returncode == 0, run.stderr
    report = findings(run)
    statuses = {name: row["status"] for name, row in report.items()}
    assert statuses.pop("latency") in (OK, WARN)  # a matter of the machine
    assert statuses.pop("clock") == OK
    assert statuses.pop("persistence") == WARN  # this server keeps nothing
    assert set(statuses.values()) == {OK}
    assert admin.info("server")["redis_version"] in run.stdout or "valkey" in report["server"]["message"]
    assert report["json"]["message"].startswith("none: documents are kept as text" if PLAIN else "RedisJSON 2.")
    assert re.search(r"median \S+ ms, p99 \S+ ms, of \d+$", report["latency"]["message"])
    assert {"server", "libraries"} <= set(report)
    assert admin.dbsize() == 0


@pytest.mark.skipif(not hasattr(socket, "SO_PEERCRED"), reason="this system does not tell who listens at a socket")
@pytest.mark.parametrize(("host", "way"), [("localhost", "reached through its Unix socket"), ("127.0.0.1", "by TCP")])
def test_it_tells_the_way(own, host, way):
    url = f"redis://{host}:{urllib.parse.urlsplit(own[0]).port}"
    assert findings(CommandLine(url, "")("doctor", "--json"))["access"]["message"].endswith(way)


@pytest.mark.long
def test_the_installed_command_in_a_pipe_and_in_a_terminal(own):
    cli = CommandLine(own[0], "robot:")
    run = cli.process("doctor")
    assert (run.returncode, run.stderr) == (0, "")
    lines = {line.split("\t")[1]: line.split("\t") for line in run.stdout.splitlines()}
    assert lines["persistence"][0] == "warn"
    assert "reem up --directory" in lines["persistence"][3]
    shown, code = cli.in_terminal("doctor", columns=50)
    assert code == 0
    assert "\x1b[32m✓" in shown
    assert "→ if it must outlive" in shown


def test_nobody_there():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    run = CommandLine(f"redis://:hidden-4711@127.0.0.1:{port}", "")("doctor", "--json")
    assert run.returncode == 1
    report = findings(run)
    assert report["server"]["status"] == FAIL
    assert "reem up" in report["server"]["message"]
    assert report["libraries"]["status"] == OK
    assert "hidden" not in run.stdout + run.stderr


def test_a_user_who_may_do_little(own):
    url, admin = own
    rules = ["reset", "on", ">hidden-4711", "~robot:*", "&*", "-@all", "+hello", "+auth"]
    rules += ["+get", "+type", "+getrange"] if PLAIN else ["+json.get", "+json.type"]
    admin.execute_command("ACL", "SETUSER", "guest", *rules)
    parts = urllib.parse.urlsplit(url)
    cli = CommandLine(f"redis://guest:hidden-4711@127.0.0.1:{parts.port}", "robot:")
    run = cli("doctor", "--json")
    assert run.returncode == 0, run.stdout + run.stderr
    report = findings(run)
    for name in ("latency", "clock", "memory", "eviction", "persistence"):
        assert report[name]["status"] == UNKNOWN, name
    assert report["memory"]["remedy"] == "ask as an administrator, or allow +info"
    assert "with password, without TLS" in report["access"]["message"]
    assert "hidden" not in run.stdout + run.stderr
    said = cli.error(1, "ls")
    assert "the user may not do this" in said
    assert "scan" in said


def nodes_with(report, check):
    return [
        (row["node"], row["status"]) for row in map(json.loads, report.stdout.splitlines()) if row["check"] == check
    ]


@pytest.mark.long
def test_every_node_of_a_cluster_is_examined_and_named():
    """Also where one does not answer."""
    with EmbeddedCluster(replicas=0) as cluster:
        cli, ports = CommandLine(cluster.url, "robot:"), [f"127.0.0.1:{node.port}" for node in cluster.nodes]
        bad = cluster.nodes[1]
        with redis.Redis(port=bad.port) as admin:
            admin.config_set("maxmemory", "200mb")
            admin.config_set("maxmemory-policy", "allkeys-lru")
        run = cli("doctor", "--json")
        lines = cli.result("doctor").splitlines()
        bad.stop()
        without = cli("doctor", "--json")
    assert run.returncode == 0, run.stdout + run.stderr
    for check in ("server", "json", "access", "latency", "clock", "memory"):
        assert {node for node, _ in nodes_with(run, check)} == set(ports), check
    found = nodes_with(run, "eviction")
    assert dict(found) == {port: WARN if port == ports[1] else OK for port in ports}
    assert '"check":"libraries","status"' in run.stdout, "it is not of a node"
    assert [line for line in lines if line.startswith(f"warn\teviction\t{ports[1]}: allkeys-lru")]
    assert without.returncode == 1
    assert dict(nodes_with(without, "server")) == {port: FAIL if port == ports[1] else OK for port in ports}
    assert len(nodes_with(without, "eviction")) == 2


# --- what the facts mean -------------------------------------------------


SAVED = {"rdb_last_bgsave_status": "ok", "aof_enabled": "0"}


@pytest.mark.parametrize(
    ("check", "info", "config", "status"),
    [
        (checks.persistence, SAVED | {"aof_enabled": "1"}, None, OK),
        (checks.persistence, SAVED, {"save": "3600 1"}, OK),
        (checks.persistence, SAVED, {"save": ""}, WARN),
        (checks.persistence, SAVED, None, UNKNOWN),
        (checks.persistence, SAVED | {"rdb_last_bgsave_status": "err"}, {"save": "3600 1"}, FAIL),
        (checks.persistence, {"aof_last_write_status": "err", "aof_enabled": "1"}, None, FAIL),
        (checks.memory, {"used_memory": "95", "maxmemory": "100"}, None, WARN),
        (checks.memory, {"used_memory": "5", "maxmemory": "0", "total_system_memory": "100"}, None, OK),
        (checks.memory, {"used_memory": "95", "maxmemory": "0", "total_system_memory": "100"}, None, WARN),
        (checks.eviction, {"maxmemory_policy": "allkeys-lru", "maxmemory": "0"}, None, OK),
        (checks.eviction, {"maxmemory_policy": "allkeys-lru", "maxmemory": "9"}, None, WARN),
        (checks.eviction, {"evicted_keys": "3"}, None, FAIL),
    ],
)
def test_what_the_facts_mean(check, info, config, status):
    assert check(Facts(info, config)).status == status


def test_clock_and_latency():
    assert checks.clock(ClockOffset(0.005, 0.001, 0.0)).status == OK
    assert checks.clock(ClockOffset(0.05, 0.045, 0.0)).status == OK  # it may be the way there
    assert checks.clock(ClockOffset(-3.0, 0.001, 0.0), "on arm ") == (
        "clock",
        WARN,
        "on arm the server's clock is 3000.0 ms behind, give or take 1.0 ms",
        "set both by NTP or chrony; until then `reem delay` and time stamps are off by as much",
    )
    slow = checks.latency([0.01] * 197 + [0.5] * 3)
    assert (slow.status, slow.message) == (WARN, "a round trip: median 10.00 ms, p99 500.00 ms, of 200")
    assert checks.latency([0.001]).status == OK


def test_access():
    def statuses(**how):
        known = {"address": "robot:6379", "loopback": False, "by_socket": False, "tls": True, "password": True}
        return [finding.status for finding in checks.who("default", **{**known, **how})]

    assert statuses() == [OK]
    assert statuses(tls=False) == [WARN]
    assert statuses(password=False) == [WARN]
    assert statuses(password=False, tls=False) == [WARN, WARN]
    assert statuses(password=False, tls=False, loopback=True) == [OK]
    assert checks.is_loopback("127.0.0.1")
    assert checks.is_loopback("localhost")
    assert not checks.is_loopback("192.0.2.1")
    assert not checks.is_loopback("no-such-host.invalid")


def test_versions_of_redis_8_and_of_a_cluster():
    info = {"redis_version": "8.2.1", "redis_mode": "standalone"}
    assert checks.version(Facts(info, None), "robot:6379", sharded=False).message == (
        "redis 8.2.1 at robot:6379, standalone"
    )
    node = Facts({**info, "redis_mode": "cluster"}, None)
    assert checks.version(node, "robot:6379", sharded=True).status == OK
    alone = checks.version(node, "robot:6379", sharded=False)
    assert (alone.status, alone.remedy) == (
        WARN,
        "this is one node of several; reach all: redis+cluster://robot:6379",
    )
    modules = "name=bf,ver=80200,api=1\nname=ReJSON,ver=80201,api=1"
    assert checks.json_support(Facts({"module": modules}, None), plain=False).message == "RedisJSON 8.2.1"
    assert "kept as text" in checks.json_support(Facts({}, None), plain=True).message
