"""Rows 4 and 5: nothing torn, nothing left over, with the harness of tests/test_atomic.py."""

from __future__ import annotations

import contextlib
import threading
from typing import Any

import numpy as np
import test_atomic
from conftest import assert_no_orphans, assert_same, keys_of
from test_atomic import Crew

import reem

from .scoreboard import Run, row
from .servers import PrivateServer

TOP = "frame"


def _stores(stack: contextlib.ExitStack, url: str, count: int) -> list[reem.KeyValueStore]:
    """Stores, each on an interface of its own: as many programs, as far as the server can tell."""
    opened = [stack.enter_context(contextlib.closing(reem.RedisInterface(url))) for _ in range(count)]
    return [reem.KeyValueStore(interface) for interface in opened]


def _frame(stamp: int) -> dict[str, Any]:
    """A camera's image whose every pixel is the stamp beside it."""
    return {"stamp": stamp, "image": np.full((480, 640), stamp, np.uint32)}


@row(4, "640x480 image + stamp, 2 writers, 4 readers", "0 torn in >= 20,000 reads")
def torn(run: Run) -> None:
    """Both writers replace both parts, at the root or below it; the readers read the whole, or both parts' parent."""
    reads = run.size(20_000, 1_500)
    lock, done, broken, written = threading.Lock(), [0], [], [0, 0]
    with PrivateServer() as server, contextlib.ExitStack() as stack:
        stores = _stores(stack, server.url, 6)
        stores[0][TOP] = {"now": _frame(0)}

        def write(me: int) -> None:
            for stamp in range(1 + me, 10**9, 2):
                if crew.over.is_set():
                    return
                if stamp % 5:
                    stores[me][TOP]["now"] = _frame(stamp)
                else:
                    stores[me][TOP] = {"now": _frame(stamp)}
                written[me] += 1

        def read(me: int) -> None:
            for number in range(reads // 4 + 1):
                value = stores[me][TOP]["now"].read() if number % 3 else stores[me][TOP].read()["now"]
                image = value["image"]
                if not value["stamp"] == image.min() == image.max():
                    broken.append((value["stamp"], int(image.min()), int(image.max())))
                with lock:
                    done[0] += 1

        with Crew() as crew:
            crew.start(write, 0)
            crew.start(write, 1)
            with Crew() as readers:
                for me in range(2, 6):
                    readers.start(read, me)
    run.at_least("reads", done[0], reads)
    run.at_least("writes of each writer", min(written), reads // 50)
    run.none("torn", broken)


@row(5, "8 writers that change shapes: array, dict, list, scalar", "every own entry as last written, 0 orphans")
def shapes(run: Run) -> None:
    """Each of 2,000 steps changes a shared entry and an own one; `foo` and `foobar` lie side by side."""
    test_atomic.CHANGES = steps = run.size(2000, 80)
    expected: dict[str, dict[str, Any]] = {"foo": {}, "foobar": {}}
    refused: list[int] = []
    with PrivateServer() as server, server.raw() as raw, contextlib.ExitStack() as stack:
        stores = _stores(stack, server.url, 8)
        for top in expected:
            stores[0][top] = {"shared": 0, "list": []}
        seeds = [run.rng.getrandbits(64) for _ in stores]

        def work(me: int) -> None:
            import random

            top = "foo" if me % 4 else "foobar"
            mine, last = test_atomic._change_shapes(stores[me], top, me, random.Random(seeds[me]), refused)
            expected[top][mine] = last

        with Crew() as crew:
            for me in range(8):
                crew.start(work, me)
        wrong, orphans = [], []
        for top, entries in expected.items():
            value = stores[0][top].read()
            for name, entry in entries.items():
                try:
                    assert_same(value[name], entry, f"{top}.{name}")
                except AssertionError as error:
                    wrong.append(str(error))
            for check in (lambda top=top: assert_no_orphans(raw, top), lambda top=top: _empties(stores[0], raw, top)):
                try:
                    check()
                except AssertionError as error:
                    orphans.append(str(error))
    run.at_least("steps", 8 * steps, 8 * steps)
    run.at_most("of them refused, as they must be", len(refused), 4 * steps)
    run.none("entries not as last written", wrong)
    run.none("orphans", orphans)


def _empties(kvs: reem.KeyValueStore, raw: Any, top: str) -> None:
    """Deleting the key leaves nothing of it."""
    del kvs[top]
    left = keys_of(raw, top)
    assert not left, f"left of {top}: {left}"
