"""The age of a mirror is never smaller than the true one: delays, slow loops, expiry, SWAPDB, missing rights."""

import asyncio
import math
import random
import threading
import time

import pytest
import redis
from chaos.proxy import Proxy
from conftest import sized

import reem
import reem_async
from reem_async.errors import Stale
from reem_async.server import EmbeddedServer

BOUND = 0.01
"""Seconds by which an age may be too small: the clocks of server and process are read at different steps."""
KEY = "stop"
MAX_AGE = 0.3


class Truth:
    """Changes one key at random, and knows which values the server had when: [value, from, until]."""

    def __init__(self, url, seed):
        self.interface = reem.RedisInterface(url)
        self.kvs, self.pspace = reem.KeyValueStore(self.interface), reem.PublishSpace(self.interface)
        self.raw = redis.Redis.from_url(url)
        self.random = random.Random(seed)
        self.spans = []
        self.number = 0
        self.do(self.store)
        pipeline = self.raw.pipeline(transaction=False)
        for number in range(20_000):  # among so many, the server finds an expired key by chance only after minutes
            pipeline.set(f"session {number}", "x", ex=3600)
        pipeline.execute()

    def do(self, action):
        """Change the key; the value before was there until the server has answered, at the latest."""
        before = time.monotonic()
        value = action()
        if self.spans:
            self.spans[-1][2] = min(self.spans[-1][2], time.monotonic())
        self.spans.append([value, before, math.inf])

    def had(self, value, since):
        """Whether the server had a value at any time since then."""
        return any(each == value and until >= since for each, _, until in self.spans)

    def store(self):
        self.number += 1
        self.kvs[KEY] = self.number
        return self.number

    def publish(self):
        self.number += 1
        self.pspace[KEY] = self.number
        return self.number

    def delete(self):
        self.raw.delete(KEY)

    def step(self):
        kind = self.random.choice(["store", "store", "publish", "burst", "delete", "expire", "swap"])
        if kind == "burst":
            for _ in range(self.random.randrange(50)):
                self.do(self.random.choice([self.store, self.publish]))
        elif kind == "expire":
            self.do(self.store)
            self.raw.pexpire(KEY, 50)
            over = time.monotonic() + 0.052
            self.spans[-1][2] = over
            self.spans.append([None, over - 0.05, math.inf])
            time.sleep(0.1)
        elif kind == "swap":
            value = self.spans[-1][0]
            for there in None, value:
                self.do(lambda there=there: self.raw.swapdb(0, 1) and there)
                time.sleep(self.random.uniform(0.01, 0.5))
        else:
            self.do(getattr(self, kind))

    def run(self, over, proxy):
        while not over.is_set():
            proxy.delay = self.random.choice([0.0, 0.0, 0.0, 0.02, 0.2, 0.6])
            for _ in range(self.random.randrange(1, 4)):
                self.step()
                time.sleep(self.random.choice([0.0, 0.05, 0.3]))

    def close(self):
        self.interface.close()
        self.raw.close()


def asked(mirror):
    """Return when the answer is from at the earliest, by the age of before, and the value; None if it is Stale."""
    since = time.monotonic() - mirror.age
    try:
        return since, mirror.value()
    except Stale:
        return None


@pytest.mark.parametrize("seed", range(sized(2, 10)))
async def test_no_age_is_smaller_than_the_true_one(seed):
    """Whatever comes between; and answers come where nothing does."""
    over = threading.Event()
    with EmbeddedServer() as server, Proxy(server.port) as proxy:
        truth = await asyncio.to_thread(Truth, server.url, seed)
        truth.raw.execute_command("ACL SETUSER robot on >secret ~* &* +@all -client|tracking")
        changing = threading.Thread(target=truth.run, args=(over, proxy))
        async with (
            reem_async.RedisInterface(proxy.url) as interface,
            reem_async.RedisInterface(proxy.url, username="robot", password="secret") as unprivileged,
            reem_async.KeyValueStore(interface)[KEY].mirror(max_age=MAX_AGE) as mirror,
            reem_async.KeyValueStore(unprivileged)[KEY].mirror(max_age=MAX_AGE) as blind,
        ):
            answers = [asked(mirror), asked(blind)]
            assert None not in answers
            end, slow = time.monotonic() + 4, random.Random(-seed)
            changing.start()
            while time.monotonic() < end:
                await asyncio.sleep(0.002)
                if slow.random() < 0.01:
                    time.sleep(slow.uniform(0.05, 0.5))  # a loop that is slower than its updates
                answers += filter(None, (asked(mirror), asked(blind)))
            over.set()
            await asyncio.to_thread(changing.join)
            proxy.delay = 0.0
            await asyncio.to_thread(truth.do, truth.store)
            assert await mirror.wait_until(lambda value: value == truth.number, 10)
            await asyncio.sleep(MAX_AGE)
            with pytest.raises(Stale, match=r"does not report what is only stored.*client\|tracking"):
                blind.value()
        truth.close()
    wrong = [(since, value) for since, value in answers if not truth.had(value, since - BOUND)]
    print(f"seed {seed}: {len(answers)} answers, wrong: {wrong[:10]}")
    assert not wrong
    assert len(answers) > 2
