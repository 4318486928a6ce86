"""Slots of shared memory in the hands of processes that are killed: none is torn, and nothing is left.

    python tests/slots.py [--seed N] [--uses N]

Two publishers of one path and four readers, some of whom keep what they see for a while. Each frame says its own
checksum, which is compared when it is seen and again before it is let go. A party at random is killed (kill -9) every
few milliseconds, and another takes its place.
"""

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
import zlib
from typing import Any

import numpy as np

from reem_async.local import LocalPath
from reem_async.local.segment import NAME, SLOTS, reason_against
from reem_async.plan.keys import keys_of
from reem_async.plan.notices import Slot

FORK = multiprocessing.get_context("fork")
PUBLISHERS, READERS = 2, 4
KEYS = keys_of("frames")
LARGEST = 1 << 16
"""Bytes of a frame; most are shorter, so that a processor makes many."""
PATIENCE = 60.0
"""Seconds in which something must come about that takes some milliseconds on a machine with nothing else to do."""
COUNTED = WRITTEN, FULL, SEEN, GONE, TORN, LEFT = range(6)
NAMES = [f"\0reem-slots-{secrets.token_hex(8)}-{reader}" for reader in range(READERS)]
"""Where readers are told."""


class Work:
    """What processes share: the first of them publish, all count, killed ones included, until they are told to end."""

    def __init__(self, publish: Any, read: Any, places: int, counted: int) -> None:
        self._publish, self._read = publish, read
        self.counts = np.frombuffer(FORK.RawArray("q", places * counted), np.int64).reshape(places, counted)
        self._over = FORK.RawArray("b", places)
        self._parent = os.getpid()

    def is_over(self, place: int) -> bool:
        return bool(self._over[place]) or os.getppid() != self._parent

    def total(self, what: int) -> int:
        return int(self.counts[:, what].sum())

    def started(self, place: int) -> Any:
        target = self._publish if place < PUBLISHERS else self._read
        process = FORK.Process(target=target, args=(self, place), daemon=True)
        process.start()
        return process

    def end(self, place: int, process: Any) -> int | None:
        self._over[place] = True
        return ended(process)


def ended(process: Any) -> int | None:
    process.join(PATIENCE)
    code: int | None = process.exitcode
    process.close()
    return code


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


def segments(process: object) -> set[int]:
    """Return the inodes of the shared memory of REEM that a process has open or mapped; none if it has ended."""
    found = set()
    for folder in ("fd", "map_files"):
        with contextlib.suppress(OSError):
            for entry in os.scandir(f"/proc/{process}/{folder}"):
                with contextlib.suppress(OSError):  # it is closed just now
                    if os.readlink(entry.path) == f"/memfd:{NAME} (deleted)":
                        found.add(entry.stat().st_ino)
    return found


def holders(memory: set[int]) -> list[int]:
    """Return the processes of this machine that have some of this memory."""
    return [int(it) for it in os.listdir("/proc") if it.isdigit() and segments(it) & memory]


def publish(work: Work, place: int) -> None:
    """Put frames into slots and say where, until told to stop; then see to it that all slots are free."""
    rng, local, count = random.Random(secrets.randbits(64)), LocalPath(), work.counts[place]
    source = np.frombuffer(rng.randbytes(4 * LARGEST), np.uint8)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as told:
        before = open_files()
        while not work.is_over(place):
            pieces = frame(rng, source)
            size = sum(len(piece) for piece in pieces)
            slot = local.put(KEYS, pieces, [size])
            count[FULL if slot is None else WRITTEN] += 1
            taken = False
            for name in NAMES if slot is not None else ():
                with contextlib.suppress(OSError):  # it was killed, or is behind
                    told.sendto(json.dumps([*slot, size]).encode(), name)
                    taken = True
            if not taken:
                time.sleep(0.0005)
            elif rng.random() < 0.001:  # it is dropped while others look into it
                local._segments.clear()
        wanted = SLOTS
        while wanted:  # readers are gone
            views = [local.view(slot, 1) if (slot := local.put(KEYS, [b"x"], [1])) else None for _ in range(3)]
            wanted = wanted - 3 if None not in views else wanted
            del views
        local.close()
        count[LEFT] += open_files() - before


def newest(told: socket.socket) -> list[Any]:
    """Return the last few that were said; who is behind leaves the others out."""
    said: list[Any] = []
    if select.select([told], [], [], 0.05)[0]:
        with contextlib.suppress(BlockingIOError):
            while len(said) < 20:
                said.append(told.recv(1000))
    return [json.loads(each) for each in said[-5:]]


def read(work: Work, place: int) -> None:
    """See what is said, and keep some of it for a while, until told to stop."""
    rng, local, count = random.Random(secrets.randbits(64)), LocalPath(), work.counts[place]
    reader, kept = place - PUBLISHERS, []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as told:
        with contextlib.suppress(OSError):
            told.bind(NAMES[reader])
        local.reader  # noqa: B018 - what is imported is imported
        before = open_files()
        while not work.is_over(place):
            for *where, size in newest(told):
                view = local.view(Slot(*where), size)
                count[GONE if view is None else SEEN] += 1
                if view is not None:
                    count[TORN] += not is_whole(view)
                    kept.append(view)
            view = None
            if len(kept) > rng.randrange(1, 20):
                time.sleep(rng.random() * reader * 0.004)
                count[TORN] += sum(not is_whole(each) for each in kept)
                kept.clear()
            if rng.random() < 0.001:
                local.reader.close()
        kept.clear()
        local.close()
        count[LEFT] += open_files() - before


def hunt(seed: int, uses: int) -> None:
    """Have slots written and looked into so many times."""
    rng, memory = random.Random(seed), shared_memory()
    work = Work(publish, read, PUBLISHERS + READERS, len(COUNTED))
    before, begun = open_files(), time.monotonic()
    processes = [work.started(place) for place in range(PUBLISHERS + READERS)]
    kills, said = 0, begun
    while work.total(SEEN) + work.total(WRITTEN) < uses:
        time.sleep(rng.uniform(0.0, 0.2))
        victim = rng.randrange(len(processes))
        process = processes[victim]
        if rng.random() < 0.2:  # one that stands still has its slots, and keeps nobody from anything
            os.kill(process.pid, signal.SIGSTOP)
            time.sleep(rng.uniform(0.0, 0.1))
            os.kill(process.pid, signal.SIGCONT)
        else:
            process.kill()
            code = ended(process)
            assert code == -signal.SIGKILL, f"a process has ended with {code}"
            processes[victim] = work.started(victim)
            kills += 1
        if time.monotonic() > said + 20:
            said = time.monotonic()
            print(f"{work.total(WRITTEN):,} written, {work.total(SEEN):,} seen, {kills} killed", flush=True)
    codes = [work.end(place, process) for place, process in reversed([*enumerate(processes)])]  # publishers last
    assert not any(codes), f"processes have ended with {codes}"
    print(
        f"{work.total(WRITTEN):,} frames written and {work.total(SEEN):,} seen in {time.monotonic() - begun:.0f} s; "
        f"{work.total(GONE):,} gone, {work.total(FULL):,} found no slot; {kills} processes killed; "
        f"{work.total(TORN)} torn; {work.total(LEFT)} descriptors left in them, {open_files() - before} here; "
        f"shared memory of the machine {memory} MB before, {shared_memory()} MB after"
    )
    assert (work.total(TORN), work.total(LEFT)) == (0, 0)
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
