"""What the recorder remembers of the values it wrote, to tell later whether one has changed."""

import subprocess
import sys
import weakref

import numpy as np
import pytest

from reem_async.recording import contents
from reem_async.recording.contents import Content, Recent


def test_contents_are_told_apart_by_head_and_body() -> None:
    same = Content(b"<f8[2]", memoryview(np.array([1.0, 2.0])).cast("B"))
    assert Content(b"<f8[2]", np.array([1.0, 2.0]).tobytes()).digest() == same.digest()
    assert Content(b"<f8[2]", np.array([1.0, -2.0]).tobytes()).digest() != same.digest()
    assert Content(b"<i8[2]", np.array([1.0, 2.0]).tobytes()).digest() != same.digest()


def test_bytes_are_let_go_of_once_there_is_a_digest() -> None:
    content = Content(b"head", bytes(1000))
    assert content.size == 1004
    first = content.digest()
    assert content.size == 0
    assert content.digest() == first


def test_bytes_are_kept_for_a_moment_only(monkeypatch: pytest.MonkeyPatch) -> None:
    recent, content = Recent(), Content(b"", bytes(1000))
    recent.add(content)
    recent.tick()
    assert content.size == 1000
    monkeypatch.setattr(contents, "_MOMENT", 0.0)
    recent.tick()
    assert content.size == 0


def test_too_many_bytes_are_let_go_of_at_once_oldest_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contents, "_MOST_KEPT", 2500)
    recent, all_of_them = Recent(), [Content(b"", bytes(1000)) for _ in range(3)]
    for content in all_of_them:
        recent.add(content)
    assert [content.size for content in all_of_them] == [0, 1000, 1000]


def test_what_was_replaced_is_not_kept() -> None:
    recent, content = Recent(), Content(b"", bytes(1000))
    recent.add(content)
    gone = weakref.ref(content)
    del content
    assert gone() is None
    recent.tick()


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
