"""Publishing and subscribing in `reem`: mirrors, callbacks on threads of their own, and loops that block."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import pickle
import threading
import time

import numpy as np
import pytest
from conftest import PATIENCE, assert_same, eventually, nothing_sent, python, subscribed

import reem
from reem import (
    CallbackSubscriber,
    Every,
    KeyValueStore,
    Last,
    Newest,
    PublishSpace,
    RedisInterface,
    SilentSubscriber,
)


@pytest.fixture
def other(server_url):
    """A second client: another program, as far as the server can tell."""
    with contextlib.closing(RedisInterface(server_url)) as opened:
        yield opened


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


def take(updates, count):
    """The next updates, read in a thread so that a test cannot hang."""
    got = []

    def work():
        iterator = iter(updates)
        while len(got) < count:
            got.append(next(iterator))

    with in_thread(work):
        pass
    return got


# --- the mirror ------------------------------------------------------------------------------------


def test_a_mirror_starts_with_what_is_there_and_follows(interface, kvs, pspace, key):
    """`.value()` for the root, `["number"].read()` below."""
    kvs[key()] = {"number": 4, "image": np.arange(3)}
    subscriber = SilentSubscriber(channel=key(), interface=interface)
    subscriber.listen()
    assert_same(subscriber.value(), {"number": 4, "image": np.arange(3)})
    pspace[key()] = {"number": 5, "string": "REEM"}
    eventually(lambda: subscriber["number"].read() == 5)
    assert subscriber.value() == {"number": 5, "string": "REEM"}
    pspace[key()]["deep"] = {"l": [np.arange(2)]}
    eventually(lambda: "deep" in subscriber.value())
    assert_same(subscriber["deep"]["l"][0].read(), np.arange(2))
    pspace[key()] = 5
    eventually(lambda: subscriber.value() == 5)
    subscriber.close()


def test_augmented_assignment_and_del_of_a_publish_space_are_published(interface, kvs, pspace, key):
    """It is written like a store."""
    pspace[key()] = {"n": 5, "l": [1], "gone": np.arange(2)}
    with SilentSubscriber(key(), interface) as mirror:
        pspace[key()]["n"] += 2
        pspace[key()]["n"] *= 3
        pspace[key()]["l"].append(np.arange(2))
        pspace[key()]["l"] += ["x"]
        del pspace[key()]["gone"]
        pspace[key()]["last"] = True
        eventually(lambda: "last" in mirror.value())
        assert_same(mirror.value(), {"n": 21, "l": [1, np.arange(2), "x"], "last": True})
        assert_same(kvs[key()].read(), mirror.value())


def test_reading_a_mirror_is_local_and_gives_copies(interface, kvs, key, raw):
    """No command reaches the server."""
    kvs[key()] = {"number": 5, "l": [1]}
    with SilentSubscriber(key(), interface) as mirror:
        with nothing_sent(raw):
            for _ in range(100):
                assert mirror["number"].read() == 5
                mirror.value()["l"].append(2)
        assert mirror.value() == {"number": 5, "l": [1]}
        with pytest.raises(KeyError, match="absent"):
            mirror["absent"].read()


def test_a_mirror_cannot_be_written(interface, kvs, key):
    """Neither assigned to nor deleted from."""
    kvs[key()] = {"a": 1}
    with SilentSubscriber(key(), interface) as mirror:
        with pytest.raises(reem.ReadOnly):
            mirror["a"] = 2
        with pytest.raises(NotImplementedError):
            mirror["a"].write(2)
    assert kvs[key()].read() == {"a": 1}


def test_no_publish_after_listen_is_missed(interface, key, other):
    """By another client, at once."""
    publishing = PublishSpace(other)
    for n in range(30):
        with SilentSubscriber(key(f"channel{n}"), interface) as mirror:
            publishing[key(f"channel{n}")] = {"n": n}
            eventually(lambda mirror=mirror, n=n: mirror.value() == {"n": n})


def test_large_updates_arrive_whole(interface, key, other):
    """A full camera image."""
    publishing = PublishSpace(other)
    with SilentSubscriber(key(), interface) as mirror:
        for n in range(3):
            image = np.full((640, 480, 3), float(n))
            publishing[key()] = {"image": image, "n": n}
            eventually(lambda n=n: (mirror.value() or {}).get("n") == n)
            assert_same(mirror["image"].read(), image)


# --- callbacks -------------------------------------------------------------------------------------


def test_a_callback_gets_data_path_and_its_keyword_arguments(interface, pspace, key):
    """The whole structure below the channel, and the updated path as a string."""
    calls = []

    def callback(data, updated_path, foo):
        calls.append((data, updated_path, foo))

    subscriber = CallbackSubscriber(
        channel=key("c"), interface=interface, callback_function=callback, kwargs={"foo": 5}
    )
    subscriber.listen()
    pspace[key("c")] = {"number": 5, "string": "REEM"}
    eventually(lambda: len(calls) == 1)
    pspace[key("c")]["number"] = 6
    eventually(lambda: len(calls) == 2)
    subscriber.close()
    assert calls == [
        ({"number": 5, "string": "REEM"}, key("c"), 5),
        ({"number": 6, "string": "REEM"}, key("c") + ".number", 5),
    ]
    assert all(type(path) is str for _, path, _ in calls)


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
        assert time.monotonic() - began < PATIENCE / 2
        release.set()
        eventually(lambda: seen and seen[-1] == 49)
        assert seen == sorted(seen)


def test_an_exception_in_a_callback_is_logged_and_ends_nothing(interface, pspace, key, caplog):
    """The next update is delivered, and no thread dies of it."""
    seen = []

    def fail(data, updated_path):
        seen.append(data)
        if data == 1:
            raise ZeroDivisionError("on purpose")

    with caplog.at_level(logging.ERROR), CallbackSubscriber(key(), interface, fail, {}):
        pspace[key()] = 1
        eventually(lambda: seen == [1])
        pspace[key()] = 2
        eventually(lambda: seen == [1, 2])
    assert any(record.exc_info and record.exc_info[0] is ZeroDivisionError for record in caplog.records)


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


def test_a_fresh_parent_is_reported_and_a_neighbour_is_not(interface, pspace, key):
    """`foo.bar` hears of `foo`, `foo` never of `foobar`."""
    heard = []

    def hear(data, updated_path):
        heard.append((data, updated_path.removeprefix(key("foo"))))

    with CallbackSubscriber(key("foo") + ".bar", interface, hear, {}):
        pspace[key("foobar")] = {"bar": 1}
        pspace[key("foo")] = {"bar": 2, "other": 1}
        eventually(lambda: len(heard) == 1)
        pspace[key("foo")]["other"] = 2
        pspace[key("foo")]["bar"] = 3
        eventually(lambda: len(heard) == 2)
    assert heard == [(2, ""), (3, ".bar")]


# --- loops -----------------------------------------------------------------------------------------


def test_a_loop_begins_with_what_is_there_and_then_tells_every_update(kvs, pspace, key):
    """`for update in kvs["c"].watch()`, item by item."""
    kvs[key()] = {"n": 0, "image": np.arange(3)}
    updates = kvs[key()].watch()
    (first,) = take(updates, 1)
    assert (first.initial, first.path) == (True, key())
    assert_same(first.data, {"n": 0, "image": np.arange(3)})
    pspace[key()]["n"] = 7
    (second,) = take(updates, 1)
    assert (second.initial, second.path, second.value) == (False, key() + ".n", 7)
    assert_same(second.data, {"n": 7, "image": np.arange(3)})
    assert not second.gap
    pspace[key()] = 8
    (third,) = take(updates, 1)
    assert second.publisher == third.publisher is not None
    assert second.sequence < third.sequence
    assert second.time <= third.time


@pytest.mark.parametrize(("policy", "kept"), [(None, 1), (Newest(), 1), (Last(5), 5), (Every(100), 20)], ids=repr)
def test_a_queue_is_bounded_by_a_named_policy_and_counts_what_it_dropped(kvs, pspace, key, policy, kept):
    """Newest only by default, the last n, or every one."""
    kvs[key()] = -1
    updates = kvs[key()].watch() if policy is None else kvs[key()].watch(policy=policy)
    assert take(updates, 1)[0].initial
    for n in range(20):
        pspace[key()] = n
    time.sleep(0.5)
    assert [update.data for update in take(updates, kept)] == list(range(20 - kept, 20))
    assert updates.dropped == 20 - kept


def test_every_one_beyond_its_bound_is_an_error(kvs, pspace, key):
    """A subscriber that asked for all must not miss some silently."""
    kvs[key()] = -1
    updates = kvs[key()].watch(policy=Every(5))
    take(updates, 1)
    for n in range(20):
        pspace[key()] = n
    time.sleep(0.3)
    with pytest.raises(reem.QueueFull):
        take(updates, 20)


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


def test_all_subscribers_of_an_interface_share_one_connection(server_url, key, raw):
    """However many there are, and none is left after close."""
    before = subscribed(raw)
    with contextlib.closing(RedisInterface(server_url)) as interface:
        mirrors = [SilentSubscriber(key(f"c{n % 5}"), interface) for n in range(20)]
        for mirror in mirrors:
            mirror.listen()
        calls = CallbackSubscriber(key("c1"), interface, lambda data, updated_path: None, {})
        calls.listen()
        assert len(subscribed(raw) - before) == 1
        PublishSpace(interface)[key("c3")] = 5
        eventually(lambda: [mirror.value() for mirror in mirrors[3::5]] == [5] * 4)
    eventually(lambda: not subscribed(raw) - before)


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
