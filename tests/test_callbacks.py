"""The calls of callback subscribers on an event loop: where, in which order, and for how long they are made."""

import asyncio
import contextlib
import gc
import os
import time
import weakref

import pytest
from conftest import FRONTS, PATIENCE, aeventually, eventually, python

import reem
import reem_async
from reem_async import CallbackSubscriber, PublishSpace, RedisInterface, SilentSubscriber
from reem_async.concurrency.queues import Every
from reem_async.concurrency.timeouts import time_limit
from reem_async.errors import WrongLoop


async def test_calls_that_are_awaited_are_made_one_after_the_other_and_close_waits_for_all(ainterface, apspace, key):
    """What comes while one is awaited waits, and is not lost by closing."""
    begun, ended, go_on = [], [], asyncio.Event()

    async def callback(data, updated_path):
        begun.append(data)
        await go_on.wait()
        ended.append(data)

    subscriber = CallbackSubscriber(key(), ainterface, callback)
    await subscriber.listen()
    for number in range(5):
        await apspace[key()].write(number)
    await aeventually(lambda: subscriber.value() == 4)
    assert (begun, ended) == ([0], [])
    closing = asyncio.create_task(subscriber.close())
    await asyncio.sleep(0.05)
    assert not closing.done()
    go_on.set()
    await asyncio.wait_for(closing, PATIENCE)
    assert begun == ended == list(range(5))


async def test_an_awaited_call_may_close_its_own_subscriber(ainterface, apspace, key):
    """It does not wait for itself, and what waited is still told."""
    told = []

    async def callback(data, updated_path):
        told.append(data)
        if data == 0:
            await apspace[key()].write(1)
            await aeventually(lambda: subscriber.value() == 1)
            await subscriber.close()

    subscriber = CallbackSubscriber(key(), ainterface, callback)
    await subscriber.listen()
    await apspace[key()].write(0)
    await aeventually(lambda: told == [0, 1])


@pytest.mark.parametrize("how", ["one by one", "gather", "wait_for", "TaskGroup"])
async def test_calls_may_close_all_subscribers_at_once(ainterface, apspace, key, how):
    """Two callbacks that close each other do not wait for each other; whoever else closes waits for both."""
    subscribers, reached = [], []

    async def stop(data, updated_path, side):
        closing = [subscriber.close() for subscriber in subscribers]
        if how == "gather":
            await asyncio.gather(*closing)
        elif how == "TaskGroup":
            async with asyncio.TaskGroup() as group:
                for each in closing:
                    group.create_task(each)
        else:
            for each in closing:
                await (asyncio.wait_for(each, PATIENCE) if how == "wait_for" else each)
        await asyncio.sleep(0.05)
        reached.append(side)

    for side in "left", "right":
        subscribers.append(CallbackSubscriber(key(), ainterface, stop, {"side": side}))
        await subscribers[-1].listen()
    await apspace[key()].write(True)
    await aeventually(lambda: all(subscriber._link.closed for subscriber in subscribers))
    for subscriber in subscribers:
        await subscriber.close()
    assert sorted(reached) == ["left", "right"]


class Odd(BaseException):
    pass


@pytest.mark.parametrize("kind", [ValueError, SystemExit, KeyboardInterrupt, Odd])
def test_whatever_a_call_raises_on_its_thread_is_reported_once_and_calls_go_on(interface, pspace, key, kind, caplog):
    """KeyboardInterrupt is raised in the main thread too."""
    told = []

    def callback(data, updated_path):
        told.append(data)
        if data < 2:
            raise kind

    with reem.CallbackSubscriber(key(), interface, callback):
        with pytest.raises(KeyboardInterrupt) if kind is KeyboardInterrupt else contextlib.nullcontext():
            pspace[key()] = 0
            eventually(lambda: told == [0])
            time.sleep(0.2)
        with contextlib.suppress(KeyboardInterrupt):
            pspace[key()] = 1
            time.sleep(0.2)
        for number in range(2, 5):
            pspace[key()] = number
        eventually(lambda: told == list(range(5)))
    (record,) = [it for it in caplog.records if it.exc_info]
    assert record.exc_info[0] is kind


@pytest.mark.parametrize("awaited", [False, True])
@pytest.mark.parametrize("kind", [SystemExit, KeyboardInterrupt, Odd])
def test_what_a_call_raises_leaves_the_event_loop_and_the_subscription_goes_on(server_url, key, kind, awaited, caplog):
    """As from any callback of asyncio; SystemExit only once, so that a program can close what it has open."""
    told, left = [], []

    def callback(data, updated_path):
        told.append(data)
        if data < 2:
            raise kind

    async def acallback(data, updated_path):
        callback(data, updated_path)

    loop = asyncio.new_event_loop()
    interface = RedisInterface(server_url)
    space, subscriber = (
        PublishSpace(interface),
        CallbackSubscriber(key(), interface, acallback if awaited else callback),
    )

    async def publish(number):
        await space[key()].write(number)
        await aeventually(lambda: told == list(range(number + 1)))

    loop.run_until_complete(subscriber.listen())
    for number in range(4):
        publishing = loop.create_task(publish(number))
        while not publishing.done():
            try:
                loop.run_until_complete(publishing)
            except kind:
                left.append(number)
                loop.call_soon(loop.stop)  # asyncio may have scheduled a stop for `publishing`, which is done
                loop.run_forever()
    loop.run_until_complete(interface.close())
    loop.close()
    assert left == {SystemExit: [0], KeyboardInterrupt: [0, 1], Odd: []}[kind]
    assert [it.exc_info[0] for it in caplog.records if it.exc_info] == ([] if kind is KeyboardInterrupt else [kind])


async def test_a_function_that_returns_something_to_await_is_awaited(ainterface, apspace, key):
    told = []

    async def slowly(data):
        await asyncio.sleep(0.01)
        told.append(data)

    async with CallbackSubscriber(key(), ainterface, lambda data, _: slowly(data) if data % 2 else told.append(data)):
        for number in range(6):
            await apspace[key()].write(number)
        await aeventually(lambda: told == list(range(6)))


def test_a_subscriber_that_nobody_holds_works_until_its_interface_is_closed(open_front, pspace, key):
    front, told = open_front(), []
    package = reem_async if isinstance(front, FRONTS["asyncio"]) else reem

    class Told:
        def __call__(self, data, updated_path):
            told.append(data)

    callback = Told()
    kept = weakref.ref(callback)
    front.wait(package.CallbackSubscriber(key(), front.interface, callback).listen())
    del callback
    gc.collect()
    pspace[key()] = 1
    front.until(lambda: told == [1])
    front.wait(front.interface.close())
    front.until(lambda: gc.collect() >= 0 and kept() is None)


async def test_a_callback_sees_mirrors_of_the_same_key_as_they_are_after_the_update(ainterface, apspace, key):
    seen = []
    before = SilentSubscriber(key(), ainterface)
    await before.listen()
    caller = CallbackSubscriber(
        key(), ainterface, lambda data, _: seen.append((data, before.value(), after.value(), caller.value()))
    )
    after = SilentSubscriber(key(), ainterface)
    await caller.listen()
    await after.listen()
    for number in range(3):
        await apspace[key()].write(number)
    await aeventually(lambda: seen == [(number,) * 4 for number in range(3)])
    await caller.close()


async def test_a_time_limit_for_listen_is_not_one_for_the_calls(ainterface, apspace, key):
    """Nor is one that somebody else sets while the update arrives."""
    limits = []

    subscriber = CallbackSubscriber(key(), ainterface, lambda *_: limits.append(time_limit(7.0)))
    with reem_async.timeout(0.5):
        await subscriber.listen()
        await apspace[key()].write(1)
        await aeventually(lambda: limits == [7.0])
    await subscriber.close()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_forked_child_does_not_take_what_its_parent_waits_for():
    """Both wait at the same queue; the update is the parent's, whoever began to wait first."""
    done = python(_FORKED)
    assert (done.stdout, done.stderr) == ("1 2 3\n", "")


_FORKED = """
import os, signal, threading, time
from reem_async.concurrency.queues import Last, BoundedQueue
queue = BoundedQueue(Last(10))
threading.Timer(0.1, queue.put, [1]).start()
first = queue.take_waiting()
time.sleep(0.1)
child = os.fork()
if child == 0:
    signal.alarm(20)
    queue.take_waiting()
    os._exit(0)
time.sleep(0.3)
taken = [first]
signal.alarm(20)
for number in (2, 3):
    threading.Timer(0.1, queue.put, [number]).start()
    taken.append(queue.take_waiting())
os.kill(child, signal.SIGKILL)
os.waitpid(child, 0)
print(*taken)
"""


def test_a_call_of_listen_in_a_wrong_loop_changes_nothing(server_url, key):
    """WrongLoop is raised; in its own loop the subscriber goes on as before: one call for each update."""
    told = []
    with asyncio.Runner() as mine, asyncio.Runner() as other:
        interface = RedisInterface(server_url)
        subscriber = CallbackSubscriber(key(), interface, lambda data, _: told.append(data))
        space = PublishSpace(interface)
        mine.run(subscriber.listen())
        with pytest.raises(WrongLoop):
            other.run(subscriber.listen())

        async def go_on():
            await subscriber.listen()
            await space[key()].write(1)
            await aeventually(lambda: subscriber.value() == 1)
            await subscriber.close()
            await space[key()].write(2)
            await interface.close()

        mine.run(go_on())
    assert told == [1]


@pytest.mark.parametrize("kind", ["plain", "awaited"])
async def test_the_cancelled_result_of_something_else_ends_nothing(ainterface, apspace, key, caplog, kind):
    """A CancelledError that a callback lets out is logged like any other; others hear all of it, without a gap."""
    told, gone = [], asyncio.get_running_loop().create_future()
    gone.cancel()

    def callback(data, updated_path):
        told.append(data)
        return gone if kind == "awaited" else gone.result()

    caller = CallbackSubscriber(key(), ainterface, callback)
    async with caller, SilentSubscriber(key(), ainterface) as mirror, mirror.watch(Every(10)) as updates:
        for number in range(3):
            await apspace[key()].write(number)
        heard = [await asyncio.wait_for(anext(updates), PATIENCE) for _ in range(3)]
        await aeventually(lambda: told == [0, 1, 2])
    assert [(update.data, update.gap) for update in heard] == [(0, False), (1, False), (2, False)]
    assert caplog.text.count("the subscription goes on") == 1  # then counted
    assert "connection" not in caplog.text
