"""`reem`: Python's own syntax, threads, processes, exit, programs with loops, and callbacks."""

import asyncio
import contextlib
import gc
import logging
import pickle
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from conftest import PATIENCE, SLOW_MACHINE, assert_no_orphans, assert_same, eventually, python

import reem
from reem import CallbackSubscriber, Conflict, KeyValueStore, RedisInterface, SilentSubscriber

# --- Python's own syntax ---------------------------------------------------------------------------


def test_a_with_block_that_raises_or_is_overtaken_writes_nothing(kvs, key, server_url):
    kvs[key()] = {"n": 1}
    with pytest.raises(ZeroDivisionError), kvs[key()] as value:
        value["n"] = 1 / 0
    other = RedisInterface(server_url)
    with contextlib.closing(other), pytest.raises(Conflict), kvs[key()] as value:  # noqa: PT012
        value["n"] = 2
        KeyValueStore(other)[key()]["n"] = 3
    assert kvs[key()].read() == {"n": 3}


# --- threads and visibility ------------------------------------------------------------------------


def test_several_threads_share_one_interface(kvs, key, raw):
    kvs[key()] = {"count": 0}

    def work(me):
        for n in range(40):
            value = {"me": me, "n": n, "image": np.full((3, me + 1), n)}
            kvs[key()][f"t{me}"] = value
            assert_same(kvs[key()][f"t{me}"].read(), value)
            kvs[key()]["count"] += 1

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(8)))
    assert kvs[key()]["count"].read() == 320
    assert_no_orphans(raw, key())


def test_closing_while_other_threads_call_ends_their_calls_with_interface_closed(server_url, key):
    for _ in range(5):
        interface = RedisInterface(server_url)
        kvs = KeyValueStore(interface)
        kvs[key()] = {"image": np.zeros((200, 300))}
        ends = []

        def until_closed(call, ends=ends):
            try:
                while True:
                    call()
            except BaseException as error:
                ends.append(error)

        calls = [kvs[key()].read, lambda kvs=kvs: next(iter(kvs[key()].watch()))]
        threads = [threading.Thread(target=until_closed, args=[call], daemon=True) for call in calls * 2]
        for thread in threads:
            thread.start()
        time.sleep(0.1)
        interface.close()
        eventually(lambda ends=ends: len(ends) == 4)
        assert all(isinstance(end, (reem.InterfaceClosed, StopIteration)) for end in ends), ends


def test_a_blocking_call_on_the_loop_thread_is_an_error_not_a_deadlock(kvs, interface, key):
    """Whatever loop REEM runs is asked to follow, which would wait for itself. A read only waits for the server."""
    kvs[key()] = 1
    subscriber = reem.SilentSubscriber(key(), interface)
    subscriber.listen()
    loops = [it for it in gc.get_objects() if isinstance(it, asyncio.AbstractEventLoop) and it.is_running()]
    assert loops, "no running loop was found"
    outcomes = []

    def misuse():
        assert kvs[key()].read() == 1
        try:
            outcomes.append(kvs[key()].watch().listen())
        except BaseException as error:
            outcomes.append(error)

    for loop in loops:
        loop.call_soon_threadsafe(misuse)
    eventually(lambda: len(outcomes) == len(loops))
    assert any(isinstance(outcome, reem.WrongLoop) for outcome in outcomes), outcomes
    assert kvs[key()].read() == 1


def test_log_handlers_and_finalizers_may_write_on_the_loop_thread(server_url, key, raw):
    """A log in the store has REEM's own warnings, and what a `__del__` writes arrives wherever garbage is collected."""
    errors, threads, logger = [], set(), logging.getLogger("reem")
    interface = reem.RedisInterface(server_url)
    log, motor = (reem.KeyValueStore(interface)[key(name)] for name in ("log", "motor"))
    log.write([])

    def guarded(call, value):
        try:
            threads.add(threading.current_thread().name)
            call(value)
        except Exception as error:
            errors.append(error)

    class ToStore(logging.Handler):
        def emit(self, record):
            guarded(log.append, record.getMessage())

    class Motor:
        def __init__(self):
            self.me = self  # only the garbage collector ends it

        def __del__(self):
            guarded(motor.write, "off")

    handler = ToStore()
    logger.addHandler(handler)
    portal = interface._background.started()[0]
    try:
        with reem.SilentSubscriber(key("followed"), interface):
            wire = next(iter(interface._followers.session.subscriptions._wires.values()))
            wire.abort_soon(reem.ConnectionLost("cut; the call was applied once or not at all"))
            eventually(lambda: "the subscription connection was lost, reconnecting: cut" in log.read())
            Motor()
            portal._loop.call_soon_threadsafe(gc.collect)
            eventually(lambda: motor.read() == "off")
    finally:
        logger.removeHandler(handler)
        interface.close()
    assert errors == []
    assert "reem-loop" in threads


def test_a_log_handler_may_publish_the_warning_of_its_own_outage(caplog):
    """It is dropped like everything else then, and not warned of in turn without end."""
    interface = reem.RedisInterface("127.0.0.1:1")
    space = reem.PublishSpace(interface, outage="drop")

    class ToSpace(logging.Handler):
        def emit(self, record):
            space["log"] = record.getMessage()

    handler = ToSpace()
    logging.getLogger("reem").addHandler(handler)
    try:
        space["arm"] = 1
    finally:
        logging.getLogger("reem").removeHandler(handler)
        interface.close()
    assert space.dropped == 2
    assert len([each for each in caplog.records if "until the server is back" in each.message]) == 1


def test_threads_are_named_daemons_and_gone_after_close(server_url, key):
    """In a fresh Python: nothing but the main thread is left, and none would keep it alive."""
    code = (
        "import sys, threading, time, reem\n"
        "url, key = sys.argv[1:]\n"
        "assert threading.active_count() == 1, 'a thread before first use'\n"
        "interface = reem.RedisInterface(url)\n"
        "sub = reem.SilentSubscriber(key, interface); sub.listen()\n"
        "call = reem.CallbackSubscriber(key, interface, lambda data, updated_path: None, {}); call.listen()\n"
        "reem.PublishSpace(interface)[key] = 1\n"
        "others = [t for t in threading.enumerate() if t is not threading.main_thread()]\n"
        "assert others and all(t.daemon for t in others), others\n"
        "assert all('reem' in t.name.lower() for t in others), others\n"
        "interface.close()\n"
        "end = time.monotonic() + 5\n"
        "while threading.active_count() > 1 and time.monotonic() < end: time.sleep(0.01)\n"
        "print(threading.active_count())\n"
    )
    done = python(code, server_url, key())
    assert (done.stdout.strip(), done.stderr) == ("1", "")


LEAVING = {
    "closed": "interface.close()",
    "a callback running": (
        "import time\n"
        "sub = reem.CallbackSubscriber(key, interface, lambda data, updated_path: time.sleep(0.3), {})\n"
        "sub.listen(); reem.PublishSpace(interface)[key] = 2; time.sleep(0.05)"
    ),
    "a thread still working": (
        "import threading\n"
        "def work():\n"
        "    try:\n"
        "        while True: kvs[key].read()\n"
        "    except reem.ReemError: pass\n"
        "threading.Thread(target=work, daemon=True).start()"
    ),
    "threads that never end": (
        "import threading\n"
        "def work(call):\n"
        "    while True: call()\n"
        "space = reem.PublishSpace(interface)\n"
        "mirror = kvs[key].mirror(); mirror.listen()\n"
        "until = lambda: mirror.wait_until(lambda value: False)\n"
        "for call in (kvs[key].read, lambda: space[key].write({'n': 1}), until, mirror.value):\n"
        "    threading.Thread(target=work, args=[call], daemon=True).start()"
    ),
}


@pytest.mark.alone
@pytest.mark.parametrize("leaving", LEAVING)
def test_a_program_ends_quietly_however_it_leaves(server_url, key, leaving):
    """Within two seconds, with an empty stderr under -X dev -W error."""
    code = (
        "import sys, reem\n"
        "url, key = sys.argv[1:]\n"
        "interface = reem.RedisInterface(url)\n"
        "kvs = reem.KeyValueStore(interface)\n"
        "kvs[key] = 1\n"
        "print(kvs[key].read(), flush=True)\n"
    )
    process = python(code + LEAVING[leaving], server_url, key(), start=True)
    try:
        assert process.stdout.readline() == "1\n", process.communicate()[1]
        began = time.monotonic()
        _, errors = process.communicate(timeout=PATIENCE)
        assert (process.returncode, SLOW_MACHINE.sub("", errors)) == (0, "")
        assert time.monotonic() - began < 3
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("blocked", ["for update in kvs[key].watch(): print('got', flush=True)", "sub_loop()"])
def test_ctrl_c_interrupts_a_blocking_call(server_url, key, blocked):
    code = (
        "import sys, reem\n"
        "url, key = sys.argv[1:]\n"
        "interface = reem.RedisInterface(url)\n"
        "kvs = reem.KeyValueStore(interface)\n"
        "kvs[key] = 1\n"
        "def sub_loop():\n"
        "    with reem.SilentSubscriber(key, interface) as subscriber:\n"
        "        for update in subscriber: print('got', flush=True)\n"
        "print('ready', flush=True)\n"
        f"try: {blocked}\n"
        "except KeyboardInterrupt: print('interrupted', kvs[key].read(), flush=True)\n"
        "interface.close()\n"
    ).replace("try: for", "try:\n    for")
    process = python(code, server_url, key(), start=True)
    try:
        assert process.stdout.readline() == "ready\n", process.communicate()[1]
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=PATIENCE)
        assert out.splitlines()[-1] == "interrupted 1", errors
        assert errors == ""
    finally:
        process.kill()
        process.communicate()


# --- subscribing in `reem`: callbacks on threads of their own, and loops that block. `test_following.py` has the rest


def test_callbacks_run_on_a_thread_of_their_own_and_may_use_reem(interface, kvs, pspace, key):
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


def test_a_slow_callback_holds_up_nobody_else(interface, kvs, pspace, key):
    """Neither other subscribers nor calls; and it may close its own subscriber when it gets on."""
    go_on, closed, seen = threading.Event(), threading.Event(), []

    def slow(data, updated_path):
        go_on.wait(PATIENCE)
        seen.append(data)
        subscriber.close()
        closed.set()

    subscriber = CallbackSubscriber(key(), interface, slow, {})
    subscriber.listen()
    with SilentSubscriber(key(), interface) as mirror:
        for number in range(50):
            pspace[key()] = number
        eventually(lambda: mirror.value() == 49)
        assert (kvs[key()].read(), seen) == (49, [])
        go_on.set()
        assert closed.wait(PATIENCE)
        eventually(lambda: seen == list(range(50)))  # what waited is still told
        pspace[key()] = 50
        eventually(lambda: mirror.value() == 50)
        time.sleep(0.1)
        assert seen == list(range(50))


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
