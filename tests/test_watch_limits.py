"""A watcher that does not keep up: what it owes stays small, at the server and in both processes."""

import contextlib
import os
import signal

import pytest
from conftest import RawCluster, eventually, python

import reem
from reem_async import Last

KEYS = int(os.environ.get("REEM_TEST_WATCHED", "200"))
ROUNDS = 80
LONG = "k" * 400
"""How names begin: a message for each write would make 7 MB, more than fits into the sockets' buffers."""

WATCHER = """
import sys
import reem
url, prefix, last = sys.argv[1:]
with reem.RedisInterface(url) as interface:
    watch = reem.KeyValueStore(interface).watch(prefix + "*", policy=reem.Last(100_000))
    watch.listen()
    print("ready", flush=True)
    known = {}
    for update in watch:
        known[update.path.split(".")[0]] = update.data["n"]
        if len(known) == int(sys.argv[3].split()[0]) and set(known.values()) == {int(sys.argv[3].split()[1])}:
            break
    print("all", flush=True)
"""


@pytest.mark.long
def test_a_stopped_watcher_of_many_keys_owes_one_message_for_each(server_url, kvs, raw, key):
    """However often they are written; when it goes on, it has the last state of each."""
    if isinstance(raw, RawCluster):
        pytest.skip("counts the bytes of one server")
    names = [key(f"{LONG}{number}") for number in range(KEYS)]
    for name in names:
        kvs[name] = {"n": 0}
    before = {row["id"] for row in raw.client_list()}
    process = python(WATCHER, server_url, key(LONG), f"{KEYS} {ROUNDS}", start=True)
    try:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGSTOP)
        for number in range(1, ROUNDS + 1):
            for name in names:
                kvs[name] = {"n": number}
        mine = [row for row in raw.client_list() if row["id"] not in before]
        assert sum(int(row["omem"]) for row in mine) < (len(LONG) + 200) * KEYS + 100_000
        process.send_signal(signal.SIGCONT)
        said, errors = process.communicate(timeout=60)
        assert said == "all\n", errors
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()


def test_a_loop_that_takes_nothing_keeps_no_more_than_its_policy_says(interface, key):
    kvs = reem.KeyValueStore(interface)
    kvs[key()] = {"n": 0}
    with kvs[key()].watch(Last(10)) as watch, kvs[key()].mirror() as mirror:
        for number in range(1, 200):
            kvs[key()]["n"] = number
            if number % 5 == 0:  # so that there is a look for each
                mirror.wait_until(lambda value, number=number: value["n"] == number, 10)
        eventually(lambda: watch.dropped > 0)
        assert len(watch._core.queue._items) <= 10
        taken = next(watch)
        while taken.data["n"] != 199:
            taken = next(watch)
