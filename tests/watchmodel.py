"""Random changes by four processes, and watchers of all kinds, which must have what the server has at each pause.

    python -m tests.watchmodel [--seed N] [--changes N] [--kill] [--cluster]

One process stores, one publishes, one does both in asyncio, and one sends bare commands of Redis. In this process
watchers of both fronts follow places at the root, nested ones, arrays, items counted from the end, and patterns. With
`--kill` their connections, and the writers', are cut at random. What differs is printed, with the seed.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import random
import secrets
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import redis

import reem
import reem_async
from reem_async.errors import InterfaceClosed, MissingKey, ReemError, Stale
from reem_async.plan.paths import parse
from reem_async.plan.trees import same
from reem_async.server import EmbeddedServer
from reem_async.server.cluster import EmbeddedCluster

ROOT = Path(__file__).resolve().parents[1]
KEYS = [f"w{number}" for number in range(4)]
PLACES = [(), (), ("a",), ("a", "b"), ("a", "c"), ("img",), ("l",), ("l", 0), ("l", -1), ("t",)]
WATCHED = ["w0", "w0.a", "w0.a.b", "w1", "w1.img", "w1.l[-1]", "w2.l[0]", "w2", "w3.t", "w3"]
PATIENCE = 20.0
"""Seconds of rest after which a watcher that differs is wrong."""


def value(rng: random.Random, place: tuple) -> object:
    """What may be at a place: of few kinds, so that equal values come up too."""
    if not place:
        return {"a": value(rng, ("a",)), "img": value(rng, ("img",)), "l": [1, 2], "t": "x"}
    if place == ("a",):
        return {"b": rng.randrange(5), "c": [rng.random()]}
    if place == ("img",):
        return np.full(10_000 if rng.random() < 0.05 else rng.randrange(1, 5), rng.randrange(3), np.float64)
    if place == ("l",):
        return [{"x": rng.randrange(3)}, np.arange(rng.randrange(1, 4)), rng.randrange(9)][: rng.randrange(4)]
    return rng.choice([rng.randrange(4), 1.5, "text", None, True, [1], {"x": 1}])


def change(space: object, rng: random.Random) -> None:
    place, kind = rng.choice(PLACES), rng.random()
    handle = space[rng.choice(KEYS)]
    for key in place:
        handle = handle[key]
    if kind < 0.12:
        handle.delete()
    elif kind < 0.22 and place == ("a", "b"):
        handle += 1
    elif kind < 0.4 and place == ("l",):
        handle.append(value(rng, ("l", 0)))
    else:
        handle.write(value(rng, place))


async def achange(space: object, rng: random.Random) -> None:
    place = rng.choice(PLACES)
    handle = space[rng.choice(KEYS)]
    for key in place:
        handle = handle[key]
    await (handle.delete() if rng.random() < 0.12 else handle.write(value(rng, place)))


def command(client: redis.Redis, rng: random.Random) -> None:
    key = rng.choice(KEYS)
    kind = rng.randrange(8)
    if kind < 3:
        client.execute_command("JSON.SET", key, rng.choice(["$.a.b", "$.t", "$.l[0]"]), str(rng.randrange(5)))
    elif kind == 3:
        client.execute_command("JSON.NUMINCRBY", key, "$.a.b", "1")
    elif kind == 4:
        client.execute_command("JSON.ARRAPPEND", key, "$.l", str(rng.randrange(5)))
    elif kind == 5:
        client.execute_command("JSON.DEL", key, rng.choice(["$.a.b", "$.t", "$.l[0]"]))
    elif kind == 6 and isinstance(client, redis.Redis):
        name = "{" + key + "}.img"
        held = client.get(name)
        if held:  # between the two the array may be replaced: then this is of another size, and read as such
            with client.pipeline() as together:
                together.watch(name)
                if together.get(name) == held:
                    together.multi()
                    together.set(name, held[:-8] + np.float64(rng.randrange(3)).tobytes())
                    together.execute()
    elif rng.random() < 0.3:
        client.pexpire(key, rng.choice([1, 20]))
    else:
        client.delete(key)


def write(url: str, kind: str, seed: int) -> None:
    """Make as many changes as each line of the standard input says."""
    rng = random.Random(seed)
    if kind == "bare":
        plain = url.replace("redis+cluster://", "redis://").split(",")[0]
        client = (redis.RedisCluster if "cluster" in url else redis.Redis).from_url(plain)
        one = lambda: command(client, rng)  # noqa: E731
    elif kind == "asyncio":
        runner = asyncio.Runner()

        async def open_() -> list:
            interface = reem_async.RedisInterface(url, timeout=5)
            return [reem_async.KeyValueStore(interface), reem_async.PublishSpace(interface)]

        spaces = runner.run(open_())
        one = lambda: runner.run(achange(rng.choice(spaces), rng))  # noqa: E731
    else:
        space = getattr(reem, "KeyValueStore" if kind == "store" else "PublishSpace")(
            reem.RedisInterface(url, timeout=5)
        )
        one = lambda: change(space, rng)  # noqa: E731
    for line in sys.stdin:
        for _ in range(int(line)):
            with contextlib.suppress(ReemError, redis.exceptions.RedisError):  # no parent there, a cut connection
                one()
        print("done", flush=True)


class Last:
    def __init__(self, name: str) -> None:
        self.name = name
        self.data: dict[str, object] = {}
        self.updates = self.stored = 0

    def take(self, place: str, update: object) -> None:
        self.data[place] = update.data
        self.updates += 1
        self.stored += update.origin == "stored"

    def at(self, place: str) -> object:
        return self.data.get(place)


class Watchers:
    """Watchers of both fronts; those of asyncio are on the running loop, those of the blocking one on threads."""

    def __init__(self, url: str) -> None:
        self.interface, self.blocking = reem_async.RedisInterface(url, timeout=5), reem.RedisInterface(url, timeout=5)
        self.lasts: list[tuple[Last, list[str]]] = []
        self.copies: list[tuple[str, object, str]] = []
        self.threads: list[threading.Thread] = []
        self.tasks: list[asyncio.Task] = []

    async def begin(self) -> None:
        kvs, plain = reem_async.KeyValueStore(self.interface), reem.KeyValueStore(self.blocking)
        for place in WATCHED:
            self._loop(Last(f"asyncio watch of {place}"), kvs.at(place).watch(reem_async.Last(3)), [place])
            self._thread(Last(f"blocking watch of {place}"), plain.at(place).watch(), [place])
        self._loop(Last("asyncio watch of w*"), kvs.watch("w*"), KEYS)
        self._thread(Last("blocking watch of w?"), plain.watch("w?"), KEYS)
        for place in WATCHED:
            mirror, other = kvs.at(place).mirror(), plain.at(place).mirror()
            subscriber = reem_async.SilentSubscriber(place, self.interface, stored=True)
            await mirror.listen()
            await asyncio.to_thread(other.listen)
            await subscriber.listen()
            self.copies += [
                (f"asyncio mirror of {place}", mirror, place),
                (f"blocking mirror of {place}", other, place),
                (f"subscriber of {place}", subscriber, place),
            ]

    def _loop(self, last: Last, watch: object, places: list[str]) -> None:
        async def follow() -> None:
            with contextlib.suppress(InterfaceClosed):
                async for update in watch:
                    last.take(_place(update, places), update)

        self.lasts.append((last, places))
        self.tasks.append(asyncio.ensure_future(follow()))

    def _thread(self, last: Last, watch: object, places: list[str]) -> None:
        def follow() -> None:
            with contextlib.suppress(InterfaceClosed):
                for update in watch:
                    last.take(_place(update, places), update)

        self.lasts.append((last, places))
        self.threads.append(threading.Thread(target=follow, daemon=True))
        self.threads[-1].start()

    async def wrong(self) -> list[str]:
        kvs, found = reem_async.KeyValueStore(self.interface), {}
        for place in {*WATCHED, *KEYS}:
            try:
                found[place] = await kvs.at(place).read()
            except MissingKey:
                found[place] = None
        differing = []
        for last, places in self.lasts:
            differing += [
                f"{last.name}: {last.at(place)!r:.200} in place of {found[place]!r:.200}"
                for place in places
                if not same(last.at(place), found[place])
            ]
        for name, copy, place in self.copies:
            try:
                held = copy.value()
            except Stale as error:
                held = error
            if not same(held, found[place]):
                differing.append(f"{name}: {held!r:.200} in place of {found[place]!r:.200}")
        return differing

    async def close(self) -> None:
        await self.interface.close()
        await asyncio.to_thread(self.blocking.close)
        await asyncio.gather(*self.tasks)
        for thread in self.threads:
            await asyncio.to_thread(thread.join, 5)


def _place(update: object, places: list[str]) -> str:
    """Return the place that an update is about: the only one, or the key of one of many."""
    return places[0] if len(places) == 1 else str(parse(update.path)[0])


def cut(clients: list[redis.Redis], rng: random.Random, stopping: threading.Event) -> None:
    """Cut connections at random, mostly those of watchers."""
    while not stopping.wait(rng.uniform(0.02, 0.4)):
        client = rng.choice(clients)
        with contextlib.suppress(redis.exceptions.RedisError):
            if rng.random() < 0.7:
                client.execute_command("CLIENT", "KILL", "TYPE", "pubsub")
            else:
                victim = rng.choice(client.client_list())
                client.client_kill_filter(_id=victim["id"], skipme=True)


async def hunt(url: str, nodes: list, seed: int, changes: int, *, kill: bool) -> int:
    """Return 0 if nobody was wrong at any pause."""
    rng = random.Random(seed)
    kinds = ["store", "publish", "asyncio", "bare"]
    writers = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.watchmodel", "--write", url, kind, str(seed * 10 + number)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT,
        )
        for number, kind in enumerate(kinds)
    ]  # fmt: skip
    watchers, clients = Watchers(url), [redis.Redis(port=node.port) for node in nodes]
    await watchers.begin()
    made, pauses, begun, longest = 0, 0, time.monotonic(), 0.0
    try:
        while made < changes:
            batch = min(rng.choice([1, 5, 50, 500, 1000]), (changes - made + 3) // 4)
            stopping = threading.Event()
            cutter = threading.Thread(target=cut, args=(clients, rng, stopping))
            if kill:
                cutter.start()
            for writer in writers:
                writer.stdin.write(f"{batch}\n")
                writer.stdin.flush()
            for writer in writers:
                if await asyncio.to_thread(writer.stdout.readline) != "done\n":
                    raise RuntimeError("a writer has ended")
            stopping.set()
            if kill:
                await asyncio.to_thread(cutter.join)
            made, pauses, rest = made + 4 * batch, pauses + 1, time.monotonic()
            while wrong := await watchers.wrong():
                if time.monotonic() - rest > PATIENCE:
                    print(f"seed {seed}, after {made} changes, pause {pauses}:", *wrong, sep="\n")
                    return 1
                await asyncio.sleep(0.02)
            longest = max(longest, time.monotonic() - rest)
        told = [last for last, _ in watchers.lasts]
        print(
            f"seed {seed}: {made} changes, {pauses} pauses, none wrong; {sum(each.updates for each in told)} updates, "
            f"{sum(each.stored for each in told)} of them stored; {time.monotonic() - begun:.0f} s, "
            f"longest wait {longest:.2f} s"
        )
        return 0
    finally:
        for writer in writers:
            writer.stdin.close()
            writer.wait(30)
            writer.stdout.close()
        await watchers.close()
        for client in clients:
            client.close()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.watchmodel")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--changes", type=int, default=100_000)
    parser.add_argument("--kill", action="store_true", help="cut connections at random")
    parser.add_argument("--cluster", action="store_true")
    parser.add_argument("--write", nargs=3, metavar=("URL", "KIND", "SEED"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    if given.write:
        write(given.write[0], given.write[1], int(given.write[2]))
        return 0
    seed = secrets.randbelow(10**6) if given.seed is None else given.seed
    with EmbeddedCluster(replicas=0) if given.cluster else EmbeddedServer() as server:
        nodes = server.nodes if given.cluster else [server]
        return asyncio.run(hunt(server.url, nodes, seed, given.changes, kill=given.kill))


if __name__ == "__main__":
    sys.exit(main())
