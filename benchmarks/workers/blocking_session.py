"""What a worker with blocking calls can be asked to do."""

import threading
import time
from collections.abc import Callable
from typing import Any

from ..values import Spec, below, build, same
from .control import control_loop

Call = Callable[[], Any]
clock = time.perf_counter
FEWEST = 2  # calls measured even when the time is up


def timed(call: Call, count: int, limit: float) -> list[float]:
    """Seconds of each of up to `count` calls, within about `limit` seconds."""
    seconds: list[float] = []
    end = clock() + limit
    while len(seconds) < count:
        start = clock()
        call()
        stop = clock()
        seconds.append(stop - start)
        if stop > end and len(seconds) >= FEWEST:
            break
    return seconds


def wait_until(moment: float) -> None:
    """Sleep until `clock()` shows `moment`."""
    if (rest := moment - clock()) > 0:
        time.sleep(rest)


class BlockingSession:
    """Drives one contender whose methods return when their work is done."""

    def __init__(self, kind: type[Any]) -> None:
        self.kind = kind
        self.contender: Any = None
        self.call: Call = lambda: None
        self.latencies: list[float] = []

    def open(self, target: dict[str, Any]) -> str:
        """Connect; the reply is the contender's version."""
        self.contender = self.kind(target)
        return str(self.contender.version())

    def prepare(self, operation: str, key: str, value: Spec, **places: list[str]) -> None:
        """Write the value once, read it back once, keep the call to be measured, and warm it up."""
        inner, tail = places.get("inner", []), places.get("tail", [])
        content = build(value)
        if inner:
            self.contender.writing([key], {"other": 0})()
        write = self.contender.writing([key, *inner], content)
        write()
        read = self.contender.reading([key, *inner, *tail], content)
        if operation == "get" and not same(read(), below(content, tail)):
            raise ValueError("what was read is not what was written")
        self.call = write if operation == "set" else read
        timed(self.call, 20, 0.1)

    def run(self, count: int, limit: float, start: float = 0.0) -> list[float]:
        """Measure the prepared call, from a given moment on if one is given."""
        wait_until(start)
        return timed(self.call, count, limit)

    def crowd(self, width: int, count: int, limit: float) -> list[float]:
        """Seconds per call while `width` threads call at once on one connection object."""
        samples: list[float] = []
        end = clock() + limit
        while len(samples) < count and (clock() < end or len(samples) < FEWEST):
            samples.append(self._together(width, 400) / 400)
        return samples

    def _together(self, width: int, calls: int) -> float:
        def work() -> None:
            barrier.wait()
            for _ in range(calls // width):
                self.call()
            barrier.wait()

        barrier = threading.Barrier(width + 1)
        threads = [threading.Thread(target=work) for _ in range(width)]
        for thread in threads:
            thread.start()
        barrier.wait()
        start = clock()
        barrier.wait()
        taken = clock() - start
        for thread in threads:
            thread.join()
        return taken * calls / (calls // width * width)

    def camera(self, key: str, seconds: float, beside: bool, rate: float, frames: float) -> dict[str, list[float]]:
        """Write set points at `rate`, alone or beside a thread that writes 8 MB frames."""
        image = self.contender.writing([f"{key}_camera"], build({"kind": "array", "shape": [1000, 1000]}))
        setpoint = self.contender.writing([f"{key}_setpoint"], {"position": 1.0, "velocity": 0.5})
        image()
        timed(setpoint, 50, 0.1)
        stop, frame_seconds = threading.Event(), list[float]()
        thread = threading.Thread(target=self._stream, args=(image, frames, stop, frame_seconds))
        if beside:
            thread.start()
        try:
            result = self._write_at(setpoint, rate, seconds)
        finally:
            stop.set()
            if beside:
                thread.join()
        return {**result, "frames": frame_seconds}

    @staticmethod
    def _stream(image: Call, frames: float, stop: threading.Event, seconds: list[float]) -> None:
        due = clock()
        while not stop.is_set():
            start = clock()
            image()
            seconds.append(clock() - start)
            due = max(due + 1 / frames, clock())
            wait_until(due)

    @staticmethod
    def _write_at(setpoint: Call, rate: float, seconds: float) -> dict[str, list[float]]:
        calls: list[float] = []
        late: list[float] = []
        due = clock() + 0.1
        end = due + seconds
        while due < end:
            wait_until(due)
            start = clock()
            setpoint()
            stop = clock()
            calls.append(stop - start)
            late.append(stop - due)
            due += 1 / rate
        return {"calls": calls, "late": late}

    def listen(self, channel: str, payload: str, subscribers: int = 1) -> None:
        """Subscribe; from now on every message's age on arrival is kept."""

        def heard(stamp: int) -> None:
            self.latencies.append((time.monotonic_ns() - stamp) / 1e9)

        for _ in range(subscribers):
            self.contender.subscribe(channel, payload, heard)

    def stream(self, channel: str, payload: str, rate: float) -> None:
        """Publish at `rate` from a thread, until the process ends."""
        publish = self.contender.publishing(channel, payload)
        arguments = (publish, rate, threading.Event(), [])
        threading.Thread(target=self._stream, args=arguments, daemon=True).start()

    def prepare_control(self, command: str, state: str) -> None:
        """Follow the channel of the command, and be ready to publish the state."""
        self.newest, self.call = self.contender.following(command), self.contender.publishing(state, "state")

    def control(self, periods: int, rate: float) -> dict[str, Any]:
        """Run the control loop that was prepared."""
        return control_loop(self.newest, self.call, periods, rate)

    def heard(self) -> list[float]:
        """The ages since the last time this was asked."""
        ages, self.latencies[:] = list(self.latencies), []
        return ages

    def publish(self, channel: str, payload: str, count: int, gap: float) -> list[float]:
        """Publish `count` stamped messages, one every `gap` seconds; the reply is what each call took."""
        publish = self.contender.publishing(channel, payload)
        seconds = []
        due = clock()
        for _ in range(count):
            start = clock()
            publish()
            seconds.append(clock() - start)
            due = max(due + gap, clock())
            wait_until(due)
        return seconds
