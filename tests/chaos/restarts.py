"""Row 1: the server is killed and started again, over and over."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import Any

from redis.exceptions import RedisError

import reem
import reem_async
from reem_async.concurrency.queues import Last

from .scoreboard import Run, row, tell
from .servers import PrivateServer
from .tools import Log, background, became, frame, measured

CREW = 4
TOP = "load"


class _Writer:
    """Publishes numbers one after the other, and knows which were acknowledged."""

    def __init__(self, space: reem_async.PublishSpace, me: int) -> None:
        self._place = space[TOP][f"w{me}"]
        self.name = f"w{me}"
        self.tried = self.acknowledged = self.failed = 0
        self.calls: list[float] = []
        self.quiet = self.resting = False

    async def work(self) -> None:
        while True:
            self.resting = self.quiet
            if self.quiet:
                await asyncio.sleep(0.002)
                continue
            self.tried += 1
            value = {"n": self.tried, "array": frame(self.tried)}
            with measured(self.calls):
                try:
                    await self._place.write(value)
                except RedisError:
                    self.failed += 1
                    await asyncio.sleep(0.01)
                else:
                    self.acknowledged = self.tried


class _Follower:
    def __init__(self, interface: reem_async.RedisInterface) -> None:
        self.mirror = reem_async.SilentSubscriber(TOP, interface)
        self.log = Log(self.mirror.watch(Last(1_000_000)))


def _number(value: Any, name: str) -> int:
    """The number in an entry, whose array must be of the same write."""
    entry = value[name]
    assert (entry["array"] == entry["n"]).all(), f"torn: {entry}"
    return entry["n"]


def _numbers(value: Any) -> dict[str, int]:
    return {name: _number(value, name) for name in value}


class _Crew:
    """Writers and followers, each with an interface of its own, and two interfaces that lie idle."""

    def __init__(self, stack: contextlib.AsyncExitStack, url: str) -> None:
        self._stack = stack
        self._url = url
        self.writers: list[_Writer] = []
        self.followers: list[_Follower] = []
        self.first_failures: list[Any] = []
        self.settling: list[float] = []
        self.lost: list[Any] = []

    async def _interface(self) -> reem_async.RedisInterface:
        return await self._stack.enter_async_context(reem_async.RedisInterface(self._url))

    async def muster(self) -> None:
        self.idle = reem_async.KeyValueStore(await self._interface())
        blocking = reem.RedisInterface(self._url)
        self._stack.callback(blocking.close)
        self.idle_blocking = reem.KeyValueStore(blocking)
        await self.idle[TOP].write({f"w{me}": {"n": 0, "array": frame(0)} for me in range(CREW)})
        for me in range(CREW):
            self.writers.append(_Writer(reem_async.PublishSpace(await self._interface()), me))
            follower = _Follower(await self._interface())
            await self._stack.enter_async_context(follower.mirror)
            self.followers.append(follower)

    async def restart(self, server: PrivateServer, outage: float) -> None:
        """One kill -9 under load, and the time until all copies are equal to what the new server has."""
        for read in (self.idle[TOP].read, lambda: asyncio.to_thread(self.idle_blocking[TOP].read)):
            await read()  # now they are connected, and lie idle through the restart
        before = [writer.acknowledged for writer in self.writers]
        loaded = await became(
            lambda: all(w.acknowledged >= b + 10 for w, b in zip(self.writers, before, strict=True)), 10
        )
        assert loaded is not None, "the load is not real: a writer got fewer than 10 writes through in 10 s"
        promised = {writer.name: writer.acknowledged for writer in self.writers}
        told = [follower.log.told for follower in self.followers]
        await asyncio.to_thread(server.kill)
        promised = {writer.name: max(promised[writer.name], writer.acknowledged) for writer in self.writers}
        await asyncio.sleep(outage)
        await asyncio.to_thread(server.start)
        healed = time.monotonic()
        await self._first_calls(promised)
        for writer in self.writers:
            writer.quiet = True
        assert await became(lambda: all(w.resting for w in self.writers), 5) is not None, "a writer hangs"
        stored = _numbers(await self.idle[TOP].read())
        for follower, last in zip(self.followers, told, strict=True):
            took = await became(lambda f=follower, n=last: f.log.told > n and _numbers(f.mirror.value()) == stored, 10)
            assert took is not None, f"a subscriber is dead: {_numbers(follower.mirror.value())}, stored: {stored}"
        self.settling.append(time.monotonic() - healed)
        for writer in self.writers:
            writer.quiet = False

    async def _first_calls(self, promised: dict[str, int]) -> None:
        """The first call after a restart of interfaces that had nothing to do: it must work, and find all."""
        for who, read in (
            ("asyncio", self.idle[TOP].read),
            ("blocking", lambda: asyncio.to_thread(self.idle_blocking[TOP].read)),
        ):
            try:
                found = _numbers(await read())
            except RedisError as error:
                self.first_failures.append((who, error))
                found = _numbers(await read())
            self.lost += [(name, number, found[name]) for name, number in promised.items() if found[name] < number]


@row(
    1,
    "kill -9 and restart, 4 writers, 4 subscribers",
    "none hung, none dead, settled <= 2 s, every loss flagged, no acknowledged write lost",
)
def restarts(run: Run) -> None:
    """50 times; appendfsync always, so that what was acknowledged must be there."""
    asyncio.run(_restarts(run))


async def _restarts(run: Run) -> None:
    times = run.size(50, 3)
    with PrivateServer(keep=True) as server:
        async with contextlib.AsyncExitStack() as stack:
            crew = _Crew(stack, server.url)
            await crew.muster()
            logs = [follower.log for follower in crew.followers]
            for log in logs:
                await log.updates.listen()
            jobs = [writer.work() for writer in crew.writers] + [log.follow() for log in logs]
            async with background(*jobs) as tasks:
                for number in range(times):
                    await asyncio.sleep(run.rng.uniform(0, 0.05))
                    await crew.restart(server, run.rng.uniform(0, 0.8))
                    if number % 10 == 9:
                        tell(f"{number + 1} restarts")
                run.none("dead tasks", sum(task.done() for task in tasks))
    run.at_least("restarts", times, times)
    run.at_least("writes acknowledged", sum(writer.acknowledged for writer in crew.writers), 40 * times)
    run.at_least("updates told with frames in shared memory", sum(log.shared for log in logs), 10 * times)
    run.at_least("writes failed", sum(writer.failed for writer in crew.writers), 1)
    run.at_most("s until all copies were right", max(crew.settling), 2.0)
    run.at_most("s the longest call", max(max(writer.calls) for writer in crew.writers), 1.1)
    run.none("acknowledged writes lost", crew.lost)
    run.none("losses not flagged", [it for log in logs for it in log.silent])
    run.none("updates told again or backwards", [it for log in logs for it in log.repeated + log.backward])
    run.none("first calls after a restart failed", crew.first_failures)
