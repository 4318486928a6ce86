"""Slots of shared memory in the hands of processes that are killed: none torn, nothing left, mirrors that are right.

    python tests/slots.py [--seed N] [--uses N] [--rounds N] [--within SECONDS]

First without a server: two publishers of one path and four readers, some of whom keep what they see for a while. Each
frame says its own checksum, which is compared when it is seen and again before it is let go. A party at random is
killed (kill -9) every few milliseconds, and another takes its place. Then with a server: two publishers of one path,
one of them early, and mirrors and slow callbacks in four processes; in each round some are killed, and then all mirrors
must have what the server has. One more publisher and one of the readers are never killed: they must have lost no
descriptor and little memory by the others at the end.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import json
import logging
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
from typing import Any, NamedTuple

import numpy as np
from slotkit import in_slot

import reem
from reem.server import EmbeddedServer
from reem_async.local.host import reason_against
from reem_async.local.path import LEAST, LocalPath
from reem_async.local.reader import LocalReader
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
COUNTED = "written", "full", "seen", "gone", "torn", "left", "shared"
MODES = "auto", "early", "auto"
"""Of the publishers with a server; the last one is never killed."""


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
        """End it at once, and begin anew."""
        self._process.kill()
        self.end()
        self._begin()

    def ask(self, what: Any) -> Any:
        """Send it something and return its answer."""
        self.pipe.send(what)
        assert self.pipe.poll(PATIENCE), "a party does not answer"
        return self.pipe.recv()

    def stop(self, signal_number: int) -> None:
        """Send it a signal."""
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


def frame(rng: random.Random, source: np.ndarray, smallest: int = 256, largest: int = LARGEST) -> list[Any]:
    """Return the pieces of a frame: its checksum, and bytes that are not those of any other."""
    size = int(smallest * (largest / smallest) ** rng.random())
    start = rng.randrange(len(source) - size)
    body = source[start : start + size].data
    return [zlib.crc32(body).to_bytes(8, "little"), body]


def is_whole(view: memoryview) -> bool:
    """Return whether a frame is as it was made."""
    return zlib.crc32(view[8:]).to_bytes(8, "little") == view[:8]


def open_files() -> int:
    """Return how many descriptors this process has."""
    gc.collect()
    return len(os.listdir("/proc/self/fd"))


def shared_memory() -> int:
    """Return the megabytes of shared memory of the whole machine."""
    with open("/proc/meminfo", encoding="ascii") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("Shmem:")) >> 10


# --- without a server --------------------------------------------------------------------------------


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


def without_server(seed: int, uses: int, say: Callable[[str], None]) -> Count:
    """Have slots written and looked into so many times; returns what was counted."""
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
            say(f"{count['written']:,} written, {count['seen']:,} seen, {kills} killed, {count['torn']} torn")
    for party in parties[PUBLISHERS:] + parties[:PUBLISHERS]:
        party.ask("stop")
    ended = [party.end() for party in parties]
    assert ended == [0] * len(parties), f"parties have ended with {ended}"
    seconds = time.monotonic() - begun
    say(
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
    return count


# --- with a server -----------------------------------------------------------------------------------


def shot(rng: random.Random, source: np.ndarray) -> dict[str, Any]:
    """Return a document that can be told from any other, and from a torn one; most go through shared memory."""
    checksum, body = frame(rng, source, LEAST // 2, 4 * LEAST)
    return {"image": np.frombuffer(body, np.uint8), "sum": int.from_bytes(checksum, "little"), "id": rng.random()}


def is_whole_shot(data: Any) -> bool:
    """Return whether an image belongs to its checksum."""
    return zlib.crc32(data["image"].data) == data["sum"]


class Costs:
    """What a party has lost from its beginning to its end.

    Args:
        url: Of a server; what a process needs once, such as threads, is there when it was used once.
    """

    def __init__(self, url: str) -> None:
        with reem.RedisInterface(url) as interface:
            reem.SilentSubscriber("cam", interface).listen()
        self._descriptors, self._memory, self.grown = open_files(), 0.0, 0.0

    @property
    def begun(self) -> bool:
        """Whether somebody has looked."""
        return self._memory > 0

    def look(self) -> None:
        """Look at the memory; what is needed is there the first time."""
        # What had waited for a slow callback was let go, and glibc keeps its heaps for what may come.
        ctypes.CDLL(None).malloc_trim(0)
        self._memory = self._memory or resident()
        self.grown = resident() - self._memory

    def end(self) -> tuple[int, float]:
        """Return how many descriptors more there are, once all was let go, and how many megabytes there were."""
        deadline = time.monotonic() + PATIENCE
        while (left := open_files() - self._descriptors) > 0 and time.monotonic() < deadline:
            time.sleep(0.01)  # threads are ending
        return left, self.grown


def resident() -> float:
    """Return the megabytes of this process's own, without what it shares with others."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("RssAnon:")) / 1024


def publish_through(end: Any, url: str, mode: str) -> None:
    """Publish between "go" and "pause", until "end"."""
    costs = Costs(url)
    _publish_through(end, url, mode, costs)
    end.send(costs.end())


def _publish_through(end: Any, url: str, mode: str, costs: Costs) -> None:
    rng = random.Random(secrets.randbits(64))
    source = np.frombuffer(rng.randbytes(8 * LARGEST), np.uint8)
    with reem.RedisInterface(url, local=mode) as interface:
        space, said = reem.PublishSpace(interface), "go"
        while True:
            while end.poll(0 if said == "go" else None):
                said = end.recv()
                costs.look()
                if said == "end":
                    return
                end.send(said)
            space["cam"] = shot(rng, source)


def mirror_through(end: Any, url: str, place: int, count: Count) -> None:
    """Follow, and answer with the id of what the mirror has; every other one keeps frames and looks at them slowly."""
    costs = Costs(url)
    _mirror_through(end, url, place, count, costs)
    end.send(costs.end())


def _mirror_through(end: Any, url: str, place: int, count: Count, costs: Costs) -> None:
    logging.getLogger("reem").setLevel(logging.ERROR)  # it says that callbacks are behind
    kept: list[Any] = []
    last: list[Any] = [None]

    def see(data: Any, updated_path: str) -> None:
        if data is None:
            return
        last[0] = data["id"]
        count.add(place, "seen")
        count.add(place, "shared", in_slot(data["image"]))
        count.add(place, "torn", not is_whole_shot(data))
        if place % 2:
            kept.append(data)
            time.sleep(random.random() * 0.01)
            if len(kept) > 20:
                count.add(place, "torn", sum(not is_whole_shot(each) for each in kept))
                kept.clear()

    with reem.RedisInterface(url) as interface:
        mirror = reem.SilentSubscriber("cam", interface)
        mirror.listen()
        calls = reem.CallbackSubscriber("cam", interface, see)
        calls.listen()

        def look() -> None:
            """Look at the memory when no frame waits for the callback: up to a thousand may, as is due."""
            seen = None
            while seen != last[0]:
                seen = last[0]
                time.sleep(0.3)  # a callback takes a thirtieth of that at most
            kept.clear()
            costs.look()

        while (asked := end.recv()) != "end":
            if asked == "look" and not costs.begun:
                look()
            data = mirror.value()
            end.send((data["id"], is_whole_shot(data)) if data else (None, True))
            del data
        look()


class Result(NamedTuple):
    """What came out with a server.

    Attributes:
        count: What all have counted.
        killed: Parties.
        slowest: The most seconds until all mirrors had what the server has,
        slowest_early: and where the early publisher was killed, whose last update may be nowhere.
        descriptors: Left in the two that were not killed.
        grown: Megabytes more in one of them.
    """

    count: Count
    killed: int
    slowest: float
    slowest_early: float
    descriptors: int
    grown: float


def with_server(url: str, seed: int, rounds: int, say: Callable[[str], None]) -> Result:
    """Publish, kill and pause."""
    rng, count, slowest, kills = random.Random(seed), Count(), [0.0, 0.0], 0
    with reem.RedisInterface(url) as interface:
        kvs = reem.KeyValueStore(interface)
        reem.PublishSpace(interface)["cam"] = shot(rng, np.frombuffer(rng.randbytes(8 * LARGEST), np.uint8))
        publishers = [Party(lambda end, it=it: publish_through(end, url, it)) for it in MODES]
        mirrors = [Party(lambda end, it=it: mirror_through(end, url, PUBLISHERS + it, count)) for it in range(READERS)]
        mortal = publishers[:-1] + mirrors[:-1]
        for _ in range(rounds):
            for publisher in publishers:
                publisher.ask("go")
            early = False
            for _ in range(rng.randrange(1, 4)):
                time.sleep(rng.uniform(0.0, 0.3))
                victim = rng.choice(mortal)
                victim.kill()
                kills += 1
                early = early or victim is publishers[MODES.index("early")]
            time.sleep(rng.uniform(0.0, 0.3))
            assert {publisher.ask("pause") for publisher in publishers} == {"pause"}
            wanted, begun = kvs["cam"].read()["id"], time.monotonic()
            for party in mirrors:
                while (found := party.ask("what?")) != (wanted, True):
                    assert found[1], "a mirror has a torn frame"
                    assert time.monotonic() < begun + PATIENCE, "a mirror has something else than the server"
            slowest[early] = max(slowest[early], time.monotonic() - begun)
            for party in mirrors:  # behind the time taken: this waits for slow callbacks
                party.ask("look")
        for party in mortal:
            party.stop(signal.SIGKILL)
            party.end()
        lasting = [party.ask("end") for party in (mirrors[-1], publishers[-1])]
        assert [party.end() for party in (mirrors[-1], publishers[-1])] == [0, 0]
    result = Result(count, kills, *slowest, sum(it[0] for it in lasting), max(it[1] for it in lasting))
    say(
        f"{rounds} rounds, {count['seen']:,} updates seen, {count['shared']:,} of them in shared memory; "
        f"{kills} parties killed; {count['torn']} torn; all mirrors were equal to the server's within "
        f"{slowest[0]:.2f} s, {slowest[1]:.2f} where the early publisher was killed; "
        f"{result.descriptors} descriptors left and at most {result.grown:.1f} MB more in those that were not killed"
    )
    return result


def main() -> None:
    """Run both parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6))
    parser.add_argument(
        "--uses", type=int, default=1_000_000, help="times that a slot is written or looked into, without a server"
    )
    parser.add_argument("--rounds", type=int, default=60, help="with a server")
    parser.add_argument("--within", type=float, default=2.0, help="seconds for mirrors to have what the server has")
    options = parser.parse_args()
    if reason_against():
        sys.exit(f"no shared memory here: {reason_against()}")
    print(f"seed {options.seed}", flush=True)

    def say(line: str) -> None:
        print(line, flush=True)

    LocalReader()
    without_server(options.seed, options.uses, say)
    with EmbeddedServer() as server:
        result = with_server(server.url, options.seed, options.rounds, say)
    assert result.count["torn"] == 0
    assert result.count["shared"] > 0, "no frame went through shared memory"
    assert result.descriptors == 0
    slowest = result.slowest
    if slowest > options.within:
        sys.exit(f"a mirror was behind for more than {options.within:g} s; is the machine busy?")


if __name__ == "__main__":
    main()
