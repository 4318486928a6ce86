"""Early updates between processes that are killed: none is torn, mirrors end equal to the server, and nothing is left.

    python tests/earlysoak.py [--seed N] [--updates N]

Two early publishers and three subscribers of one key: a callback, a watch of what is stored, and a mirror. Each update
says its own checksum. A process at random is killed (kill -9) every few milliseconds, and another takes its place.
"""

import argparse
import contextlib
import os
import random
import sys
import tempfile
import threading
import time
import zlib
from functools import partial
from typing import Any

import numpy as np
from slots import PUBLISHERS, Work, ended, holders, open_files, segments

import reem
from reem_async.local import mailbox
from reem_async.server import EmbeddedServer

KEY = "arm"
KINDS = ("publisher",) * PUBLISHERS + ("callback", "watch", "mirror")
COUNTED = SENT, SEEN, EARLY, TORN, UNEQUAL = range(5)
SIZES = (0, 1 << 10, 20_000, 1 << 17)  # bytes: in the notice, in a datagram alone, and in shared memory
PATIENCE = 60.0


def made(rng: random.Random) -> dict[str, Any]:
    body = np.frombuffer(rng.randbytes(rng.choices(SIZES, (90, 6, 3, 1))[0] or 16), np.uint8)
    return {"body": body if len(body) > 16 else body.tolist(), "crc": zlib.crc32(body)}


def is_whole(value: Any) -> bool:
    return value is None or zlib.crc32(np.asarray(value["body"], np.uint8)) == value["crc"]


def publish(url: str, work: Work, place: int) -> None:
    rng, count = random.Random(os.urandom(8)), work.counts[place]
    with reem.RedisInterface(url, local="early") as interface:
        space = reem.PublishSpace(interface)
        while not work.is_over(place):
            space[KEY] = made(rng)
            count[SENT] += 1


def follow(url: str, work: Work, place: int) -> None:
    count = work.counts[place]

    def check(data: Any, is_early: bool) -> None:
        count[SEEN] += 1
        count[EARLY] += is_early
        count[TORN] += not is_whole(data)

    with reem.RedisInterface(url) as interface:
        watch = reem.SilentSubscriber(KEY, interface, stored=KINDS[place] == "watch").watch(reem.Last(100))
        mirror = reem.KeyValueStore(interface)[KEY].mirror()
        with mirror, watch:
            if KINDS[place] == "mirror":
                while not work.is_over(place):
                    with contextlib.suppress(TimeoutError):
                        mirror.wait_until(lambda value: check(value, False) or work.is_over(place), 0.05)
            else:
                threading.Thread(target=lambda: [check(each.data, each.early) for each in watch], daemon=True).start()
                while not work.is_over(place):
                    time.sleep(0.01)
            expected, deadline = reem.KeyValueStore(interface)[KEY].read(), time.monotonic() + PATIENCE
            while mirror.value()["crc"] != expected["crc"] and time.monotonic() < deadline:
                time.sleep(0.01)
            count[UNEQUAL] += mirror.value()["crc"] != expected["crc"]


def soak(seed: int, updates: int) -> None:
    rng, begun = random.Random(seed), time.monotonic()
    memory, kills = set[int](), 0  # inodes of shared memory, as it was when a process was killed
    with tempfile.TemporaryDirectory(dir="/tmp") as folder, EmbeddedServer() as server:
        mailbox._PARENT = folder  # other programs have sockets in the usual one
        work = Work(partial(publish, server.url), partial(follow, server.url), len(KINDS), len(COUNTED))
        before = open_files()
        processes = [work.started(place) for place in range(len(KINDS))]
        while work.total(SENT) < updates:
            time.sleep(rng.uniform(0.02, 0.2))
            place = rng.randrange(len(KINDS))
            memory |= segments(processes[place].pid)
            processes[place].kill()
            ended(processes[place])
            processes[place], kills = work.started(place), kills + 1
        memory = memory.union(*[segments(process.pid) for process in processes])
        codes = [work.end(place, process) for place, process in enumerate(processes)]
        mailbox.Mailbox(mailbox.PUBLISHER).close()
        descriptors, left, having = open_files() - before, os.listdir(mailbox._path()), holders(memory)
    print(
        f"seed {seed}: {work.total(SENT)} updates, {work.total(SEEN)} seen, {work.total(EARLY)} of them early, "
        f"{kills} kills, {time.monotonic() - begun:.0f} s; {work.total(TORN)} torn, {work.total(UNEQUAL)} differ; "
        f"{len(left)} sockets, {descriptors} descriptors are left; {len(having)} processes hold one of "
        f"{len(memory)} segments"
    )
    assert codes == [0] * len(KINDS), codes
    assert work.total(EARLY) > 0
    assert (work.total(TORN), work.total(UNEQUAL)) == (0, 0)
    assert not left
    assert not descriptors
    assert memory, "no process had shared memory"
    assert not having, f"processes {having} hold memory of those that have ended"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    parser.add_argument("--updates", type=int, default=1_000_000)
    chosen = parser.parse_args()
    sys.exit(soak(chosen.seed, chosen.updates))
