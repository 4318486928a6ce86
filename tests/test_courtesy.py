"""What a process does so that others do not notice it."""

import subprocess
import sys

import pytest

_FAULTS = """
import resource
from reem_async.courtesy import keep_memory
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
