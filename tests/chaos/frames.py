"""Rows 22 and 23: frames through shared memory, and programs that are stopped, greedy or hostile."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import orjson
import test_local_memory as memory

import reem
from reem_async.local.segment import HEAD, SLOTS, Segment, host, reason_against
from reem_async.plan.notices import Slot

from .programs import SIZE, shot
from .scoreboard import NotBuilt, Run, row
from .servers import PrivateServer
from .tools import order, program, quantile, said


def _needs_shared_memory() -> None:
    if reason_against():
        raise NotBuilt(f"no shared memory here: {reason_against()}")


# --- 22: stopped, greedy ---------------------------------------------------------------------------


class _Party:
    """A program, and what it says when it is asked."""

    def __init__(self, process: Any) -> None:
        self.process = process

    def ask(self, word: object = 0) -> dict[str, Any]:
        """Have it say how it is."""
        order(self.process, word)
        return said(self.process)

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> float:
        """Ask until the condition holds; returns the seconds that took."""
        begun = time.monotonic()
        while not condition(found := self.ask(10**9)):
            assert time.monotonic() < begun + 100, f"it does not come about: {found}"
            time.sleep(0.05)
        return time.monotonic() - begun


@row(
    22,
    "a reader that keeps 1,000 frames, one that is stopped (SIGSTOP)",
    "the newest is told <= 2 s, calls <= 3x, publisher's memory flat, kept frames whole",
)
def greedy(run: Run) -> None:
    """What they look into is not written; publisher and other readers go on, through the server if need be."""
    _needs_shared_memory()
    rate, count, keep = 100, run.size(500, 100), run.size(1000, 300)
    with PrivateServer() as server, contextlib.ExitStack() as stack:
        words = [("camera", rate), ("reader", 1), ("reader", keep), ("reader", 3)]
        started = [program(name, server.url, it) for name, it in words]
        camera, other, keeper, sleeper = (_Party(stack.enter_context(each)) for each in started)
        for party in (camera, other, keeper, sleeper):
            said(party.process)
        order(camera.process, "all are listening")
        other.until(lambda it: it["told"] >= 50)

        def phase() -> dict[str, Any]:
            """So many images more: what became of them."""
            start, before = camera.ask()["published"], other.ask()
            camera.until(lambda it: it["published"] >= start + count)
            made, seen = camera.ask(start), other.ask()
            late.append(other.until(lambda it: it["newest"] >= made["published"] - 1))
            told, shared = seen["told"] - before["told"], seen["shared"] - before["shared"]
            return made | {"told": told / (made["published"] - start), "shared": shared / max(1, told)}

        late: list[float] = []
        phases = {"before": phase()}
        keeper.until(lambda it: it["kept"] == keep)
        phases["beside a keeper"] = phase()
        sleeper.until(lambda it: it["kept"] == 3)
        os.kill(sleeper.process.pid, signal.SIGSTOP)
        phases["beside a stopped one"] = phase()
        os.kill(sleeper.process.pid, signal.SIGCONT)
        newest = camera.ask()["published"]
        awake = sleeper.until(lambda it: it["newest"] >= newest - 1)
        phases["after"] = phase()
        full, torn = keeper.ask(), sum(it.ask()["torn"] for it in (other, keeper, sleeper))
    for name, found in phases.items():
        run.at_least(f"of the frames told {name}", found["told"], 0.05)  # callbacks skip where the machine is busy
        if name != "beside a stopped one":  # there the keeper and the stopped one have three slots each: all
            run.at_least("of them in shared memory", found["shared"], 0.1)
        if name != "before":
            slower = quantile(found["calls"], 0.5) / quantile(phases["before"]["calls"], 0.5)
            run.at_most("x the median call before", slower, 3.0)
    run.at_most("s the longest call", max(call for found in phases.values() for call in found["calls"]), 1.1)
    run.at_most("s until the other had the newest", max(late), 2.0)
    run.at_least("frames kept", full["kept"], keep)
    run.at_most("of them views", full["views"], 3)
    run.at_most("s until the stopped one was right again", awake, 2.0)
    run.none("torn", torn)
    last = phases["after"]
    run.at_most("MB of shared memory", last["segments"], (SLOTS * (SIZE + 2 * HEAD) + HEAD) / 2**20)
    run.at_most("MB more memory of the publisher", last["memory"] - phases["before"]["memory"], 8)


# --- 23: hostile -----------------------------------------------------------------------------------


class _Forger:
    """Makes notices that name what is no segment, is another one, or is not there."""

    def __init__(self, folder: Path, victim: int) -> None:
        self._folder = folder
        self._victim = victim
        self._numbers = itertools.count(1)

    def notice(self, slot: Slot, text: int = 2, parts: list[Any] | None = None) -> bytes:
        """A notice that says that an update is in a slot."""
        body = [[*slot, text], *([["numpy", ".image", SIZE + 128]] if parts is None else parts)]
        return orjson.dumps([1, "evil", next(self._numbers), time.time(), [], "look", SIZE, body]) + b"\n"

    def opened(self, descriptor: int) -> bytes:
        """A notice of a descriptor of this process."""
        return self.notice(Slot(host(), os.getpid(), descriptor, os.fstat(descriptor).st_ino, 0, 7))

    def all(self, true: bytes) -> Iterator[tuple[str, bytes]]:
        """Every forgery, and what it is; those of an honest notice with a word changed come last."""
        for number, (what, make) in enumerate(memory.OPENED.items()):
            folder = self._folder / str(number)
            folder.mkdir()
            with _closed(make(folder)) as descriptor:
                yield what, self.opened(descriptor)
        for what, make in (("fifo", _fifo), ("device", _device), ("file", _file)):
            with contextlib.suppress(PermissionError), _closed(_named_as_memory(make)) as descriptor:
                yield f"a {what} of the right name", self.opened(descriptor)
        yield from self._reused()
        yield from self._sparse()
        for descriptor in range(30):
            with contextlib.suppress(OSError):
                inode = os.stat(f"/proc/{self._victim}/fd/{descriptor}").st_ino
                slot = Slot(host(), self._victim, descriptor, inode, 0, 7)
                yield f"its own descriptor {descriptor}", self.notice(slot)
        yield from self._changed(true)

    def _reused(self) -> Iterator[tuple[str, bytes]]:
        """A segment that was there a moment ago, in whose place there is something else."""
        for what, make in (("a fifo", _fifo), ("a segment", None)):
            segment = Segment(SIZE)
            number, stamp = segment.put([b"{}"], [2]) or (0, 0)
            descriptor = os.dup(segment.descriptor)
            slot = Slot(host(), os.getpid(), descriptor, segment.inode, number, stamp)
            yield f"a descriptor before it is {what}", self.notice(slot, 2, [])
            other = Segment(SIZE) if make is None else None
            os.dup2(other.descriptor if other else make(self._folder / "reused"), descriptor)
            with _closed(descriptor):
                yield f"a descriptor that is {what} now", self.notice(slot, 2, [])

    def _sparse(self) -> Iterator[tuple[str, bytes]]:
        """A segment of 15 GB of nothing: who copies it has no memory left."""
        room = 15 << 30
        with _closed(memory.sealed(memory.identity(1, room), size=HEAD + room, sparse=True)) as descriptor:
            slot = Slot(host(), os.getpid(), descriptor, os.fstat(descriptor).st_ino, 0, 7)
            yield "a text of 15 GB", self.notice(slot, room, [])
            yield "an array of 14 GB", self.notice(slot, 2, [["numpy", ".image", 14 << 30]])
            yield "bytes of 14 GB", self.notice(slot, 2, [["bytes", ".image", 14 << 30]])

    def _changed(self, true: bytes) -> Iterator[tuple[str, bytes]]:
        fields = orjson.loads(true)
        names = (*Slot._fields, "size of the text")
        for place, name in enumerate(names):
            for wrong in ("x", None, 0, 1, 5, 63, 2**22, 2**31, 2**52, -1, 1.5, [], {}):
                words = [*fields[-1][0]]
                words[place] = wrong
                changed = [*fields[:1], "evil", next(self._numbers), *fields[3:-1], [words, *fields[-1][1:]]]
                yield f"{name} {wrong!r}", orjson.dumps(changed) + b"\n"
        for wrong in (0, 1, 2**31, 2**52, -1, "x", None):
            parts = [fields[-1][0], [*fields[-1][1][:2], wrong]]
            changed = [*fields[:1], "evil", next(self._numbers), *fields[3:-1], parts]
            yield f"size of the array {wrong!r}", orjson.dumps(changed) + b"\n"


@contextlib.contextmanager
def _closed(descriptor: int) -> Iterator[int]:
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _fifo(path: Path) -> int:
    """A FIFO that nobody has open for writing: to open it is to wait for that."""
    os.mkfifo(path)
    return os.open(path, os.O_PATH)


def _device(path: Path) -> int:
    os.mknod(path, stat.S_IFCHR | 0o600, os.makedev(1, 5))  # /dev/zero
    return os.open(path, os.O_PATH)


def _file(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT)


def _named_as_memory(make: Callable[[Path], int]) -> int:
    """Something whose name is that of REEM's memory; for a moment it is in the root folder, where that can be made."""
    path = Path("/memfd:reem")
    try:
        return make(path)
    finally:
        path.unlink(missing_ok=True)


@row(
    23,
    "hostile notices: FIFO, device, /dev/zero, huge, wrong pid, reused fd",
    "a fallback: the next update right <= 2 s in every way of hearing, memory and descriptors flat, nothing hangs",
)
def forged(run: Run) -> None:
    """Each by the channel of notices and by that of early ones, and an honest update after each."""
    _needs_shared_memory()
    took: list[float] = []
    wrong: list[Any] = []
    looks: list[dict[str, Any]] = []
    with (
        PrivateServer() as server,
        server.raw() as raw,
        tempfile.TemporaryDirectory() as folder,
        contextlib.closing(reem.RedisInterface(server.url)) as interface,
        raw.pubsub() as heard,
    ):
        space, numbers = reem.PublishSpace(interface), itertools.count(1)
        space["cam"] = {"n": 0, "image": 0, "sum": 0}
        with program("victims", server.url) as process:
            victim = said(process)["pid"]

            def honest(what: str) -> None:
                number = next(numbers)
                space["cam"] = shot(number)
                order(process, number)
                look = said(process)
                looks.append(look)
                took.append(float("inf") if look["took"] is None else look["took"])
                wrong.extend((what, each) for each in look["wrong"])

            for _ in range(20):
                honest("nothing forged")
            heard.subscribe("{cam}:notices")
            true = b""
            space["cam"] = shot(0)
            while not true.startswith(b"["):
                message = heard.get_message(timeout=10)
                assert message, "no notice"
                true = str(message["data"]).encode()
            forgeries, channels = 0, ["{cam}:notices", f"{{cam}}:notices@{host()}"]
            for what, notice in _Forger(Path(folder), victim).all(true):
                for channel in run.size(channels, [run.rng.choice(channels)]):
                    raw.publish(channel, notice)
                    honest(what)
                    forgeries += 1
            for _ in range(20):
                honest("nothing forged any more")
    run.at_least("forgeries", forgeries, run.size(250, 120))
    run.at_most("s the longest until all had the next update", max(took), 2.0)
    run.none("torn or wrong", wrong)
    run.at_least("of the last 20 in shared memory in every way", sum(it["shared"] == 3 for it in looks[-20:]), 10)
    start, end = looks[19], looks[-1]
    run.at_most("more descriptors", end["descriptors"][0] - start["descriptors"][0], 1)
    # Of segments that strangers have named, up to 64 in each of two interfaces, until they are idle for ten seconds.
    run.at_most("descriptors of shared memory", max(it["descriptors"][1] for it in looks), 260)
    run.at_most("MB more memory", max(it["memory"] for it in looks) - start["memory"], 30)
