"""What a worker with coroutines can be asked to do: the requests of `blocking_session`, on one event loop."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

from ..values import Spec, below, build, same
from .blocking_session import FEWEST, clock

Call = Callable[[], Awaitable[Any]]


async def timed(call: Call, count: int, limit: float) -> list[float]:
    """Seconds of each of up to `count` calls, within about `limit` seconds."""
    seconds: list[float] = []
    end = clock() + limit
    while len(seconds) < count:
        start = clock()
        await call()
        stop = clock()
        seconds.append(stop - start)
        if stop > end and len(seconds) >= FEWEST:
            break
    return seconds


async def wait_until(moment: float) -> None:
    """Let others run until `clock()` shows `moment`."""
    if (rest := moment - clock()) > 0:
        await asyncio.sleep(rest)


async def _nothing() -> None:
    return None


class AsyncSession:
    """Drives one contender whose methods are coroutines."""

    def __init__(self, kind: type[Any]) -> None:
        self.kind = kind
        self.contender: Any = None
        self.call: Call = _nothing
        self.latencies: list[float] = []

    async def open(self, target: dict[str, Any]) -> str:
        """Connect; the reply is the contender's version."""
        self.contender = self.kind(target)
        await self.contender.connect()
        return str(self.contender.version())

    async def prepare(self, operation: str, key: str, value: Spec, **places: list[str]) -> None:
        """Write the value once, read it back once, keep the call to be measured, and warm it up."""
        inner, tail = places.get("inner", []), places.get("tail", [])
        content = build(value)
        if inner:
            await self.contender.writing([key], {"other": 0})()
        write = self.contender.writing([key, *inner], content)
        await write()
        read = self.contender.reading([key, *inner, *tail], content)
        if operation == "get" and not same(await read(), below(content, tail)):
            raise ValueError("what was read is not what was written")
        self.call = write if operation == "set" else read
        await timed(self.call, 20, 0.1)

    async def run(self, count: int, limit: float, start: float = 0.0) -> list[float]:
        """Measure the prepared call, from a given moment on if one is given."""
        await wait_until(start)
        return await timed(self.call, count, limit)

    async def crowd(self, width: int, count: int, limit: float) -> list[float]:
        """Seconds per call while `width` callers call at once, each of them once."""
        samples: list[float] = []
        end = clock() + limit
        await asyncio.gather(*(self.call() for _ in range(width)))
        while len(samples) < count and (clock() < end or len(samples) < FEWEST):
            start = clock()
            await asyncio.gather(*(self.call() for _ in range(width)))
            samples.append((clock() - start) / width)
        return samples

    async def camera(
        self, key: str, seconds: float, beside: bool, rate: float, frames: float
    ) -> dict[str, list[float]]:
        """Write set points at `rate`, alone or beside a task that writes 8 MB frames."""
        image = self.contender.writing([f"{key}_camera"], build({"kind": "array", "shape": [1000, 1000]}))
        setpoint = self.contender.writing([f"{key}_setpoint"], {"position": 1.0, "velocity": 0.5})
        await image()
        await timed(setpoint, 50, 0.1)
        stop, frame_seconds = asyncio.Event(), list[float]()
        task = asyncio.create_task(self._stream(image, frames, stop, frame_seconds)) if beside else None
        try:
            result = await self._write_at(setpoint, rate, seconds)
        finally:
            stop.set()
            if task:
                await task
        return {**result, "frames": frame_seconds}

    @staticmethod
    async def _stream(image: Call, frames: float, stop: asyncio.Event, seconds: list[float]) -> None:
        due = clock()
        while not stop.is_set():
            start = clock()
            await image()
            seconds.append(clock() - start)
            due = max(due + 1 / frames, clock())
            await wait_until(due)

    @staticmethod
    async def _write_at(setpoint: Call, rate: float, seconds: float) -> dict[str, list[float]]:
        calls: list[float] = []
        late: list[float] = []
        due = clock() + 0.1
        end = due + seconds
        while due < end:
            await wait_until(due)
            start = clock()
            await setpoint()
            stop = clock()
            calls.append(stop - start)
            late.append(stop - due)
            due += 1 / rate
        return {"calls": calls, "late": late}

    async def listen(self, channel: str, payload: str, subscribers: int = 1) -> None:
        """Subscribe; from now on every message's age on arrival is kept."""

        def heard(stamp: int) -> None:
            self.latencies.append((time.monotonic_ns() - stamp) / 1e9)

        for _ in range(subscribers):
            await self.contender.subscribe(channel, payload, heard)

    async def heard(self) -> list[float]:
        """The ages since the last time this was asked."""
        ages, self.latencies[:] = list(self.latencies), []
        return ages

    async def publish(self, channel: str, payload: str, count: int, gap: float) -> list[float]:
        """Publish `count` stamped messages, one every `gap` seconds; the reply is what each call took."""
        publish = self.contender.publishing(channel, payload)
        seconds = []
        due = clock()
        for _ in range(count):
            start = clock()
            await publish()
            seconds.append(clock() - start)
            due = max(due + gap, clock())
            await wait_until(due)
        return seconds
