"""Top-level keys that expire, and arrays that no document refers to any more."""

import json
import threading

import numpy as np
import pytest
import redis
from clikit import CommandLine
from conftest import assert_same, eventually

import reem
from reem_async.errors import BadKey, BadType, BadValue, MissingKey
from reem_async.server import EmbeddedServer


def left(raw, key):
    """All Redis keys of a test, with the milliseconds they have."""
    return {name: raw.pttl(name) for name in raw.scan_iter(match=f"*{key()}*", count=1000)}


@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
def test_all_of_a_key_expires_at_once(open_front, key, raw, space):
    """Document, arrays, registry and note; `persist` ends it."""
    front = open_front(space)
    front.write([key()], {"label": "cup", "crop": np.zeros((100, 100)), "parts": [np.arange(3), b"bytes"]})
    front.wait(front.at([key()]).expire(50))
    names = left(raw, key)
    assert len(names) == 5 + (space == "PublishSpace")
    assert all(0 < milliseconds <= 50_000 for milliseconds in names.values()), names
    front.write([key(), "label"], "cup, red")
    assert 0 < raw.pttl(key()) <= 50_000, "a later write keeps it"
    front.wait(front.at([key()]).persist())
    assert {time for name, time in left(raw, key).items() if not name.endswith(":last")} == {-1}
    front.wait(front.at([key()]).expire(np.float32(0.05)))
    eventually(lambda: not left(raw, key))


def test_followers_are_told_of_an_expiry_as_of_a_deletion(kvs, key):
    kvs[key()] = {"n": 1, "a": np.arange(3)}
    with kvs[key()].watch() as updates:
        assert next(updates).initial
        kvs[key()].expire(0.05)
        update = next(updates)
    assert update.deleted
    assert key() not in kvs


@pytest.mark.parametrize(
    ("path", "seconds", "error"),
    [
        (["n"], 1, BadKey),
        ([], 0, BadValue),
        ([], -1, BadValue),
        ([], float("nan"), BadValue),
        ([], 1e11, BadValue),
        ([], "1", BadType),
        ([], True, BadType),
    ],
)
def test_what_cannot_expire_is_refused(front, key, raw, path, seconds, error):
    front.write([key()], {"n": 1})
    with pytest.raises(error, match=key()):
        front.wait(front.at([key(), *path]).expire(seconds))
    assert raw.pttl(key()) == -1
    with pytest.raises(MissingKey, match=key("absent")):
        front.wait(front.at([key("absent")]).expire(1))


def test_no_array_outlives_its_document_while_others_change_the_shape(interface, server_url, key, raw):
    """The key is watched: an array that is put between look and transaction expires too."""
    kvs, over = reem.KeyValueStore(interface), threading.Event()

    def change():
        with reem.RedisInterface(server_url) as other:
            store = reem.KeyValueStore(other)
            for number in range(10**9):
                if over.is_set():
                    return
                store[key()] = {f"a{number % 7}": np.arange(number % 5)}

    thread = threading.Thread(target=change)
    thread.start()
    try:
        eventually(lambda: key() in kvs)
        with reem.timeout(20):
            for _ in range(30):
                kvs[key()].expire(1000)
    finally:
        over.set()
        thread.join()
    kvs[key()].expire(0.05)
    eventually(lambda: not left(raw, key))


@pytest.fixture
def own():
    with EmbeddedServer() as server, redis.Redis.from_url(server.url) as client:
        yield server.url, client


def doctor(url, *words):
    run = CommandLine(url, "")("doctor", "--json", *words)
    return next(row for row in map(json.loads, run.stdout.splitlines()) if row["check"] == "arrays")


def test_the_doctor_counts_and_removes_what_documents_have_left_behind(own):
    """Of documents that expired, were deleted or renamed; nothing that a document refers to, or that is not REEM's."""
    url, client = own
    with reem.RedisInterface(url) as interface:
        kvs = reem.KeyValueStore(interface)
        for name in ("expired", "gone", "renamed", "whole", "late"):
            kvs[name] = {"crop": np.zeros(9), "list": [b"bytes"]}
        client.pexpire("expired", 1)
        client.delete("gone")
        client.rename("renamed", "other")
        kvs["late"].expire(0.2)
        kvs["late"]["crop"] = np.arange(3)  # after `expire`, so it stays when the rest goes, registry too
        kvs["foreign"] = 1
        for name in ("{foreign}.count", "{basket}.items", "{basket}:ships2"):
            client.set(name, "of another program")
        eventually(lambda: not client.exists("late", "{late}:ships"))
        found = doctor(url)
        assert found["status"] == "warn"
        assert "7 that no document refers to" in found["message"]
        assert "--clean" in found["remedy"]
        assert doctor(url, "--clean")["message"].startswith("removed 7 ")
        assert doctor(url) == {
            "check": "arrays",
            "status": "ok",
            "message": "each belongs to a document",
            "remedy": "",
        }
        assert_same(kvs["whole"].read(), {"crop": np.zeros(9), "list": [b"bytes"]})
        assert client.exists("{foreign}.count", "{basket}.items", "{basket}:ships2") == 3
        assert not client.exists("{late}.crop", "{gone}:ships", "{renamed}.crop")


def test_a_registry_that_cannot_be_read_is_unknown_and_the_others_are_cleaned(own):
    url, client = own
    with reem.RedisInterface(url) as interface:
        for name in ("bad", "gone"):
            reem.KeyValueStore(interface)[name] = np.arange(3)
    client.set("{bad}:ships", "x")
    client.delete("gone")
    found = doctor(url, "--clean")
    assert found["status"] == "unknown"
    assert "removed 1" in found["message"]
    assert "not known of bad" in found["message"]
    assert client.exists("{bad}") == 1


def test_cleaning_beside_writers_removes_nothing_that_a_document_refers_to(own):
    """The writer makes what the look has found anew, in between."""
    url, client = own
    over, right = threading.Event(), []

    def write():
        with reem.RedisInterface(url) as interface:
            kvs = reem.KeyValueStore(interface)
            while not over.is_set():
                number = len(right)
                kvs["busy"] = {"a": np.full(5, number), f"b{number % 3}": [np.arange(3)]}
                right.append(kvs["busy"]["a"].read()[0] == number)
                client.delete("busy")

    thread = threading.Thread(target=write)
    thread.start()
    for _ in range(3):
        doctor(url, "--clean")
    over.set()
    thread.join()
    assert len(right) > 10
    assert all(right)
