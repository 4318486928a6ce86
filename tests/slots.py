"""Slots of shared memory in the hands of processes that are killed: none is torn, and nothing is left.

    python tests/slots.py [--seed N] [--uses N]

Two publishers of one path and four readers, some of whom keep what they see for a while. Each frame says its own
checksum, which is compared when it is seen and again before it is let go. A party at random is killed (kill -9) every
few milliseconds, and another takes its place.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import multiprocessing
import os
import random
import secrets
import select
import signal
import socket
import sys
import time
import traceback
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from reem_async.local.host import reason_against
from reem_async.local.path import LocalPath
from reem_async.local.segment import SLOTS
from reem_async.plan.keys import keys_of
from reem_async.plan.notices import Slot

FORK = multiprocessing.get_context("fork")
PUBLISHERS, READERS = 2, 4
KEYS = keys_of("frames")
LARGEST = 1 << 16
"""Bytes of a frame; most are shorter, so that a processor makes many."""
PATIENCE = 60.0
"""Seconds in which something must come about that takes some milliseconds on a machine with nothing else to do."""
COUNTED = "written", "full", "seen", "gone", "torn", "left"


class Party:
    """A process of the test, and another one in its place when it is killed.

    Args:
        work: What it does, with its end of a pipe.
    """

    def __init__(self, work: Callable[[Any], None]) -> None:
        self._work = work
        self._begin()

    def _begin(self) -> None:
        self.pipe, end = FORK.Pipe()
        self._process = FORK.Process(target=self._run, args=(end,), daemon=True)
        self._process.start()
        end.close()

    def _run(self, end: Any) -> None:
        try:
            self._work(end)
        except (EOFError, BrokenPipeError):  # the test is over
            pass
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)

    def kill(self) -> None:
        self._process.kill()
        self.end()
        self._begin()

    def ask(self, what: Any) -> Any:
        self.pipe.send(what)
        assert self.pipe.poll(PATIENCE), "a party does not answer"
        return self.pipe.recv()

    def stop(self, signal_number: int) -> None:
        os.kill(self._process.pid or 0, signal_number)

    def end(self) -> int | None:
        """Wait until it has ended by itself."""
        self.pipe.close()
        self._process.join(PATIENCE)
        code = self._process.exitcode
        self._process.close()
        return code


class Count:
    """What all parties have counted, those that were killed included."""

    def __init__(self) -> None:
        self._rows = [FORK.RawArray("q", len(COUNTED)) for _ in range(PUBLISHERS + READERS)]

    def add(self, party: int, what: str, number: int = 1) -> None:
        """Count for a party; only this one does."""
        self._rows[party][COUNTED.index(what)] += number

    def __getitem__(self, what: str) -> int:
        return sum(row[COUNTED.index(what)] for row in self._rows)


def frame(rng: random.Random, source: np.ndarray) -> list[Any]:
    """Return the pieces of a frame: its checksum, and bytes that are not those of any other."""
    size = int(256 * (LARGEST / 256) ** rng.random())
    start = rng.randrange(len(source) - size)
    body = source[start : start + size].data
    return [zlib.crc32(body).to_bytes(8, "little"), body]


def is_whole(view: memoryview) -> bool:
    return zlib.crc32(view[8:]).to_bytes(8, "little") == view[:8]


def open_files() -> int:
    gc.collect()
    return len(os.listdir("/proc/self/fd"))


def shared_memory() -> int:
    """Return the megabytes of shared memory of the whole machine."""
    with open("/proc/meminfo", encoding="ascii") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("Shmem:")) >> 10


def publish(end: Any, place: int, names: list[str], count: Count) -> None:
    """Put frames into slots and say where, until told to stop; then see to it that all slots are free."""
    rng, local = random.Random(secrets.randbits(64)), LocalPath()
    source = np.frombuffer(rng.randbytes(4 * LARGEST), np.uint8)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as told:
        before = open_files()
        while not end.poll():
            pieces = frame(rng, source)
            slot = local.put(KEYS, pieces, [sum(len(piece) for piece in pieces)])
            count.add(place, "full" if slot is None else "written")
            taken = False
            for name in names if slot is not None else ():
                with contextlib.suppress(OSError):  # it was killed, or is behind
                    told.sendto(json.dumps([*slot, sum(len(piece) for piece in pieces)]).encode(), name)
                    taken = True
            if not taken:
                time.sleep(0.0005)
            elif rng.random() < 0.001:  # it is dropped while others look into it
                local._segments.clear()
        end.recv()
        wanted = SLOTS
        while wanted:  # readers are gone
            views = [local.view(slot, 1) if (slot := local.put(KEYS, [b"x"], [1])) else None for _ in range(3)]
            wanted = wanted - 3 if None not in views else wanted
            del views
        local.close()
        left = open_files() - before
        count.add(place, "left", left)
        end.send(left)


def newest(told: socket.socket) -> list[Any]:
    """Return the last few that were said; who is behind leaves the others out."""
    said: list[Any] = []
    if select.select([told], [], [], 0.05)[0]:
        with contextlib.suppress(BlockingIOError):
            while len(said) < 20:
                said.append(told.recv(1000))
    return [json.loads(each) for each in said[-5:]]


def read(end: Any, place: int, name: str, slowness: float, count: Count) -> None:
    """See what is said, and keep some of it for a while, until told to stop."""
    rng, local, kept = random.Random(secrets.randbits(64)), LocalPath(), []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as told:
        with contextlib.suppress(OSError):
            told.bind(name)
        local.reader  # noqa: B018 - what is imported is imported
        before = open_files()
        while not end.poll():
            for *where, size in newest(told):
                view = local.view(Slot(*where), size)
                count.add(place, "gone" if view is None else "seen")
                if view is not None:
                    count.add(place, "torn", not is_whole(view))
                    kept.append(view)
            view = None
            if len(kept) > rng.randrange(1, 20):
                time.sleep(rng.random() * slowness)
                count.add(place, "torn", sum(not is_whole(each) for each in kept))
                kept.clear()
            if rng.random() < 0.001:
                local.reader.close()
        end.recv()
        kept.clear()
        local.close()
        left = open_files() - before
        count.add(place, "left", left)
        end.send(left)


def hunt(seed: int, uses: int) -> None:
    """Have slots written and looked into so many times."""
    rng, count, memory = random.Random(seed), Count(), shared_memory()
    before, begun = open_files(), time.monotonic()
    tag = secrets.token_hex(8)

    def name(generation: int, reader: int) -> str:
        return f"\0reem-slots-{tag}-{generation}-{reader}"

    names = [name(0, reader) for reader in range(READERS)]
    parties = [
        *(Party(lambda end, it=it: publish(end, it, names, count)) for it in range(PUBLISHERS)),
        *(Party(lambda end, it=it: read(end, PUBLISHERS + it, names[it], it * 0.004, count)) for it in range(READERS)),
    ]
    kills, said = 0, begun
    while count["seen"] + count["written"] < uses:
        time.sleep(rng.uniform(0.0, 0.2))
        victim = rng.choice(parties)
        if rng.random() < 0.2:  # one that stands still has its slots, and keeps nobody from anything
            victim.stop(signal.SIGSTOP)
            time.sleep(rng.uniform(0.0, 0.1))
            victim.stop(signal.SIGCONT)
        else:
            victim.kill()
            kills += 1
        if time.monotonic() > said + 20:
            said = time.monotonic()
            print(
                f"{count['written']:,} written, {count['seen']:,} seen, {kills} killed, {count['torn']} torn",
                flush=True,
            )
    for party in parties[PUBLISHERS:] + parties[:PUBLISHERS]:
        party.ask("stop")
    ended = [party.end() for party in parties]
    assert ended == [0] * len(parties), f"parties have ended with {ended}"
    seconds = time.monotonic() - begun
    print(
        f"{count['written']:,} frames written and {count['seen']:,} seen in {seconds:.0f} s; {count['gone']:,} gone, "
        f"{count['full']:,} found no slot; {kills} parties killed; {count['torn']} torn; "
        f"{count['left']} descriptors left in the parties, {open_files() - before} here; "
        f"shared memory of the machine {memory} MB before, {shared_memory()} MB after"
    )
    assert count["torn"] == 0
    assert count["left"] == 0
    assert open_files() == before
    deadline = time.monotonic() + PATIENCE
    while shared_memory() > memory + 64:  # others have some, too
        assert time.monotonic() < deadline, "shared memory is left"
        time.sleep(0.1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6))
    parser.add_argument("--uses", type=int, default=1_000_000, help="times that a slot is written or looked into")
    options = parser.parse_args()
    if reason_against():
        sys.exit(f"no shared memory here: {reason_against()}")
    print(f"seed {options.seed}", flush=True)
    hunt(options.seed, options.uses)


if __name__ == "__main__":
    main()
