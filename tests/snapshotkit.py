"""What tests of snapshots share: two private servers, what to fill them with, and all that they hold."""

import contextlib
import random
import struct

import numpy as np
import pytest
import redis

import reem
import reem.snapshots
import reem_async
import reem_async.snapshots
from reem_async.server import EmbeddedServer

STRANGE = [
    "with blank",
    'double "quote"',
    "it's",
    "ünïcode 🤖",
    "a.b.c",
    "tab\there",
    "back\\slash",
    "star*",
    "[0]",
    "~",
]


def hard_floats(count, seed=7):
    """Finite doubles of any size; RedisJSON reads the text of one in three with a changed last bit."""
    dice = random.Random(seed)
    found = []
    while len(found) < count:
        (value,) = struct.unpack("<d", dice.randbytes(8))
        if value == value and abs(value) != float("inf"):
            found.append(value)
    return found


TREE = {
    "nested": {"a": {"b": {"c": [1, 2.5, None, True, "text", {}, []]}}, "big": 2**64 - 1, "small": -(2**63)},
    "arrays": [np.arange(12.0).reshape(3, 4), {"deep": [np.array(["é", "x"]), np.zeros((0, 3))]}],
    "floats": hard_floats(2000),
    "bytes": b"\x00\xff\r\n",
    "mark": "$ship numpy .not.one",
    "scalar": np.array(1 + 2j),
}


@pytest.fixture(scope="module")
def servers():
    with EmbeddedServer() as source, EmbeddedServer() as target:
        yield [source, target]


@pytest.fixture
def snapshots(tmp_path):
    """A portable snapshot and an RDB file of one server, whose keys are under a namespace."""
    with EmbeddedServer() as server, reem.RedisInterface(server, namespace="r1:") as interface:
        kvs = reem.KeyValueStore(interface)
        kvs["foo"] = {"x": np.arange(3), "n": 1.5}
        kvs["image"] = np.zeros((1000, 1000))
        reem.snapshots.save(interface, tmp_path / "a.zip")
        reem.snapshots.save_rdb(interface, tmp_path / "b.rdb")
    return tmp_path


@pytest.fixture
def raws(servers):
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(redis.Redis.from_url(server.url)) for server in servers]
        for client in clients:
            client.flushall()
        yield clients


@pytest.fixture
async def here(servers, raws):
    async with reem_async.RedisInterface(servers[0]) as interface:
        yield interface


@pytest.fixture
async def there(servers, raws):
    async with reem_async.RedisInterface(servers[1]) as interface:
        yield interface


READS = {
    b"string": ("GET",),
    b"hash": ("HGETALL",),
    b"list": ("LRANGE", 0, -1),
    b"set": ("SMEMBERS",),
    b"zset": ("ZRANGE", 0, -1, "WITHSCORES"),
    b"ReJSON-RL": ("JSON.GET",),
}


def everything(raw, match="*"):
    content = {}
    for key in raw.scan_iter(match=match, count=1000):
        if not key.endswith(b":last"):
            kind = raw.type(key)
            command, *rest = READS[kind]
            content[key] = kind, raw.execute_command(command, key, *rest)
    return content


def left_in(directory):
    return sorted(path.name for path in directory.iterdir())


async def fill(interface):
    kvs = reem_async.KeyValueStore(interface)
    await kvs["tree"].write(TREE)
    for name in STRANGE:
        await kvs[name].write({name: [np.arange(3), name], "empty": {}})
    for name, value in {
        "array": np.arange(5),
        "number": 1.5,
        "text": "x",
        "none": None,
        "list": [],
        "dict": {},
    }.items():
        await kvs[name].write(value)
    await kvs["image"].write({"stamp": 1, "data": np.random.default_rng(1).integers(0, 255, (1000, 8000), np.uint8)})
    return kvs
