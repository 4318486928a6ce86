"""Subscribing in `reem`: callbacks on threads of their own, and loops that block. `test_following.py` has the rest."""

import asyncio
import contextlib
import logging
import pickle
import threading
import time

import numpy as np
import pytest
from conftest import PATIENCE, assert_same, eventually

from reem import (
    CallbackSubscriber,
    PublishSpace,
    RedisInterface,
    SilentSubscriber,
)


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


def test_leaving_the_with_block_ends_the_callbacks(interface, pspace, key):
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


def test_a_pickled_subscriber_listens_anew(interface, pspace, kvs, key):
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
