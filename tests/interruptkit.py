"""Signals at random instants in every blocking call: handlers that raise, as Ctrl-C does, and that close the interface.

python tests/interruptkit.py [--seed N] [--seconds N] [--mode raise|close] [--url URL]

What must hold: each call ends, with its result or with what the handler did to it; calls of other threads go on;
no reply reaches another call; nothing crashes. A call that has not ended in 15 s is shown with the stacks of all
threads. Without a URL it runs against an embedded server.
"""

import argparse
import contextlib
import faulthandler
import gc
import logging
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

import reem
from reem import recording, snapshots
from reem.errors import Conflict, InterfaceClosed, PartialWrite
from reem.server import EmbeddedServer

STUCK = 15.0
"""Seconds after which a call has not ended: all limits of the calls below are far shorter."""
NAMES = "a", "b", "c", "big"


def document(name, n=0):
    """A value that names its key, so that a reply that reaches another call shows."""
    return {"name": name, "n": n, "list": []} | ({"image": np.arange(20_000, dtype=float)} if name == "big" else {})


def check(name, value):
    assert value["name"] == name, f"{name}: read {value!r:.100}"
    assert name != "big" or value["image"].size == 20_000


class Work:
    """An interface that may be closed under its calls."""

    def __init__(self, host, prefix, folder):
        self.host, self.prefix, self.folder, self.number = host, prefix, Path(folder), 0
        self.renew()

    def renew(self):
        self.interface = reem.RedisInterface(self.host, namespace=self.prefix)
        self.kvs, self.pspace = reem.KeyValueStore(self.interface), reem.PublishSpace(self.interface)

    def file(self, suffix):
        self.number += 1
        return self.folder / f"{self.number}{suffix}"


def edit(work, name):
    with contextlib.suppress(Conflict), work.kvs[name].edit() as value:
        value["n"] = 3


def watch(work, name):
    loop = work.kvs[name].watch()
    loop.listen()
    loop.close()


def loop(work, name):
    for update in work.kvs[name].watch():
        check(name, update.data)
        break


def mirror(work, name):
    with reem.SilentSubscriber(name, work.interface) as following:
        check(name, following.value())


def callback(work, name):
    with reem.CallbackSubscriber(name, work.interface, lambda *_: None):
        pass


def first_use(work, name):
    interface = reem.RedisInterface(work.host, namespace=work.prefix)
    try:
        reem.KeyValueStore(interface)[name].read()
        reem.KeyValueStore(interface)[name].watch().listen()
    finally:
        interface.close()


def record(work, name):
    with recording.Recorder(work.interface, [name], work.file(".mcap")):
        pass


def snapshot(work, name):
    path = work.file(".zip")
    snapshots.save(work.interface, path)
    snapshots.restore(work.interface, path, replace=True)


CALLS = {
    "read": lambda work, name: check(name, work.kvs[name].read()),
    "write": lambda work, name: work.kvs.set(name, document(name, 1)),
    "publish": lambda work, name: work.pspace.set(name, document(name, 2)),
    "calculate": lambda work, name: work.kvs[name]["n"].increment(1),
    "append": lambda work, name: work.kvs[name]["list"].append(1),
    "length": lambda work, name: work.kvs[name].length(),
    "keys": lambda work, name: work.kvs.keys(),
    "initialize": lambda work, name: work.interface.initialize(),
    "state": lambda work, name: next(work.interface.states()),
    **{call.__name__: call for call in (edit, watch, loop, mirror, callback, first_use, record, snapshot)},
}
SLOW = ("record", "snapshot")


class Stress:
    """One run. `hits` counts the signals that came during each call."""

    def __init__(self, work, mode, seed):
        self.work, self.mode, self.random = work, mode, random.Random(seed)
        self.armed = False
        self.hits, self.problems = Counter(), []
        self.durations = {}
        signal.signal(signal.SIGALRM, self.ring)

    def ring(self, *_):
        if not self.armed:
            return
        self.armed = False
        self.hits[self.call] += 1
        if self.mode == "raise":
            raise KeyboardInterrupt
        self.work.interface.close()

    def step(self):
        self.call, name = self.random.choice([*CALLS]), self.random.choice(NAMES)
        if self.call in SLOW and self.random.random() < 0.9:
            return
        usual = self.durations.get(self.call, 0.003)
        began = time.monotonic()
        try:
            try:
                self.armed = True
                signal.setitimer(signal.ITIMER_REAL, max(self.random.uniform(0, 1.2) * usual, 1e-6))
                CALLS[self.call](self.work, name)
            finally:
                self.armed = False
                signal.setitimer(signal.ITIMER_REAL, 0)
            self.durations[self.call] = 0.8 * usual + 0.2 * min(time.monotonic() - began, 0.1)
        except KeyboardInterrupt:
            pass
        except BaseException as error:
            # A restore is no one write: it says what it had written.
            if not (self.mode == "close" and isinstance(error, InterfaceClosed | PartialWrite)):
                self.problems.append(f"{self.call}: {error!r}")
        if self.mode == "close":
            self.work.interface.close()
            self.work.renew()

    def probe(self):
        """Do all that takes a lock of the interface on another thread: what was broken off must not keep it."""

        def all_of_them():
            try:
                for call in CALLS:
                    if call not in SLOW:
                        CALLS[call](self.work, "big")
            except BaseException as error:
                self.problems.append(f"on another thread: {error!r}")

        thread = threading.Thread(target=all_of_them, daemon=True)
        thread.start()
        thread.join()  # the alarm of faulthandler shows where it stands

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
    parser.add_argument("--mode", choices=("raise", "close"), default="raise")
    parser.add_argument("--url")
    parser.add_argument("--prefix", default="interrupts:")
    given = parser.parse_args()
    warnings.filterwarnings("ignore", "coroutine .* was never awaited")  # interrupted before its first step
    sys.unraisablehook = lambda it: None  # an interrupt in a finalizer: Python can only tell of it
    logging.disable(logging.WARNING)  # a mirror whose connection the run closes says so
    with contextlib.ExitStack() as stack:
        host = given.url or stack.enter_context(EmbeddedServer())
        work = Work(host, given.prefix, stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        for name in NAMES:
            work.kvs[name] = document(name)
        stress = Stress(work, given.mode, given.seed)
        steps = stress.run(given.seconds)
        work.interface.close()
        gc.collect()
    print(f"seed {given.seed}: {steps} calls, {sum(stress.hits.values())} signals while one was under way")
    print(*(f"  {name:15} {stress.hits[name]:6}" for name in CALLS), *stress.problems, sep="\n")
    return not stress.problems


if __name__ == "__main__":
    sys.exit(0 if main() else 1)
