"""What a server without the JSON module costs, beside the same server with it: `python -m benchmarks.plain`.

Each figure is the median of many calls, the two servers asked in turns, through their Unix sockets.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import threading
import time
from collections.abc import Callable
from typing import Any

import reem
from reem.server import EmbeddedServer

from .values import build

SMALL, TEXTS = build({"kind": "small"}), build({"kind": "strings", "count": 400})

Call = Callable[[], Any]


def calls(store: reem.KeyValueStore) -> dict[str, tuple[Call, float]]:
    """Return what is measured at one server, and how its cost compared with JSON's may be at most."""
    store["small"], store["texts"], store["nested"] = SMALL, TEXTS, SMALL
    return {
        "set a small dict": (lambda: store.__setitem__("small", SMALL), 1.0),
        "get a small dict": (lambda: store["small"].read(), 1.0),
        "set a number in a small dict": (lambda: store["nested"].__setitem__("number", 2), 2.5),
        "set 400 strings": (lambda: store.__setitem__("texts", TEXTS), 0.7),
        "get 400 strings": (lambda: store["texts"].read(), 0.7),
    }


def heard(stack: contextlib.ExitStack, server: EmbeddedServer) -> Call:
    """Return a call that publishes and returns when the callback was called."""
    interface = stack.enter_context(reem.RedisInterface(server))
    space, arrived = reem.PublishSpace(interface), threading.Event()
    space["told"] = SMALL
    subscriber = reem.CallbackSubscriber("told", interface, lambda data, updated_path: arrived.set(), {})
    subscriber.listen()

    def publish() -> None:
        arrived.clear()
        space["told"] = SMALL
        assert arrived.wait(5)

    return publish


def timed(call: Call, count: int) -> list[float]:
    """Return the seconds of each of `count` calls."""
    seconds = []
    for _ in range(count):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return seconds


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plain", description=__doc__)
    parser.add_argument("--rounds", type=int, default=30, help="turns of each server, 100 calls in each")
    given = parser.parse_args()
    with contextlib.ExitStack() as stack:
        servers = [stack.enter_context(EmbeddedServer(json=json)) for json in (True, False)]
        if not servers[0].json:
            parser.error("there is no JSON module to compare with")
        sets = [calls(reem.KeyValueStore(stack.enter_context(reem.RedisInterface(server)))) for server in servers]
        for each, server in zip(sets, servers, strict=True):
            each["publish to callback"] = (heard(stack, server), 1.15)
        for name, (_, most) in sets[0].items():
            times: list[list[float]] = [[], []]
            for _ in range(given.rounds):
                for place, each in enumerate(sets):
                    times[place] += timed(each[name][0], 100)
            with_json, plain = (statistics.median(each) * 1e6 for each in times)
            print(
                f"{name:30s} JSON {with_json:7.1f} us   text {plain:7.1f} us   {plain / with_json:.2f} (at most {most})"
            )


if __name__ == "__main__":
    main()
