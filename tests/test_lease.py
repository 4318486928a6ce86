"""Ownership of a top-level key: one owner, who loses it for good by silence or by a takeover."""

import asyncio
import contextlib
import json
import math
import os
import pickle
import random
import signal
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import redis
from conftest import (
    FRONTS,
    RawCluster,
    aeventually,
    commands_run,
    eventually,
    line_of,
    python,
    server_without_right,
    sized,
)

import reem
import reem_async
from reem_async.errors import (
    BadData,
    BadKey,
    BadType,
    BadValue,
    ConnectionLost,
    LeaseLost,
    Misuse,
    NotAllowed,
    NotConnected,
    Owned,
)
from reem_async.plan.leases import FenceFilter

LONG = 30.0  # seconds that a lease lasts where it is not to expire


@pytest.fixture
def other(open_front):
    return open_front()


def test_one_program_owns_a_key_until_another_takes_it_over(front, other, key):
    cmd, rival = (each.kvs[key()].own(ttl=LONG, name=name) for each, name in ((front, "joystick"), (other, "planner")))
    taker = other.kvs[key()].own(ttl=LONG, name="autopilot", take=True)
    with pytest.raises(LeaseLost, match="not acquired yet"):
        front.wait(cmd.write(1))
    front.wait(cmd.acquire())
    front.wait(cmd.write({"v": 1.0, "image": np.arange(6)}))
    front.wait(cmd["v"].write(2.0))
    front.wait(cmd["image"].write(np.zeros(100_000)))
    front.wait(cmd["v"].increment(0.5))
    with pytest.raises(Owned, match=r"owned by 'joystick' \(process \d+ on .*own\(take=True\)") as caught:
        other.wait(rival.acquire())
    assert (caught.value.name, cmd.lost, cmd.fence) == ("joystick", False, 1)
    assert 0 <= caught.value.since < 60
    other.wait(taker.acquire())
    for write in (lambda: cmd.write({"v": 3}), lambda: cmd["v"].write(3), lambda: cmd["v"].increment(1), cmd.renew):
        with pytest.raises(LeaseLost, match=r"'autopilot'.*has taken it over; to go on, acquire it again"):
            front.wait(write())
    assert (cmd.lost, taker.lost, taker.fence) == (True, False, 2)
    front.wait(cmd.release())  # which is not its own any more
    other.wait(taker["v"].increment(1))
    assert other.read([key(), "v"]) == 3.5
    other.wait(taker.release())
    front.wait(cmd.acquire())
    front.wait(cmd.write({"v": 4}))
    assert (front.read([key(), "v"]), cmd.fence) == (4, 3)


def test_the_block_releases_the_key_and_subscribers_are_notified(kvs, raw, key):
    with kvs[key()].own(ttl=LONG) as cmd, kvs[key()].watch(stored=False) as watch:
        cmd.write({"v": 2})
        assert next(watch).data == {"v": 2}
        cmd["v"] = 3
        assert (next(watch).data, cmd.read()) == ({"v": 3}, {"v": 3})
        with pytest.raises(Misuse, match="call own"):
            pickle.dumps(cmd)
    lease, fence = f"{{{key()}}}:lease", f"{{{key()}}}:fence"
    assert (raw.get(lease), raw.get(fence)) == (None, "1")
    assert kvs.keys(f"{key.prefix}*") == [key()]
    del kvs[key()]
    assert raw.get(fence) == "1", "later owners of the key must not have the numbers of former ones"


@pytest.mark.parametrize("how", ["expired", "removed", "another program"])
def test_a_quiet_owner_cannot_resume(front, raw, key, how):
    """Also where nobody has taken it over."""
    cmd = front.kvs[key()].own(ttl=1)
    front.wait(cmd.acquire())
    if how == "expired":
        for _ in range(3):
            time.sleep(0.4)
            front.wait(cmd.renew())
        front.wait(cmd.write(1))
        cmd_lease = (cmd._core if hasattr(cmd, "_core") else cmd)._writer.lease
        cmd_lease._milliseconds = 10_000  # or this process's clock would tell, too
        time.sleep(1.1)
    elif how == "removed":
        raw.unlink(f"{{{key()}}}:lease")
    else:
        raw.set(f"{{{key()}}}:lease", "mine")
    reason = "another program has taken it over" if how == "another program" else "the lease has expired"
    with pytest.raises(LeaseLost, match=reason):
        front.wait(cmd.write(2))
    assert front.read([key()]) == (1 if how == "expired" else None)
    with pytest.raises(LeaseLost):
        front.wait(cmd.write(3))


def test_an_owner_that_is_stopped_and_wakes_later_has_lost_the_key(server_url, kvs, key):
    program = """
        import sys, time, reem
        with reem.KeyValueStore(sys.argv[1])[sys.argv[2]].own(ttl=1, name="joystick") as cmd:
            for number in range(100000):
                try:
                    cmd.write(number)
                except reem.LeaseLost as error:
                    print("lost", number)
                    sys.exit(str(error))
                if number == 10:
                    print("owner", flush=True)
                time.sleep(0.01)
    """
    with python(program, server_url, key(), start=True) as owner:
        try:
            assert line_of(owner.stdout.fileno()) == "owner\n"
            owner.send_signal(signal.SIGSTOP)
            time.sleep(1.2)
            last = kvs[key()].read()
            owner.send_signal(signal.SIGCONT)
            said, error = owner.communicate(timeout=30)
        finally:
            owner.kill()
    assert "lost" in said
    assert "expired" in error
    assert kvs[key()].read() == last


def test_each_write_is_one_transaction_and_one_round_trip(kvs, raw, key):
    count = 20
    with kvs[key()].own(ttl=LONG) as cmd:
        cmd.write({"v": 0})
        before = commands_run(raw)
        for number in range(count):
            cmd.write({"v": number})
        sent = {name: calls - before.get(name, 0) for name, calls in commands_run(raw).items()}
    each = {name: sent.get(name, 0) // count for name in ("multi", "exec", "watch", "get")}
    assert each == dict.fromkeys(("multi", "exec", "watch", "get"), 1)


@pytest.mark.parametrize("right", ["watch", "incr", "set"])
async def test_an_error_names_the_right_that_an_owner_lacks(right):
    async with server_without_right(right) as (store, url):
        await store["cmd"].write(1)
        async with reem_async.RedisInterface(url) as interface:
            with pytest.raises(NotAllowed, match=rf"(?i){right}.*\+incr.*publishing without a lease"):
                await reem_async.KeyValueStore(interface)["cmd"].own().acquire()


BAD = [
    *(({"ttl": ttl}, BadValue) for ttl in (0, -1, math.nan, math.inf, 3601, 1e-9)),
    *(({"ttl": ttl}, BadType) for ttl in ("1", None, True)),
    *(({"name": name}, BadValue) for name in ("", "a\n", "x" * 65)),
    *(({"name": name}, BadType) for name in (7, b"joystick")),
]


@pytest.mark.parametrize(("arguments", "error"), BAD)
def test_what_cannot_be_is_refused_before_anything_is_sent(kvs, key, arguments, error):
    with pytest.raises(error):
        kvs[key()].own(**arguments)


def test_only_a_top_level_key_is_owned_and_odd_keys_are_named(kvs, raw, key):
    with pytest.raises(BadKey, match=r"only a whole top-level key.*\.own\(\)"):
        kvs[key()]["v"].own()
    lease, fence = f"{{{key()}}}:lease", f"{{{key()}}}:fence"
    for text in ("x", "[]", '[1,"a","b",2,3]', json.dumps([1, "a", "b", 2, math.inf, "t"]), b"\xff" * 100):
        raw.set(lease, text)
        with pytest.raises(Owned, match="owned by another program") as caught:
            kvs[key()].own().acquire()
        assert (caught.value.name, caught.value.since) == ("", None)
    with kvs[key()].own(take=True) as cmd:
        cmd.write(1)
    for odd, error in (("x", BadData), (str(2**60), BadData)):
        raw.set(fence, odd)
        with pytest.raises(error, match="fence"):
            kvs[key()].own().acquire()
    raw.unlink(fence)
    raw.rpush(lease, "x")
    with pytest.raises(BadData, match=r"lease.*another program"):
        kvs[key()].own(take=True).acquire()


def owners_connections(raw, key):
    """The connections that last looked at a lease: an owner's do after each write."""
    return [row["id"] for row in raw.client_list() if row["cmd"] == "get" and "O" not in row["flags"]]


@pytest.mark.parametrize("gone", [False, True])
def test_an_owner_reconnects_and_resumes_only_what_is_still_its_own(front, raw, key, gone):
    cmd = front.kvs[key()].own(ttl=LONG)
    front.wait(cmd.acquire())
    front.wait(cmd.write(1))
    for connection in owners_connections(raw, key):
        with contextlib.suppress(redis.ResponseError):
            raw.client_kill_filter(_id=connection)
    if gone:
        raw.unlink(f"{{{key()}}}:lease")
    with pytest.raises(LeaseLost) if gone else contextlib.nullcontext():
        try:
            front.wait(cmd.write(2))
        except ConnectionLost:
            front.wait(cmd.write(2))
    assert front.read([key()]) == (1 if gone else 2)


def test_a_forked_child_does_not_own_what_its_parent_owns(server_url, key):
    program = """
        import os, sys, reem
        kvs = reem.KeyValueStore(sys.argv[1])
        with kvs[sys.argv[2]].own(ttl=30) as cmd:
            cmd.write(1)
            child = os.fork()
            if not child:
                try:
                    cmd.write(2)
                except reem.Misuse as error:
                    print(error, flush=True)
            else:
                os.waitpid(child, 0)
                cmd.write(3)
                print(kvs[sys.argv[2]].read(), cmd.lost)
    """
    done = python(program, server_url, key(), flags=("-X", "dev", "-W", "ignore:.*fork:DeprecationWarning"))
    assert done.returncode == 0, done.stderr
    assert "belongs to the parent process" in done.stdout
    assert done.stdout.endswith("3 False\n")


def test_a_program_may_end_without_releasing_what_it_owns(server_url, key):
    program = """
        import asyncio, sys, reem, reem_async
        async def main():
            kvs = reem_async.KeyValueStore(sys.argv[1])
            for number in range(40):  # more than there are connections that callers share
                cmd = kvs[sys.argv[2] + str(number)].own(ttl=30)
                await cmd.acquire()
                await cmd.write(number)
        asyncio.run(main())
        cmd = reem.KeyValueStore(sys.argv[1])[sys.argv[2]].own(ttl=30)
        cmd.acquire()
        cmd.write(1)
    """
    done = python(program, server_url, key())
    assert (done.returncode, done.stderr) == (0, "")


async def test_a_cancelled_write_never_follows_a_takeover(akvs, binterface, key):
    """The owner does not know what became of it; what it watches since is right."""
    rivals = reem_async.KeyValueStore(binterface)
    for number in range(sized(10, 200)):
        async with akvs[key()].own(ttl=LONG, take=True) as cmd:
            await cmd.write({"n": number, "x": 0})
            writing = asyncio.create_task(cmd["x"].write(np.zeros(random.choice([1, 1 << 19]))))
            await asyncio.sleep(random.choice([0, 0, 1e-3]))
            writing.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await writing
            if number % 2:
                await cmd.write({"n": number, "x": 1})
                assert await akvs[key()].read() == {"n": number, "x": 1}
            async with rivals[key()].own(ttl=LONG, take=True) as rival:
                await rival.write({"n": -1})
                with pytest.raises(LeaseLost):
                    await cmd.write({"n": number})
                await asyncio.sleep(0.002)
                assert await akvs[key()].read() == {"n": -1}


def applied(raw, name):
    """What the server applies to one key, in its order, until `{name}:over` is set: leases and documents."""
    node = raw.get_node_from_key(name).redis_connection if isinstance(raw, RawCluster) else raw
    where = {name: node.connection_pool.connection_kwargs[name] for name in ("host", "port")}
    connection = redis.Redis(**where, decode_responses=True, socket_timeout=60)
    found = []
    with contextlib.closing(connection), connection.monitor() as monitor:
        yield None
        while True:
            command = monitor.next_command()
            words = command["command"]
            if f"{name}:over" in words:
                break
            kind, _, rest = words.partition(" ")
            if kind in ("SET", "JSON.SET") and rest.startswith((f"{{{name}}}:lease ", f"{name} ")):
                found.append(words)
    yield found


def hammer(url, name, seconds, seed, log):
    """Own a key again and again, by all means, and write to it; note what was confirmed."""
    rand = random.Random(seed)
    end = time.monotonic() + seconds
    writes = 0
    with contextlib.closing(reem.RedisInterface(url)) as interface:
        kvs = reem.KeyValueStore(interface)
        while time.monotonic() < end:
            own = kvs[name].own(ttl=rand.choice([0.02, 0.05, 1]), take=rand.random() < 0.7, name=f"p{seed}")
            with contextlib.suppress(Owned, LeaseLost, ConnectionLost, NotConnected), own as cmd:
                for _ in range(rand.randrange(30)):
                    cmd.write({"fence": cmd.fence})
                    log.append(cmd.fence)
                    writes += 1
                    if rand.random() < 0.02:
                        time.sleep(rand.choice([0.001, 0.06]))
    return writes


def cut(raw, name, seconds):
    end = time.monotonic() + seconds
    node = raw.get_node_from_key(name).redis_connection if isinstance(raw, RawCluster) else raw
    while time.monotonic() < end:
        time.sleep(0.1)
        rows = [row for row in node.client_list() if "O" not in row["flags"] and row["cmd"] in ("exec", "get", "watch")]
        for row in random.sample(rows, min(1, len(rows))):
            node.client_kill_filter(_id=row["id"])


def test_no_write_of_a_former_owner_follows_a_takeover(server_url, raw, key):
    """In the order in which the server applied all writes, while two programs take a key from each other."""
    name, seconds = key(), sized(2, int(os.environ.get("REEM_LEASE_SECONDS", "30")))
    watching = applied(raw, name)
    next(watching)
    logs = [[], []]
    with ThreadPoolExecutor(3) as pool:
        owners = [pool.submit(hammer, server_url, name, seconds, seed, logs[seed]) for seed in range(2)]
        cutting = pool.submit(cut, raw, name, seconds)
        writes = [each.result() for each in owners]
        cutting.result()
    raw.set(f"{{{name}}}:over", f"{name}:over")
    found = next(watching)
    raw.unlink(f"{{{name}}}:over")
    numbers, documents, written = [], 0, None
    for words in found:
        if words.startswith((f"SET {{{name}}}:lease", f"JSON.SET {{{name}}}:lease")):
            numbers.append(int(words.partition("[")[2].partition(",")[0]))
            assert written in (None, numbers[-1]), "a document that was written under another lease"
            written = None
        else:
            written = int(words.partition("fence")[2].split(":")[1].partition("}")[0])
            documents += 1
    assert numbers == sorted(numbers)
    assert documents >= sum(writes) > 100, (documents, writes)
    assert len(set(numbers)) > 10
    assert not set(logs[0]) & set(logs[1])


async def test_a_reader_with_a_ttl_ignores_what_is_not_of_the_owner(akvs, apspace, key):
    """As long as there is one."""
    stop = {"v": 0}
    mirroring, watching = akvs[key()].mirror(ttl=2), akvs[key()].watch(reem_async.Last(100), ttl=2)
    async with akvs[key()].own(ttl=LONG) as cmd, mirroring as mirror, watching as watch:
        await cmd.write({"v": 1})
        assert (await anext(watch)).data == {"v": 1}
        await aeventually(lambda: mirror.value(default=stop) == {"v": 1})
        await apspace[key()].write({"v": 2})
        await aeventually(lambda: mirror.value(default=stop) == stop)
        await cmd.write({"v": 3})
        assert (await anext(watch)).data == {"v": 3}
        await aeventually(lambda: mirror.value(default=stop) == {"v": 3})
        assert (await anext(watch)).silent
        await apspace[key()].write({"v": 4})
        assert (await anext(watch)).data == {"v": 4}


def test_a_reader_judges_updates_by_their_fencing_numbers():
    judge = FenceFilter(0.2)
    leases, times = (0, 5, 4, 0, 5, 0, 6, 5, 0, 0, 1), (0, 1, 1.1, 1.1, 1.15, 1.3, 1.3, 1.4, 1.49, 1.6, 1.6)
    admitted = [judge.admits(lease, now) for lease, now in zip(leases, times, strict=True)]
    assert admitted == [True, True, False, False, True, False, True, False, False, True, True]


async def test_a_lease_ends_with_its_interface_and_its_server(server):
    """A server that lost its data knows no owner, and counts from 1 again."""
    async with reem_async.RedisInterface(server) as interface:
        cmd = reem_async.KeyValueStore(interface)["cmd"].own(ttl=LONG)
        await cmd.acquire()
        await cmd.write(1)
        with redis.Redis.from_url(server.url) as client:
            client.flushall()
        with pytest.raises(LeaseLost, match="or the server has lost its data"):
            await cmd.write(3)
        await cmd.acquire()
        follower = redis.Redis.from_url(server.url).pubsub()
        with contextlib.closing(follower):
            follower.subscribe("{cmd}:notices")
            follower.get_message(timeout=10)
            await cmd.write(4)
            header, _, _ = follower.get_message(timeout=10)["data"].partition(b"\n")
        assert json.loads(header)[8] == {"lease": cmd.fence} == {"lease": 1}
    with pytest.raises(reem.InterfaceClosed):
        await cmd.write(5)
    await cmd.release()
    with reem.RedisInterface(server) as again:
        assert reem.KeyValueStore(again)["cmd"].read() == 4
        connections = again.client.client_list
        await aeventually(lambda: len(connections()) <= 3)


@pytest.mark.long
@pytest.mark.parametrize("name", ["blocking", "asyncio"])
def test_an_owner_goes_on_after_a_failover_or_has_lost_the_key(watched, name):
    """Its connection to the primary of before is not used any more, though that still answers."""
    watched.settle()
    with contextlib.closing(FRONTS[name](watched.url)) as front:
        cmd = front.kvs["lease"].own(ttl=60, take=True)
        front.wait(cmd.acquire())
        front.wait(cmd.write(0))
        eventually(watched.fail_over)
        number = 0

        def written():
            nonlocal number
            number += 1
            try:
                front.wait(cmd.write(number))
            except LeaseLost:
                front.wait(cmd.acquire())
            except (ConnectionLost, NotConnected):
                pass
            return watched.now().exists("lease") and front.read(["lease"]) == number

        eventually(written)
        front.wait(cmd.release())
        assert not watched.now().exists("{lease}:lease")
    watched.settle()
