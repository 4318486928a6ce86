"""One publisher in a process of its own: `python -m tests.rates.writer URL STREAM SEED SECONDS FILE`."""

from __future__ import annotations

import random
import sys
import time
from typing import Any

import numpy as np

from reem import PublishSpace, RedisInterface

from .streams import STREAMS, Op

__all__ = ["call"]


def call(space: PublishSpace, name: str, op: Op) -> None:
    handle: Any = space[name]
    for key in op.path:
        handle = handle[key]
    if op.kind == "set":
        handle.write(op.value)
    elif op.kind == "delete":
        handle.delete()
    elif op.kind == "append":
        handle.append(op.value)
    else:
        handle += op.value


def main() -> None:
    url, name, seed, seconds, file = sys.argv[1:]
    stream, times = STREAMS[name], []
    with RedisInterface(url, timeout=30) as interface:
        space, begin = PublishSpace(interface), time.monotonic()
        for number, ops in enumerate(stream.ops(random.Random(int(seed)))):
            wait = begin + number / stream.rate - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            if time.monotonic() > begin + float(seconds):
                break
            for op in ops:
                if op.pause:
                    time.sleep(op.pause)
                began = time.time()
                call(space, name, op)
                times.append((began, time.time()))
    np.save(file, np.array(times))


if __name__ == "__main__":
    main()
