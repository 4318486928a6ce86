"""Servers without the JSON module: documents are text there, and everything else is as it is with it."""

import asyncio
import contextlib
import os

import numpy as np
import orjson
import pytest
import redis
from conftest import PLAIN, assert_same, eventually, placeholders
from plainkit import Comparison

import reem
import reem.migration
import reem.snapshots
import reem_async
from reem.server import EmbeddedCluster, EmbeddedServer
from reem_async.plain.translation import Known, directly, looked_at, translated
from reem_async.store.catalog import names
from reem_async.transport.protocol import error_of
from reem_async.transport.text import HeldText

with_module = pytest.mark.skipif(PLAIN, reason="compares with a server that has the module")


@pytest.fixture(scope="module")
def server():
    with EmbeddedServer(json=False) as running:
        yield running


@pytest.fixture(scope="module")
def server_url(server):
    return server.url


@pytest.fixture(scope="module")
def raw(server):
    with redis.Redis(unix_socket_path=server.socket_path) as client:
        yield client


@pytest.fixture(scope="module")
def with_json():
    with EmbeddedServer() as running:
        if not running.json:
            pytest.skip("there is no server with JSON")
        yield running


def calls(raw):
    rows = raw.info("commandstats")
    return {name.removeprefix("cmdstat_"): row["calls"] + row["rejected_calls"] for name, row in rows.items()}


def called(raw, work):
    before = calls(raw)
    work()
    return {name: count - before.get(name, 0) for name, count in calls(raw).items() if count > before.get(name, 0)}


def text_of(raw, key):
    return raw.execute_command("GET", key)


def check_no_orphans(raw, key):
    found = placeholders(orjson.loads(text_of(raw, key)))
    members = {member.decode() for member in raw.smembers(f"{{{key}}}:ships")}
    there = {name.decode().removeprefix(f"{{{key}}}") for name in raw.scan_iter(f"{{{key}}}*")} - {":ships", ":last"}
    assert members == there
    assert len(found) == len(there)


# --- as the module -------------------------------------------------


@with_module
@pytest.mark.parametrize("seed", range(3))
def test_generated_commands_are_answered_as_by_the_module(with_json, seed):
    """Replies, refusals and what is stored, one by one; REEM_TEST_EXAMPLES says how many."""
    comparison = Comparison(f"unix://{with_json.socket_path}", f"compared{seed}", seed)
    assert comparison.run(int(os.environ.get("REEM_TEST_EXAMPLES", "2000")) // 2) is None
    assert comparison.refused > 10


# --- what is stored -------------------------------------------------


def test_a_document_is_json_text_behind_a_space(front, raw):
    """Any program can read it; none writes a string that begins so."""
    front.write(["text"], {"a": [1, 2.5, "x"], "b": None})
    assert text_of(raw, "text") == b' {"a":[1,2.5,"x"],"b":null}'
    front.write(["text", "a", 0], {"new": True})
    assert orjson.loads(text_of(raw, "text")) == {"a": [{"new": True}, 2.5, "x"], "b": None}


def test_whole_values_take_one_command_once_the_key_is_known(front, raw):
    front.write(["whole"], {"a": 1})

    def work():
        for number in range(5):
            front.write(["whole"], {"a": number})
            assert front.read(["whole"]) == {"a": number}

    assert {name: count for name, count in called(raw, work).items() if name != "info"} == {
        "set": 5,
        "get": 5,
        "smembers": 5,
    }


def test_a_change_below_the_top_is_a_look_and_a_transaction(front, raw):
    front.write(["below"], {"a": 1})
    front.write(["below", "a"], 2)
    done = called(raw, lambda: front.write(["below", "a"], 3))
    done.pop("info")
    assert done == {"watch": 1, "get": 1, "multi": 1, "set": 1, "exec": 1, "smembers": 1}


def test_an_expiry_stays(front, raw):
    front.write(["brief"], {"a": 1})
    raw.expire("brief", 100)
    front.write(["brief", "a"], 2)
    front.write(["brief"], {"a": 3})
    assert 90 < raw.ttl("brief") <= 100


@pytest.mark.parametrize("text", [b"5", b'{"a": 1}', b"", b"hello"], ids=repr)
def test_strings_of_other_programs_are_left_alone(front, raw, text):
    """However they look; also right after a document was deleted under that name."""
    front.write(["mine"], {"a": 1})
    front.write(["mine"], {"a": 2})
    front.delete(["mine"])
    raw.set("mine", text)
    for call in (
        lambda: front.read(["mine"]),
        lambda: front.write(["mine"], {"b": 1}),
        lambda: front.write(["mine"], {"b": np.arange(3)}),
        lambda: front.write(["mine", "a"], 1),
        lambda: front.delete(["mine"]),
        lambda: front.increment(["mine", "a"], 1),
        lambda: front.append(["mine"], 1),
    ):
        with pytest.raises(reem.WrongKind, match="string"):
            call()
    assert text_of(raw, "mine") == text
    assert not raw.exists("{mine}:ships", "{mine}.b")
    raw.delete("mine")


def test_what_has_taken_the_place_of_a_document_is_not_deleted(front, raw):
    """Also right after a document was seen there."""
    raw.delete("seen")
    front.write(["seen"], {"a": 1})
    front.write(["seen"], {"a": 2})
    raw.delete("seen")
    raw.rpush("seen", 1)
    with pytest.raises(reem.WrongKind, match="list"):
        front.delete(["seen"])
    assert raw.lrange("seen", 0, -1) == [b"1"]
    raw.delete("seen")


async def test_a_catalogue_tells_documents_from_strings(server, raw):
    async with reem_async.RedisInterface(server, namespace="listed:") as interface:
        store = reem_async.KeyValueStore(interface)
        await store["one"].write({"a": np.arange(3)})
        await store["two"].write(1)
        raw.set("listed:three", "3")
        raw.set("listed:four", '{"a": 1}')
        assert {name async for name in names(interface)} == {"one", "two"}
        assert set(await store.keys()) == {"one", "two"}


# --- together with others -------------------------------------------------


async def test_a_cancelled_change_is_done_once_or_not_at_all(akvs):
    """Cancelled after any number of steps of the event loop; the next change finds nothing watched, nor half done."""
    it = akvs["given_up"]
    await it.write({"n": 0, "a": None})
    for steps in range(40):
        before = (await it["n"].read(), await it["a"].read())
        task = asyncio.create_task(it.update({"n": steps + 1, "a": np.full(3, steps)}))
        for _ in range(steps):
            await asyncio.sleep(0)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        after = await it.read()
        assert after["n"] in (before[0], steps + 1)
        assert_same(after["a"], np.full(3, steps) if after["n"] == steps + 1 else before[1])


# --- a cluster, and servers of the other kind -------------------------------------------------


@pytest.mark.long
def test_a_cluster_without_the_module():
    with EmbeddedCluster(replicas=0, json=False) as cluster, contextlib.closing(reem.RedisInterface(cluster)) as at:
        assert not cluster.json
        store, space = reem.KeyValueStore(at), reem.PublishSpace(at)
        for name in ("a", "b", "c", "d"):
            store[name] = {"n": 1, "image": np.arange(5)}
            mirror = reem.SilentSubscriber(name, at)
            mirror.listen()
            space[name]["more"] = {"deep": np.ones(2)}
            space[name]["n"] = 2
            eventually(lambda mirror=mirror: mirror.value()["n"] == 2)
            assert_same(store[name].read(), {"n": 2, "image": np.arange(5), "more": {"deep": np.ones(2)}})
            assert_same(mirror.value(), store[name].read())
        assert set(store.keys()) == {"a", "b", "c", "d"}


@with_module
@pytest.mark.skipif(PLAIN, reason="the clients of such a run were taught what a document is")
async def test_the_plain_client_says_what_to_use_in_place_of_json_commands(server):
    """Those of both fronts, and by rejson's names; the error is a ResponseError, as old programs expect."""
    with reem.RedisInterface(server) as interface:
        reem.KeyValueStore(interface)["foo"] = {"n": 1}
        client = interface.client
        for call in (
            lambda: client.json().get("foo"),
            lambda: client.jsonset("foo", ".n", 2),
            lambda: client.execute_command("json.del", "foo"),
        ):
            with pytest.raises(reem.NoJsonSupport, match="KeyValueStore") as caught:
                call()
            assert isinstance(caught.value, redis.ResponseError)
        with pytest.raises(redis.ResponseError, match="unknown command 'NONSENSE'"):
            client.execute_command("NONSENSE")
        assert client.get("foo") == ' {"n":1}'
        with pytest.raises(redis.ResponseError, match="unknown command"):
            client.pipeline().json().get("foo", "$").execute()
    async with reem_async.RedisInterface(server) as interface:
        with pytest.raises(reem.NoJsonSupport, match="KeyValueStore"):
            await interface.client.json().get("foo")
        assert orjson.loads(await interface.client.get("foo")) == {"n": 1}


def test_a_server_with_the_module_is_asked_nothing_more(with_json):
    with redis.Redis(unix_socket_path=with_json.socket_path) as raw:

        def work():
            with contextlib.closing(reem.RedisInterface(with_json)) as interface:
                store = reem.KeyValueStore(interface)
                store["as_ever"] = {"a": 1}
                store["as_ever"]["a"] = 2
                assert store["as_ever"].read() == {"a": 2}

        done = called(raw, work)
    assert "watch" not in done
    assert "get" not in done
    assert done["json.get"] == 1


@with_module
def test_documents_move_to_a_server_with_json_and_back(server, with_json, tmp_path):
    """Through a portable snapshot, to the last bit."""
    value = {"f": [0.1, 1 / 3, 2.1046907004965418e-207, 1e300], "i": 2**64 - 1, "a": np.arange(4.0), "s": "\u00e9\0"}
    with (
        contextlib.closing(reem.RedisInterface(server, namespace="moved:")) as one,
        contextlib.closing(reem.RedisInterface(with_json, namespace="moved:")) as other,
    ):
        reem.KeyValueStore(one)["it"] = value
        reem.snapshots.save(one, tmp_path / "one.zip")
        reem.snapshots.restore(other, tmp_path / "one.zip")
        assert_same(reem.KeyValueStore(other)["it"].read(), value)
        del reem.KeyValueStore(one)["it"]
        reem.snapshots.save(other, tmp_path / "other.zip")
        reem.snapshots.restore(one, tmp_path / "other.zip")
        assert_same(reem.KeyValueStore(one)["it"].read(), value)


@with_module
def test_text_on_a_server_with_json_is_refused_with_the_command_that_converts_it(server, with_json):
    """An RDB file of a plain server, loaded by one with the module, looks so."""
    value = {"f": [0.1, 1 / 3, 2.1046907004965418e-207], "a": np.arange(4.0)}
    with (
        contextlib.closing(reem.RedisInterface(server)) as one,
        contextlib.closing(reem.RedisInterface(with_json)) as other,
        redis.Redis(unix_socket_path=server.socket_path) as source,
        redis.Redis(unix_socket_path=with_json.socket_path) as target,
    ):
        reem.KeyValueStore(one)["carried"] = value
        for key in ("carried", *source.scan_iter("{carried}*")):
            target.restore(key, 0, source.dump(key))
        target.set("stranger", "5")
        store = reem.KeyValueStore(other)
        for call in (
            store["carried"].read,
            lambda: store.set("carried", 1),
            lambda: store.set("carried.b", 1),
        ):
            with pytest.raises(reem.WrongKind, match="reem migrate --yes"):
                call()
        assert [key.name for key in reem.migration.migrate(other, dry_run=True).keys] == ["carried"]
        told = []
        (done,) = reem.migration.migrate(other, progress=lambda *how: told.append(how)).keys
        assert told == [(0, 1), (1, 1)]
        assert (done.name, done.was_text, done.problem) == ("carried", True, "")
        assert target.get("stranger") == b"5"
        assert_same(store["carried"].read(), value)
        assert reem.migration.migrate(other).keys == ()
        assert reem.migration.migrate(one).keys == ()


# --- the translation, without a server -------------------------------------------------


def test_a_refused_transaction_says_why_at_its_command():
    """As a server that is out of memory, or a replica, refuses it."""
    known = Known()
    batch = [("MULTI",), ("JSON.SET", "k", '$["a"]', b"1"), ("SMEMBERS", "{k}:ships"), ("EXEC",)]
    steps = translated(batch, known, error_of)
    assert next(steps) == [("WATCH", b"k"), ("GET", b"k")]
    sent = steps.send([b"OK", b' {"a":0}'])
    assert [command[0] for command in sent] == ["MULTI", "SET", "SMEMBERS", "EXEC"]
    oom, aborted = error_of("OOM command not allowed"), error_of("EXECABORT Transaction discarded")
    with pytest.raises(StopIteration) as end:
        steps.send([b"OK", oom, b"QUEUED", aborted])
    assert end.value.value == [b"OK", oom, b"QUEUED", aborted]


@pytest.mark.parametrize("asking", [True, False])
def test_a_document_is_deleted_by_itself_where_there_is_no_memory_for_a_transaction(asking):
    """Redis queues nothing then, but takes what makes room."""
    ask = [("ASKING",)] if asking else []
    steps = translated([*ask, ("JSON.DEL", "k", "$"), *ask, ("SMEMBERS", "{k}:ships")], Known(), error_of)
    looked = [word for look in (("WATCH", b"k"), ("TYPE", b"k"), ("GETRANGE", b"k", "0", "0")) for word in (*ask, look)]
    assert next(steps) == looked
    replies = iter([b"OK", b"string", b" "])
    sent = steps.send([b"OK" if word[0] == "ASKING" else next(replies) for word in looked])
    assert sent == [*ask, ("MULTI",), ("UNLINK", b"k"), ("EXEC",), *ask, ("SMEMBERS", "{k}:ships")]
    oom, aborted = error_of("OOM command not allowed"), error_of("EXECABORT Transaction discarded")
    sent = steps.send([*([b"OK"] * (len(ask) + 1)), oom, aborted, *([b"OK"] * len(ask)), []])
    assert sent == [*ask, ("UNLINK", b"k"), *ask, ("SMEMBERS", "{k}:ships")]
    with pytest.raises(StopIteration) as end:
        steps.send([word for reply in (1, []) for word in (*([b"OK"] * len(ask)), reply)])
    assert [reply for reply in end.value.value if reply != b"OK"] == [1, []]


def test_a_look_that_is_redirected_is_an_answer_of_the_node():
    """A cluster's transport follows it: nothing was applied."""
    moved = error_of("MOVED 5 127.0.0.1:7001")
    steps = translated([("JSON.DEL", "k", '$["a"]')], Known(), error_of)
    next(steps)
    assert steps.send([moved, moved]) == [("UNWATCH",)]
    with pytest.raises(StopIteration) as end:
        steps.send([b"OK"])
    assert end.value.value == [moved]


@pytest.mark.parametrize(
    ("space", "value"), [("pspace", "x" * 100_000), ("kvs", np.arange(1 << 15))], ids=["text", "array"]
)
def test_what_is_large_is_written_though_somebody_was_first(request, kvs, raw, monkeypatch, space, value):
    """An array is sent ahead and put in its place; a text is not: there is no key of its own for it to go to."""
    attempt, firsts = HeldText.attempt, []

    async def overtaken(self, *batch):
        if not firsts:
            firsts.append(batch)
            return None
        return await attempt(self, *batch)

    kvs["large"] = {"n": 0}
    monkeypatch.setattr(HeldText, "attempt", overtaken)
    request.getfixturevalue(space)["large"]["it"] = value
    assert firsts
    assert_same(kvs["large"].read(), {"n": 0, "it": value})
    assert not list(raw.scan_iter("*:staged:*"))
    check_no_orphans(raw, "large")


def test_what_somebody_nested_too_deep_is_refused_and_breaks_no_connection(interface, kvs, pspace, raw):
    """Followers, whose reads go over the connection of all, are told as of any value that cannot be read."""
    raw.set("deep", ' {"a":' + "[" * 300 + "]" * 300 + "}")
    states = []
    interface.on_state(states.append)
    kvs["beside"] = 1
    with reem.SilentSubscriber("beside", interface) as beside:
        for call in (lambda: kvs["deep"]["a"].read(), lambda: kvs["deep"]["b"].write(1)):
            with pytest.raises(redis.ResponseError, match="nested over"):
                call()
        with contextlib.suppress(redis.ResponseError, reem.ReemError), reem.SilentSubscriber("deep.a", interface):
            pass
        pspace["beside"] = 2
        eventually(lambda: beside.value() == 2)
    assert [each for each in states if "lost" in str(each)] == []


def test_whether_there_must_be_a_look_is_decided_once():
    """What is known of a key is known for some seconds: the second answer could be another."""
    known = Known()
    known.saw(b"k", True)
    commands = [("MULTI",), ("JSON.SET", "k", "$", b"1"), ("PUBLISH", "c", b"x"), ("EXEC",)]
    assert looked_at(commands, known) == []
    known.saw(b"k", False)  # or its time is over
    assert [command[0] for command in next(directly(commands, known, error_of))] == ["MULTI", "SET", "PUBLISH", "EXEC"]


def test_a_question_about_the_commands_of_the_server_is_asked():
    """`reem doctor` asks it beside others: a server without JSON calls it unknown."""
    batch = [("TYPE", "k"), ("JSON.GET",)]
    assert next(translated(batch, Known(), error_of)) == [("TYPE", "k"), ("GETRANGE", b"k", "0", "0"), ("JSON.GET",)]


def test_a_user_without_multi_is_told_that_it_was_done():
    """The server carries out what was to be in the transaction, one by one."""
    steps = translated([("JSON.DEL", "k", '$["a"]'), ("SMEMBERS", "{k}:ships")], Known(), error_of)
    next(steps)
    steps.send([b"OK", b' {"a":0}'])
    denied, without = error_of("NOPERM User x has no permissions to run the 'multi' command"), error_of("ERR EXEC")
    with pytest.raises(StopIteration) as end:
        steps.send([denied, b"OK", without, []])
    told, looked = end.value.value
    assert isinstance(told, reem.PartialWrite)
    assert looked == []
