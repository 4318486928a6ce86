"""What watching costs: `python -m benchmarks.watch`, a few minutes; prints tables in Markdown.

Programs are processes of their own, conditions take turns, figures are medians. Only ratios within one table mean
much. On a machine that others use, `sudo chrt --rr 1 .venv/bin/python -m benchmarks.watch` gives all of them, the
server too, one real-time priority, so that wake-ups do not wait behind strangers.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import statistics
import time
from typing import Any

import redis

import reem
import reem_async
from reem_async.server import EmbeddedServer

SMALL = {"speed": 0.5, "side": "left"}
ROUNDS, COUNT, GAP = 5, 200, 0.004
TURNS, WRITES = 7, 1000


# --- from a change to who waits for it ---------------------------------------------------------------


def receive(url: str, kind: str, key: str, pipe: Any) -> None:
    """Collect the ages of what is heard; hand them over when asked for."""
    ages: list[float] = []

    def hear(data: Any, path: str = "") -> None:
        if isinstance(data, dict) and "t" in data:
            ages.append(time.time() - data["t"])

    def serve() -> None:
        pipe.send(None)
        while pipe.recv():
            pipe.send(ages.copy())
            ages.clear()

    async def live() -> None:
        async with reem_async.RedisInterface(url) as interface:
            if kind == "async callback":
                await reem_async.CallbackSubscriber(key, interface, hear).listen()
            else:
                watch = reem_async.KeyValueStore(interface)[key].watch()
                await watch.listen()

                async def follow() -> None:
                    async for update in watch:
                        hear(update.data)

                following = asyncio.ensure_future(follow())
            await asyncio.to_thread(serve)
            if kind != "async callback":
                following.cancel()

    if kind.startswith("async"):
        asyncio.run(live())
        return
    interface = reem.RedisInterface(url)
    if kind == "callback":
        reem.CallbackSubscriber(key, interface, hear).listen()
    else:
        import threading

        watch = reem.KeyValueStore(interface)[key].watch()
        watch.listen()
        threading.Thread(target=lambda: [hear(update.data) for update in watch], daemon=True).start()
    serve()


def latencies(url: str) -> dict[str, float]:
    """Return the median age in microseconds of each kind."""
    kinds = ["callback", "watch", "async callback", "async watch"]
    found: dict[str, list[float]] = {kind: [] for kind in kinds}
    receivers = {}
    for kind in kinds:
        here, there = multiprocessing.Pipe()
        process = multiprocessing.Process(target=receive, args=(url, kind, f"bench {kind}", there), daemon=True)
        process.start()
        here.recv()
        receivers[kind] = here, process
    with reem.RedisInterface(url) as interface:
        spaces = {"callback": reem.PublishSpace(interface), "watch": reem.KeyValueStore(interface)}
        for _ in range(ROUNDS):
            for kind in kinds:
                space = spaces[kind.split()[-1]]
                for _ in range(COUNT):
                    space[f"bench {kind}"] = SMALL | {"t": time.time()}
                    time.sleep(GAP)
                receivers[kind][0].send(True)
                found[kind] += receivers[kind][0].recv()
    for here, process in receivers.values():
        here.send(False)
        process.join(5)
        process.kill()
    return {kind: statistics.median(ages) * 1e6 for kind, ages in found.items()}


# --- reading from memory ------------------------------------------------------------------------------


def reads(url: str) -> dict[str, float]:
    """Return what a read of a number takes, in microseconds: from the server and from a mirror."""
    with reem.RedisInterface(url) as interface:
        kvs = reem.KeyValueStore(interface)
        kvs["arm"] = {"joint": 1.5, "names": ["a", "b"]}
        with kvs["arm"].mirror() as arm:
            handle, local = kvs["arm"]["joint"], arm["joint"]
            found: dict[str, list[float]] = {"server": [], "mirror": []}
            for _ in range(TURNS):
                for name, read in (("server", handle.read), ("mirror", local.read)):
                    for _ in range(WRITES):
                        begun = time.perf_counter()
                        read()
                        found[name].append(time.perf_counter() - begun)
    return {name: statistics.median(times) * 1e6 for name, times in found.items()}


# --- what writers notice ------------------------------------------------------------------------------


def watch_many(url: str, pipe: Any) -> None:
    """Have as many watchers as is asked for, each over a connection of its own."""

    async def live() -> None:
        while (asked := await asyncio.to_thread(pipe.recv)) is not None:
            count, key = asked
            async with contextlib.AsyncExitStack() as stack:
                for number in range(count):
                    interface = await stack.enter_async_context(reem_async.RedisInterface(url))
                    store = reem_async.KeyValueStore(interface)
                    watch = await stack.enter_async_context(store[key.format(number)].watch())
                    following = asyncio.ensure_future(_drain(watch))
                    stack.callback(following.cancel)
                pipe.send(None)
                await asyncio.to_thread(pipe.recv)
            pipe.send(None)

    asyncio.run(live())


async def _drain(watch: Any) -> None:
    async for _ in watch:
        pass


def writers(url: str) -> dict[str, float]:
    """Return what a small blocking set takes, in microseconds, beside watchers."""
    conditions = {
        "nobody": (0, ""), "1 watcher of another key": (1, "other {}"), "100 watchers of other keys": (100, "other {}"),
        "1 watcher of the same key": (1, "written"),
    }  # fmt: skip
    here, there = multiprocessing.Pipe()
    process = multiprocessing.Process(target=watch_many, args=(url, there), daemon=True)
    process.start()
    found: dict[str, list[float]] = {name: [] for name in conditions}
    with reem.RedisInterface(url) as interface:
        kvs = reem.KeyValueStore(interface)
        for _ in range(TURNS):
            for name, asked in conditions.items():
                here.send(asked)
                here.recv()
                for number in range(WRITES):
                    begun = time.perf_counter()
                    kvs["written"] = SMALL | {"n": number}
                    found[name].append(time.perf_counter() - begun)
                    time.sleep(0.0005)
                here.send(None)
                here.recv()
    here.send(None)
    process.join(10)
    process.kill()
    return {name: statistics.median(times) * 1e6 for name, times in found.items()}


# --- what the server pays -----------------------------------------------------------------------------


def server_costs(port: int) -> list[tuple[int, float, float, float]]:
    """Return by number of watchers: CPU of a write in us, of another key and of theirs, and bytes for each watcher."""
    client = redis.Redis(port=port)
    rows = []
    for count in (0, 1, 100, 1000):
        links = [redis.Connection(port=port, protocol=3) for _ in range(count)]
        for link in links:
            link.connect()
            _ask(link, "CLIENT", "TRACKING", "ON")
        before = client.info("memory")["used_memory"]
        for number, link in enumerate(links):
            _ask(link, "JSON.GET", f"other {number}", "$")
        held = client.info("memory")["used_memory"] - before
        elsewhere = _cpu(client, 20_000, "written", [])
        own = _cpu(client, 2000 if count < 100 else 40, "written", links)
        rows.append((count, elsewhere, own, held / count if count else 0.0))
        for link in links:
            link.disconnect()
    client.close()
    return rows


def _ask(link: Any, *command: str) -> Any:
    link.send_command(*command)
    return link.read_response()


def _cpu(client: redis.Redis, count: int, key: str, links: list[Any]) -> float:
    """Return the server's CPU time of one write, with the reads of those who watch the key, in microseconds."""

    def used() -> float:
        it = client.info("cpu")
        return float(it["used_cpu_user"] + it["used_cpu_sys"])

    for link in links:
        _ask(link, "JSON.GET", key, "$")
    before = used()
    if not links:
        for _ in range(count // 100):
            with client.pipeline(transaction=False) as pipe:
                for number in range(100):
                    pipe.execute_command("JSON.SET", key, "$", f'{{"n":{number}}}')
                pipe.execute()
    for number in range(count if links else 0):
        client.execute_command("JSON.SET", key, "$", f'{{"n":{number}}}')
        for link in links:
            link.send_command("JSON.GET", key, "$")
        for link in links:
            link.read_response()
    return (used() - before) / count * 1e6


# --- the whole ----------------------------------------------------------------------------------------


def main() -> None:
    multiprocessing.set_start_method("spawn")
    with EmbeddedServer() as server:
        url = f"redis://127.0.0.1:{server.port}"
        ages = latencies(url)
        print("| from a change to who waits for it | us | ratio |\n| --- | --- | --- |")
        for kind in ("callback", "watch", "async callback", "async watch"):
            base = ages["async callback" if kind.startswith("async") else "callback"]
            what = "published, to a callback" if "callback" in kind else "stored, to a loop over watch()"
            front = "asyncio" if "async" in kind else "blocking"
            print(f"| {what}, {front} | {ages[kind]:.0f} | {ages[kind] / base:.2f} |")
        memory = reads(url)
        print("\n| reading a number | us | ratio |\n| --- | --- | --- |")
        for name, figure in memory.items():
            print(f"| {name} | {figure:.1f} | {figure / memory['server']:.3f} |")
        beside = writers(url)
        print("\n| a small blocking set beside | us | ratio |\n| --- | --- | --- |")
        for name, figure in beside.items():
            print(f"| {name} | {figure:.1f} | {figure / beside['nobody']:.3f} |")
        print("\n| watchers | CPU us of a write of another key | of their key, with their reads | bytes each |")
        print("| --- | --- | --- | --- |")
        for count, elsewhere, own, held in server_costs(server.port):
            print(f"| {count:,} | {elsewhere:.2f} | {own:.0f} | {held:.0f} |")


if __name__ == "__main__":
    main()
