"""Subscribers that the server cuts off since they do not read: what they missed is told, number by number."""

import asyncio
import threading
import time

from own_servers import own_server

import reem
import reem_async
from reem_async import Last

LIMITS = "client-output-buffer-limit pubsub 300kb 0 0"
ROUNDS, BURST = 3, 900
FILLING = "x" * 12_000  # it travels in the notice


class Listener(threading.Thread):
    """Follows a key in an event loop of its own, which can be held up as a busy program holds it up."""

    def __init__(self, url, key):
        super().__init__(daemon=True)
        self.url, self.key = url, key
        self.updates = []
        self.begun, self.hold, self.held, self.go_on = (threading.Event() for _ in range(4))

    def run(self):
        asyncio.run(self._follow())

    async def _follow(self):
        async with reem_async.RedisInterface(self.url) as interface:
            self.watch = reem_async.KeyValueStore(interface)[self.key].watch(Last(1_000_000))
            task = asyncio.ensure_future(self._collect())
            while not task.done():
                await asyncio.sleep(0.001)
                if self.hold.is_set():
                    self.hold.clear()
                    self.held.set()
                    self.go_on.wait(30)
                    self.go_on.clear()

    async def _collect(self):
        await self.watch.listen()
        self.begun.set()
        async for update in self.watch:
            self.updates.append(update)
            if update.data == "end":
                return


def test_what_an_evicted_subscriber_missed_is_told_number_by_number(key):
    """Each number is heard of, counted as missed, or lies before an update with a gap whose size nobody knows."""
    with own_server(LIMITS) as server, reem.RedisInterface(server.url, timeout=5) as interface:
        space = reem.PublishSpace(interface)
        space[key()] = "before"
        listener = Listener(server.url, key())
        listener.start()
        assert listener.begun.wait(10)
        for count in range(ROUNDS):
            for number in range(20):
                space[key()] = [count, number]
            listener.hold.set()
            assert listener.held.wait(10)
            listener.held.clear()
            for number in range(BURST):
                space[key()] = [count, number, FILLING]
            listener.go_on.set()
            time.sleep(0.3 * count)  # it has connected anew before the next updates, or not
        time.sleep(1.5)
        space[key()] = "end"
        listener.join(20)
        assert not listener.is_alive(), f"the end is not heard of, but {listener.updates[-1]!r:.300}"
        with server.admin() as raw:
            evicted = raw.info("stats")["client_output_buffer_limit_disconnections"]
    assert evicted >= ROUNDS - 1, "where it had not connected anew there was nothing to cut off"
    published = ROUNDS * (20 + BURST) + 2
    told(listener.updates, 1, published, listener.watch.dropped)


def told(updates, last, published, dropped):
    missing, lost_unknown, unaccounted = 0, False, 0
    for update in updates:
        if update.gap:
            assert update.missed is None or update.missed > 0
            lost_unknown |= update.missed is None
            missing += update.missed or 0
        if update.sequence is None:
            continue
        assert update.sequence > last, f"{update.sequence} after {last}"
        between = update.sequence - last - 1
        if between and not lost_unknown:
            unaccounted += between - missing
        last, missing, lost_unknown = update.sequence, 0, False
    assert last == published
    assert unaccounted <= dropped, f"{unaccounted} were neither heard of nor told as missed; {dropped} were skipped"
