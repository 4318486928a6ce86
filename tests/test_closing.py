"""Closing ends all that waits: loops, callbacks and waits of both fronts, whatever the event loop is busy with."""

import asyncio
import contextlib
import sys
import threading

import pytest
from conftest import PATIENCE, aeventually, eventually

import reem
import reem_async
from reem_async.errors import InterfaceClosed, Stale


class Waiting:
    def __init__(self, updates):
        self.taken = []
        self.thread = threading.Thread(target=self._loop, args=(updates,), daemon=True)
        self.thread.start()

    def _loop(self, updates):
        with contextlib.suppress(InterfaceClosed):
            for update in updates:
                self.taken.append(update)

    def ends(self, within=PATIENCE):
        self.thread.join(within)
        return not self.thread.is_alive()


class Busy(reem.ships.BytesShip):
    """Keeps the thread of the event loop busy with the value that says so, until it is let go."""

    def __init__(self):
        self.busy, self.go_on = threading.Event(), threading.Event()

    def interpret_read(self, replies):
        if bytes(replies[0] or b"")[:4] == b"busy":
            self.busy.set()
            self.go_on.wait(PATIENCE)
        return super().interpret_read(replies)


def test_loops_end_though_the_event_loop_is_busy_and_it_is_closed_when_it_has_time(server_url, key):
    """With a ship that decodes for long: that is no reason to leave threads, or connections, as they are."""
    ship = Busy()
    interface = reem.RedisInterface(server_url, ships=[ship], local="off")
    heard = []
    callback = reem.CallbackSubscriber(key("other"), interface, lambda data, updated_path: heard.append(data))
    callback.listen()
    loop = Waiting(reem.KeyValueStore(interface)[key("other")].watch())
    busy = reem.SilentSubscriber(key(), interface)
    busy.listen()
    reem.PublishSpace(interface)[key("other")] = 1
    eventually(lambda: loop.taken and heard)
    followers = interface._followers.session
    reem.PublishSpace(interface)[key()] = {"large": b"busy" + bytes(30_000)}
    try:
        assert ship.busy.wait(PATIENCE)
        closing = threading.Thread(target=interface.close, daemon=True)
        closing.start()
        assert loop.ends()
        callback._thread.join(PATIENCE)
        assert not callback._thread.is_alive()
        assert not followers.closed  # it is still busy
    finally:
        ship.go_on.set()
    closing.join(PATIENCE)
    eventually(lambda: followers.transport.states.last.state == "closed" and not followers.subscriptions._wires)


def test_a_callback_of_the_state_may_close_the_interface(server_url, key, raw):
    """On the thread of the event loop, which cannot wait for itself: loops end nevertheless."""
    interface = reem.RedisInterface(server_url, local="off")
    loop = Waiting(reem.KeyValueStore(interface)[key()].watch())
    reem.KeyValueStore(interface)[key()] = 1
    eventually(lambda: loop.taken)
    inside, wire = [], next(iter(interface._followers.session.subscriptions._wires.values()))

    def on_state(change):
        if change.state == "lost":
            inside.append(threading.current_thread().name)
            interface.close()

    interface.on_state(on_state)
    thread = interface._background._made[next(iter(interface._background._made))][0]._thread
    wire.abort_soon(reem.errors.ConnectionLost("cut"))
    assert loop.ends()
    assert inside == ["reem-loop"]
    thread.join(PATIENCE)
    assert not thread.is_alive()
    interface.close()


class Slow(reem.ships.BytesShip):
    """Whose decoding is so many seconds slow to end when it is cancelled."""

    def __init__(self, seconds):
        self.seconds, self.begun, self.ended = seconds, False, False

    async def interpret_read(self, replies):
        value = super().interpret_read(replies)
        if value[:4] == b"slow":
            self.begun = True
            try:
                await asyncio.sleep(PATIENCE)
            except asyncio.CancelledError:
                await asyncio.sleep(self.seconds)
                self.ended = True
                raise
        return value


async def test_loops_do_not_wait_for_a_task_that_is_slow_to_end(server_url, key):
    ship = Slow(0.5)
    interface = reem_async.RedisInterface(server_url, ships=[ship], local="off")
    store = reem_async.KeyValueStore(interface)
    await store[key("other")].write(1)
    watch = store[key("other")].watch()
    await anext(watch)
    slow = reem_async.SilentSubscriber(key(), interface)
    await slow.listen()
    await reem_async.PublishSpace(interface)[key()].write({"large": b"slow" + bytes(30_000)})
    await aeventually(lambda: ship.begun)
    loop = asyncio.ensure_future(anext(watch, "ended"))
    await asyncio.sleep(0)
    closing = asyncio.ensure_future(interface.close())
    done, _ = await asyncio.wait([loop, closing], timeout=PATIENCE, return_when=asyncio.FIRST_COMPLETED)
    assert done == {loop}
    assert (loop.result(), ship.ended) == ("ended", False)
    await closing


@pytest.fixture
def short_turns():
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("short_turns")
def test_loops_may_begin_in_threads_while_a_subscriber_is_closed(interface, key):
    """What it knows of its loops is read on the event loop and written by any thread."""
    for _ in range(20):
        subscriber = reem.SilentSubscriber(key(), interface)
        kept, stop = [], threading.Event()

        def begin(subscriber=subscriber, kept=kept, stop=stop):
            while not stop.is_set():
                kept.append(subscriber.watch())

        thread = threading.Thread(target=begin, daemon=True)
        thread.start()
        eventually(lambda kept=kept: len(kept) > 200)
        subscriber.close()
        stop.set()
        thread.join(PATIENCE)


async def test_closing_the_interface_ends_a_wait_for_a_mirror(server_url, key):
    """It waited for ever; and `value()` says that the interface is closed, not that it is being made again."""
    interface = reem_async.RedisInterface(server_url)
    mirror = reem_async.KeyValueStore(interface)[key()].mirror()
    await mirror.listen()
    waiting = asyncio.ensure_future(mirror.wait_until(lambda value: value == 1))
    await asyncio.sleep(0)
    await interface.close()
    with pytest.raises(InterfaceClosed, match="the RedisInterface of this mirror was closed"):
        await asyncio.wait_for(waiting, 5)
    with pytest.raises(InterfaceClosed):
        await mirror.wait_until(lambda value: value == 1)
    with pytest.raises(Stale, match="the RedisInterface of this mirror is closed"):
        mirror.value()


def test_closing_the_interface_ends_a_wait_for_a_mirror_in_a_thread(server_url, key):
    interface = reem.RedisInterface(server_url)
    mirror = reem.KeyValueStore(interface)[key()].mirror()
    mirror.listen()
    ended, looked = [], threading.Event()

    def is_one(value):
        looked.set()
        return value == 1

    def wait():
        try:
            mirror.wait_until(is_one)
        except InterfaceClosed as error:
            ended.append(error)

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    assert looked.wait(PATIENCE)
    interface.close()
    thread.join(PATIENCE)
    assert ended
    with pytest.raises(Stale, match="the RedisInterface of this mirror is closed"):
        mirror.value()
