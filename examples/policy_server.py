"""A policy server and a robot that asks it, here in one program: arrays in, arrays out, no pickle.

The robot asks for a chunk of actions while it still executes the last one, and holds still when no answer comes.

    python -m examples.policy_server [--front asyncio] [--seconds 5] [--url redis://...]
"""

from __future__ import annotations

import asyncio
import time
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

import reem
import reem_async
from examples.common import parser, run, server

CHUNK, PERIOD, TIMEOUT = 10, 0.02, 0.5  # steps of a chunk, seconds between steps, seconds to wait for a chunk


def act(images: dict[str, Any], state: Any, prompt: str) -> dict[str, Any]:
    """Stand in for the network: move a little towards zero."""
    brightness = float(np.mean([image.mean() for image in images.values()])) / 255
    return {"actions": np.linspace(0.0, -0.1, CHUNK)[:, None] * state, "confidence": 1.0 - brightness, "for": prompt}


def observed(state: Any) -> dict[str, Any]:
    image = np.zeros((120, 160, 3), np.uint8)
    return {"images": {"front": image, "wrist": image}, "state": state, "prompt": "pick the cup"}


def execute(state: Any, action: Any) -> Any:
    """Stand in for the motors."""
    return state + action


# --- asyncio: the next chunk is a task ---


async def arobot(kvs: reem_async.KeyValueStore, seconds: float) -> int:
    state, chunks, end = np.ones(7), 0, time.monotonic() + seconds
    coming = asyncio.create_task(kvs["policy"].call(timeout=TIMEOUT, **observed(state)))
    while time.monotonic() < end:
        try:
            actions = (await coming)["actions"]
        except (reem_async.ServiceError, reem_async.ConnectionLost) as error:
            print("holding still:", error)
            actions = np.zeros((CHUNK, 7))
        chunks += 1
        coming = asyncio.create_task(kvs["policy"].call(timeout=TIMEOUT, **observed(state)))
        for action in actions:
            state = execute(state, action)
            await asyncio.sleep(PERIOD)
    coming.cancel()
    return chunks


async def asynchronous(options: Namespace) -> None:
    async with server(options.url) as url, reem_async.RedisInterface(url) as interface:
        kvs = reem_async.KeyValueStore(interface)
        async with kvs["policy"].serve(act):
            print(f"executed {await arobot(kvs, options.seconds)} chunks")


# --- blocking: the next chunk is called on a thread ---


def robot(kvs: reem.KeyValueStore, seconds: float) -> int:
    state, chunks, end = np.ones(7), 0, time.monotonic() + seconds
    with ThreadPoolExecutor(1) as caller:
        coming = caller.submit(kvs["policy"].call, timeout=TIMEOUT, **observed(state))
        while time.monotonic() < end:
            try:
                actions = coming.result()["actions"]
            except (reem.ServiceError, reem.ConnectionLost) as error:
                print("holding still:", error)
                actions = np.zeros((CHUNK, 7))
            chunks += 1
            coming = caller.submit(kvs["policy"].call, timeout=TIMEOUT, **observed(state))
            for action in actions:
                state = execute(state, action)
                time.sleep(PERIOD)
    return chunks


def blocking(options: Namespace) -> None:
    with server(options.url) as url, reem.RedisInterface(url) as interface:
        kvs = reem.KeyValueStore(interface)
        with kvs["policy"].serve(act):
            print(f"executed {robot(kvs, options.seconds)} chunks")


if __name__ == "__main__":
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=float, default=5.0, help="how long to run; default: %(default)s")
    run(arguments.parse_args(), blocking, asynchronous)
