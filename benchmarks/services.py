"""What a call of a service costs: `python -m benchmarks.services`, about a minute; prints tables in Markdown.

The server of each way is a process of its own on this host. A call each 4 ms, the ways take turns, figures are medians
of all rounds. Ways whose package is missing are left out: pyzmq, eclipse-zenoh, grpcio.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import redis

import reem
import reem_async
from reem_async.server import EmbeddedServer

ROUNDS, COUNT, GAP = 5, 150, 0.004
IMAGES = {side: np.random.default_rng(1).integers(0, 255, (480, 640, 3), np.uint8) for side in ("left", "right")}
NEEDS = {"pyzmq REQ/REP": "zmq", "zenoh queryable": "zenoh", "gRPC, arrays as bytes": "grpc"}
INBOX = b"inbox-%030d" % os.getpid()


def act(**arguments: Any) -> dict[str, Any]:
    return {"actions": [0.5] * 10, "got": len(arguments)}


# --- serving, in a process of its own ---------------------------------------------------------------


def serve(way: str, url: str, place: str, ready: Any) -> None:
    if way == "redis-py lists":
        client = redis.Redis.from_url(url)
        ready.set()
        while True:
            _, body = client.blpop(["q"])
            client.rpush(body[: len(INBOX)], b"x" * 120)
    elif way == "pyzmq REQ/REP":
        import zmq

        replier = zmq.Context().socket(zmq.REP)
        replier.bind(place)
        ready.set()
        while True:
            replier.recv()
            replier.send(b"x" * 120)
    elif way == "zenoh queryable":
        import zenoh

        session = zenoh.open(zenoh.Config())
        queryable = session.declare_queryable("q", lambda query: query.reply("q", b"x" * 120))
        ready.set()
        time.sleep(600)
        queryable.undeclare()
    elif way == "gRPC, arrays as bytes":
        serve_grpc(place, ready)
    elif way.startswith("REEM, asyncio"):
        asyncio.run(serve_async(url, ready))
    else:
        service = reem.KeyValueStore(url)["policy"].serve(act)
        ready.set()
        service.wait()


async def serve_async(url: str, ready: Any) -> None:
    async def aact(**arguments: Any) -> dict[str, Any]:
        return act(**arguments)

    async with reem_async.RedisInterface(url) as interface:
        service = reem_async.KeyValueStore(interface)["policy"].serve(aact)
        await service.listen()
        ready.set()
        await service.wait()


def serve_grpc(place: str, ready: Any) -> None:
    import grpc

    def handle(request: bytes, _: Any) -> bytes:
        size = len(request) // 2
        arrays = {side: np.frombuffer(request, np.uint8, size, size * n) for n, side in enumerate(("left", "right"))}
        return bytes(str(act(**arrays)), "ascii")

    server = grpc.server(ThreadPoolExecutor(1), options=[("grpc.max_receive_message_length", -1)])
    handler = grpc.method_handlers_generic_handler("q", {"call": grpc.unary_unary_rpc_method_handler(handle)})
    server.add_generic_rpc_handlers((handler,))
    server.add_insecure_port(place)
    server.start()
    ready.set()
    server.wait_for_termination()


# --- calling ---------------------------------------------------------------


@contextlib.contextmanager
def caller(way: str, url: str, place: str, arguments: dict[str, Any]) -> Iterator[Callable[[], Any]]:
    """What makes one call; the small request is 120 bytes for those that know only bytes."""
    body = INBOX + b"x" * 84
    if way == "redis-py lists":
        client = redis.Redis.from_url(url)
        yield lambda: (client.rpush("q", body), client.blpop([INBOX]))
    elif way == "pyzmq REQ/REP":
        import zmq

        asker = zmq.Context().socket(zmq.REQ)
        asker.connect(place)
        yield lambda: (asker.send(body), asker.recv())
    elif way == "zenoh queryable":
        import zenoh

        session = zenoh.open(zenoh.Config())
        time.sleep(1.5)
        yield lambda: list(session.get("q", payload=body))
    elif way == "gRPC, arrays as bytes":
        import grpc

        with grpc.insecure_channel(place, options=[("grpc.max_send_message_length", -1)]) as channel:
            ask = channel.unary_unary("/q/call")
            yield lambda: ask(b"".join([each.tobytes() for each in arguments.values()]) or body)
    elif way.startswith("REEM, asyncio"):
        with asyncio.Runner() as runner:
            interface = reem_async.RedisInterface(url, local="early" if way.endswith("direct") else "auto")
            service = reem_async.KeyValueStore(interface)["policy"]

            async def call() -> Any:
                return await service.call(**arguments)

            yield lambda: runner.run(call())
            runner.run(interface.close())
    else:
        mode = {"REEM, through the server": "off", "REEM, blocking, direct": "early"}.get(way, "auto")
        with reem.RedisInterface(url, local=mode) as interface:
            service = reem.KeyValueStore(interface)["policy"]
            yield lambda: service.call(**arguments)


def measured(way: str, url: str, arguments: dict[str, Any]) -> list[float]:
    """Seconds of each call."""
    context = multiprocessing.get_context("spawn")
    place = f"{tempfile.gettempdir()}/call{os.getpid()}"
    place = f"unix:{place}.grpc" if way.startswith("gRPC") else f"ipc://{place}"
    ready = context.Event()
    process = context.Process(target=serve, args=(way, url, place, ready), daemon=True)
    process.start()
    try:
        ready.wait(30)
        took = []
        with caller(way, url, place, arguments) as call:
            for number in range(COUNT + 20):
                began = time.perf_counter()
                call()
                if number >= 20:
                    took.append(time.perf_counter() - began)
                time.sleep(GAP)
        return took
    finally:
        process.kill()
        process.join()


def table(title: str, ways: list[str], url: str, arguments: dict[str, Any]) -> None:
    ways = [way for way in ways if way not in NEEDS or importlib.util.find_spec(NEEDS[way])]
    took: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(ROUNDS):
        for way in ways:
            took[way] += measured(way, url, arguments)
    print(f"\n| {title} | median | p99 |\n|---|---|---|")
    for way, each in took.items():
        print(
            f"| {way} | {statistics.median(each) * 1e6:.0f} µs | {sorted(each)[len(each) * 99 // 100] * 1e6:.0f} µs |"
        )


def main() -> None:
    with EmbeddedServer() as server:
        small = ["redis-py lists", "REEM, blocking", "REEM, asyncio"]
        small += ["REEM, blocking, direct", "REEM, asyncio, direct", "zenoh queryable", "pyzmq REQ/REP"]
        table("small call", small, server.url, {"state": [0.5] * 6, "step": 7})
        large = ["gRPC, arrays as bytes", "REEM, blocking", "REEM, asyncio", "REEM, through the server"]
        table("policy call, two images of 0.92 MB", large, server.url, IMAGES)


if __name__ == "__main__":
    main()
