"""A control loop: read the newest command, compute, publish the state."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

_COMMANDED = 10.0  # seconds within which the first command must have come


def newest_of(receive: Callable[[], Any]) -> Callable[[], Any]:
    """The newest of the JSON texts that `receive` returns, one at a time, until it returns None; it must not wait."""
    import orjson  # the environments of the original do not have it

    newest: Any = None

    def call() -> Any:
        nonlocal newest
        text = None
        while (data := receive()) is not None:
            text = data
        if text is not None:
            newest = orjson.loads(text)
        return newest

    return call


def control_loop(newest: Callable[[], Any], publish: Callable[..., Any], periods: int, rate: float) -> dict[str, Any]:
    """Run for so many periods; return the seconds of each cycle, and how many deadlines were missed.

    A cycle counts from when it was due to when its state is published, so waking up late is part of it. Its deadline is
    the end of its period. A cycle that takes longer than two periods also misses the deadlines of those it passes over.
    """
    clock, period = time.perf_counter, 1 / rate
    end = clock() + _COMMANDED
    while not newest():
        if clock() > end:
            raise TimeoutError(f"no command within {_COMMANDED:g} s")
        time.sleep(0.01)
    cycles: list[float] = []
    missed, left, due = 0, periods, clock() + period
    while left > 0:
        time.sleep(max(0.0, due - clock()))
        command = np.asarray(newest()["q"])
        publish(q=(0.9 * command + 0.1 * np.sin(command + due)).tolist())
        cycles.append(clock() - due)
        late = int(cycles[-1] / period)
        missed += min(late, left)
        due += max(late, 1) * period
        left -= max(late, 1)
    return {"cycles": cycles, "missed": missed}
