"""Subscribing in `reem`: callbacks on threads of their own, and loops that block. `test_following.py` has the rest."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import pickle
import threading
import time

import numpy as np
import pytest
from conftest import PATIENCE, assert_same, eventually, python, subscribed

import reem
from reem import (
    CallbackSubscriber,
    KeyValueStore,
    PublishSpace,
    RedisInterface,
    SilentSubscriber,
)


@contextlib.contextmanager
def in_thread(work):
    """Runs work beside the test; fails if it fails or does not end."""
    failures = []

    def run():
        try:
            work()
        except BaseException as failure:
            failures.append(failure)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield thread
    thread.join(PATIENCE)
    assert not thread.is_alive(), "still waiting"
    if failures:
        raise failures[0]


# --- callbacks -------------------------------------------------------------------------------------


def test_callbacks_run_on_a_thread_of_their_own_and_may_use_reem(interface, kvs, pspace, key):
    """Read, write, publish and even subscribe, without deadlock."""
    threads = set()

    def process(data, updated_path):
        threads.add(threading.current_thread())
        kvs[key("count")] = kvs[key("count")].get(0) + 1
        with SilentSubscriber(key("in"), interface) as inner:
            twice = inner["n"].read() * 2
        pspace[key("out")] = {"twice": twice, "image": data["image"]}

    with (
        CallbackSubscriber(key("in"), interface, process, {}),
        SilentSubscriber(key("out"), interface) as out,
    ):
        for n in range(1, 4):
            pspace[key("in")] = {"n": n, "image": np.full(3, n)}
            eventually(lambda n=n: (out.value() or {}).get("twice") == 2 * n)
            assert_same(out["image"].read(), np.full(3, n))
    assert kvs[key("count")].read() == 3
    assert threading.main_thread() not in threads


@pytest.mark.alone
def test_a_slow_callback_holds_up_nobody_else(interface, kvs, pspace, key):
    """Neither other subscribers nor calls, and it still sees the newest in the end."""
    release = threading.Event()
    seen = []

    def slow(data, updated_path):
        release.wait(PATIENCE)
        seen.append(data)

    with CallbackSubscriber(key(), interface, slow, {}), SilentSubscriber(key(), interface) as mirror:
        for n in range(50):
            pspace[key()] = n
        began = time.monotonic()
        eventually(lambda: mirror.value() == 49)
        assert kvs[key()].read() == 49
        assert time.monotonic() - began < 5
        release.set()
        eventually(lambda: seen and seen[-1] == 49)
        assert seen == sorted(seen)


def test_a_callback_that_always_raises_is_logged_once_and_then_counted(interface, pspace, key, caplog):
    """At 200 Hz a traceback for each would fill the log; another kind is another matter."""
    seen = []

    def fail(data, updated_path):
        seen.append(data)
        if data == 50:
            raise KeyError(data)
        raise ZeroDivisionError(data)

    with caplog.at_level(logging.ERROR), CallbackSubscriber(key(), interface, fail, {}):
        for number in range(60):
            pspace[key()] = number
        eventually(lambda: len(seen) == 60)
    kinds = [record.exc_info[0] for record in caplog.records if record.exc_info]
    assert kinds == [ZeroDivisionError, KeyError]
    assert "has raised ZeroDivisionError 10 times by now" in caplog.text


def test_a_callback_may_close_its_own_subscriber(interface, pspace, key):
    """After the first update it wanted; no deadlock, and nothing that is published afterwards is seen."""
    seen, closed = [], threading.Event()

    def once(data, updated_path):
        seen.append(data)
        subscriber.close()
        closed.set()

    subscriber = CallbackSubscriber(key(), interface, once, {})
    subscriber.listen()
    pspace[key()] = 1
    assert closed.wait(PATIENCE)
    pspace[key()] = 2
    time.sleep(0.2)
    assert seen == [1]


# --- loops -----------------------------------------------------------------------------------------


def test_subscribers_are_iterators(interface, pspace, key):
    """`for update in subscriber`, and a break leaves it usable."""
    got = []
    with SilentSubscriber(key(), interface) as subscriber:

        def loop():
            for update in subscriber:
                got.append(update.data)
                if update.data == "last":
                    break

        with in_thread(loop):
            time.sleep(0.1)
            pspace[key()] = {"n": 1}
            eventually(lambda: {"n": 1} in got)
            pspace[key()] = "last"
        assert subscriber.value() == "last"
        pspace[key()] = "after"
        eventually(lambda: subscriber.value() == "after")


def test_an_update_arrives_once_a_loop_is_waiting(kvs, pspace, key, raw):
    """Also where nothing was stored before."""
    before = subscribed(raw)
    got = []
    with in_thread(lambda: got.append(next(iter(kvs[key()].watch())))):
        eventually(lambda: subscribed(raw) - before)
        time.sleep(0.1)
        pspace[key()] = "first"
    assert (got[0].initial, got[0].data) == (False, "first")


# --- connections, processes and endings ------------------------------------------------------------


def test_close_ends_loops_that_wait_in_other_threads(server_url, key):
    """They end by themselves or by InterfaceClosed; none hangs."""
    interface = RedisInterface(server_url)
    KeyValueStore(interface)[key()] = 1
    mirror = SilentSubscriber(key(), interface)
    mirror.listen()
    started = []

    def loop(updates):
        with contextlib.suppress(reem.InterfaceClosed):
            for update in updates:
                started.append(update)  # noqa: PERF402

    threads = [
        threading.Thread(target=loop, args=(each,), daemon=True)
        for each in (mirror, KeyValueStore(interface)[key()].watch(), KeyValueStore(interface)[key()].watch())
    ]
    for thread in threads:
        thread.start()
    eventually(lambda: len(started) >= 2)
    interface.close()
    for thread in threads:
        thread.join(PATIENCE)
    assert not any(thread.is_alive() for thread in threads)


def test_leaving_the_with_block_ends_the_callbacks(interface, pspace, key):
    """And no thread of theirs is left."""
    heard = []
    before = set(threading.enumerate())
    with SilentSubscriber(key("warm"), interface):
        running = set(threading.enumerate())
        with CallbackSubscriber(key(), interface, lambda data, updated_path: heard.append(data), {}):
            pspace[key()] = 1
            eventually(lambda: heard == [1])
        pspace[key()] = 2
        time.sleep(0.2)
        assert heard == [1]
        eventually(lambda: set(threading.enumerate()) <= running | before)


def test_a_subscriber_in_another_process(key, pspace, server_url):
    """Ready when listen() returned."""
    code = (
        "import sys, time, reem\n"
        "url, key = sys.argv[1:]\n"
        "with reem.RedisInterface(url) as interface, reem.SilentSubscriber(key, interface) as mirror:\n"
        "    print('listening', flush=True)\n"
        "    while not mirror.value(): time.sleep(0.001)\n"
        "    print(mirror['image'].read().sum(), flush=True)\n"
    )
    process = python(code, server_url, key(), start=True)
    try:
        assert process.stdout.readline() == "listening\n", process.communicate()[1]
        pspace[key()] = {"image": np.arange(5)}
        out, errors = process.communicate(timeout=PATIENCE)
        assert (out, errors) == ("10\n", "")
    finally:
        process.kill()
        process.communicate()


def test_a_pickled_subscriber_listens_anew(interface, pspace, kvs, key):
    """On a connection of its own."""
    kvs[key()] = 1
    with SilentSubscriber(key(), interface) as mirror:
        copy = pickle.loads(pickle.dumps(mirror))
        copy.listen()
        pspace[key()] = 2
        eventually(lambda: copy.value() == mirror.value() == 2)
        copy.close()
        with contextlib.suppress(AttributeError):
            copy.interface.close()


def test_callbacks_run_beside_a_running_event_loop(server_url, key):
    """In a program, or a notebook, that has one of its own."""
    seen = []

    async def main():
        with RedisInterface(server_url) as interface:
            subscriber = CallbackSubscriber(key(), interface, lambda data, updated_path: seen.append(data), {})
            subscriber.listen()
            PublishSpace(interface)[key()] = 1
            async with asyncio.timeout(PATIENCE):
                while not seen:
                    await asyncio.sleep(0.01)
            subscriber.close()

    asyncio.run(main())
    assert seen == [1]
