"""Rows 10, 11, 12 and 20: connections that stand and carry nothing, servers that stand still, resets without end."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import itertools
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import numpy as np
from redis.exceptions import RedisError
from slotkit import in_slot, shared_in

import reem
import reem_async
from reem_async.concurrency.queues import Last

from .proxy import Proxy
from .scoreboard import Run, row, tell
from .servers import PrivateServer
from .tools import Log, background, became, frame, measured, order, program, quantile, said

TOP = "top"
LARGE = np.zeros(300_000, np.uint8)
"""So large that it goes another way, and that a part of it is still on its way up when nothing moves any more."""
LOST = ("lost", "reconnecting")
IN_TIME = 1.1
"""Seconds within which a call must have ended: the timeout is one."""


# --- 10: a subscriber that stands still ------------------------------------------------------------


@row(
    10,
    "stalled subscriber, 200 MB published, server's limit 1 MB",
    "publisher's p99 <= 2x, gap and right again <= 2 s, subscriber's memory < +64 MB",
)
def stalled_subscriber(run: Run) -> None:
    """The publisher is not slowed, and the subscriber is told that it has missed something."""
    array = np.arange(15_000, dtype=np.uint8)
    count = run.size(200_000_000, 12_000_000) // array.nbytes
    with (
        PrivateServer("client-output-buffer-limit pubsub 1mb 0 0") as server,
        server.raw() as raw,
        PrivateServer() as apart,
        apart.raw() as plain,
        contextlib.closing(reem.RedisInterface(server.url)) as interface,
        program("stalled", server.url) as process,
    ):
        space = reem.PublishSpace(interface)
        numbers = itertools.count()

        def publish(times: int, taken: list[float], machine: list[float]) -> int:
            for number in itertools.islice(numbers, times):
                with measured(taken):
                    space["flood"] = {"end": number, "array": array}
                with measured(machine):  # at a server that nobody follows
                    plain.set("yardstick", array.data)
            return number

        said(process)
        before: list[float] = []
        during: list[float] = []
        machine_before: list[float] = []
        machine_during: list[float] = []
        publish(run.size(3000, 500), before, machine_before)
        order(process, "stall")
        run.at_least("updates told before", said(process)["told"], 1)
        end = publish(count, during, machine_during)
        cut = not any(int(client["sub"]) for client in raw.client_list())
        order(process, end)
        found = said(process)
    run.at_least("MB published", count * array.nbytes / 1e6, run.size(199, 11))
    run.at_least("subscribers cut off by the server", int(cut), 1)
    # Of two programs on two cores or on one the machine makes two and more times the time, without anybody stalled.
    share = run.size(0.99, 0.9)  # of 500 calls, five that waited for other programs would decide
    slower = quantile(during, share) / quantile(before, share)
    machine = max(1.0, quantile(machine_during, share) / quantile(machine_before, share))
    run.at_most(f"x the publisher's p{100 * share:g}", slower / machine, 2.0)
    run.at_least("x that of a plain client elsewhere", machine, 1.0)
    run.at_least("gaps flagged", found["gaps"], 1)
    run.at_most("s until right again", found["took"] if found["settled"] is not None else float("inf"), 2.0)
    run.at_most("MB more memory of the subscriber", found["grown"], 64)
    run.none("losses not flagged", found["silent"])
    run.none("updates told again or backwards", found["disordered"])


# --- 11 and 12: silence ----------------------------------------------------------------------------


class _Victims:
    """Clients of one address: callers of both fronts, and a subscriber that hears nothing for long."""

    def __init__(self, stack: contextlib.AsyncExitStack, url: str) -> None:
        self._stack = stack
        self._url = url
        self.calls: list[float] = []
        self.unanswered: list[Any] = []
        self.flagged: list[float | None] = []
        self.settled: list[float | None] = []
        self.token = itertools.count(1)
        self.sure: list[str] = []
        self.shared = 0
        self.names = f"v{id(self)}"

    async def begin(self) -> None:
        interface = await self._stack.enter_async_context(reem_async.RedisInterface(self._url))
        self.following = await self._stack.enter_async_context(reem_async.RedisInterface(self._url))
        blocking = reem.RedisInterface(self._url)
        self._stack.callback(blocking.close)
        self.space, self.blocking = reem_async.PublishSpace(interface), reem.PublishSpace(blocking)
        self.mirror = reem_async.SilentSubscriber(TOP, self.following)
        self.log = Log(self.mirror.watch(Last(1_000_000)))
        await self.mirror.listen()
        await self.log.updates.listen()
        self.large = reem_async.CallbackSubscriber("large", self.following, self._see)
        await self.large.listen()
        await self.work()

    def _see(self, data: Any, updated_path: str) -> None:
        self.shared += in_slot(data)

    async def work(self) -> None:
        """One call of each front that must work."""
        await self._large("")
        await self._large_blocking("")
        for call in (self._append, self._append_blocking):
            token = f"{self.names}.{next(self.token)}"
            await call(token)
            self.sure.append(token)

    async def _append(self, token: str) -> None:
        await self.space[TOP]["list"].append(token)

    async def _append_blocking(self, token: str) -> None:
        await asyncio.to_thread(self.blocking[TOP]["list"].append, token)

    async def _large(self, _: str) -> None:
        await self.space["large"].write(LARGE)

    async def _large_blocking(self, _: str) -> None:
        await asyncio.to_thread(self.blocking["large"].write, LARGE)

    async def suffer(self, seconds: float) -> None:
        """Call both fronts, again and again until the time is up, and note how long each took to fail."""
        begun = time.monotonic()

        async def call(append: Callable[[str], Any]) -> None:
            while time.monotonic() - begun < seconds - IN_TIME:
                try:
                    with measured(self.calls):
                        await append(f"{self.names}.{next(self.token)}")
                except RedisError:
                    await asyncio.sleep(0.05)
                else:
                    self.unanswered.append("a call was answered by nobody")

        async def flag() -> None:
            self.flagged.append(await became(lambda: self.following.state in LOST, max(seconds, 4.0)))

        calls = self._append, self._append_blocking, self._large, self._large_blocking
        await asyncio.gather(*map(call, calls), flag())

    async def recover(self, kvs: reem_async.KeyValueStore, gaps: int) -> None:
        """Note how long the copy takes to be equal to the server's, with the loss flagged."""
        begun = time.monotonic()
        while time.monotonic() - begun < 10:
            if self.mirror.value() == await kvs[TOP].read() and self.log.gaps > gaps:
                break
            await asyncio.sleep(0.01)
        else:
            self.settled.append(None)
            return
        self.settled.append(time.monotonic() - begun)


def _judge(run: Run, victims: list[_Victims], times: int) -> None:
    def worst(values: list[float | None]) -> float:
        return float("inf") if not values or None in values else max(value for value in values if value is not None)

    run.at_least("frames seen in shared memory", sum(it.shared for it in victims), 2 * len(victims))
    run.at_least("calls given up", sum(len(it.calls) for it in victims), 4 * times)
    run.at_most("s the longest", worst([call for it in victims for call in it.calls]), IN_TIME)
    run.none("calls that did not fail", [one for it in victims for one in it.unanswered])
    run.at_most("s until the subscription's loss was flagged", worst([t for it in victims for t in it.flagged]), 3.5)
    run.at_most("s until right again", worst([t for it in victims for t in it.settled]), 2.0)
    run.none("losses not flagged", [one for it in victims for one in it.log.silent])
    run.none("updates told again or backwards", [o for it in victims for o in it.log.repeated + it.log.backward])


def _judge_tokens(run: Run, victims: list[_Victims], items: list[str]) -> None:
    run.none("applied twice", len(items) - len(set(items)))
    run.none("acknowledged and not there", sorted({token for it in victims for token in it.sure} - set(items)))


@row(11, "black hole: no byte, no FIN", "a call's error <= 1.1 s, subscription's loss flagged <= 3.5 s")
def black_hole(run: Run) -> None:
    """20 of them; nobody says anything on the subscription, so only REEM itself can notice."""
    rounds, beside = run.size((4, 5), (1, 2))
    with PrivateServer() as server, contextlib.ExitStack() as stack:
        proxies = [stack.enter_context(Proxy(server.port)) for _ in range(beside)]
        direct = reem.PublishSpace(stack.enter_context(reem.RedisInterface(server.url)))

        @contextlib.asynccontextmanager
        async def silent() -> AsyncIterator[None]:
            for proxy in proxies:
                proxy.black_hole()
            async with background(publish()):
                yield
            for proxy in proxies:
                proxy.heal()

        async def publish() -> None:
            await asyncio.sleep(0.5)
            direct[TOP]["unheard"] = asyncio.get_running_loop().time()

        asyncio.run(_silence(run, server, [proxy.url for proxy in proxies], rounds, 3.5, silent))


@row(12, "SIGSTOP of the server for 5 s", "as row 11; nothing applied twice after SIGCONT")
def stopped_server(run: Run) -> None:
    """Its kernel still accepts everything; what was sent meanwhile is applied when it goes on."""
    with PrivateServer() as server:

        @contextlib.asynccontextmanager
        async def silent() -> AsyncIterator[None]:
            server.pause()
            try:
                yield
            finally:
                server.resume()

        asyncio.run(_silence(run, server, [server.url], run.size(5, 1), run.size(5.0, 4.0), silent))


async def _silence(
    run: Run, server: PrivateServer, urls: list[str], rounds: int, seconds: float, silent: Callable[[], Any]
) -> None:
    """Have clients of each address call and listen while it is silent, round by round; none waits for another."""
    asyncio.get_running_loop().set_default_executor(concurrent.futures.ThreadPoolExecutor(4 * len(urls)))
    async with contextlib.AsyncExitStack() as stack:
        kvs = reem_async.KeyValueStore(await stack.enter_async_context(reem_async.RedisInterface(server.url)))
        await kvs[TOP].write({"list": [], "unheard": -1})
        victims = [_Victims(stack, url) for url in urls]
        for it in victims:
            await it.begin()
        async with background(*(it.log.follow() for it in victims)):
            for number in range(rounds):
                gaps = [it.log.gaps for it in victims]
                async with silent():
                    await asyncio.gather(*(it.suffer(seconds) for it in victims))
                await asyncio.gather(*(it.recover(kvs, n) for it, n in zip(victims, gaps, strict=True)))
                for it in victims:
                    await it.work()
                tell(f"{(number + 1) * len(urls)} times silent")
        items = (await kvs[TOP].read())["list"]
    _judge(run, victims, rounds * len(urls))
    _judge_tokens(run, victims, items)


# --- 20: resets without end ------------------------------------------------------------------------


def _is_whole(value: Any, n: int) -> bool:
    return value is not None and value["n"] == n and bool((value["frame"] == n).all())


@row(20, "500 subscribes while the connection is reset every ~30 ms", "0 RuntimeErrors, 0 channels without updates")
def resets(run: Run) -> None:
    """Whoever could not subscribe gets an error and tries again; whoever could must hear of everything later."""
    asyncio.run(_resets(run))


async def _resets(run: Run) -> None:
    count = run.size(500, 100)
    wrong: list[Any] = []
    attempts = resets = 0
    with PrivateServer() as server, Proxy(server.port) as proxy:
        async with reem_async.RedisInterface(server.url) as direct, reem_async.RedisInterface(proxy.url) as interface:
            space = reem_async.PublishSpace(direct)
            mirrors = [reem_async.SilentSubscriber(f"channel{n}", interface) for n in range(count)]

            async def reset_all() -> None:
                nonlocal resets
                while True:
                    await asyncio.sleep(run.rng.uniform(0.02, 0.04))
                    await asyncio.to_thread(proxy.reset)
                    resets += 1

            async def subscribe(some: list[reem_async.SilentSubscriber]) -> None:
                nonlocal attempts
                for mirror in some:
                    await asyncio.sleep(run.rng.uniform(0, 0.08))
                    while True:
                        attempts += 1
                        try:
                            await mirror.listen()
                            break
                        except RedisError:
                            await asyncio.sleep(0.001)
                        except Exception as error:
                            wrong.append(error)
                            break

            begun = time.monotonic()
            async with background(reset_all()):
                async with asyncio.timeout(120):
                    await asyncio.gather(*(subscribe(mirrors[start::8]) for start in range(8)))
                taken = time.monotonic() - begun
            proxy.heal()

            async def told(offset: int) -> float | None:
                """Publish once on each channel; the seconds until all had theirs."""
                for n in range(count):
                    await space[f"channel{n}"].write({"n": n + offset, "frame": frame(n + offset)})
                return await became(lambda: all(_is_whole(m.value(), n + offset) for n, m in enumerate(mirrors)), 5)

            settled = await told(0)
            missing = [m.channel for n, m in enumerate(mirrors) if not _is_whole(m.value(), n)]
            # The first round met connections still being made: what comes then is fetched from the server, and the
            # publisher holds for a second that nobody near by listens.
            await asyncio.sleep(1.1)
            await told(count)
            missing += [m.channel for n, m in enumerate(mirrors) if not _is_whole(m.value(), n + count)]
    run.at_least("subscribed", count - len(wrong), count)
    run.at_least("resets meanwhile", resets, run.size(50, 3))
    run.at_most("s", taken, 60.0)
    run.none("wrong errors", wrong)
    run.none("channels without updates", missing)
    # Not of all: one interface has segments of 64 keys.
    run.at_least("of them with frames in shared memory", sum(shared_in(m.value()) for m in mirrors), 50)
    run.at_most("s until all had theirs", settled if settled is not None else float("inf"), 2.0)
    tell(f"{attempts} attempts for {count} subscriptions")
