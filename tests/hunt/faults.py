"""What breaks calls off: interrupts, cancels, cut connections, forks, and signal handlers that close REEM."""

from __future__ import annotations

import os
import random
import select
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

from chaos.proxy import Proxy

from .clients import LIMIT, Asyncio, Blocking
from .model import Op


def interrupted(rng: random.Random, call: Callable[[], Any]) -> Any:
    """Make a call with Ctrl-C, which raises KeyboardInterrupt, some time after it began."""

    def stop() -> None:
        raise KeyboardInterrupt

    return handled(rng, call, stop)


def handled(rng: random.Random, call: Callable[[], Any], action: Callable[[], None]) -> Any:
    """Make a call, and take an action some time after it began, if it has not ended."""
    seconds = 10 ** rng.uniform(-5, -2.5)
    armed = [True]

    def ring(*_: Any) -> None:
        if armed[0]:
            armed[0] = False
            action()

    before = signal.signal(signal.SIGALRM, ring)
    try:
        try:
            signal.setitimer(signal.ITIMER_REAL, seconds)
            return call()
        finally:
            armed[0] = False
            signal.setitimer(signal.ITIMER_REAL, 0)
    finally:
        signal.signal(signal.SIGALRM, before)


def cut(rng: random.Random, proxy: Proxy, call: Callable[[], Any]) -> Any:
    """Make a call whose reply is lost, or whose connection is cut a moment after it began."""
    breaks = rng.choice([proxy.reset, proxy.half_close, None])
    timer = threading.Timer(10 ** rng.uniform(-5, -2.5), breaks or (lambda: None))
    if breaks is None:
        proxy.drop_reply(b"\r\n")
    timer.start()
    try:
        return call()
    finally:
        timer.join()
        proxy.heal()
        proxy.settled()


def cancelled(rng: random.Random, client: Asyncio, op: Op, published: bool) -> bool:
    if rng.random() < 0.6:
        return client.cancelled(op, published, rng.randrange(12), 0)
    return client.cancelled(op, published, 0, 10 ** rng.uniform(-5, -2.5))


def in_a_fork(client: Blocking, make: Callable[[Blocking], None], meanwhile: Callable[[], None]) -> str:
    """Call `make` in a forked child, and `meanwhile` here; returns what went wrong in the child."""
    reads, writes = os.pipe()
    child = os.fork()
    if not child:
        try:
            make(client)
            os.write(writes, b"done")
        except BaseException as error:
            os.write(writes, repr(error).encode()[:2000])
        finally:
            os._exit(0)
    os.close(writes)
    try:
        meanwhile()
        return _answer(child, reads)
    finally:
        os.close(reads)
        os.waitpid(child, 0)


def _answer(child: int, reads: int) -> str:
    deadline = time.monotonic() + LIMIT
    while not select.select([reads], [], [], 0.1)[0]:
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGABRT)
            return f"the child has not ended its call in {LIMIT} s"
    said = os.read(reads, 4000).decode(errors="replace")
    return "" if said == "done" else said or "the child ended without a word"
