"""Programs for test_local_processes.py, which compares what they say: `python tests/localkit.py NAME URL KEY ...`."""

import asyncio
import gc
import os
import signal
import sys
import threading
import time

import numpy as np
from slotkit import in_slot

import reem
from reem_async.local import LocalPath, Slot, segment  # users without rights cannot import them later
from reem_async.store import publish

PATIENCE = 30.0


def until(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "it does not come about"
        time.sleep(0.001)


def frame(n, items=30_000):
    return {"n": n, "image": np.full(items, float(n))}


def is_whole(data):
    return bool((data["image"] == data["n"]).all())


def say(*words):
    print(*words, flush=True)


class Pair:
    """A publisher and a reader, with an interface each."""

    def __init__(self, url, key):
        self.interfaces = reem.RedisInterface(url), reem.RedisInterface(url)
        self.space, self.key = reem.PublishSpace(self.interfaces[0]), key
        self.mirror = reem.SilentSubscriber(key, self.interfaces[1])
        self.mirror.listen()

    def publish(self, n):
        self.space[self.key] = frame(n)
        return self.heard(n)

    def heard(self, n):
        until(lambda: (self.mirror.value() or {"n": None})["n"] == n)
        found = self.mirror.value()
        assert is_whole(found)
        return found

    def go_round(self, first):
        """Publish so many that each slot that is free is written twice."""
        for n in range(first, first + 2 * segment.SLOTS):
            self.publish(n)


def forked(work):
    """Do something in a child; returns what waits for its end, and says whether all was well there."""
    here, there = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.close(here)
            work(there)
        except BaseException as error:
            say("child:", repr(error))
            os._exit(1)
        os._exit(0)
    os.close(there)

    def wait():
        _, status = os.waitpid(pid, 0)
        os.close(here)
        return os.waitstatus_to_exitcode(status)

    return here, wait


def fork_reader(url, key):
    """A child lets go of what its parent looks at, and of all else; then one keeps what its parent has let go of."""
    pair = Pair(url, key)
    kept = [pair.publish(0)]
    assert in_slot(kept[0]["image"])

    def let_go(there):
        kept.clear()
        pair.mirror = None
        gc.collect()
        os.write(there, b"!")

    here, wait = forked(let_go)
    assert os.read(here, 1) == b"!"
    pair.go_round(1)
    assert wait() == 0
    pair.go_round(100)
    say("kept by the parent:", is_whole(kept[0]))

    go, told = os.pipe()

    def keep(there):
        os.close(told)
        os.write(there, b"!")
        os.read(go, 1)  # its parent has let go, and all slots were written
        assert is_whole(kept[0])

    here, wait = forked(keep)
    assert os.read(here, 1) == b"!"
    kept.clear()
    pair.go_round(200)
    os.write(told, b"!")
    say("kept by the child:", wait() == 0)


def fork_publisher(url, key):
    """A child publishes and follows by what it has inherited."""
    pair = Pair(url, key)
    kept = pair.publish(0)
    segments = pair.interfaces[0]._direct.session.local._segments
    inodes = [each.inode for each in segments.values()]

    def use(there):
        own = reem.SilentSubscriber(key, pair.interfaces[1])
        own.listen()
        pair.mirror = own
        shared = 0
        for n in range(100, 100 + 3 * segment.SLOTS):
            shared += in_slot(pair.publish(n)["image"])
        mine = [each.inode for each in pair.interfaces[0]._direct.session.local._segments.values()]
        assert shared, "what a child publishes is in shared memory"
        assert not set(mine) & set(inodes), "it is in its parent's"

    _, wait = forked(use)
    say("child:", wait() == 0)
    pair.heard(100 + 3 * segment.SLOTS - 1)
    say("kept:", in_slot(kept["image"]), is_whole(kept))
    say("parent:", in_slot(pair.publish(1)["image"]), is_whole(pair.mirror.value()))


KEPT = []
"""What is alive until the interpreter clears its modules."""


def exit_keeping(url, key):
    """Frames, a cycle that refers to one, and nothing is closed."""
    pair = Pair(url, key)
    KEPT.extend([pair, *(pair.publish(n) for n in range(5))])
    cycle = [KEPT[-1]]
    cycle.append(cycle)
    say(in_slot(KEPT[1]["image"]))  # the last ones are copies


def exit_in_thread(url, key):
    """A daemon thread looks at frames until there is no interpreter any more, and another one publishes."""
    pair, seen = Pair(url, key), threading.Event()

    def look():
        while True:
            value = pair.mirror.value()
            if value is not None and in_slot(value["image"]):
                seen.set()
                value["image"].sum()

    def make():
        n = 0
        while True:
            n += 1
            pair.space[key] = frame(n)

    for work in (look, make):
        threading.Thread(target=work, daemon=True).start()
    say(seen.wait(PATIENCE))


EXITS = [name for name in dict(globals()) if name.startswith("exit_")]


def another_user(url, key, user):
    """Follow as somebody else, with a look at where the memory is."""
    with reem.RedisInterface(url) as interface:  # what is imported late is where root alone may look
        reem.SilentSubscriber(key, interface).listen()
    os.setgroups([])
    os.setgid(int(user))
    os.setuid(int(user))
    with reem.RedisInterface(url) as interface:
        mirror = reem.SilentSubscriber(key, interface)
        mirror.listen()
        say("ready")
        until(lambda: mirror.value() is not None and mirror.value()["n"] == 1)
        say(in_slot(mirror.value()["image"]), is_whole(mirror.value()))
        process, descriptor, inode, number, stamp = map(int, sys.stdin.readline().split())
        slot = Slot(segment.host(), process, descriptor, inode, number, stamp)
        say(interface._followers.session.local.reader.view(slot, 1))
        try:
            os.close(os.open(f"/proc/{process}/fd/{descriptor}", os.O_RDONLY))
        except PermissionError:
            say("refused")


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def killing(owner, name, before=False):
    """Have a function end this process: when it is called, or when it is done."""
    original = getattr(owner, name)

    def ended(*words):
        if not before:
            original(*words)
        die()

    async def ended_later(*words):
        await original(*words)
        if words[-1] != b"":  # that only asks who listens
            die()

    setattr(owner, name, ended_later if asyncio.iscoroutinefunction(original) else ended)


class Numpy:
    """numpy, but for the second piece of an update: then the first one is in the slot."""

    uint8 = np.uint8

    def __init__(self):
        self.calls = 0

    def frombuffer(self, *words):
        self.calls += 1
        if self.calls == 3:  # the text, the array's header, the array
            die()
        return np.frombuffer(*words)


STEPS = {
    "before it is put into a slot": lambda: killing(LocalPath, "put", before=True),
    "before there is memory": lambda: killing(segment.os, "memfd_create", before=True),
    "memory without seals": lambda: killing(segment.os, "posix_fallocate"),
    "memory with seals and nothing in it": lambda: killing(segment.fcntl, "fcntl"),
    "a slot is locked": lambda: killing(segment, "lock_for_writing"),
    "in the middle of writing": lambda: setattr(segment, "np", Numpy()),
    "written and locked": lambda: killing(segment.Segment, "_write"),
    "in the slot": lambda: killing(LocalPath, "put"),
    "told early, not stored": lambda: killing(publish.ValueAnnouncement, "_notify_early"),
    "not stored": lambda: killing(publish.ValueAnnouncement, "share"),
    "stored": lambda: None,
}
"""Where a publisher ends; of its memory each publisher makes an own one."""


def killed_at(url, key, mode):
    """Have children publish, and end at the step that is said."""
    assert segment.host()  # what is tried for that is none of the steps
    for line in sys.stdin:
        step = line.strip()
        pid = os.fork()
        if pid == 0:
            interface = reem.RedisInterface(url, local=mode)
            space = reem.PublishSpace(interface)
            if "memory" not in step:
                space[key] = frame(1)
            STEPS[step]()
            space[key] = frame(2)
            die()
        _, status = os.waitpid(pid, 0)
        say(pid, os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
