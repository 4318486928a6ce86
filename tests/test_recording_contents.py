"""What the recorder remembers of the values it wrote, to tell later whether one has changed."""

import weakref

import numpy as np

from reem_async.tools.recording.contents import Content


def test_contents_are_told_apart_by_head_and_body() -> None:
    same = Content(b"<f8[2]", memoryview(np.array([1.0, 2.0])).cast("B"))
    assert Content(b"<f8[2]", np.array([1.0, 2.0]).tobytes()).digest() == same.digest()
    assert Content(b"<f8[2]", np.array([1.0, -2.0]).tobytes()).digest() != same.digest()
    assert Content(b"<i8[2]", np.array([1.0, 2.0]).tobytes()).digest() != same.digest()


def test_bytes_are_let_go_of_once_there_is_a_digest() -> None:
    body = np.zeros(1000, np.uint8)
    content, gone = Content(b"head", body), weakref.ref(body)
    del body
    first = content.digest()
    assert gone() is None
    assert content.digest() == first
