"""What a publisher does in an outage: raise, drop, or keep the newest of each place; on servers that really go away."""

import asyncio
import contextlib
import os
import pickle
import random
import threading
import time

import numpy as np
import orjson
import pytest
from chaos.proxy import Proxy
from chaos.servers import PrivateServer
from conftest import FRONTS, PATIENCE, aeventually, assert_same, eventually, sized, stopped

import reem
import reem_async
from reem_async.concurrency.queues import Every
from reem_async.errors import ConnectionLost, NotConnected
from reem_async.plan.trees import MISSING, CannotApply, removed, replaced
from reem_async.store import outage
from reem_async.store.document import Assignment


@pytest.fixture
def server():
    with PrivateServer(keep=True) as running:
        yield running


@pytest.fixture(params=list(FRONTS))
def publisher(request, server):
    with contextlib.ExitStack() as stack:

        def make(policy, url=server.url, **options):
            front = stack.enter_context(contextlib.closing(FRONTS[request.param](url, "PublishSpace", **options)))
            front.kvs = type(front.kvs)(front.interface, policy)

            return front

        yield make


@pytest.fixture
def reader(server):
    with contextlib.ExitStack() as stack:
        yield lambda: reem.KeyValueStore(stack.enter_context(reem.RedisInterface(server.url)))


def lose(front, server):
    """End the server, and have the publisher notice by an update that may be lost."""
    front.write(["lost"], 0)
    server.kill()
    front.write(["lost"], 1)


def test_a_publisher_raises_unless_it_says_otherwise(publisher, server):
    front = publisher("raise")
    front.write(["a"], 1)
    server.kill()
    with pytest.raises((NotConnected, ConnectionLost)):
        front.write(["a"], 2)
    with pytest.raises(NotConnected):
        front.write(["a"], 2)
    assert (front.kvs.dropped, front.kvs.waiting) == (0, 0)


def test_the_newest_of_each_place_is_sent_when_the_server_is_back(publisher, server, reader, caplog):
    """With the bytes of the time of the call; what was replaced is counted."""
    front, image = publisher("newest"), np.zeros(40_000)
    front.write(["robot"], {"pose": {"x": 0, "y": 0}, "old": 1, "image": image})
    lose(front, server)
    before = front.kvs.dropped
    for number in range(1, 4):
        front.write(["robot", "pose", "x"], number)
    front.write(["robot", "pose"], {"x": 5, "y": 5})  # in place of what is inside
    front.write(["robot", "pose", "y"], 6)
    image[:] = 7
    front.write(["robot", "image"], image)
    image[:] = 8
    front.delete(["robot", "old"])
    assert front.kvs.dropped - before == 3
    assert front.kvs.waiting >= 4
    server.start()
    front.until(lambda: front.kvs.waiting == 0)
    assert_same(reader()["robot"].read(), {"pose": {"x": 5, "y": 6}, "image": np.full(40_000, 7.0)})
    assert front.kvs.dropped - before == 3
    front.write(["robot", "pose", "x"], 9)
    assert reader()["robot"]["pose"]["x"].read() == 9
    front.until(lambda: "the server answers again" in caplog.text)
    assert caplog.text.count("until the server is back") == 1


def test_closing_in_an_outage_does_not_say_that_the_server_answers(publisher, server, caplog):
    front = publisher("drop")
    front.write(["a"], 1)
    lose(front, server)
    outages = getattr(front.kvs, "_core", front.kvs)._outages

    async def closed_meanwhile(out):
        outages.close()
        return False

    outages._answers = closed_meanwhile
    front.until(lambda: outages._asking is False)
    assert "the server answers again" not in caplog.text


def test_updates_are_dropped_and_counted(publisher, server, reader, caplog):
    front = publisher("drop")
    front.write(["a"], 1)
    lose(front, server)
    before = front.kvs.dropped
    assert before == 1
    for number in range(5):
        front.write(["a"], number)
    front.delete(["a"])
    assert (front.kvs.dropped - before, front.kvs.waiting) == (6, 0)
    server.start()
    front.until(lambda: "the server answers again" in caplog.text)
    assert reader()["a"].read() == 1
    front.write(["a"], 7)
    assert reader()["a"].read() == 7


@pytest.mark.parametrize("policy", ["drop", "newest"])
async def test_subscribers_are_told_of_what_was_dropped(server, policy):
    """One whose own connection stands: by the number of what comes next; and each update comes once, in its order."""
    with Proxy(server.port) as proxy:
        async with (
            reem_async.RedisInterface(server.url) as near,
            reem_async.RedisInterface(proxy.url, timeout=0.3) as far,
        ):
            space = reem_async.PublishSpace(far, policy)
            await space["a"].write({"x": 0, "y": 0})
            async with reem_async.KeyValueStore(near)["a"].watch(Every(100)) as watch:
                assert (await anext(watch)).initial
                proxy.black_hole()
                await space["a"]["x"].write(1)  # it was under way: swallowed here, but nobody can know
                began = time.time()
                for number in range(2, 6):
                    await space["a"]["x"].write(number)
                await space["a"]["y"].write(1)
                ended = time.time()
                proxy.heal()
                await aeventually(lambda: not space.waiting and space._outages._asking is False)
                await space["a"]["x"].write(6)
                if policy == "newest":
                    kept = [await asyncio.wait_for(anext(watch), PATIENCE) for _ in range(2)]
                    assert [(each.path, each.value, each.missed) for each in kept] == [("a.x", 5, 4), ("a.y", 1, 0)]
                    assert all(began <= each.time <= ended for each in kept)
                last = await asyncio.wait_for(anext(watch), PATIENCE)
                assert (last.value, last.sequence) == (6, 8)
                assert last.missed == (0 if policy == "newest" else 6)
                assert space.dropped == (4 if policy == "newest" else 6)


def test_what_may_have_been_applied_is_not_sent_again(publisher, server, reader):
    """Its reply was lost: here it was applied, and another program's later write stays."""
    with Proxy(server.port) as proxy:
        front = publisher("newest", proxy.url)
        front.write(["a"], 0)
        proxy.drop_reply(b"SET")
        front.write(["a"], 1)
        assert proxy.settled()
        assert (front.kvs.dropped, front.kvs.waiting) == (1, 0)
        other = reader()
        assert other["a"].read() == 1
        other["a"] = 2
        front.write(["b"], 1)
        front.until(lambda: front.kvs.waiting == 0 and "b" in other)
        assert other["a"].read() == 2


def test_a_server_that_hangs_is_waited_for_once(publisher, server, reader):
    """The first call takes its time limit; those after it, of other keys too, do not ask the server at all."""
    front = publisher("newest", timeout=0.3)
    for name in "abc":
        front.write([name], 0)
    with stopped(server):
        front.write(["a"], 1)
        for name in "bc" * 50:
            front.write([name], 1)
        assert front.kvs.waiting == 2
        assert front.kvs.dropped == 1 + 98
    front.until(lambda: front.kvs.waiting == 0)
    assert {name: reader()[name].read() for name in "bc"} == {"b": 1, "c": 1}


@pytest.mark.parametrize("policy", ["drop", "newest"])
def test_an_outage_ends_for_several_keys_that_are_published_all_the_time(publisher, server, reader, caplog, policy):
    """Faster than the server is asked for each of them: a key that is within reach again stays so."""
    with Proxy(server.port) as proxy:
        front, names, number = publisher(policy, proxy.url), "abc", 0
        for name in names:
            front.write([name], 0)

        def publish():
            nonlocal number
            number += 1
            for name in names:
                front.write([name], number)

        server.kill()
        publish()
        publish()
        proxy.delay = 0.01
        server.start()
        front.until(lambda: publish() or "the server answers again" in caplog.text)
        publish()
        assert [reader()[name].read() for name in names] == [number] * 3
        assert front.kvs.waiting == 0
        assert caplog.text.count("until the server is back") == 1


async def test_what_is_kept_has_the_time_of_its_call(server):
    """And not that at which the server, or the call before it, was given up."""
    async with (
        reem_async.RedisInterface(server.url, timeout=0.5) as interface,
        reem_async.RedisInterface(server.url, timeout=PATIENCE) as other,
        reem_async.SilentSubscriber("arm", other) as subscriber,
    ):
        told, arm = subscriber.watch(Every(100)), reem_async.PublishSpace(interface, outage="newest")["arm"]
        await reem_async.KeyValueStore(other)["arm"].write({})
        await anext(told)
        with stopped(server):
            called = time.time()
            await asyncio.gather(arm["a"].write(1), arm["b"].write(2))  # the second waits for the first, which is lost
            assert time.time() - called > 0.4
        while (update := await asyncio.wait_for(anext(told), PATIENCE)).path != "arm.b":
            assert update.path == "arm.a"
        assert abs(update.time - called) < 0.2


def test_what_depends_on_what_is_there_raises_and_comes_behind_what_is_kept(publisher, server, reader):
    front = publisher("newest")
    front.write(["l"], [1])
    lose(front, server)
    for call in (lambda: front.append(["l"], 2), lambda: front.increment(["n"], 1)):
        with pytest.raises(NotConnected):
            call()
    front.write(["l"], [3])
    server.start()
    front.append(["l"], 4)
    front.until(lambda: front.kvs.waiting == 0)
    assert reader()["l"].read() == [3, 4]


def test_what_is_refused_afterwards_is_logged_and_counted(publisher, server, caplog):
    """As where the server has lost what the place was in. A deletion of what is not there is no loss."""
    front = publisher("newest")
    front.write(["a"], {"b": {}})
    front.write(["lost"], 0)
    lose(front, server)
    before = front.kvs.dropped
    for file in server.directory.rglob("*"):
        if file.is_file():
            file.unlink()
    front.write(["a", "b", "c"], 1)
    front.delete(["a", "b", "d"])
    server.start()
    front.until(lambda: front.kvs.waiting == 0)
    front.until(lambda: "the server answers again" in caplog.text)
    assert front.kvs.dropped - before == 1
    assert "a.b.c: kept in an outage, and refused now" in caplog.text


def test_memory_is_bounded(publisher, server, reader, monkeypatch):
    monkeypatch.setattr(outage, "_MOST", 10_000)
    front = publisher("newest")
    front.write(["a"], {})
    lose(front, server)
    before, waiting = front.kvs.dropped, front.kvs.waiting
    for number in range(20):
        front.write(["a", f"n{number}"], "x" * 1000)
    assert 3 <= front.kvs.waiting <= 7
    assert front.kvs.dropped - before + front.kvs.waiting - waiting == 20
    front.write(["b"], "x" * 20_000)
    assert front.kvs.dropped - before + front.kvs.waiting - waiting == 21
    server.start()
    front.until(lambda: front.kvs.waiting == 0)
    assert "n19" in reader()["a"].read()
    assert "n0" not in reader()["a"].read()


def test_closing_gives_up_what_is_kept(publisher, server, caplog):
    """It is counted and logged, and nobody goes on asking."""
    front = publisher("newest")
    lose(front, server)
    front.write(["a"], 1)
    before, left = front.kvs.dropped, front.kvs.waiting
    front.wait(front.interface.close())
    assert left >= 1
    assert (front.kvs.dropped, front.kvs.waiting) == (before + left, 0)
    assert f"{left} kept updates were not sent" in caplog.text
    assert "reem outage" not in [thread.name for thread in threading.enumerate()]
    with pytest.raises(reem_async.InterfaceClosed):
        front.write(["a"], 1)


def test_an_update_of_several_is_kept_by_its_entries(publisher, server, reader):
    front = publisher("newest")
    front.write(["a"], {"x": 0, "y": 0, "z": 0})
    lose(front, server)
    front.wait(front.kvs["a"].update({"x": 1, "y": 1}))
    front.write(["a", "y"], 2)
    server.start()
    front.until(lambda: front.kvs.waiting == 0)
    assert reader()["a"].read() == {"x": 1, "y": 2, "z": 0}


def _random_call(random, tree):
    """Return a path below `tree`, and what is written there, MISSING if it is deleted: what the server would do."""
    path = ()
    while isinstance(tree, dict | list) and tree and (not path or random.random() < 0.7):
        key = random.choice(list(tree) if isinstance(tree, dict) else [*range(len(tree)), -1])
        path, tree = (*path, key), tree[key]
    choices = [random.randrange(100), [random.randrange(10) for _ in range(3)], {"x": [1, [2, 3]]}, MISSING]
    return path, random.choice(choices) if path else {"l": [0, [1, {"y": 2}]], "d": {"l": [4, 5]}}


@pytest.mark.parametrize("seed", range(20))
def test_what_is_kept_leads_to_what_the_calls_lead_to(seed):
    """Also where items are removed from lists, so that an index names another item. What is kept stays small."""
    rng = random.Random(seed)
    for _ in range(sized(50, 500)):
        start = {"l": [0, [1, {"y": 2}], 3], "d": {"l": [4, 5]}, "n": 1}
        kept, expected, count, replaced_count = outage.UnsentUpdates(None), start, rng.randrange(30), 0
        for _ in range(count):
            path, value = _random_call(rng, expected)
            expected = removed(expected, path) if value is MISSING else replaced(expected, path, value)
            text = None if value is MISSING else orjson.dumps(value)
            replaced_count += kept.put(outage.Kept((Assignment(path, text),), 1, 0.0))
        found = start
        for it in [each.assignments[0] for each in kept.kept.values()]:
            value = it.text and orjson.loads(it.text)
            with contextlib.suppress(CannotApply):  # the server refuses it: only l[-1] and l[2] may be one place
                found = removed(found, it.path) if value is None else replaced(found, it.path, value)
        assert found == expected
        assert len(kept.kept) == kept.size == count - replaced_count
    for number in range(100):
        kept.put(outage.Kept((Assignment(("l", 0), b"%d" % number),), 1, 0.0))
    assert sum(each.assignments[0].path == ("l", 0) for each in kept.kept.values()) == 1


def test_pickled_spaces_and_handles_keep_the_policy(publisher, server):
    front = publisher("drop")
    space, handle = pickle.loads(pickle.dumps((front.kvs, front.kvs["a"]["b"])))
    assert space.outage == "drop"
    server.kill()
    for call in (lambda: space["a"].write(1), lambda: handle.write(1)):
        front.wait(call())
    assert space.dropped == 1
    front.wait(space.interface.close())


def _appends(space):
    space["a"].append(3)
    return True


def _closes(space):
    space.interface.close()
    return space.dropped == 0


@pytest.mark.parametrize("call", [_appends, _closes, lambda space: (space.waiting, space.dropped) == (0, 0)])
def test_whatever_a_child_calls_first_what_is_kept_is_not_its_own(server, reader, call):
    with reem.RedisInterface(server.url) as interface:
        space = reem.PublishSpace(interface, outage="newest")
        space["a"] = [0]
        server.kill()
        space["a"] = [1]
        space["a"] = [2]
        go, tell = os.pipe()
        child = os.fork()
        if child == 0:
            status = 1
            with contextlib.suppress(BaseException):
                os.close(tell)  # so that it does not wait for a parent that has failed
                os.read(go, 1)
                status = 0 if call(space) else 2
            os._exit(status)
        assert space.waiting == 1
        server.start()
        eventually(lambda: space.waiting == 0)
        reader()["a"] = [4]
        os.write(tell, b"x")
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        os.close(go)
        os.close(tell)
        assert reader()["a"].read() == ([4, 3] if call is _appends else [4])
