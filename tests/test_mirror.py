"""A mirror of the store: read from memory, with its age, and an error in place of an old value."""

import asyncio
import contextlib
import functools
import math
import os
import random
import signal
import threading
import time

import numpy as np
import pytest
import redis
from chaos.proxy import Proxy
from conftest import FRONTS, aeventually, assert_same, eventually, nothing_sent, server_without_right, sized
from test_ships import Pose, PoseShip

import reem
import reem_async
from reem_async.errors import BadValue, InterfaceClosed, MissingKey, ReadOnly, Stale
from reem_async.pubsub import manager as manager_module
from reem_async.pubsub.manager import manager_of
from reem_async.server import EmbeddedServer

IMAGE = np.zeros((480, 640, 3), np.uint8)


class Mirrored:
    def __init__(self, front, path, **options):
        self.front = front
        self.mirror = front.at(path).mirror(**options)
        front.wait(self.mirror.listen())

    def until(self, predicate, timeout=10.0):
        return self.front.wait(self.mirror.wait_until(predicate, timeout))

    def close(self):
        self.front.wait(self.mirror.close())


@pytest.fixture
def mirrored(front):
    return functools.partial(Mirrored, front)


def test_a_mirror_answers_from_memory_what_anybody_stored_or_published(mirrored, kvs, pspace, raw, key):
    """With nothing sent, at any depth; what is missing as in a store."""
    top = key()
    kvs[top] = {"joint": 1.5, "deep": {"l": [1, 2]}, "small": np.arange(3)}
    it = mirrored((top,))
    mirror = it.mirror
    with nothing_sent(raw):
        for _ in range(50):
            assert mirror["joint"].read() == 1.5
            assert mirror["deep"]["l"][-1].read() == 2
            assert_same(mirror.value(), {"joint": 1.5, "deep": {"l": [1, 2]}, "small": np.arange(3)})
    kvs[top]["joint"] = 2.5
    assert it.until(lambda value: value["joint"] == 2.5)["deep"] == {"l": [1, 2]}
    raw.execute_command("JSON.SET", top, "$.joint", "3.5")
    it.until(lambda value: value["joint"] == 3.5)
    pspace[top]["joint"] = 4.5
    it.until(lambda value: value["joint"] == 4.5)
    assert mirror["joint"].read() == 4.5
    with pytest.raises(MissingKey):
        mirror["nothing"].read()
    assert mirror["nothing"].get("default") == "default"
    with pytest.raises(ReadOnly):
        mirror["joint"] = 1
    raw.delete(top)
    assert it.until(lambda value: value is None) is None


def test_waiting_ends_at_once_later_or_in_vain(mirrored, kvs, key):
    it = mirrored((key(),))
    assert it.until(lambda value: value is None) is None
    with pytest.raises(TimeoutError, match=key()):
        it.until(lambda value: value == 5, 0.05)
    with pytest.raises(ZeroDivisionError):
        it.until(lambda value: 1 / 0)

    def late(value):
        raise TimeoutError("the predicate's own")

    for timeout in None, 10.0:
        with pytest.raises(TimeoutError, match="own"):
            it.until(late, timeout)
    later = threading.Timer(0.1, kvs[key()].write, [5])
    later.start()
    assert it.until(lambda value: value == 5) == 5
    later.join()


def test_a_predicate_sees_each_published_state(mirrored, pspace, key):
    """Also one that the next one follows at once, as of a button that is pressed for a moment."""
    pspace[key()] = {"pressed": False}
    it = mirrored((key(),))

    for _ in range(20):
        waits = threading.Event()

        def press(waits=waits):
            waits.wait(10)
            pspace[key()]["pressed"] = True
            pspace[key()]["pressed"] = False

        def pressed(value, waits=waits):
            waits.set()
            return value["pressed"]

        thread = threading.Thread(target=press)
        thread.start()
        assert it.until(pressed)["pressed"] is True
        thread.join()
        it.until(lambda value: not value["pressed"])


def test_objects_of_a_users_own_ship_are_copied_too(server_url, key):
    """A reader that changes one changes it in no mirror and for no other subscriber."""
    with reem.RedisInterface(server_url, ships=[PoseShip(), reem.NumpyShip()]) as interface:
        kvs = reem.KeyValueStore(interface)
        kvs[key()] = {"pose": Pose(1.0, 2.0), "image": np.zeros(3)}
        with kvs[key()].mirror() as mirror, kvs[key()].watch() as watch:
            for pose in (mirror.value()["pose"], mirror["pose"].read(), next(watch).data["pose"]):
                assert pose.x == 1.0
                pose.x = 9.0
            assert mirror["pose"].read().x == mirror.value()["pose"].x == 1.0
            assert mirror["image"].read() is mirror["image"].read()  # read-only


def test_a_predicate_of_the_blocking_front_may_call_reem(kvs, key):
    kvs[key()] = 1
    with kvs[key()].mirror() as mirror:
        assert mirror.wait_until(lambda value: kvs[key()].read() == value, 10) == 1


def test_large_arrays_stay_at_the_server_if_asked_for(mirrored, raw, kvs, key):
    """What they are stands in their place; small ones are fetched."""
    top = key()
    kvs[top] = {"image": IMAGE, "small": np.arange(3), "n": 1}
    it = mirrored((top,), largest=1000)
    place = it.mirror["image"].read()
    assert (place.label, place.size >= IMAGE.nbytes, place.summary) == ("numpy", True, "uint8[480,640,3]")
    assert_same(it.mirror["small"].read(), np.arange(3))
    kvs[top]["n"] = 2
    it.until(lambda value: value["n"] == 2)
    assert it.mirror["image"].read() is place
    kvs[top]["image"] = IMAGE + 1  # of the same shape
    it.until(lambda value: value["image"] is not place)
    kvs[top]["image"] = np.zeros((2, 2), np.uint8)
    assert_same(it.until(lambda value: isinstance(value["image"], np.ndarray))["image"], np.zeros((2, 2), np.uint8))
    kvs[top]["image"] = IMAGE
    it.until(lambda value: not isinstance(value["image"], np.ndarray))
    assert_same(kvs[top]["image"].read(), IMAGE)


async def test_a_large_array_needs_no_right_to_type():
    """It was an Unreadable: only what is reported of its changes needs that right."""
    async with server_without_right("type") as (kvs, url), reem_async.RedisInterface(url) as interface:
        await kvs["a"].write({"n": 1, "image": IMAGE})
        async with reem_async.KeyValueStore(interface)["a"].mirror(largest=1000) as mirror:
            assert mirror["image"].read().summary == "uint8[480,640,3]"


@pytest.mark.alone
def test_the_age_is_that_of_the_last_sign_of_life(mirrored, kvs, key):
    """Asked for as often as `max_age` needs it, so a quiet key is no old one."""
    kvs[key()] = 1
    it = mirrored((key(),), max_age=0.5)
    fresh = 0
    for _ in range(40):
        with pytest.raises(TimeoutError):
            it.until(lambda value: False, 0.05)
        with contextlib.suppress(Stale):  # a busy machine
            assert it.mirror.value() == 1
            fresh += it.mirror.age < 0.5
    assert fresh > 30  # with a sign of life each second, half of them
    with pytest.raises(BadValue):
        mirrored((key(),), max_age=0)


@pytest.mark.parametrize("kind", list(FRONTS))
def test_a_stopped_server_makes_the_copy_too_old_and_a_dead_one_is_an_error(kind):
    """No old value; when it is back, the mirror is too."""
    with EmbeddedServer() as server:
        front = FRONTS[kind](server.url)
        with contextlib.closing(front):
            front.write(("foo",), {"a": 1})
            fresh, any_age = Mirrored(front, ("foo",), max_age=0.3), Mirrored(front, ("foo",))
            kept = Mirrored(front, ("foo",), stale="keep")
            os.kill(server.pid, signal.SIGSTOP)
            try:

                def raises(mirror):
                    if kind == "asyncio":
                        front.run(asyncio.sleep(0.02))
                    try:
                        return not mirror.value()
                    except Stale as error:
                        return str(error)

                assert "copy" in eventually(lambda: raises(fresh.mirror))
                assert fresh.mirror.age > 0.3
                assert "connection is down" in eventually(lambda: raises(any_age.mirror))
                assert kept.mirror.value() == {"a": kept.mirror["a"].read()} == kept.until(bool) == {"a": 1}
                assert kept.mirror.age > 0.3
            finally:
                os.kill(server.pid, signal.SIGCONT)
            assert any_age.until(lambda value: value == {"a": 1}, 10)
            assert fresh.until(lambda value: value == {"a": 1}, 10)
            fresh.close()
            with pytest.raises(Stale, match="closed"):
                fresh.mirror.value()
            with pytest.raises(InterfaceClosed):
                fresh.until(lambda value: True)
            assert eventually(lambda: kept.mirror.age < 0.3 or raises(kept.mirror)) is True
            any_age.close()
            kept.close()
            with pytest.raises(Stale, match="closed"):
                kept.mirror.value()


@pytest.mark.parametrize("options", [{"stale": "old"}, {"stale": None}, {"stale": "keep", "max_age": 1.0}])
def test_a_mirror_refuses_what_cannot_be_meant(front, key, options):
    with pytest.raises(BadValue, match="stale="):
        front.at((key(),)).mirror(**options)


def test_a_mirror_that_does_not_follow_yet_says_so(front, key):
    mirror = front.at((key(),)).mirror()
    with pytest.raises(Stale, match="listen"):
        mirror.value()
    assert mirror.age == float("inf")
    with pytest.raises(Stale, match="listen"):
        front.wait(mirror.wait_until(lambda value: True, 1.0))


async def test_a_cut_connection_is_an_error_until_the_copy_is_there_again(ainterface, akvs, key):
    """Not the old value with a new connection."""
    await akvs[key()].write(1)
    async with akvs[key()].mirror() as mirror:
        for wire in list(manager_of(ainterface.session)._wires.values()):
            wire.abort(reem_async.ConnectionLost("cut"))
        with pytest.raises(Stale):
            mirror.value()
        await akvs[key()].write(2)
        assert await mirror.wait_until(lambda value: True, 10) == 2


@pytest.mark.long
async def test_frequent_signs_of_life_ask_for_nothing_else_and_last_as_long_as_the_mirror(
    ainterface, akvs, key, raw, monkeypatch
):
    """However many keys are followed beside; then the next one that needs them decides."""
    monkeypatch.setattr(manager_module, "_PERIOD", 1000.0)
    manager = manager_of(ainterface.session)

    def calls(command):
        return raw.info("commandstats").get(f"cmdstat_{command}", {"calls": 0})["calls"]

    async with akvs[key("a")].mirror(max_age=0.3):
        async with akvs[key("b")].mirror(max_age=0.005) as mirror:
            assert manager._heartbeats._period == 0.005 / 3
            await manager.fence()  # the notes that following begins with have been asked for
            gets, pings = calls("get"), calls("ping")
            await aeventually(lambda: calls("ping") >= pings + 20)
            assert calls("get") == gets
            assert mirror.age < 10
        monkeypatch.setattr(manager_module, "_PERIOD", 1.0)
        await aeventually(lambda: manager._heartbeats._period == 0.3 / 3)
    await aeventually(lambda: manager._heartbeats._period == 1.0)


async def test_many_wait_and_one_is_cancelled(akvs, key):
    async with akvs[key()].mirror() as mirror:
        waiting = [asyncio.ensure_future(mirror.wait_until(lambda value: value == 1)) for _ in range(5)]
        await asyncio.sleep(0)
        waiting[0].cancel()
        await akvs[key()].write(1)
        assert await asyncio.wait_for(asyncio.gather(*waiting[1:]), 10) == [1] * 4
        await aeventually(lambda: not mirror._waiting)


# --- the age of a mirror is never smaller than the true one: delays, slow loops, expiry, SWAPDB, missing rights


BOUND = 0.01
"""Seconds by which an age may be too small: the clocks of server and process are read at different steps."""
KEY = "stop"
MAX_AGE = 0.3


class Truth:
    """Changes one key at random, and knows which values the server had when: [value, from, until]."""

    def __init__(self, url, seed):
        self.interface = reem.RedisInterface(url)
        self.kvs, self.pspace = reem.KeyValueStore(self.interface), reem.PublishSpace(self.interface)
        self.raw = redis.Redis.from_url(url)
        self.random = random.Random(seed)
        self.spans = []
        self.number = 0
        self.do(self.store)
        pipeline = self.raw.pipeline(transaction=False)
        for number in range(20_000):  # among so many, the server finds an expired key by chance only after minutes
            pipeline.set(f"session {number}", "x", ex=3600)
        pipeline.execute()

    def do(self, action):
        """Change the key; the value before was there until the server has answered, at the latest."""
        before = time.monotonic()
        value = action()
        if self.spans:
            self.spans[-1][2] = min(self.spans[-1][2], time.monotonic())
        self.spans.append([value, before, math.inf])

    def had(self, value, since):
        """Whether the server had a value at any time since then."""
        return any(each == value and until >= since for each, _, until in self.spans)

    def store(self):
        self.number += 1
        self.kvs[KEY] = self.number
        return self.number

    def publish(self):
        self.number += 1
        self.pspace[KEY] = self.number
        return self.number

    def delete(self):
        self.raw.delete(KEY)

    def step(self):
        kind = self.random.choice(["store", "store", "publish", "burst", "delete", "expire", "swap"])
        if kind == "burst":
            for _ in range(self.random.randrange(50)):
                self.do(self.random.choice([self.store, self.publish]))
        elif kind == "expire":
            self.do(self.store)
            self.raw.pexpire(KEY, 50)
            over = time.monotonic() + 0.052
            self.spans[-1][2] = over
            self.spans.append([None, over - 0.05, math.inf])
            time.sleep(0.1)
        elif kind == "swap":
            value = self.spans[-1][0]
            for there in None, value:
                self.do(lambda there=there: self.raw.swapdb(0, 1) and there)
                time.sleep(self.random.uniform(0.01, 0.5))
        else:
            self.do(getattr(self, kind))

    def run(self, over, proxy):
        while not over.is_set():
            proxy.delay = self.random.choice([0.0, 0.0, 0.0, 0.02, 0.2, 0.6])
            for _ in range(self.random.randrange(1, 4)):
                self.step()
                time.sleep(self.random.choice([0.0, 0.05, 0.3]))

    def close(self):
        self.interface.close()
        self.raw.close()


def asked(mirror):
    """Return when the answer is from at the earliest, by the age of before, and the value; None if it is Stale."""
    since = time.monotonic() - mirror.age
    try:
        return since, mirror.value()
    except Stale:
        return None


@pytest.mark.parametrize("seed", range(sized(1, 10)))
async def test_no_age_is_smaller_than_the_true_one(seed):
    """Whatever comes between; and answers come where nothing does."""
    over = threading.Event()
    with EmbeddedServer() as server, Proxy(server.port) as proxy:
        truth = await asyncio.to_thread(Truth, server.url, seed)
        truth.raw.execute_command("ACL SETUSER robot on >secret ~* &* +@all -client|tracking")
        changing = threading.Thread(target=truth.run, args=(over, proxy))
        async with (
            reem_async.RedisInterface(proxy.url) as interface,
            reem_async.RedisInterface(proxy.url, username="robot", password="secret") as unprivileged,
            reem_async.KeyValueStore(interface)[KEY].mirror(max_age=MAX_AGE) as mirror,
            reem_async.KeyValueStore(unprivileged)[KEY].mirror(max_age=MAX_AGE) as blind,
        ):
            answers = [asked(mirror), asked(blind)]
            assert None not in answers
            end, slow = time.monotonic() + 4, random.Random(-seed)
            changing.start()
            while time.monotonic() < end:
                await asyncio.sleep(0.002)
                if slow.random() < 0.01:
                    time.sleep(slow.uniform(0.05, 0.5))  # a loop that is slower than its updates
                answers += filter(None, (asked(mirror), asked(blind)))
            over.set()
            await asyncio.to_thread(changing.join)
            proxy.delay = 0.0
            await asyncio.to_thread(truth.do, truth.store)
            assert await mirror.wait_until(lambda value: value == truth.number, 10)
            await asyncio.sleep(MAX_AGE)
            with pytest.raises(Stale, match=r"does not report what is only stored.*client\|tracking"):
                blind.value()
        truth.close()
    wrong = [(since, value) for since, value in answers if not truth.had(value, since - BOUND)]
    print(f"seed {seed}: {len(answers)} answers, wrong: {wrong[:10]}")
    assert not wrong
    assert len(answers) > 2
