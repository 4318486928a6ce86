"""`kvs.raw`: keys of programs without REEM, as these wrote them."""

import asyncio
import contextlib
import os

import numpy as np
import pytest
import redis
from conftest import PATIENCE, Loop, assert_same, eventually, url_of_user

import reem
from reem.errors import (
    BadKey,
    BadType,
    BadValue,
    InterfaceClosed,
    NotAllowed,
    TooLarge,
    WriteOnly,
    WrongKind,
    WrongType,
)
from reem_async import Last
from reem_async.plan import raw as plans
from reem_async.plan.placeholders import Unfetched
from reem_async.pubsub import raw_watch
from reem_async.transport.route import slot_of

IMAGE = np.arange(3 * 480 * 640, dtype=np.uint8).reshape(480, 640, 3)


@pytest.fixture
def watching(front):
    with contextlib.ExitStack() as stack:

        def begin(watch):
            return stack.enter_context(contextlib.closing(Loop(front, watch)))

        yield begin


@pytest.fixture
def read(front, key):
    return lambda name="q", **options: front.wait(front.kvs.raw[key(name)].read(**options))


@pytest.mark.parametrize(
    ("stored", "value"),
    [
        (b"[0.1, -2, true, null]", [0.1, -2, True, None]),
        (b'{"q": {"a": "\xc3\xa4"}}', {"q": {"a": "ä"}}),
        (b"1.5\n", 1.5),
        (b"null", None),
        (b"0.1 0.2 0.3", "0.1 0.2 0.3"),
        (b"007", "007"),
        (b"NaN", "NaN"),
        (b"[" * 5000 + b"]" * 5000, "[" * 5000 + "]" * 5000),
        (b"", ""),
        (b"\xff\xd8\xff\xe0", b"\xff\xd8\xff\xe0"),
        (IMAGE.tobytes(), IMAGE.tobytes()),
        (bytes(1000), bytes(1000)),
    ],
    ids=lambda value: repr(value)[:12],
)
def test_a_string_is_json_if_it_parses_else_text_else_bytes(read, raw, key, stored, value):
    raw.set(key("q"), stored)
    assert_same(read(), value)


def test_hashes_lists_sets_and_streams_are_plain_python_values(front, read, raw, key):
    raw.hset(key("h"), mapping={"volts": "24.1", "pose": "[1, 2]", "name": "left"})
    raw.rpush(key("l"), "1", "two", b"\x00\x01")
    raw.sadd(key("s"), "b", "a")
    raw.zadd(key("z"), {"slow": 2.5, "fast": 1})
    raw.xadd(key("x"), {"ax": "1"})
    raw.xadd(key("x"), {"ax": "2", "note": "end"})
    assert_same(read("h"), {"volts": 24.1, "pose": [1, 2], "name": "left"})
    assert read("l") == [1, "two", b"\x00\x01"]
    assert read("s") == ["a", "b"]
    assert list(read("z").items()) == [("fast", 1.0), ("slow", 2.5)]
    assert read("x") == {"ax": 2, "note": "end"}
    assert read("missing") is None
    assert [front.wait(front.kvs.raw[key("h")][field].read()) for field in ("volts", "none")] == [24.1, None]
    with pytest.raises(WrongType, match="is no hash"):
        front.wait(front.kvs.raw[key("l")]["volts"].read())
    assert front.wait(front.kvs.raw.keys(key("?"))) == sorted(map(key, "hlszx"))


@pytest.mark.parametrize(
    ("value", "stored"),
    [
        ([0.1, 2], "[0.1, 2]"),
        ({"a": None}, '{"a": null}'),
        (1.5, "1.5"),
        (True, "true"),
        ("0.1 0.2", "0.1 0.2"),
        ("ä", "ä"),
        (b"\x00\xff", None),
    ],
    ids=str,
)
def test_a_value_is_written_as_the_other_program_would(front, raw, key, value, stored):
    """As a string, and as a field of a hash; nothing else is stored."""
    front.wait(front.kvs.raw[key("q")].write(value))
    front.wait(front.kvs.raw[key("h")]["field"].write(value))
    assert {*raw.scan_iter(match=f"*{key.prefix}*", count=1000)} == {key("q"), key("h")}
    assert_same(front.wait(front.kvs.raw[key("q")].read()), value)
    if stored is not None:
        assert (raw.get(key("q")), raw.hget(key("h"), "field")) == (stored, stored)


def test_what_cannot_be_written_changes_nothing(front, kvs, raw, key):
    raw.hset(key("h"), "a", "1")
    kvs[key("document")] = {"n": 1}
    refused = [
        (key("q"), np.zeros(3), BadType, "tolist"),
        (key("q"), float("nan"), BadValue, "cannot be JSON"),
        (key("q"), "\ud800", BadValue, "UTF-8"),
        (key("q"), object(), BadType, "plain values"),
        (key("h"), 1, WrongType, "is a hash"),
        (key("document"), 1, WrongType, "is a document of REEM"),
    ]
    for name, value, kind, words in refused:
        with pytest.raises(kind, match=words):
            front.wait(front.kvs.raw[name].write(value))
    with pytest.raises(WrongType, match=r"kvs\["):
        front.wait(front.kvs.raw[key("document")].read())
    for name in ("", 3, "\ud800"):
        with pytest.raises(BadKey):
            front.kvs.raw[name]
    with pytest.raises(WriteOnly):
        reem.PublishSpace(front.interface if isinstance(front.kvs, reem.KeyValueStore) else "localhost").raw  # noqa: B018
    assert kvs[key("document")].read() == {"n": 1}
    assert (raw.hgetall(key("h")), raw.exists(key("q"))) == ({"a": "1"}, 0)


def test_documents_are_told_apart_from_json_of_others(front, kvs, pspace, raw, key):
    """With and without the JSON module: neither store takes the other's keys for its own."""
    kvs[key("mine")] = {"image": IMAGE[:4], "n": 1}
    pspace[key("told")] = {"image": IMAGE[:4]}
    raw.set(key("theirs"), '{"n": 1}')
    assert front.wait(front.kvs.raw.keys(f"*{key.prefix}*")) == [key("theirs")]
    assert kvs.keys(key("*")) == [key("mine"), key("told")]
    with pytest.raises(WrongKind, match=r"kvs\.raw\['t.*theirs'\] reads it"):
        kvs[key("theirs")]["n"].read()


def test_a_key_that_is_too_large_is_named_with_the_cure(front, read, watching, raw, key):
    raw.set(key("q"), bytes(300_000))
    raw.hset(key("h"), mapping={"a": bytes(300_000), "b": "1"})
    for name in ("q", "h"):
        with pytest.raises(TooLarge, match=r"read\(largest=3\d\d\d\d\d\) fetches it"):
            read(name, largest=100_000)
    with pytest.raises(TooLarge, match=r"read\(largest=300000\)"):
        front.wait(front.kvs.raw[key("h")]["a"].read(largest=100_000))
    assert (len(read(largest=300_000)), read("h", largest=400_000)["b"]) == (300_000, 1)
    watch = watching(front.kvs.raw.watch(key("?"), policy=Last(10), largest=100_000))
    found = {update.path: update for update in (watch.next(), watch.next())}
    assert all(isinstance(update.value, Unfetched) for update in found.values())
    assert (found[key("q")].size, found[key("h")].value.summary) == (300_000, "hash of 2")


def test_all_keys_of_a_pattern_are_told_first_and_then_what_changes(watching, front, kvs, raw, key):
    """New keys, those that change their type, and those that go; REEM's own are left out."""
    raw.set(key("a1"), "1")
    raw.set(key("b"), "2")
    kvs[key("a_document")] = {"n": 1}
    watch = watching(front.kvs.raw.watch(key("a*"), policy=Last(100)))
    first = watch.next()
    assert (first.path, first.value, first.initial, first.kind) == (key("a1"), 1, True, "string")
    raw.set(key("b"), "3")
    kvs[key("a_document")]["n"] = 2
    raw.set(key("a1"), "[1, 2]")
    assert watch.told() == ("stored", key("a1"), [1, 2], False)
    for text, value in (("3", 3), ("x" * 5000, "x" * 5000), ("4", 4), ("5", 5), ("", ""), ("6", 6)):
        raw.set(key("a1"), text)
        assert watch.told() == ("stored", key("a1"), value, False)
    raw.hset(key("a2"), "volts", "24.5")
    assert watch.told() == ("stored", key("a2"), {"volts": 24.5}, False)
    raw.delete(key("a1"))
    assert watch.told() == ("stored", key("a1"), None, True)
    raw.rpush(key("a1"), "x")
    changed = watch.next()
    assert (changed.value, changed.kind) == (["x"], "list")
    raw.set(key("a2"), "7", px=50)
    assert watch.told() == ("stored", key("a2"), 7, False)
    eventually(lambda: not raw.exists(key("a2")))
    assert watch.told() == ("stored", key("a2"), None, True)


def test_a_document_that_another_program_replaces_is_reported(watching, front, kvs, raw, key, monkeypatch):
    """Also at once, while the watch takes the key for one of REEM's."""
    monkeypatch.setattr(raw_watch, "_DOCUMENT_SECONDS", 0.5)
    raw.set(key("a"), "1")
    watch = watching(front.kvs.raw.watch(key("*"), policy=Last(100)))
    assert watch.next().value == 1
    kvs[key("b")] = {"n": 1}
    raw.set(key("a"), "2")
    assert watch.told() == ("stored", key("a"), 2, False)
    raw.set(key("b"), "[7]")
    assert watch.told() == ("stored", key("b"), [7], False)


def test_one_key_is_watched_and_the_last_value_always_arrives(watching, front, raw, key):
    raw.set(key("q"), "0")
    watch = watching(front.kvs.raw[key("q")].watch())
    assert watch.next().initial
    raw.set(key("q2"), "another")
    with raw.pipeline(transaction=False) as burst:
        for number in range(1, 1001):
            burst.set(key("q"), number)
        burst.execute()
    told = [watch.next().value]
    while told[-1] != 1000:
        told.append(watch.next().value)
    assert told == sorted(told)


def test_a_connection_that_breaks_is_made_again_and_all_is_told_with_a_gap(watching, front, raw, key):
    raw.set(key("q"), "1")
    watch = watching(front.kvs.raw.watch(key("*"), policy=Last(100)))
    assert watch.next().value == 1
    tracking = [row["id"] for row in raw.client_list() if "B" in row["flags"]]
    assert tracking
    for each in tracking:
        raw.client_kill_filter(_id=each)
    raw.set(key("q"), "2")
    update = watch.next()
    while not update.gap:
        update = watch.next()
    assert (update.value, update.origin, update.initial) == (2, "found", False)
    raw.set(key("q"), "3")
    while update.value != 3:
        update = watch.next()


def test_many_keys_are_bounded_and_a_warning_says_so(watching, front, raw, key, monkeypatch, caplog):
    monkeypatch.setattr(raw_watch, "MOST", 100)
    for number in range(500):
        raw.set(key(f"q{number}"), number)
    watch = watching(front.kvs.raw.watch(key("q*"), policy=Last(1000)))
    watch.next()
    assert f"{key('q*')} names more than 100 keys of other programs" in caplog.text
    raw.set(key("q_new"), "new")
    while (update := watch.next()).value != "new":
        assert update.initial
    assert not update.initial


async def test_what_changes_does_not_wait_for_thousands_that_were_found(akvs, raw, key):
    for number in range(2000):
        raw.set(key(f"k{number}"), number)
    seen = {}
    watch = raw_watch.RawWatch(akvs.interface.session, [key("*")], Last(10_000), 1000, pace=0.2)
    async with watch, asyncio.timeout(PATIENCE):
        for number in (0, 1000, 1999):
            raw.set(key(f"k{number}"), "new")
        while [each.value for each in seen.values()].count("new") < 3:
            update = await watch.next()
            seen[update.path] = update
        assert len(seen) < 1000
        while len(seen) < 2000:
            update = await watch.next()
            seen[update.path] = update
        await watch._follower._search()  # as after a reconnect, when all are known and found
        raw.set(key("k1500"), "newest")
        later = [(await watch.next()).value for _ in range(1000)]
        assert "newest" in later
    assert all(update.initial for update in seen.values() if update.value != "new")


def test_nothing_is_changed_by_looking(server):
    """A user without the right to any write command reads, lists and watches."""
    with redis.Redis.from_url(server.url) as client:
        client.execute_command("ACL", "SETUSER", "looker", "on", ">pw", "~*", "&*", "+@all", "-@write")
        client.set("q", "[1, 2]")
        client.hset("h", "a", "1")
        client.xadd("x", {"a": "1"})
        with reem.RedisInterface(url_of_user(server.url, "looker", "pw")) as interface:
            looking = reem.KeyValueStore(interface).raw
            assert [looking[name].read() for name in looking.keys()] == [{"a": 1}, [1, 2], {"a": 1}]  # noqa: SIM118
            with looking.watch() as watch:
                assert {watch.next(5).path for _ in range(3)} == {"h", "q", "x"}
                client.set("q", "[3]")
                assert watch.next(5).value == [3]
            with pytest.raises(NotAllowed):
                looking["q"].write(1)


def test_keys_that_the_user_may_not_look_at_are_left_out(server):
    with redis.Redis.from_url(server.url) as client:
        client.execute_command("ACL", "SETUSER", "limited", "on", ">pw", "~q*", "&*", "+@all")
        client.set("q", "1")
        client.set("secret", "2")
        with reem.RedisInterface(url_of_user(server.url, "limited", "pw")) as interface:
            looking = reem.KeyValueStore(interface).raw
            assert looking.keys() == ["q"]
            with looking.watch() as watch:
                assert watch.next(5).path == "q"
                client.set("secret", "3")
                client.set("q", "4")
                assert watch.next(5).value == 4
            with pytest.raises(NotAllowed):
                looking["secret"].read()


def test_a_loop_ends_with_its_interface_and_a_dropped_one_is_let_go(front, raw, key):
    raw.set(key("q"), "1")

    def trackers():
        return [row for row in raw.client_list() if "B" in row["flags"]]

    watch = front.kvs.raw.watch(key("q"))
    assert front.take(watch)[0].value == 1
    assert trackers()
    del watch
    front.until(lambda: not trackers())
    last = front.kvs.raw.watch(key("q"))
    assert front.take(last)[0].value == 1
    front.wait(front.interface.close())
    with pytest.raises(InterfaceClosed):
        front.wait(last.next(5))


def test_a_child_that_is_forked_watches_by_itself(raw, interface, key):
    raw.set(key("q"), "1")
    store = reem.KeyValueStore(interface).raw
    with store.watch(key("q")) as watch:
        assert watch.next(5).value == 1
        if (pid := os.fork()) == 0:
            with contextlib.suppress(BaseException):
                child = watch.next(5)
                os._exit(0 if child.value == 1 else 1)
            os._exit(2)
        assert os.waitpid(pid, 0)[1] == 0
        raw.set(key("q"), "2")
        assert watch.next(5).value == 2


def test_memory_usage_goes_to_the_node_of_its_key():
    assert slot_of(plans.look("foo")[1:]) == slot_of([("GET", "foo")])
