"""Silence: mirrors and loops stop relying on what was published last, in time, and not before."""

import asyncio
import contextlib
import gc
import math
import operator
import pickle
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import orjson
import pytest
from chaos.proxy import Proxy
from conftest import EXAMPLES, Loop, eventually

import reem
import reem_async
from reem_async.concurrency.queues import EMPTY
from reem_async.errors import BadInput, BadValue, InterfaceClosed, Silent, Stale
from reem_async.plan.keys import keys_of
from reem_async.pubsub.callbacks import arranged
from reem_async.pubsub.silence import LivePlaceQueue, LiveQueue

STOP = object()
TTL = 0.2
SLACK = 0.25  # seconds by which a busy machine may delay a report; tests marked `alone` measure


def publish_late(raw, key, value, late, number):
    """Publish with a notice of this test's own making, as a publisher does after an outage."""
    keys, text = keys_of(key), orjson.dumps(value)
    head = [1, "late", number, time.time(), [], "set", len(text), [], {"late": late}]
    raw.publish(keys.channel, orjson.dumps(head) + b"\n" + text)


def idle(front, seconds):
    front.wait(asyncio.sleep(seconds)) if hasattr(front, "runner") else time.sleep(seconds)


def limited(front, call):
    """Make a call in a block with a time limit of 0.1 s, of the task or thread that makes it."""
    if not hasattr(front, "runner"):
        with reem.timeout(0.1):
            return call()

    async def awaited():
        with reem_async.timeout(0.1):
            return await call()

    return front.run(awaited())


@pytest.fixture
def mirror(front, key):
    made = front.at((key(),)).mirror(ttl=TTL)
    front.wait(made.listen())
    return made


def test_a_mirror_relies_on_what_is_published_for_so_long(front, mirror, key, kvs, pspace):
    def live():
        idle(front, 0.005)
        return mirror.value(STOP) is not STOP

    def silent():
        assert mirror.value(default=STOP) is STOP
        assert mirror["v"].get(STOP) is STOP
        for read in mirror.value, mirror["v"].read:
            with pytest.raises(Silent, match=f"{key()}: no update has arrived .*ttl=0.2"):
                read()

    silent()
    kvs[key()] = {"v": 1}
    idle(front, 0.05)  # a plain write, which nobody published
    silent()
    for _ in range(8):  # equal values are life
        pspace[key()] = {"v": 2}
        eventually(live)
        idle(front, TTL / 4)
        assert mirror.value() == {"v": 2}
        assert mirror["v"].read() == mirror["v"].get(STOP) == 2
    before = time.monotonic()
    eventually(lambda: not live())
    assert time.monotonic() - before < TTL + SLACK
    silent()
    kvs[key()]["v"] = 3
    idle(front, 0.05)
    silent()
    pspace[key()]["w"] = 4
    eventually(live)
    assert mirror.value() == {"v": 3, "w": 4}
    del pspace[key()]
    eventually(lambda: not live())  # an update, of which nothing is left
    assert mirror.value() is None


def test_what_a_mirror_finds_at_the_beginning_says_nothing(front, key, pspace):
    pspace[key()] = 1
    mirror = front.at((key(),)).mirror(ttl=10)
    front.wait(mirror.listen())
    with pytest.raises(Silent, match="since following began"):
        mirror.value()
    with pytest.raises(TimeoutError, match="since following began"):
        front.wait(mirror.wait_until(lambda value: True, 0.05))
    pspace[key()] = 2
    assert front.wait(mirror.wait_until(lambda value: True, 10)) == 2
    front.wait(mirror.close())
    with pytest.raises(Stale, match="closed"):
        mirror.value(STOP)  # a mistake, which no default hides


def test_a_mirror_has_a_default_for_every_outage(front, key, kvs):
    for options in {}, {"max_age": 0.005}, {"ttl": 5.0, "max_age": 0.005}:
        kvs[key()] = 1
        mirror = front.at((key(),)).mirror(**options)
        with pytest.raises(Stale, match="listen"):
            mirror.value(STOP)
        front.wait(mirror.listen())
        kvs[key()].delete()
        eventually(lambda mirror=mirror: (idle(front, 0.01), mirror.value(STOP) is STOP)[1])
        front.wait(mirror.close())


def test_a_loop_gets_what_is_published_and_one_update_when_silence_begins(front, key, kvs, pspace):
    kvs[key()] = 0
    loop = Loop(front, front.at((key(),)).watch(reem.Last(100), ttl=TTL))
    with contextlib.closing(loop):
        begun = time.monotonic()
        update = loop.next()  # not what is there
        assert TTL <= time.monotonic() - begun + 0.05 < TTL + SLACK
        assert (update.silent, update.data, update.value, update.path) == (True, None, None, key())
        assert update.origin == "silence"
        for _ in range(2):
            told = []
            for _update in range(5):
                pspace[key()] = 5  # also equal values
                told += front.take(loop.watch, 1)
                idle(front, 0.02)
            kvs[key()] = 6
            assert [(each.value, each.origin, each.silent, each.late) for each in told] == [
                (5, "published", False, 0)
            ] * 5
            assert loop.next().silent
            assert TTL <= time.monotonic() - told[-1].arrived < TTL + SLACK
            idle(front, 1.5 * TTL)  # once
        assert loop.watch.dropped == 0


def test_what_is_late_is_not_live(front, mirror, key, raw):
    """By its lateness and what has passed since it arrived; without `ttl` it is delivered, and says so."""
    loops = [Loop(front, front.at((key(),)).watch(reem.Last(9), **more)) for more in ({"ttl": TTL}, {"stored": False})]
    for number, late in enumerate((0.1, 3.0), 1):
        publish_late(raw, key(), late, late, number)
    live, every = loops
    assert [(each.value, each.late) for each in front.take(every.watch, 2)] == [(0.1, 0.1), (3.0, 3.0)]
    assert mirror.value(STOP) is STOP
    idle(front, 0.15)
    assert live.next().silent  # the first waited for 0.15 s besides
    assert live.watch.dropped == 1
    for loop in loops:
        loop.close()


def test_what_waits_for_longer_is_not_delivered(front, key, pspace):
    loop = Loop(front, front.at((key(),)).watch(reem.Last(100), ttl=TTL))
    for number in range(5):
        pspace[key()] = number
    idle(front, TTL + 0.05)
    pspace[key()] = 5
    assert loop.next().silent  # first, since it was silent in between
    assert loop.next().value == 5
    assert loop.watch.dropped == 5
    loop.close()


def test_a_loss_is_reported_by_the_next_update_that_is_delivered():
    """Whatever reported it first was found, or has waited for too long."""

    async def run(kind):
        queue = kind(reem.Last(10), 0.05, (key,))
        queue.start_clock()

        def put(value, **more):
            queue.put(reem.Update(key, value, value, arrived=time.monotonic(), **more))

        queue.put(reem.Update(key, 0, 0, origin=reem.Origin.FOUND, gap=True, missed=2))
        put(1, gap=True, missed=3)
        put(2)
        await asyncio.sleep(0.1)
        put(3)
        silent, update = queue.take(), queue.take()
        assert (silent.silent, silent.missed, update.value, queue.dropped) == (True, 5, 3, 2)
        queue.put(reem.Update(key, 0, 0, origin=reem.Origin.FOUND, gap=True, missed=None))
        put(4)
        update = queue.take()
        assert (update.gap, update.missed, update.value) == (True, None, 4)

    key = "a"
    for kind in LiveQueue, LivePlaceQueue:
        asyncio.run(run(kind))


def test_next_waits_for_so_long(front, key, kvs, pspace):
    """A call that times out loses nothing, and threads that time out leave nothing behind."""
    watch = front.at((key(),)).watch(reem.Last(9))
    with pytest.raises(TimeoutError, match=r"within 0 s"):
        front.wait(watch.next(timeout=0))  # it follows from here on
    kvs[key()] = 1
    assert front.wait(watch.next(timeout=10)).value == 1
    before = time.monotonic()
    with pytest.raises(TimeoutError, match=r"within 0\.1 s"):
        limited(front, watch.next)
    for _ in range(3):
        with pytest.raises(TimeoutError, match=r"within 0\.05 s"):
            front.wait(watch.next(0.05))
    assert 0.25 <= time.monotonic() - before < 0.25 + 4 * SLACK
    assert not getattr(watch, "_core", watch).queue._sleepers
    pspace[key()] = 2
    assert front.wait(watch.next(math.inf)).value == 2
    for timeout in (-1, math.nan, "1", True):
        with pytest.raises(BadInput, match="timeout="):
            front.wait(watch.next(timeout))
    front.wait(watch.close())
    with pytest.raises(InterfaceClosed, match="this subscription is closed"):
        front.wait(watch.next(1))
    changes = front.interface.states()
    assert front.wait(changes.next(0)).state == "connected"
    with pytest.raises(TimeoutError):
        front.wait(changes.next(0))
    mirror = front.at((key(),)).mirror()
    front.wait(mirror.listen())
    with pytest.raises(TimeoutError, match=r"within 0\.1 s"):
        limited(front, lambda: mirror.wait_until(lambda value: value == 3))
    front.wait(mirror.close())


def test_threads_wait_for_one_loop_with_and_without_a_limit(key, kvs, pspace):
    """Each update goes to one of them, whoever times out meanwhile."""
    with kvs[key()].watch(reem.Last(10_000)) as watch, ThreadPoolExecutor(4) as threads:

        def take(limit):
            taken = []
            while True:
                with contextlib.suppress(TimeoutError):
                    taken.append(watch.next(limit).value)
                    if taken[-1] is None:
                        return taken[:-1]

        results = [threads.submit(take, limit) for limit in (0.0005, 0.002, 0.01, None)]
        for number in range(EXAMPLES):
            pspace[key()] = number
        for _ in results:
            pspace[key()] = None
            time.sleep(0.05)
        assert sorted(number for result in results for number in result.result(30)) == list(range(EXAMPLES))
        assert not watch._core.queue._sleepers


async def test_silence_after_a_late_update_begins_when_that_gets_old():
    queue, begun = LiveQueue(reem.Last(10), 0.4, ("a",)), time.monotonic()
    queue.start_clock()
    while (update := queue.take()) is EMPTY:
        await asyncio.sleep(0.001)
    assert update.silent
    assert time.monotonic() - begun >= 0.4
    arrived = time.monotonic()
    queue.put(reem.Update("a", 1, 1, arrived=arrived, late=0.35))
    queue.put(reem.Update("a", 2, 2, arrived=arrived, late=0.38))  # the other one counts for longer
    assert [queue.take().value, queue.take().value] == [1, 2]
    while (update := queue.take()) is EMPTY:
        await asyncio.sleep(0.001)
    assert update.silent
    assert 0.05 <= time.monotonic() - arrived < 0.3


BAD = [0, -1, 0.0, math.nan, math.inf, -math.inf, 1e300, True, "0.2", b"1", [1], np.nan, 1j]


@pytest.mark.parametrize("ttl", BAD, ids=repr)
def test_a_ttl_that_cannot_be_is_refused(front, key, ttl):
    for follow in front.at((key(),)).mirror, front.at((key(),)).watch:
        with pytest.raises(BadInput, match=r"^ttl=.*use seconds above 0, such as 0\.2"):
            follow(ttl=ttl)


def test_what_contradicts_a_ttl_is_refused(front, key):
    place = front.at((key(),))
    with pytest.raises(BadValue, match=r"ttl=1 refuses old values.*use one of the two"):
        place.mirror(ttl=1, stale="keep")
    with pytest.raises(BadValue, match=r"policy=Every\(5\).*use Newest\(\) or Last\(n\)"):
        place.watch(reem.Every(5), ttl=1)
    for follow in place["a"][-1].mirror, place["a"][-1].watch:
        with pytest.raises(BadValue, match="index from the end"):
            follow(ttl=1)
    for ttl in np.float32(0.5), np.int64(3), 1:
        assert place.mirror(ttl=ttl).ttl == ttl


# --- callbacks -------------------------------------------------------------------------------------------------


class Calls:
    """A callback subscriber of either front, and what it was called with."""

    def __init__(self, front, channel, kwargs=None, seconds=0.0, **options):
        self.front, self.calls, self.silences, self.seconds = front, [], [], seconds
        package = reem_async if hasattr(front, "runner") else reem
        self.subscriber = package.CallbackSubscriber(
            channel,
            front.interface,
            self.callback,
            kwargs,
            on_silent=self.silent if "ttl" in options else None,
            **options,
        )
        front.wait(self.subscriber.listen())

    def callback(self, data, updated_path, update, **kwargs):
        assert (data, updated_path) == (update.data, update.path)
        self.calls.append((update, kwargs))
        time.sleep(self.seconds)

    def silent(self, **kwargs):
        self.silences.append((time.monotonic(), kwargs))

    def close(self):
        self.front.wait(self.subscriber.close())


def test_a_callback_is_called_while_an_update_is_live_and_another_when_there_is_silence(front, key, kvs, pspace, raw):
    kvs[key()] = 1
    it = Calls(front, key(), {"robot": "r"}, ttl=TTL)
    with contextlib.closing(it):
        for round_ in (1, 2):
            for _ in range(3):
                pspace[key()] = round_
                idle(front, 0.02)
            publish_late(raw, key(), 9, 5.0, round_)
            front.until(lambda round_=round_: len(it.silences) == round_)
            update, kwargs = it.calls[-1]
            assert TTL <= it.silences[-1][0] - update.arrived < TTL + SLACK
            assert (it.silences[-1][1], kwargs) == ({"robot": "r"}, {"robot": "r"})
            idle(front, 1.5 * TTL)
            assert len(it.silences) == round_
        assert [update.data for update, _ in it.calls] == [1, 1, 1, 2, 2, 2]


def test_a_busy_callback_delays_the_call_and_is_not_called_with_what_got_old(front, key, pspace):
    it = Calls(front, key(), seconds=1.6 * TTL, ttl=TTL)
    with contextlib.closing(it):
        for number in range(3):
            pspace[key()] = number
        front.until(lambda: it.silences)
        assert [update.data for update, _ in it.calls] == [0]
        assert it.subscriber.value() == 2


def test_a_callback_learns_that_what_it_gets_was_found_or_sent_late(front, server, key):
    """An outage of the publisher, then one of the reader: without `ttl` both are called for."""
    with Proxy(server.port) as theirs, Proxy(server.port) as ours, contextlib.ExitStack() as stack:
        reader = stack.enter_context(contextlib.closing(type(front)(ours.url)))
        interface = stack.enter_context(reem.RedisInterface(theirs.url, timeout=0.1))
        it, live = (
            stack.enter_context(contextlib.closing(Calls(reader, key(), **more))) for more in ({}, {"ttl": 1.0})
        )
        space = reem.PublishSpace(interface, outage="newest")
        space[key()] = 1
        reader.until(lambda: len(it.calls) == len(live.calls) == 1)
        theirs.black_hole()
        space[key()] = 2  # applied or not
        space[key()] = 3
        called = time.monotonic()
        idle(reader, 1.1)
        theirs.heal()
        reader.until(lambda: len(it.calls) == 2)
        assert time.monotonic() - called >= it.calls[1][0].late >= 1.1
        assert (it.calls[1][0].origin, it.calls[1][0].data, it.calls[1][0].gap) == ("published", 3, True)
        ours.reset()
        reader.until(lambda: len(it.calls) == 3)
        assert (it.calls[2][0].origin, it.calls[2][0].late, it.calls[2][0].gap) == ("found", 0, True)
        space[key()] = 4
        reader.until(lambda: len(it.calls) == 4 and len(live.calls) == 2)
        assert [(update.origin, update.data, update.late) for update, _ in live.calls][1:] == [("published", 4, 0)]
        assert live.calls[1][0].gap


def test_a_subscriber_with_a_ttl_can_be_pickled(front, key):
    package = reem_async if hasattr(front, "runner") else reem
    subscriber = package.CallbackSubscriber(key(), front.interface, operator.eq, ttl=0.5, on_silent=gc.collect)
    copied = pickle.loads(pickle.dumps(subscriber))
    core = getattr(copied, "_core", copied)
    assert (core.ttl, core.on_silent, core.callback_function) == (0.5, gc.collect, operator.eq)


CALLBACKS = {
    "by name": lambda data, updated_path, update: (data, updated_path, update),
    "by name, turned round": lambda update, updated_path, data: (data, updated_path, update),
    "its own names": lambda value, where, update: (value, where, update),
    "by name alone": lambda *, update, data, updated_path: (data, updated_path, update),
    "a default": lambda data, updated_path, update=None: (data, updated_path, update),
    "any names": lambda **given: (given["data"], given["updated_path"], given["update"]),
    "any more names": lambda value, where, **more: (value, where, more["update"]),
}
WITHOUT = {
    "two names": lambda data, updated_path: (data, updated_path),
    "the path is called so": lambda data, update: (data, update),
    "the path is called so, and comes first": lambda update, data: (data, update),
    "a wrapper": lambda *args, **kwargs: (*args, *kwargs.values()),
    "positions": lambda *args: args,
}


@pytest.mark.parametrize("name", [*CALLBACKS, *WITHOUT])
def test_a_callback_gets_the_update_if_it_has_a_place_for_it(name):
    update = reem.Update("a.b", 5, 5)
    expected = (5, "a.b", update) if name in CALLBACKS else (5, "a.b")
    assert arranged({**CALLBACKS, **WITHOUT}[name], {})(update) == expected


def test_a_name_of_a_users_own_stays_his():
    call = arranged(lambda data, updated_path, **more: more, {"update": "his", "robot": 1})
    assert call(reem.Update("a", 1, 1)) == {"update": "his", "robot": 1}


def test_what_cannot_be_called_when_silence_begins_is_refused(front, key):
    package, nothing = reem_async if hasattr(front, "runner") else reem, lambda data, path: None
    for options, message in [
        ({"on_silent": print}, "ttl=0.2"),
        ({"on_silent": 5, "ttl": 1}, "on_silent=5 is not a function"),
        ({"on_silent": nothing, "ttl": 1}, r"called as on_silent\(\), with kwargs alone"),
        ({"ttl": True}, "ttl=True"),
        ({"ttl": 1, "policy": reem.Every(5)}, "policy=Every"),
    ]:
        with pytest.raises(BadInput, match=message):
            package.CallbackSubscriber(key(), front.interface, nothing, **options)
