"""Row 10: a subscriber that stands still."""

from __future__ import annotations

import contextlib
import itertools

import numpy as np

import reem

from .scoreboard import Run, row
from .servers import PrivateServer
from .tools import measured, order, program, quantile, said


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
