"""What follows belongs to a process and an event loop: after a fork, or in a second loop, it begins anew or says so."""

import os

import pytest
from conftest import PATIENCE, python

FORKED = """
import math, os, signal, sys, threading, time, reem
url, key = sys.argv[1:]
interface = reem.RedisInterface(url)
store, space, heard = reem.KeyValueStore(interface), reem.PublishSpace(interface), []
space[key] = 1
mirror, watch, unbegun = store[key].mirror(), store[key].watch(reem.Last(10)), store[key].watch()
silent = reem.SilentSubscriber(key, interface)
callback = reem.CallbackSubscriber(key, interface, lambda data, updated_path: heard.append(data))
for each in (mirror, watch, silent, callback):
    each.listen()
assert next(watch).data == 1
child = os.fork()
if child == 0:
    signal.alarm(25)
    space[key] = 2
    try:
        print("mirror", mirror.value(), flush=True)
    except reem.errors.Stale as error:
        print("mirror", str(error).partition("; ")[2], mirror.age == math.inf, flush=True)
    try:
        mirror.wait_until(lambda value: value == 2)
    except reem.errors.Stale:
        print("wait", flush=True)
    taken = []
    loops = [threading.Thread(target=taken.extend, args=(each,), daemon=True) for each in (watch, unbegun)]
    for loop in loops:
        loop.start()
    for each in (mirror, silent, callback):
        each.listen()
    mirror.wait_until(lambda value: value == 2, 10)
    while len(taken) < 2:
        time.sleep(0.01)
    print("listened", mirror.value(), mirror.age < 5, silent.value(), flush=True)
    space[key] = 3
    mirror.wait_until(lambda value: value == 3, 10)
    while silent.value() != 3 or heard != [3] or len(taken) < 4:
        time.sleep(0.01)
    print("heard", heard, sorted(update.data for update in taken), flush=True)
    interface.close()
    for loop in loops:
        loop.join(10)
    print("ended", [loop.is_alive() for loop in loops], flush=True)
    sys.stdout.flush()
    os._exit(0)
os.waitpid(child, 0)
print("parent", next(watch).data, next(watch).data, mirror.wait_until(lambda value: value == 3, 10), flush=True)
interface.close()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_what_began_before_a_fork_begins_anew_in_the_child_or_says_so(server_url, key):
    """Nothing there follows by itself, and the parent is not disturbed."""
    process = python(FORKED, server_url, key(), flags=("-X", "dev"), start=True)
    try:
        said, errors = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert said.splitlines() == [
        "mirror call listen() here True",
        "wait",
        "listened 2 True 2",
        "heard [3] [2, 2, 3, 3]",
        "ended [False, False]",
        "parent 2 3 3",
    ], errors


SECOND_LOOP = """
import asyncio, sys, reem_async
from reem_async.errors import Stale
from reem_async.transport import wire
url, key = sys.argv[1:]
interface, heard = reem_async.RedisInterface(url), []
store, space = reem_async.KeyValueStore(interface), reem_async.PublishSpace(interface)
mirror, watch, closed, left = store[key].mirror(), *[store[key].watch() for _ in range(3)]
silent = reem_async.SilentSubscriber(key, interface)
calls = [reem_async.CallbackSubscriber(key, interface, lambda data, path: heard.append(data)) for _ in range(2)]

async def first():
    await space[key].write(1)
    for each in (mirror, watch, closed, silent, *calls):
        await each.listen()
    assert (await anext(watch)).data == 1
    assert (await anext(left)).data == 1
    waiting = [asyncio.ensure_future(anext(left)), asyncio.ensure_future(mirror.wait_until(lambda value: value == 9))]
    await asyncio.sleep(0)
    return waiting

async def second():
    await space[key].write(2)
    try:
        print("mirror", mirror.value())
    except Stale as error:
        print("mirror", str(error).partition("; ")[2])
    try:
        await mirror.wait_until(lambda value: value == 2)
    except Stale:
        print("wait")
    await closed.close()
    print("closed", [update.data async for update in closed])
    print("watch", (await anext(watch)).data, (await anext(left)).data)
    await calls[1].close()
    for each in (mirror, silent, calls[0]):
        await each.listen()
    print("listened", mirror.value(), silent.value())
    await space[key].write(3)
    await mirror.wait_until(lambda value: value == 3)
    while not heard:
        await asyncio.sleep(0.01)
    print("heard", (await anext(watch)).data, (await anext(left)).data, heard)
    wires = [each for each in wire._open if each._loop is asyncio.get_running_loop()]
    await interface.close()
    print("ended", await anext(watch, None), bool(wires), any(each.alive for each in wires))

loop = asyncio.new_event_loop()
waiting = loop.run_until_complete(first())
loop.close()
asyncio.run(asyncio.wait_for(second(), 20))
"""


def test_what_began_in_an_event_loop_that_was_closed_begins_anew_in_the_next_or_says_so(server_url, key):
    """Closed by hand, so that it could not end what it had; the connections of the second one are closed by `close`."""
    done = python(SECOND_LOOP, server_url, key(), flags=("-W", "ignore"))
    assert done.stdout.splitlines() == [
        "mirror call listen() here",
        "wait",
        "closed [1]",
        "watch 2 2",
        "listened 2 2",
        "heard 3 3 [3]",
        "ended None True False",
    ], done.stderr


PATTERNS = """
import asyncio, os, signal, sys, reem_async
from reem_async.pubsub.monitor import Monitor
url, key, where = sys.argv[1:]
interface = reem_async.RedisInterface(url)
space, store = reem_async.PublishSpace(interface), reem_async.KeyValueStore(interface)
watch, monitor = store.watch(key + "*"), Monitor(interface, [key + "*"])

async def begin():
    await space[key].write(1)
    for each in (watch, monitor):
        await each.listen()
    assert (await anext(watch)).data == 1

async def again():
    loops = [asyncio.ensure_future(anext(each)) for each in (watch, monitor)]
    print((await loops[0]).data)
    while not monitor._begun:
        await asyncio.sleep(0.01)
    await space[key].write(2)
    print((await loops[1]).value, (await anext(watch)).data)
    await interface.close()
    print(await anext(watch, None), await anext(monitor, None))

loop = asyncio.new_event_loop()
loop.run_until_complete(begin())
if where == "fork":
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        os._exit(0)
    signal.alarm(25)
    asyncio.events._set_running_loop(None)
else:
    loop.close()
asyncio.run(asyncio.wait_for(again(), 20))
sys.stdout.flush()
os._exit(0)
"""


@pytest.mark.parametrize("where", ["fork", "loop"])
def test_what_follows_patterns_begins_anew_elsewhere(server_url, key, where):
    """In a forked child, and in the event loop after one that was closed."""
    done = python(PATTERNS, server_url, key(), where, flags=("-W", "ignore"))
    assert done.stdout.splitlines() == ["1", "2 2", "None None"], done.stderr
