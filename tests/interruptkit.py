"""Signals at random instants in every blocking call: handlers that raise, as Ctrl-C does, and that close the interface.

python tests/interruptkit.py [--seed N] [--seconds N] [--mode raise|close|mixed] [--calls NAME,NAME] [--url URL]

What must hold: each call ends, with what it is for, or with what the handler did to it; calls of other threads go on;
no reply meets another call; nothing crashes. A call that has not ended in 15 s is shown with the stacks of all
threads. Without a URL it runs against an embedded server.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import gc
import logging
import os
import random
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from slotkit import in_slot

import reem
from reem import recording, snapshots
from reem.errors import Conflict, InterfaceClosed, PartialWrite
from reem.server import EmbeddedServer
from reem_async.local.host import reason_against
from reem_async.local.reader import LocalReader
from reem_async.local.segment import SLOTS
from reem_async.plan.notices import Slot

STUCK = 15.0
"""Seconds after which a call has not ended: all limits of the calls below are far shorter."""
ARRAY = np.arange(20_000, dtype=float)


class Work:
    """The calls, each on an interface that may be closed under it. Values name their key: a crossed reply shows."""

    def __init__(self, host, prefix, folder):
        self.host, self.prefix, self.folder, self.number = host, prefix, Path(folder), 0
        self.renew()

    def renew(self):
        """Make a new interface, with what the calls find there."""
        self.interface = reem.RedisInterface(self.host, namespace=self.prefix)
        self.kvs, self.pspace = reem.KeyValueStore(self.interface), reem.PublishSpace(self.interface)

    def prepare(self):
        """Write what the calls read."""
        self.kvs["big"] = {"name": "big", "image": ARRAY}
        for name in "abc":
            self.kvs[name] = {"name": name, "n": 0, "list": []}

    def name(self):
        return random.choice("abc")

    def check(self, name, value):
        assert value["name"] == name, f"{name}: read {value!r:.100}"

    def read(self):
        name = self.name()
        self.check(name, self.kvs[name].read())

    def read_array(self):
        value = self.kvs["big"].read()
        self.check("big", value)
        assert value["image"].size == ARRAY.size

    def write(self):
        name = self.name()
        self.kvs[name] = {"name": name, "n": 1, "list": []}

    def write_array(self):
        self.kvs["big"] = {"name": "big", "image": ARRAY}

    def publish(self):
        name = self.name()
        self.pspace[name] = {"name": name, "n": 2, "list": []}

    def publish_array(self):
        self.pspace["big"] = {"name": "big", "image": ARRAY}

    def calculate(self):
        assert self.kvs[self.name()]["n"].increment(1) > 0

    def append(self):
        self.kvs[self.name()]["list"].append(1)

    def length(self):
        assert self.kvs[self.name()].length() == 3

    def edit(self):
        with contextlib.suppress(Conflict), self.kvs[self.name()].edit() as value:
            value["n"] = 3

    def keys(self):
        assert set(self.kvs.keys()) <= {"a", "b", "c", "big"}

    def initialize(self):
        self.interface.initialize()

    def state(self):
        assert next(self.interface.states()).state in ("idle", "connected", "lost", "reconnecting", "closed")

    def watch(self):
        watch = self.kvs[self.name()].watch()
        watch.listen()
        watch.close()

    def loop(self):
        name = self.name()
        for update in self.kvs[name].watch():
            self.check(name, update.data)
            break

    def mirror(self):
        name = self.name()
        with reem.SilentSubscriber(name, self.interface) as mirror:
            self.check(name, mirror.value())

    def callback(self):
        with reem.CallbackSubscriber(self.name(), self.interface, lambda *_: None):
            pass

    def first_use(self):
        interface = reem.RedisInterface(self.host, namespace=self.prefix)
        try:
            reem.KeyValueStore(interface)["a"].read()
            reem.KeyValueStore(interface)["a"].watch().listen()
        finally:
            interface.close()

    def record(self):
        self.number += 1
        path = self.folder / f"{self.number}.mcap"
        with recording.Recorder(self.interface, ["a"], path):
            pass

    def snapshot(self):
        self.number += 1
        path = self.folder / f"{self.number}.zip"
        snapshots.save(self.interface, path)
        snapshots.restore(self.interface, path, replace=True)


CALLS = [name for name in vars(Work) if name not in ("renew", "prepare", "name", "check") and name[0] != "_"]
SLOW = ("record", "snapshot")
QUICK = ("read", "write", "publish", "publish_array", "watch", "mirror", "state", "calculate", "append")


class Witness:
    """A program near by that looks at the arrays in shared memory, and is not interrupted."""

    def __init__(self, host, prefix):
        self.interface = reem.RedisInterface(host, namespace=prefix)
        self.mirror = reem.CallbackSubscriber("big", self.interface, self.see)
        self.mirror.listen()
        self.shared, self.problems = 0, []

    def see(self, data, updated_path):
        if data is None:
            return
        self.shared += in_slot(data["image"])
        if data["name"] != "big" or not np.array_equal(data["image"], ARRAY):
            self.problems.append(f"heard {data!r:.100}")

    def look_at_locks(self, work):
        """Nobody looks at any slot any more: each can be written, and is free when it was looked at."""
        until = time.monotonic() + STUCK
        while not self.shared and time.monotonic() < until:  # a short run on a busy machine
            work.publish_array()
        work.publish_array()
        self.interface.close()
        self.mirror = None  # it has the last one
        gc.collect()
        for segment in work.interface._direct.session.local._segments.values():
            for _ in range(2):
                views = []
                for _ in range(SLOTS):
                    where = segment.put([b"x"], [1]) or (0, 0)
                    slot = Slot("", os.getpid(), segment.descriptor, segment.inode, *where)
                    views.append(LocalReader().view(slot, 1))
                if None in views:
                    self.problems.append(f"of {SLOTS} slots {views.count(None)} cannot be written, or read")
                del views
        if not self.shared:
            self.problems.append("nothing has gone through shared memory")


class Stress:
    """One run. `hits` counts the signals that came during a call, by call and mode."""

    def __init__(self, work, mode, calls, seed):
        self.work, self.calls = work, calls
        self.modes = ["raise", "close"] if mode == "mixed" else [mode]
        self.random = random.Random(seed)
        self.armed = ""
        self.hits, self.problems = Counter(), []
        self.durations = {}
        signal.signal(signal.SIGALRM, self.ring)

    def ring(self, *_):
        mode, self.armed = self.armed, ""
        if mode:
            self.hits[self.call, mode] += 1
        if mode == "raise":
            raise KeyboardInterrupt
        if mode == "close":
            self.work.interface.close()

    def step(self):
        self.call, mode = self.random.choice(self.calls), self.random.choice(self.modes)
        if self.call in SLOW and self.random.random() < 0.9:
            return
        usual = self.durations.get(self.call, 0.003)
        began = time.monotonic()
        try:
            try:
                self.armed = mode
                signal.setitimer(signal.ITIMER_REAL, max(self.random.uniform(0, 1.2) * usual, 1e-6))
                getattr(self.work, self.call)()
            finally:
                self.armed = ""
                signal.setitimer(signal.ITIMER_REAL, 0)
            self.durations[self.call] = 0.8 * usual + 0.2 * min(time.monotonic() - began, 0.1)
        except KeyboardInterrupt:
            pass
        except BaseException as error:
            # A restore is no one write: it says what it had written.
            if not (mode == "close" and isinstance(error, InterfaceClosed | PartialWrite)):
                self.problems.append(f"{self.call}, {mode}: {error!r}")
        if mode == "close":
            self.work.interface.close()
            self.work.renew()

    def probe(self):
        """Do all that takes a lock of the interface on another thread: what was broken off must not keep it."""
        problems = []

        def all_of_them():
            try:
                for name in (*QUICK, "initialize", "callback"):
                    getattr(self.work, name)()
            except BaseException as error:
                problems.append(f"on another thread: {error!r}")

        thread = threading.Thread(target=all_of_them, daemon=True)
        thread.start()
        thread.join()  # the alarm of faulthandler shows where it stands
        self.problems += problems

    def run(self, seconds):
        until, steps = time.monotonic() + seconds, 0
        while time.monotonic() < until and not self.problems:
            faulthandler.dump_traceback_later(STUCK, exit=True)
            self.step()
            steps += 1
            if steps % 25 == 0:
                self.probe()
        faulthandler.cancel_dump_traceback_later()
        return steps


def main():
    """Run, print what came of it, and return whether nothing was wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--mode", choices=("raise", "close", "mixed"), default="mixed")
    parser.add_argument("--calls", default=",".join(CALLS))
    parser.add_argument("--url")
    parser.add_argument("--prefix", default="interrupts:")
    given = parser.parse_args()
    random.seed(given.seed)
    warnings.filterwarnings("ignore", "coroutine .* was never awaited")  # interrupted before its first step
    sys.unraisablehook = lambda it: None  # an interrupt in a finalizer: Python can only tell of it
    logging.disable(logging.WARNING)  # a mirror whose connection the run closes says so
    with contextlib.ExitStack() as stack:
        host = given.url or stack.enter_context(EmbeddedServer())
        folder = stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        work = Work(host, given.prefix, folder)
        work.prepare()
        witness = Witness(host, given.prefix)
        stress = Stress(work, given.mode, given.calls.split(","), given.seed)
        steps = stress.run(given.seconds)
        if not reason_against():
            witness.look_at_locks(work)
        stress.problems += witness.problems
        work.interface.close()
        gc.collect()
    print(f"seed {given.seed}: {steps} calls, {sum(stress.hits.values())} signals while one was under way")
    print(f"{witness.shared} arrays were seen in shared memory by another interface")
    for name in given.calls.split(","):
        print(f"  {name:15}", *(f"{mode} {stress.hits[name, mode]:6}" for mode in stress.modes))
    print(*stress.problems, sep="\n")
    return not stress.problems


if __name__ == "__main__":
    sys.exit(0 if main() else 1)
