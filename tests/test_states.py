"""What is called back with changes of the connection's state: in order, and without a lock that others need."""

import os
import signal
import threading

import pytest
from conftest import PATIENCE, eventually

import reem
from reem_async.transport.blocking import BlockingTransport
from reem_async.transport.options import Options
from reem_async.transport.state import States


def ends(work):
    ended = threading.Event()
    threading.Thread(target=lambda: (work(), ended.set()), daemon=True).start()
    return ended.wait(5)


def test_a_callback_may_publish_to_the_key_whose_call_has_connected(server_url, key):
    """It is called on the thread of that call, which has the key's lock."""
    name, heard = key(), []
    interface = reem.RedisInterface(server_url)
    pspace = reem.PublishSpace(interface)

    def told(change):
        if change.state == "connected":
            pspace[name]["state"].write(change.state)
        heard.append(change.state)

    with reem.RedisInterface(server_url) as other:
        reem.KeyValueStore(other)[name] = {}
        interface.on_state(told)
        if not ends(lambda: pspace[name]["n"].write(1)):
            pytest.fail("waits for ever")
        assert reem.KeyValueStore(other)[name].read() == {"n": 1, "state": "connected"}
    interface.close()
    assert heard == ["connected", "closed"]


def test_changes_are_told_in_order_while_a_callback_waits_for_another_thread():
    """Who notes the next change does not wait for it."""
    states, told, go_on = States(), [], threading.Event()

    def callback(change):
        told.append(change.state)
        if change.state == "connected":
            go_on.wait(PATIENCE)

    states.call(callback)
    first = threading.Thread(target=lambda: states.opened("here", "a"), daemon=True)
    first.start()
    eventually(lambda: told)
    assert ends(lambda: states.lost(OSError()))
    assert told == ["connected"]
    go_on.set()
    first.join(PATIENCE)
    states.closed()
    assert told == ["connected", "lost", "closed"]


def test_a_change_that_a_callback_makes_is_told_behind_the_one_it_was_called_with():
    """And a callback that is interrupted keeps nobody from being told later."""
    states, told = States(), []

    def callback(change):
        if change.state == "connected":
            states.lost(OSError())
        told.append(change.state)
        if change.state == "lost":
            raise KeyboardInterrupt

    states.call(callback)
    with pytest.raises(KeyboardInterrupt):
        states.opened("here", "a")
    states.closed()
    assert told == ["connected", "lost", "closed"]


def in_child(work):
    pid = os.fork()
    if not pid:
        # On the thread that has forked: a new one may pass for the one that is gone, and have its locks.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(5)
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitpid(pid, 0)[1] == 0


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("what", ["lock", "callback"])
def test_a_forked_child_needs_no_thread_that_it_does_not_have(what):
    """One that had the lock, or was calling back."""
    states, begun, go_on, told = States(), threading.Event(), threading.Event(), []

    def wait():
        begun.set()
        go_on.wait(PATIENCE)

    def hold():
        with states._lock:
            wait()

    if what == "callback":
        states.call(lambda change: wait() if change.state == "connected" else told.append(change))
    thread = threading.Thread(target=hold if what == "lock" else lambda: states.opened("here", "a"), daemon=True)
    thread.start()
    begun.wait(PATIENCE)

    def close():
        states.closed()
        assert what == "lock" or told

    assert in_child(close)
    go_on.set()
    thread.join(PATIENCE)


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_begins_with_locks_and_connections_of_its_own():
    """Before any of its threads calls: two that began at once had two locks for one key."""
    transport = BlockingTransport(Options("127.0.0.1", 1.0, {}))
    before = transport.ordered("key"), transport._idle

    def look():
        assert transport.ordered("key") is not before[0]
        assert transport._idle is not before[1]
        assert transport.ordered("key") is transport.ordered("key")

    assert in_child(look)
    assert transport.ordered("key") is before[0]
