"""Followers in a process of their own, each with its own interface, as separate programs would have.

They share no memory with publishers: in a fleet, those are on other machines.

`python -m benchmarks.scale.audience` reads what to follow from its first line of input, says "ready",
and then answers each line that asks to wait until everybody has seen so many updates. It ends with
its input.
"""

from __future__ import annotations

import asyncio
import json
import select
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any, Self

from reem_async import CallbackSubscriber, RedisInterface

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 30.0
"""Seconds until it is given up that all updates are seen."""


class Audience:
    """The process, as seen from the benchmark.

    Args:
        url: The servers.
        groups: How many follow each key; the namespace, up to a colon, goes before the key.
    """

    def __init__(self, url: str, groups: dict[str, int]) -> None:
        self.size = sum(groups.values())
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.scale.audience"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=ROOT,
        )
        try:
            self.ask(url=url, groups=groups)
        except BaseException:
            self.end()
            raise

    def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request and return the answer.

        Raises:
            RuntimeError: The process ended, or did not answer.
        """
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()
        # It gives up by itself before that.
        ready, _, _ = select.select([self._process.stdout], [], [], PATIENCE + 15)
        line = self._process.stdout.readline() if ready else b""
        if not line:
            raise RuntimeError(f"the followers gave no answer to {str(request)[:80]}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer

    def wait(self, name: str, count: int) -> None:
        """Wait until all who follow a key have together seen `count` updates since the beginning."""
        self.ask(name=name, count=count)

    def cpu(self) -> float:
        """Return the seconds of CPU time it has used."""
        return float(self.ask()["cpu"])

    def seen(self) -> dict[str, int]:
        """Return how many updates were seen, by key."""
        return dict(self.ask()["seen"])

    def end(self) -> None:
        """Have it close everything and end."""
        if self._process.stdin:
            self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout:
            self._process.stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


class Hall:
    """The followers, inside the process."""

    def __init__(self) -> None:
        self.seen: dict[str, int] = {}
        self._arrived = asyncio.Event()
        self._interfaces: list[RedisInterface] = []
        self._subscribers: list[CallbackSubscriber] = []

    async def open(self, url: str, groups: dict[str, int]) -> None:
        """Begin to follow."""
        for name, followers in groups.items():
            self.seen[name] = 0
            namespace, colon, key = name.rpartition(":")
            for _ in range(followers):
                interface = RedisInterface(url, namespace=namespace + colon, timeout=5.0, local="off")
                self._interfaces.append(interface)
                self._subscribers.append(CallbackSubscriber(key, interface, partial(self._count, name)))
        for each in self._subscribers:
            await each.listen()

    def _count(self, name: str, data: Any, path: str) -> None:
        self.seen[name] += 1
        self._arrived.set()

    async def wait(self, name: str, count: int) -> None:
        """Wait until a key's updates have been seen so many times."""
        try:
            async with asyncio.timeout(PATIENCE):
                while self.seen[name] < count:
                    self._arrived.clear()
                    await self._arrived.wait()
        except TimeoutError:
            raise RuntimeError(f"{self.seen[name]} of {count} updates of {name} arrived in {PATIENCE:g} s") from None

    async def close(self) -> None:
        """End all."""
        for interface in self._interfaces:
            await interface.close()


async def serve() -> None:
    """Answer requests until the input ends."""
    hall, lines = Hall(), asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    while line := await lines.readline():
        request = json.loads(line)
        answer: dict[str, Any] = {}
        try:
            if "groups" in request:
                await hall.open(**request)
            elif "count" in request:
                await hall.wait(**request)
            else:
                answer = {"cpu": time.process_time(), "seen": hall.seen}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)
    await hall.close()


if __name__ == "__main__":
    asyncio.run(serve())
