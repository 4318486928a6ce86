"""What the recorder remembers of the values it wrote, to tell later whether one has changed."""

import weakref

import numpy as np
import pytest

from reem_async.tools.recording import contents
from reem_async.tools.recording.contents import Content, Recent


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
