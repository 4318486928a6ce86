"""What a process does so that others do not notice it."""

import ast
import platform
import subprocess
import sys

import pytest

_FAULTS = """
import resource
from reem_async.concurrency.tasks import keep_memory
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(100):
        bytearray(2_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
keep_memory()
faults()
print(faults())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux: elsewhere nothing is done")
def test_memory_that_is_kept_is_not_taken_page_by_page_again() -> None:
    told = subprocess.run([sys.executable, "-c", _FAULTS], capture_output=True, text=True, check=True).stdout
    assert int(told) < 100  # of 48,800 pages; hundreds without


_TURN = """
import ctypes, os, struct, subprocess, threading
from reem_async.concurrency.tasks import come_last, take_short_turns
def turn():
    "Policy, flags, niceness and turn in nanoseconds of this thread, as Linux tells them."
    got = ctypes.create_string_buffer(48)
    number = {"x86_64": 315, "aarch64": 275}[os.uname().machine]
    assert ctypes.CDLL(None).syscall(ctypes.c_long(number), 0, got, 48, 0) == 0
    return struct.unpack("=IIQiIQQQ", got.raw)[1:6]
def told(*first):
    said = []
    def look():
        for each in first:
            each()
        said.append(turn())
        after = threading.Thread(target=lambda: said.append(turn()))
        after.start()
        after.join()
    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    return said
os.nice(3)
batch = lambda: os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
session = "/proc/self/autogroup"
weight = lambda: open(session).read().split()[-1] if os.path.exists(session) else ""
threads = [told(), told(take_short_turns), told(batch, take_short_turns)]
other = subprocess.Popen(["sleep", "60"])  # the robot, in the same session
threads.append(told(come_last))
shared = weight()
other.kill()
other.wait()
come_last()
print([*threads, shared, weight()])
"""


@pytest.mark.skipif(
    sys.platform != "linux" or tuple(map(int, platform.release().split(".")[:2])) < (6, 12),
    reason="Linux from 6.12 on: elsewhere nothing is done",
)
def test_short_turns_are_for_one_ordinary_thread_or_with_lowest_priority_for_all_later_ones() -> None:
    command = [sys.executable, "-c", _TURN]
    said = subprocess.run(command, capture_output=True, text=True, check=True, start_new_session=True).stdout
    (before, _), (short, of_its_thread), (of_batch, _), last, *session = ast.literal_eval(said)
    policy, _, nice, _, turn = before
    assert turn > 100_000
    assert short == (policy, 1, nice, 0, 100_000)
    assert of_its_thread == before
    assert of_batch[-1] == turn
    assert last == [(policy, 0, 19, 0, 100_000)] * 2
    assert session in (
        ["0", "19"],
        ["", ""],
    )  # niceness counts within a session only, where Linux groups programs by it
