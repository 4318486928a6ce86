"""One publisher that never stops: `python -m benchmarks.workers.steady URL setpoint|camera FILE`; SIGTERM ends it.

The file then holds two doubles for each call: when it began, on the clock all processes share, and its seconds.
"""

import array
import pathlib
import signal
import sys
import time

import numpy as np

import reem

RATES = {"setpoint": 1000, "camera": 30}


def main() -> None:
    """Publish at the rate until told to stop."""
    url, what, file = sys.argv[1:]
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
    with reem.RedisInterface(url) as interface:
        space = reem.PublishSpace(interface)
        image = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
        calls, number, due = array.array("d"), 0, time.perf_counter()
        while not ended:
            time.sleep(max(0.0, due - time.perf_counter()))
            number += 1
            begin = time.perf_counter()
            if what == "setpoint":
                space["arm"] = {"q": [0.1 * number, 1.0, 2.0, 3.0, 4.0, 5.0], "t": time.time()}
            else:
                image[number % 480, :, 0] = number % 255
                space["cam"] = {"image": image, "n": number}
            calls.extend((begin, time.perf_counter() - begin))
            due = max(due + 1 / RATES[what], begin - 0.1)
    pathlib.Path(file).write_bytes(calls.tobytes())


if __name__ == "__main__":
    main()
