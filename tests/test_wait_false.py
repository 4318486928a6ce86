"""Publishing that does not wait: `PublishSpace(interface, wait=False)`, with either front."""

import asyncio
import contextlib
import os
import pickle
import random
import re
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import redis
from chaos.proxy import Proxy
from chaos.servers import PrivateServer
from conftest import FRONTS, PATIENCE, assert_same, eventually, python, sized, stopped

import reem
import reem_async
from reem_async.concurrency.queues import Every, Last
from reem_async.errors import BadInput, BadType, BadValue, InterfaceClosed, Misuse, NotConnected, PathRefused
from reem_async.plan.keys import keys_of
from reem_async.store import outage, send_queue


@pytest.fixture(params=list(FRONTS))
def publisher(request, server_url, key):
    with contextlib.ExitStack() as stack:

        def make(url=server_url, policy="raise", on_error=None, **options):
            front = stack.enter_context(contextlib.closing(FRONTS[request.param](url, "PublishSpace", **options)))
            front.kvs = type(front.kvs)(front.interface, policy, False, on_error)
            front.flush = lambda timeout=PATIENCE: front.wait(front.kvs.flush(timeout))
            front.update = lambda path, values: front.wait(front.at(path).update(values))
            is_blocking = request.param == "blocking"
            front.sleep = time.sleep if is_blocking else lambda seconds: front.wait(asyncio.sleep(seconds))
            return front

        yield make


@pytest.fixture
def reader(server):
    with reem.RedisInterface(server.url) as interface:
        yield reem.KeyValueStore(interface)


def test_choices_that_mean_nothing_are_refused():
    for package in (reem, reem_async):
        interface = package.RedisInterface("redis://127.0.0.1:1")
        for choices, error in (
            ({"wait": 0}, BadType),
            ({"wait": None}, BadType),
            ({"on_error": print}, BadValue),
            ({"wait": False, "on_error": "log"}, BadType),
            ({"wait": False, "outage": "keep"}, BadValue),
            ({"outage": "keep"}, BadValue),
        ):
            with pytest.raises(error, match=r"wait=|on_error=|outage="):
                package.PublishSpace(interface, **choices)


def test_all_values_arrive_in_order_as_they_were_in_the_call(publisher, kvs, key):
    """Large and small, of several places; the arrays are changed after each call."""
    front, image = publisher(), np.zeros((300, 400))
    front.write([key()], {"n": 0, "l": [1, 2, 3], "image": image, "gone": 1})
    with kvs[key()].watch(Last(1000)) as watch:
        front.flush()
        for _ in range(10):
            for number in range(5):
                front.write([key(), "n"], number)
                image[:] = number
                front.write([key(), "image"], image)
                image[:] = -1
            front.flush()
        front.delete([key(), "gone"])
        front.delete([key(), "l", 0])
        front.update([key()], {"x": 1, "y": b"2"})
        front.wait(front.at([key(), "l"]).append(4))  # depends on what is stored, so it waits for what is queued
        assert_same(kvs[key()].read(), {"n": 4, "l": [2, 3, 4], "image": np.full((300, 400), 4.0), "x": 1, "y": b"2"})
        numbers, images, lateness = [], [], set()
        while (update := next(watch)).path != f"{key()}.l":
            assert not update.gap
            if update.origin == "published":
                lateness.add(update.late)
            if update.path.endswith(".n"):
                numbers.append(update.value)
            elif update.path.endswith(".image"):
                images.append(float(update.value.max()))
                assert update.value.min() == update.value.max() >= 0
        assert numbers == [*range(5)] * 10
        assert images
        assert 0 in lateness  # without an outage nothing is late
    assert (front.kvs.dropped, front.kvs.waiting) == (0, 0)


@pytest.mark.parametrize("front", ["blocking"])
def test_bad_input_is_refused_in_the_call(publisher, front, key):
    space = publisher()
    for value in (float("nan"), {1: 2}, object(), {"a": {3}}):
        with pytest.raises(BadInput):
            space.write([key()], value)
    assert (space.kvs.dropped, space.kvs.waiting) == (0, 0)


def test_the_newest_of_each_place_is_left_where_the_server_lags_and_the_rest_is_counted(publisher, server, reader):
    front = publisher(server.url, timeout=PATIENCE)
    front.write(["a"], {"x": 0, "y": 0, "z": {}})
    front.flush()
    with reader["a"].watch(Every(10_000)) as watch:
        with stopped(server):
            for number in range(1, 1001):
                front.write(["a", "x"], number)
                front.update(["a"], {"y": number, "w": number})
            front.write(["a", "z"], {"n": 1})
            assert front.kvs.waiting <= 2 * send_queue.LAG + 3
            with pytest.raises(TimeoutError, match=r"not sent within 0\.05 s"):
                front.flush(0.05)
        front.flush()
        assert reader["a"].read() == {"x": 1000, "y": 1000, "w": 1000, "z": {"n": 1}}
        arrived, missed, told = 0, 0, {"a.x": [], "a.y": [], "a.w": []}
        while (update := next(watch)).path != "a.z":
            if update.sequence is not None:
                arrived += 1
                told[update.path].append(update.value)
            missed += update.missed or 0
        assert front.kvs.dropped == missed + update.missed
        assert front.kvs.dropped + arrived == 3000
        assert all(values == sorted(set(values)) for values in told.values())


@pytest.mark.parametrize("bound", ["calls", "bytes"])
def test_the_queue_is_bounded(publisher, server, reader, monkeypatch, bound):
    """The oldest of a key go first, the newest stays."""
    monkeypatch.setattr(*((send_queue, "MOST_CALLS", 50) if bound == "calls" else (outage, "_MOST", 60_000)))
    front = publisher(server.url, timeout=PATIENCE)
    front.write(["a"], {})
    front.flush()
    with stopped(server):
        for number in range(200):
            front.write(["a", f"n{number}"], "x" * 1000)
        assert 30 <= front.kvs.waiting <= 51
        front.write(["b"], "x" * 100_000)
    front.flush()
    stored = reader["a"].read()
    assert len(stored) + front.kvs.dropped == 200
    assert {"n0", "n199"} <= stored.keys()  # the first was on its way
    assert len(reader["b"].read()) == 100_000


def test_an_error_is_raised_at_the_next_call_once(publisher, server):
    front = publisher(server.url)
    front.write(["a"], {"x": 1})
    front.write(["a", "x", "y", "z"], 1)
    front.until(lambda: front.kvs.dropped == 1)
    with pytest.raises(PathRefused) as caught:
        front.write(["a", "n"], 2)
    assert "an earlier update, of a.x.y.z" in str(caught.value.__notes__)
    front.write(["a", "n"], 3)
    front.write(["a", "x", "y", "z"], 1)
    front.delete(["a", "nothing"])
    with pytest.raises(PathRefused) as caught:
        front.flush()
    assert "the first of 2 errors" in str(caught.value.__notes__)
    front.flush()
    assert (front.kvs.dropped, front.kvs.waiting) == (3, 0)


def test_errors_go_to_the_callback(publisher, server, caplog):
    """One that raises is logged; a flush inside would wait for itself."""
    errors, inside = [], []

    def on_error(error):
        errors.append(error)
        if isinstance(front, FRONTS["blocking"]):
            with pytest.raises(Misuse, match="would wait for itself"):
                front.kvs.flush()
            inside.append(1)
        raise ValueError("of the callback")

    front = publisher(server.url, on_error=on_error)
    front.write(["a"], {"x": 1})
    for _ in range(2):
        front.write(["a", "x", "y", "z"], 1)
    front.flush()
    front.until(lambda: len(errors) == 2)
    front.write(["a"], 2)
    front.flush()
    assert all(isinstance(error, PathRefused) for error in errors)
    assert inside in ([], [1, 1])
    assert "of the callback" in caplog.text


def test_calls_that_wait_share_transactions_and_each_gets_its_own_error(publisher, server, reader):
    """Early ones are sent together every few milliseconds. Numbers, values and losses are those of single calls."""
    errors = []
    front = publisher(f"redis://localhost:{server.port}", on_error=errors.append, local="early", timeout=PATIENCE)
    front.write(["a"], {"n": -1, "image": np.zeros(3)})
    front.flush()
    with redis.Redis.from_url(server.url) as admin, reader["a"].watch(Every(1000)) as watch:
        transactions = admin.info("commandstats")["cmdstat_exec"]["calls"]
        for number in range(30):
            if number % 10 == 5:
                front.write(["a", "n", "x", f"y{number}"], number)
            elif number % 10 == 7:
                front.write(["a", "image"], np.full(3, number))
            else:
                front.write(["a", "n"], number)
        front.update(["a"], {"x": 1, "y": 2})
        front.write(["a", "end"], True)
        front.flush()
        assert admin.info("commandstats")["cmdstat_exec"]["calls"] - transactions < 30
        arrived, has_gap = [], False
        while (update := next(watch)).path != "a.end":
            arrived.append((update.path, update.value if update.path == "a.n" else None))
            assert update.missed in (0, None)
            has_gap |= update.gap
    good = [number for number in range(30) if number % 10 not in (5, 7)]
    values = [value for path, value in arrived if path == "a.n" and value in good]
    # After the read that a refused update leads to, some may be delivered once more: promise 25.
    assert (list(dict.fromkeys(values)) if has_gap else values) == good
    assert_same(reader["a"].read(), {"n": 29, "image": np.full(3, 27), "x": 1, "y": 2, "end": True})
    assert [re.search(r"y\d+", error.__notes__[0])[0] for error in errors] == ["y5", "y15", "y25"]
    assert all(isinstance(error, PathRefused) for error in errors)
    assert front.kvs.dropped == 3


@pytest.mark.parametrize("policy", ["raise", "drop", "newest"])
def test_the_server_is_killed_and_comes_back(publisher, policy, caplog):
    """With each policy; the call never waits, and what is not stored is counted."""
    with PrivateServer(keep=True) as server:
        front, errors = publisher(server.url, policy), 0
        front.write(["a"], {"x": 0})
        front.flush()
        server.kill()
        for number in range(1, 201):
            try:
                front.write(["a", "x"], number)
            except reem_async.ReemError:
                errors += 1
            front.sleep(0.001)
        front.until(lambda: policy == "newest" or front.kvs.waiting == 0)
        dropped = front.kvs.dropped
        assert dropped + front.kvs.waiting + errors == 200
        assert (errors > 0) == (policy == "raise")
        server.start()
        front.until(lambda: "the server answers again" in caplog.text)
        with contextlib.suppress(NotConnected):
            front.flush()
        with reem.RedisInterface(server.url) as interface:
            place = reem.KeyValueStore(interface)["a"]["x"]
            assert place.get(0) == (200 if policy == "newest" else 0)
            front.write(["a"], {"x": 201})
            front.flush()
            assert place.read() == 201
        assert caplog.text.count("until the server is back") == 1
        front.wait(front.interface.close())


def test_closing_sends_what_is_queued(publisher, kvs, key):
    front = publisher()
    for number in range(20):
        front.write([key(f"n{number}")], number)
    front.wait(front.interface.close())
    assert [kvs[key(f"n{number}")].read() for number in range(20)] == [*range(20)]
    assert front.kvs.dropped == 0
    with pytest.raises(InterfaceClosed):
        front.write([key()], 1)


def test_closing_waits_not_for_long_and_reports_what_was_not_sent(publisher, server, caplog):
    front = publisher(server.url, timeout=0.3)
    front.write(["a"], {})
    front.flush()
    with stopped(server):
        for number in range(20):
            front.write(["a", f"n{number}"], number)
        began = time.monotonic()
        front.wait(front.interface.close())
        assert time.monotonic() - began < 5
    assert front.kvs.waiting == 0
    assert front.kvs.dropped == 20
    assert "were not" in caplog.text


def test_pickled_spaces_and_handles_do_not_wait_either(publisher, kvs, key):
    front = publisher()
    for place in (pickle.loads(pickle.dumps(front.kvs))[key()], pickle.loads(pickle.dumps(front.kvs[key()]))):
        queue = getattr(place, "_core", place)._writer._outages
        assert isinstance(queue, send_queue.SendQueue)
        front.wait(place.write(1))
        front.wait(getattr(place, "_interface", queue._session.interface).close())
        assert kvs[key()].read() == 1


EXITS = {
    "the end": "",
    "sys.exit": "sys.exit(0)",
    "atexit, before the import": "",
    "__del__": "at_end = AtEnd(); at_end.last = functools.partial(space.__setitem__, sys.argv[3], 'last')",
    "the interface is dropped": "del space, interface",
}


@pytest.mark.parametrize("end", EXITS)
def test_a_program_that_ends_has_sent_what_it_published(server_url, key, kvs, end):
    code = f"""
import atexit, functools, sys
class AtEnd:
    def __del__(self):
        self.last()
def last():
    space[sys.argv[3]] = "last"
if {end.startswith("atexit")}:
    atexit.register(last)
import reem
interface = reem.RedisInterface(sys.argv[1])
space = reem.PublishSpace(interface, wait=False)
space[sys.argv[3]] = "first"  # in a cluster, so that there is a connection
for number in range(30):
    space[sys.argv[2]] = number
{EXITS[end]}
"""
    done = python(code, server_url, key("a"), key("b"))
    assert (done.stdout, done.stderr, done.returncode) == ("", "", 0)
    assert kvs[key("a")].read() == 29
    if end.startswith(("atexit", "__del__")):
        assert kvs[key("b")].read() == "last"


def test_an_event_loop_that_ends_sends_what_was_published(server_url, key, kvs):
    """With asyncio.run, without close, over the connection there is; and another loop goes on."""

    async def publish(number):
        await reem_async.KeyValueStore(interface)[key()].read()
        for place in range(3):
            await space[key(f"n{place}")].write(number)

    interface = reem_async.RedisInterface(server_url)
    space = reem_async.PublishSpace(interface, wait=False)
    for number in range(3):
        asyncio.run(publish(number))
        assert [kvs[key(f"n{place}")].read() for place in range(3)] == [number] * 3
    asyncio.run(interface.close())
    assert (space.dropped, space.waiting) == (0, 0)


def test_the_queue_of_a_forked_child_is_empty(server, reader):
    with reem.RedisInterface(server.url, timeout=PATIENCE) as interface:
        space = reem.PublishSpace(interface, wait=False)
        space["a"] = {"n": 0}
        space.flush()
        with stopped(server):
            for number in range(1, 6):
                space["a"]["n"] = number
            child = os.fork()
            if child == 0:
                status = 1
                with contextlib.suppress(BaseException):
                    signal.alarm(20)
                    assert (space.waiting, space.dropped) == (0, 0)
                    os.kill(server.pid, signal.SIGCONT)
                    space["b"] = "child"
                    space.flush(PATIENCE)
                    interface.close()
                    status = 0
                os._exit(status)
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        space.flush(PATIENCE)
        assert (reader["a"].read(), reader["b"].read(), space.dropped) == ({"n": 5}, "child", 0)


def test_a_call_in_the_moment_in_which_the_sender_begins_to_wait_is_sent_at_once(server_url, kvs, key, monkeypatch):
    class Queue(send_queue.SendQueue):
        @property
        def _is_idle(self):
            return vars(self)["idle"]

        @_is_idle.setter
        def _is_idle(self, value):
            if value and late:
                space[key()] = late.pop()
            vars(self)["idle"] = value

    late = [1]
    monkeypatch.setattr(send_queue, "SendQueue", Queue)
    with reem.RedisInterface(server_url) as interface:
        space = reem.PublishSpace(interface, wait=False)
        space[key()] = 0
        begin = time.monotonic()
        eventually(lambda: kvs[key()].read() == 1)
        assert time.monotonic() - begin < send_queue._IDLE / 2


def test_a_forked_child_does_not_raise_the_errors_of_its_parent(server):
    with reem.RedisInterface(server.url) as interface:
        space = reem.PublishSpace(interface, wait=False)
        space["a"] = {"x": 1}
        space["a"]["x"]["y"] = 1
        eventually(lambda: space.dropped == 1)
        child = os.fork()
        if child == 0:
            status = 1
            with contextlib.suppress(BaseException):
                assert space.dropped == 0
                space["b"] = 1
                space.flush(PATIENCE)
                status = 0
            os._exit(status)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        with pytest.raises(PathRefused):
            space.flush()


def test_plain_code_on_the_thread_of_an_event_loop_does_not_wait_either(server_url, kvs, key):
    """As in a notebook."""

    async def publish():
        with reem.RedisInterface(server_url) as interface:
            space = reem.PublishSpace(interface, wait=False)
            for number in range(20):
                space[key()] = {"n": number}
            space.flush(PATIENCE)

    asyncio.run(publish())
    assert kvs[key()].read() == {"n": 19}


def test_ctrl_c_queues_a_call_whole_or_not_at_all(server_url, key, kvs, monkeypatch):
    """At random instants, beside another thread that publishes: nothing is lost, torn, or sent twice."""
    monkeypatch.setattr(sys, "unraisablehook", lambda _: None)  # an interrupt in a callback of a weak reference
    rng, calls, returned, torn, inside, done = random.Random(key()), 0, [], [], False, threading.Event()

    def interrupt(*_):
        if inside:
            raise KeyboardInterrupt

    def other():
        while not done.is_set():
            space[key()]["other"] = len(torn)
            value = kvs[key()].read()
            torn.append(value["x"] != value["y"])
            time.sleep(0.002)

    before = signal.signal(signal.SIGALRM, interrupt)
    with reem.RedisInterface(server_url) as interface, kvs[key()].watch(Every(100_000)) as watch:
        space = reem.PublishSpace(interface, wait=False)
        kvs[key()] = {"x": 0, "y": 0, "other": 0}
        with ThreadPoolExecutor(1) as pool:
            thread, end = pool.submit(other), time.monotonic() + sized(2, 20)
            while time.monotonic() < end:
                calls += 1
                try:
                    inside = True
                    signal.setitimer(signal.ITIMER_REAL, rng.uniform(1e-6, 0.0005))
                    space[key()].update({"x": calls, "y": calls})
                    inside = False
                    returned.append(calls)
                except KeyboardInterrupt:
                    inside = False
                time.sleep(0.001)
            done.set()
            signal.setitimer(signal.ITIMER_REAL, 0)
            thread.result()
        signal.signal(signal.SIGALRM, before)
        space.flush(PATIENCE)
        value = kvs[key()].read()
        assert value["x"] == value["y"] >= returned[-1]
        space[key()]["end"] = 1
        told = []
        while (update := next(watch)).path != f"{key()}.end":
            if update.path.endswith(".y") and update.sequence is not None:
                told.append(update.value)
    assert len(returned) < calls
    assert told == sorted(set(told))
    assert not any(torn)
    assert len(told) + space.dropped >= len(returned)


def test_a_link_that_is_cut_again_and_again(publisher, server, reader):
    """At 200 Hz: at rest the mirror has what the server has, no update came twice, and what is missing is counted."""
    with Proxy(server.port) as proxy:
        front, rng, number = publisher(proxy.url, "newest", timeout=0.3), random.Random(1), 0
        front.write(["a"], {"x": 0, "y": 0, "image": np.zeros(100)})
        front.flush()
        told = []
        with (
            reader["a"].watch(Every(100_000)) as watch,
            reader["a"].mirror() as mirror,
        ):
            end = time.monotonic() + sized(2, 30)
            while time.monotonic() < end:
                if rng.random() < 0.02:
                    rng.choice([proxy.reset, proxy.half_close, lambda: proxy.drop_reply(b"EXEC")])()
                number += 1
                front.write(["a", "xy"[number % 2]], number)
                if number % 20 == 0:
                    front.write(["a", "image"], np.full(100, float(number)))
                front.sleep(0.005)
            front.flush()
            front.write(["a", "end"], 1)
            front.flush()
            missed = 0
            while (update := next(watch)).path != "a.end":
                missed += update.missed or 0
                if update.sequence is not None:
                    told.append((update.publisher, update.sequence))
            eventually(lambda: mirror.value().get("end") == 1)
            assert_same(mirror.value(), reader["a"].read())
        assert len(set(told)) == len(told)
        assert front.kvs.waiting == 0
        assert number // 2 < len(told) + front.kvs.dropped


def test_an_update_that_found_no_server_keeps_its_number(publisher, server, reader):
    with Proxy(server.port) as proxy, reader["a"].watch(Every(100)) as watch:
        front = publisher(proxy.url, "newest", timeout=0.3)
        front.write(["a"], 1)
        front.flush()
        proxy.black_hole()
        proxy.reset()
        front.sleep(0.1)  # until the reset has arrived: what is sent before it may have been applied
        front.write(["a"], 2)
        front.sleep(0.5)
        proxy.heal()
        front.flush()
        front.write(["a"], 3)
        front.flush()
        updates = [watch.next(PATIENCE) for _ in range(3)]
        assert [(update.data, update.sequence, update.missed) for update in updates] == [(n, n, 0) for n in (1, 2, 3)]
        assert len({update.publisher for update in updates}) == 1


@pytest.mark.parametrize("large", [False, True])
def test_early_updates_arrive_while_the_server_does_not_answer(publisher, server, large):
    """In the order of the calls; each once, and at rest mirror and server agree."""
    url, told = f"redis://localhost:{server.port}", []
    front = publisher(url, local="early", timeout=PATIENCE)
    value = (lambda number: np.full(10_000, float(number))) if large else lambda number: number

    def note(data, updated_path, update):
        if update.sequence is not None:
            told.append((update.sequence, update.early, float(np.max(data["n"]))))

    with (
        reem.RedisInterface(url, timeout=PATIENCE) as interface,
        reem.KeyValueStore(interface)["a"].mirror() as mirror,
        reem.CallbackSubscriber("a", interface, note) as subscriber,
    ):
        subscriber.listen()
        front.write(["a"], {"n": value(0)})
        for _ in range(20):  # the sender finds the subscribers
            front.write(["a", "n"], value(0))
            front.flush()
            front.sleep(0.01)
        front.sleep(0.3)
        with stopped(server):
            for number in range(1, 4):
                front.write(["a", "n"], value(number))
                eventually(lambda number=number: told[-1][1:] == (True, number))
        front.flush()
        for number in range(4, sized(200, 1000)):
            front.write(["a", "n"], value(number))
            front.sleep(0.003)
        front.write(["a", "n"], value(-1))
        front.flush()
        eventually(lambda: np.max(mirror.value()["n"]) == -1)
        assert_same(mirror.value(), reem.KeyValueStore(interface)["a"].read())
        # After a gap (merged updates), and of large ones without room in shared memory, the key is read: then those
        # that the server has not confirmed may be delivered again, with the value that was read (promise 19).
        numbers = [sequence for sequence, _, _ in told]
        assert large or front.kvs.dropped or numbers == sorted(set(numbers))


def test_an_early_update_that_was_kept_in_an_outage_says_how_late_it_is(publisher, server, reader):
    """So that it does not count as fresh where it is sent at last (`ttl=`)."""
    with Proxy(server.port) as proxy, redis.Redis.from_url(server.url) as admin, admin.pubsub() as channel:
        front = publisher(proxy.url, "newest", local="early", timeout=PATIENCE)
        with reader["a"].watch(Every(1000)) as watch:
            for number in range(20):  # the sender finds the subscriber
                front.write(["a"], number)
                front.flush()
                front.sleep(0.01)
            channel.subscribe(keys_of("a").channel)
            assert channel.get_message(timeout=PATIENCE)["type"] == "subscribe"
            front.sleep(0.3)  # what the server reports as changed has been read
            proxy.black_hole()
            front.write(["a"], -1)  # on its way, and lost
            front.sleep(0.1)
            front.write(["a"], -2)
            while (update := next(watch)).value != -2:
                pass
            assert update.early
            front.sleep(0.2)
            proxy.reset()
            proxy.heal()
            front.flush()
            message = channel.get_message(timeout=PATIENCE)
            late = re.search(rb'"late":([0-9.]+)', message["data"])
            assert late is not None
            assert float(late[1]) >= 0.2
