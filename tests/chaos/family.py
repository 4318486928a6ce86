"""The program of row 14, a parent and its children: `python -m tests.chaos.family forks URL COUNT`."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import os
import select
import sys
import time
import warnings
from typing import Any

from slotkit import in_slot

import reem
import reem_async

from .tools import frame, say

SLOTS = 20
CHILD_SECONDS = 5.0


class _Family:
    """A parent with connections, threads and a subscription, whose children use what they inherit."""

    def __init__(self, url: str) -> None:
        self.interface = reem.RedisInterface(url)
        self.kvs, self.space = reem.KeyValueStore(self.interface), reem.PublishSpace(self.interface)
        self.space["family"] = {f"s{n}": n for n in range(SLOTS)} | {"from": "", "frame": frame(0)[:1]}
        self.mirror = reem.SilentSubscriber("family", self.interface)
        self.mirror.listen()
        self.url = url
        self.wrong: list[str] = []
        self.slowest = 0.0
        self.worked = self.refused = self.shared = self.frames = 0

    def child(self, report: int) -> None:
        """What each child does with its parent's interface: read, write, publish, follow."""
        outcome, begun = "worked", time.monotonic()
        try:
            for n in range(SLOTS):
                assert self.kvs["family"][f"s{n}"].read() == n, "a reply of somebody else"
            self.kvs[f"child{os.getpid()}"] = {"n": 1}
            self.space["family"]["from"] = f"child {os.getpid()}"
            own = reem.SilentSubscriber("family", self.interface)
            own.listen()
            assert own["s1"].read() == 1, "the child's own copy is wrong"
            # Its parent's slots are not its own, to read or to write: what it publishes is in memory of its own.
            self.space["family"]["frame"] = frame(-1)
            self.hear_frame(own, -1)
        except reem.Misuse as error:
            outcome = f"refused: {error}"
        except BaseException as error:
            outcome = f"wrong: {error!r}"
        os.write(report, json.dumps([outcome, time.monotonic() - begun]).encode())

    def hear_frame(self, mirror: reem.SilentSubscriber, number: int) -> bool:
        """Wait until a copy has a frame, which must be whole; returns whether that is in shared memory."""
        deadline = time.monotonic() + CHILD_SECONDS
        while (array := mirror["frame"].read())[0] != number:
            assert time.monotonic() < deadline, "a frame was not told"
            time.sleep(0.001)
        assert (array == number).all(), "a frame is torn"
        return in_slot(array)

    def publish_frame(self) -> None:
        """Publish one, and have the parent's copy look at it in shared memory while children are made."""
        self.hear_frame(self.mirror, int(self.kvs["family"]["frame"].read()[0]))  # a child's, most of the time
        self.frames += 1
        self.space["family"]["frame"] = frame(self.frames)
        self.shared += self.hear_frame(self.mirror, self.frames)

    def fork(self, way: str) -> None:
        """Fork one child, hear what became of it, and see that the parent was not disturbed."""
        here, there = os.pipe()
        if way == "os.fork":
            pid = os.fork()
            if pid == 0:
                try:
                    self.child(there)
                finally:
                    os._exit(0)
            self._hear(here, lambda: os.kill(pid, 9))
            os.waitpid(pid, 0)
        else:
            process = multiprocessing.get_context("fork").Process(target=self.child, args=(there,))
            process.start()
            self._hear(here, process.kill)
            process.join()
        os.close(here)
        os.close(there)
        for n in range(100):
            if self.kvs["family"][f"s{n % SLOTS}"].read() != n % SLOTS:
                self.wrong.append(f"the parent read a wrong value after {way}")

    def _hear(self, report: int, kill: Any) -> None:
        if not select.select([report], [], [], CHILD_SECONDS)[0]:
            kill()
            self.wrong.append("a child hung")
            self.slowest = max(self.slowest, CHILD_SECONDS)
            return
        outcome, seconds = json.loads(os.read(report, 1 << 16))
        self.slowest = max(self.slowest, seconds)
        self.worked += outcome == "worked"
        self.refused += outcome.startswith("refused")
        if outcome.startswith("wrong"):
            self.wrong.append(outcome)


async def _fork_from_a_loop(family: _Family) -> None:
    """The same with an asyncio interface: its child gets a loop of its own."""
    async with reem_async.RedisInterface(family.url) as interface:
        kvs = reem_async.KeyValueStore(interface)
        mirror = reem_async.SilentSubscriber("family", interface)
        await mirror.listen()

        async def in_child() -> None:
            for n in range(SLOTS):
                assert await kvs["family"][f"s{n}"].read() == n, "a reply of somebody else"

        here, there = os.pipe()
        pid = os.fork()
        if pid == 0:
            outcome, begun = "worked", time.monotonic()
            try:
                asyncio.run(in_child())
            except reem.Misuse as error:
                outcome = f"refused: {error}"
            except BaseException as error:
                outcome = f"wrong: {error!r}"
            os.write(there, json.dumps([outcome, time.monotonic() - begun]).encode())
            os._exit(0)
        await asyncio.to_thread(family._hear, here, lambda: os.kill(pid, 9))
        await asyncio.to_thread(os.waitpid, pid, 0)
        os.close(here)
        os.close(there)
        values = await asyncio.gather(*(kvs["family"][f"s{n % SLOTS}"].read() for n in range(100)))
        if values != [n % SLOTS for n in range(100)]:
            family.wrong.append("the parent read a wrong value on its loop")


def forks(url: str, count: str) -> None:
    """Fork `count` children in three ways."""
    warnings.filterwarnings("ignore", category=DeprecationWarning, message=".*fork.*")  # it is what this is about
    family = _Family(url)
    for number in range(int(count)):
        family.publish_frame()
        if number % 3 == 2:
            asyncio.run(_fork_from_a_loop(family))
        else:
            family.fork(("os.fork", "multiprocessing")[number % 3])
    family.space["family"]["from"] = "parent"
    deadline = time.monotonic() + 5
    while family.mirror["from"].read() != "parent":
        if time.monotonic() > deadline:
            family.wrong.append("the parent's subscription is dead")
            break
        time.sleep(0.01)
    family.publish_frame()
    counts = {"worked": family.worked, "refused": family.refused, "shared": family.shared}
    say(wrong=family.wrong, slowest=family.slowest, **counts)
    family.interface.close()


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
