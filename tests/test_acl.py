"""A user with only the commands REEM needs can do all of it: no scripting, no administration, no KEYS."""

from __future__ import annotations

import contextlib
import urllib.parse

import numpy as np
import pytest
import redis
from conftest import FRONTS, aeventually, assert_same, eventually

import reem
import reem_async
from reem_async.errors import ServerMissing
from reem_async.server import EmbeddedServer

COMMANDS = """
json.set json.get json.del json.type json.numincrby json.nummultby json.arrappend json.arrlen json.objlen
set get unlink type sadd srem smembers
multi exec discard watch unwatch
publish subscribe unsubscribe
ping hello auth select info client|setinfo
""".split()  # noqa: SIM905

FORBIDDEN = [
    ("EVAL", "return 1", "0"),
    ("SCRIPT", "FLUSH"),
    ("FUNCTION", "LIST"),
    ("KEYS", "*"),
    ("FLUSHALL",),
    ("FLUSHDB",),
    ("CONFIG", "SET", "maxmemory", "1gb"),
    ("ACL", "LIST"),
    ("MODULE", "LIST"),
    ("SHUTDOWN",),
]


@pytest.fixture(scope="module")
def guarded():
    """A private server with a user who may do little; yields its address and the administrator's client."""
    with contextlib.ExitStack() as stack:
        try:
            url = stack.enter_context(EmbeddedServer()).url
        except ServerMissing as missing:
            pytest.skip(f"needs a server of its own: {missing}")
        admin = stack.enter_context(redis.Redis.from_url(url, decode_responses=True))
        rules = ["reset", "on", ">secret", "~reem:*", "~{reem:*", "&reem:*", "&{reem:*", "-@all"]
        admin.execute_command("ACL", "SETUSER", "robot", *rules, *(f"+{name}" for name in COMMANDS))
        parts = urllib.parse.urlsplit(url)
        yield f"redis://robot:secret@{parts.hostname}:{parts.port}", admin


@pytest.fixture(autouse=True)
def nothing_denied(guarded):
    """Fails a test in which the server turned anything down; says what."""
    _, admin = guarded
    admin.execute_command("ACL", "LOG", "RESET")
    yield
    denied = [(row["reason"], row["object"], row["context"]) for row in admin.acl_log()]
    assert not denied, denied


def test_the_user_may_not_script_nor_administer(guarded):
    """Otherwise the other tests would show nothing."""
    url, admin = guarded
    with redis.Redis.from_url(url) as client:
        for command in FORBIDDEN:
            with pytest.raises(redis.exceptions.NoPermissionError):
                client.execute_command(*command)
        with pytest.raises(redis.exceptions.NoPermissionError):
            client.set("elsewhere", 1)
        with pytest.raises(redis.exceptions.NoPermissionError):
            client.publish("elsewhere", 1)
    admin.execute_command("ACL", "LOG", "RESET")


@pytest.mark.parametrize("name", list(FRONTS))
def test_the_store_needs_no_more(guarded, name):
    """Every operation of an accessor, in both fronts."""
    url, admin = guarded
    with contextlib.closing(FRONTS[name](url, namespace="reem:")) as front:
        document = {"n": 5, "x": 0.9374604873776271, "l": [1, np.arange(3)], "image": np.arange(6), "b": b"x"}
        front.write(["foo"], document)
        assert_same(front.read(["foo"]), document)
        assert_same(front.read(["foo"]), document)
        front.write(["foo", "image"], np.zeros((2, 2)))
        front.write(["foo", "l", 1], "plain")
        front.increment(["foo", "n"], 2)
        front.multiply(["foo", "n"], 3)
        front.divide(["foo", "n"], 2)
        front.append(["foo", "l"], np.arange(2))
        front.extend(["foo", "l"], [1, b"y"])
        assert front.length(["foo"]) == 5
        assert (front.length(["foo", "l"]), front.length(["foo", "image"])) == (5, 2)
        assert front.type(["foo", "image"]) is np.ndarray
        front.set("foo.d", {"e": "text"})
        assert (front.get("foo.d.e"), front.length(["foo", "d", "e"])) == ("text", 4)
        with pytest.raises(KeyError):
            front.read(["foo", "absent"])
        with pytest.raises(reem.PathRefused):
            front.write(["foo", "n", "below"], np.arange(3))
        front.write(["foo", "big"], 2**63 - 1)
        with pytest.raises(OverflowError):
            front.increment(["foo", "big"], 1)
        front.delete(["foo", "image"])
        front.write(["foo"], 1)
        front.delete(["foo"])
        assert admin.dbsize() == 0


def test_editing_needs_no_more(guarded):
    """In the blocking front."""
    url, _ = guarded
    with reem.RedisInterface(url, namespace="reem:") as interface:
        kvs = reem.KeyValueStore(interface)
        kvs["foo"] = {"image": np.zeros(3)}
        with kvs["foo"] as value:
            value["image"] += 1
        assert_same(kvs["foo"].read(), {"image": np.ones(3)})
        del kvs["foo"]


def test_a_conflict_and_a_foreign_key_are_told_without_more(guarded):
    """The errors need no further rights either."""
    url, admin = guarded
    with reem.RedisInterface(url, namespace="reem:") as interface:
        kvs = reem.KeyValueStore(interface)
        kvs["foo"] = {"n": 1, "image": np.zeros(3)}
        with pytest.raises(reem.Conflict), kvs["foo"] as value:  # noqa: PT012
            value["n"] = 2
            kvs["foo"]["image"] = np.ones(3)
        del kvs["foo"]
        admin.lpush("reem:foreign", "x")
        for call in (lambda: kvs["foreign"].read(), lambda: kvs["foreign"].write(np.arange(2))):
            with pytest.raises(reem.WrongKind, match="list"):
                call()
        admin.unlink("reem:foreign")


def test_subscribing_needs_no_more(guarded):
    """Mirrors, callbacks and loops of the blocking front, small values and large ones."""
    url, _ = guarded
    with reem.RedisInterface(url, namespace="reem:") as interface:
        space = reem.PublishSpace(interface)
        heard = []
        callback = reem.CallbackSubscriber("c", interface, lambda data, updated_path: heard.append(updated_path), {})
        with reem.SilentSubscriber("c", interface) as mirror, callback:
            space["c"] = {"n": 1, "image": np.zeros((640, 480, 3))}
            eventually(lambda: mirror.value() and heard == ["c"])
            space["c"]["n"] = 2
            eventually(lambda: mirror["n"].read() == 2 and heard == ["c", "c.n"])
            assert next(iter(reem.KeyValueStore(interface)["c"].watch())).initial
        del reem.KeyValueStore(interface)["c"]


async def test_the_async_front_needs_no_more(guarded):
    """Edit, subscribe and loop."""
    url, _ = guarded
    async with reem_async.RedisInterface(url, namespace="reem:") as interface:
        space, kvs = reem_async.PublishSpace(interface), reem_async.KeyValueStore(interface)
        await space["c"].write({"n": 1, "image": np.zeros(3)})
        async with kvs["c"].edit() as value:
            value["n"] = 2
        async with reem_async.SilentSubscriber("c", interface) as mirror:
            assert mirror["n"].read() == 2
            await space["c"]["n"].write(3)
            await aeventually(lambda: mirror["n"].read() == 3)
        assert (await anext(kvs["c"].watch())).data["n"] == 3
        await kvs["c"].delete()
