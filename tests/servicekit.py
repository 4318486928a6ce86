"""Programs that serve and call in the tests of services, to be stopped and killed.

python -m servicekit serve URL KEY        serves KEY until it is killed, and prints "serving"
python -m servicekit call URL KEY COUNT [TIMEOUT [LOCAL]]   makes so many calls, and prints number and outcome of each
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

import reem

LARGE = 30_000  # float64 items: too large for a message


def act(number, nap=0.0, array=None, done=None):
    """Answer with what shows which call it was; write to the file `done` when it has begun."""
    if done is not None:
        with open(done, "a", encoding="ascii") as file:
            file.write(f"{number} {os.getpid()}\n")
    time.sleep(nap)
    if number < 0:
        raise ValueError(f"no {number}")
    return {"number": number, "array": None if array is None else array + number, "pid": os.getpid()}


def serve(url, key):
    service = reem.KeyValueStore(url)[key].serve(act, concurrency=4)
    print("serving", flush=True)
    service.wait()


def call(url, key, count, timeout="5", local="auto"):
    place = reem.KeyValueStore(reem.RedisInterface(url, local=local))[key]
    numbers = iter(range(int(count)))
    lock = threading.Lock()

    def run():
        while True:
            with lock:
                number = next(numbers, None)
            if number is None:
                return
            array = np.full(LARGE, 1.0) if number % 50 == 0 else np.full(3, 1.0) if number % 3 == 0 else None
            ident = int(os.getpid()) * 1_000_000 + number
            try:
                answer = place.call(number=ident, array=array, timeout=float(timeout))
            except (reem.ServiceError, reem.ConnectionLost) as error:
                outcome = type(error).__name__
            else:
                fits = answer["number"] == ident and (array is None or bool((answer["array"] == 1.0 + ident).all()))
                outcome = "answered" if fits else "WRONG"
            with lock:
                print(number, outcome, flush=True)

    threads = [threading.Thread(target=run) for _ in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()


@contextlib.contextmanager
def program(*words):
    """A program of this module in the background; killed at the end."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-m", "servicekit", *map(str, words)]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    try:
        if words[0] == "serve":
            assert process.stdout.readline() == "serving\n"
        yield process
    finally:
        process.send_signal(signal.SIGKILL)
        process.stdout.close()
        process.wait()


if __name__ == "__main__":
    {"serve": serve, "call": call}[sys.argv[1]](*sys.argv[2:])
