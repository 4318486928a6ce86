"""Ctrl-C ends any blocking call and leaves the interface usable; a handler of SIGTERM may close it."""

import collections
import contextlib
import errno
import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from conftest import assert_ends_well, assert_same, eventually, sized

from reem_async import transport
from reem_async.concurrency.locks import Locks, Pipe
from reem_async.concurrency.queues import EMPTY, BoundedQueue, Ended, Last, Newest
from reem_async.plan.keys import keys_of
from reem_async.plan.replies import decoded
from reem_async.pubsub.events import Update
from reem_async.transport.options import Options
from reem_async.transport.protocol import Packer

SEED = int(os.environ.get("REEM_TEST_SEED", time.time_ns() % 10**6))
PATIENCE = 30.0


def elsewhere(work):
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(PATIENCE)
    return not thread.is_alive()


def run(code, *words):
    return subprocess.run(
        [sys.executable, "-W", "ignore:coroutine:RuntimeWarning", "-c", code, *words],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("mode", ["raise", "close"])
def test_signals_at_random_instants_in_every_blocking_call(server_url, key, mode):
    """Every call ends, other threads go on, and nothing crashes; `tests/interruptkit.py` does the same for longer."""
    words = ("--mode", mode, "--seconds", sized("1.5", "5"), "--seed", str(SEED))
    words += ("--url", server_url, "--prefix", f"{key.prefix}:")
    assert_ends_well("tests/interruptkit.py", *words, timeout=60)


def test_ctrl_c_between_the_steps_of_a_call_leaves_nothing_watched(kvs, key, raw, monkeypatch):
    """The transaction of the next call over the same connection would fail."""
    first, second = key("a"), key("b")
    kvs[first], kvs[second] = {"n": 1}, {"image": np.zeros(3)}

    def interrupted(plan, replies):
        if plan.held:
            raise KeyboardInterrupt
        return decoded(plan, replies)

    with monkeypatch.context() as patched:
        patched.setattr(transport, "decoded", interrupted)
        with pytest.raises(KeyboardInterrupt):
            kvs[first]["n"].divide(2)
    raw.delete(keys_of(first).document)
    kvs[second]["image"] = np.ones(3)
    assert_same(kvs[second].read(), {"image": np.ones(3)})


def test_ctrl_c_in_the_first_call_of_a_program_keeps_no_import_lock(server_url, key):
    """Nothing is imported in a call, so another thread's first call goes on."""
    code = (
        "import os, random, signal, sys, threading, reem\n"
        "url, key, seed = sys.argv[1:]\n"
        "random.seed(int(seed))\n"
        "armed = True\n"
        "def ring(*_):\n"
        "    if armed: raise KeyboardInterrupt\n"
        "signal.signal(signal.SIGALRM, ring)\n"
        "def probe():\n"
        "    kvs[key].watch().listen(); reem.PublishSpace(kvs)[key] = 1; kvs[key].increment(1); kvs.keys(key)\n"
        "bad = 0\n"
        "for child in range(12):\n"
        "    if pid := os.fork():\n"
        "        bad += os.waitpid(pid, 0)[1] != 0\n"
        "        continue\n"
        "    kvs = reem.KeyValueStore(reem.RedisInterface(url))\n"
        "    try:\n"
        "        signal.setitimer(signal.ITIMER_REAL, random.uniform(0.0001, 0.12))\n"
        "        probe()\n"
        "        armed = False\n"
        "    except KeyboardInterrupt: pass\n"
        "    thread = threading.Thread(target=probe, daemon=True)\n"
        "    thread.start(); thread.join(10)\n"
        "    os._exit(thread.is_alive())\n"
        "print(bad)\n"
    )
    done = run(code, server_url, key(), str(SEED))
    assert done.stdout == "0\n", (SEED, done.stderr)


def test_redis_py_never_has_hiredis_format_a_number():
    """hiredis crashes the interpreter if a handler of signals raises meanwhile."""
    packer = Options("localhost", 1.0, {})  # refuses what redis-py does not take
    assert type(packer.blocking_connection()._command_packer) is Packer
    assert Packer().pack("HELLO", 3, "AUTH", "me", b"x") == [
        b"*5\r\n$5\r\nHELLO\r\n$1\r\n3\r\n$4\r\nAUTH\r\n$2\r\nme\r\n$1\r\nx\r\n"
    ]
    assert Packer().pack("CLIENT SETINFO", 1.5) == [b"*3\r\n$6\r\nCLIENT\r\n$7\r\nSETINFO\r\n$3\r\n1.5\r\n"]


def update(number, **more):
    return Update("a", number, number, sequence=number, **more)


def test_a_queue_tells_what_was_lost_before_updates_that_it_dropped():
    """Once, with the next update that is taken, however many were dropped in between."""
    box = BoundedQueue(Last(2))
    for number in range(1, 50):
        box.put(update(number, gap=number in (3, 20), missed=number if number in (3, 20) else 0))
    assert len(box._gaps) == 1
    first, second = box.take(), box.take()
    assert (first.sequence, first.gap, first.missed) == (48, True, 23)
    assert (second.sequence, second.gap, second.missed) == (49, False, 0)
    assert (box.take(), box.dropped) == (EMPTY, 47)
    box.put(update(50, gap=True, missed=None))
    box.put(update(51, gap=True, missed=1))
    assert [(each.gap, each.missed) for each in (box.take(), box.take())] == [(True, None), (True, 1)]
    box.close()
    with pytest.raises(Ended):
        box.take()


def none_left(*_):
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


@pytest.mark.parametrize("descriptors", ["left", "used up"])
@pytest.mark.parametrize("policy", [Newest(), Last(3)])
def test_several_threads_take_from_a_queue_while_one_puts(policy, descriptors, monkeypatch):
    """Each update is taken once or counted as dropped, losses add up, the last arrives, and all threads end."""
    if descriptors == "used up":
        monkeypatch.setattr(os, "pipe", none_left)
    box, taken = BoundedQueue(policy), []

    def take():
        try:
            while True:
                taken.append(box.take_waiting())
        except Ended:
            return

    threads = [threading.Thread(target=take, daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    for number in range(1, 20_001):
        box.put(update(number, gap=number % 7 == 0, missed=number % 7 == 0 and 1))
    end = time.monotonic() + PATIENCE
    while box._items and time.monotonic() < end:
        time.sleep(0.001)
    box.close()
    for thread in threads:
        thread.join(PATIENCE)
    assert not any(thread.is_alive() for thread in threads)
    assert len(taken) + box.dropped == 20_000
    assert len({each.sequence for each in taken}) == len(taken)
    assert 20_000 in {each.sequence for each in taken}
    assert sum(each.missed for each in taken) == 20_000 // 7


def test_a_thread_is_woken_once_for_an_update():
    """However often one came as it began to wait, and however soon it waits again."""
    box, taken, woken = BoundedQueue(Last(9)), [], []

    class Sleepers(collections.deque):
        def append(self, sleeper):
            super().append(sleeper)
            if len(taken) < 50:
                box.put(update(0))  # just before the thread sleeps

    def put(self, wakeup, put=Pipe.put):
        woken.append(1)
        assert len(woken) < 100
        put(self, wakeup)
        end = time.monotonic() + 0.02
        while not box._sleepers and time.monotonic() < end:
            time.sleep(0)

    def take():
        with contextlib.suppress(Ended):
            while True:
                taken.append(box.take_waiting())

    box._sleepers = Sleepers()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Pipe, "put", put)
        thread = threading.Thread(target=take, daemon=True)
        thread.start()
        for number in range(50, 100):
            eventually(lambda number=number: len(taken) == number and box._sleepers)
            woken.clear()
            box.put(update(number))
        eventually(lambda: len(taken) == 100)
        assert len(woken) == 1
        box.close()
        thread.join(PATIENCE)
    assert not thread.is_alive()


def test_a_thread_broken_off_among_the_locks_keeps_no_other_from_them():
    """Found by `make hunt`, seed 201: a call that was broken off in there had kept the lock of the locks for ever."""
    locks = Locks(threading.Lock)
    for number in range(2000):
        locks.of(f"key{number}")
    locks._trimming.acquire()  # by a thread that was broken off
    found = []
    others = threading.Thread(target=lambda: found.extend(locks.of(f"other{number}") for number in range(2000)))
    others.start()
    others.join(10)
    assert len(found) == 2000
    assert all(locks.of(f"other{number}") is found[number] for number in range(2000))
