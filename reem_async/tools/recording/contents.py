"""The bytes of recorded values: worked on in slices, and compared by their digests.

A value that is read again is compared by a digest. Most are never read again: a frame of a camera is replaced long
before. So the bytes are kept for a moment, and only the bytes that stay are digested.
"""

from __future__ import annotations

import collections
import hashlib
import time
import weakref
from collections.abc import Iterable, Iterator
from typing import Any

from ...concurrency.scheduling import give_way

# 64 KiB: about 50 us of compression, so that other threads wait for the processor no longer.
_SLICE = 1 << 16


def slices(pieces: Iterable[Any]) -> Iterator[Any]:
    """Yield the bytes of all pieces, in order and in slices of 64 KiB or less, giving way after each."""
    small: list[Any] = []
    size = 0
    for piece in pieces:
        # Small pieces are joined: giving way after each of a thousand would cost more than the work itself.
        if len(piece) < _SLICE:
            small.append(piece)
            size += len(piece)
        if small and (size >= _SLICE or len(piece) >= _SLICE):
            yield b"".join(small)
            give_way()
            small, size = [], 0
        if len(piece) >= _SLICE:
            view = memoryview(piece)
            for start in range(0, len(view), _SLICE):
                yield view[start : start + _SLICE]
                give_way()
    if small:
        yield b"".join(small)
        give_way()


def digest(head: bytes, body: Any = b"") -> bytes:
    total = hashlib.blake2b(digest_size=16, salt=hashlib.blake2b(head, digest_size=16).digest())
    for part in slices([body]):
        total.update(part)
    return total.digest()


_MOMENT = 1.0
"""Seconds for which bytes are kept."""
# Bytes that are kept at most: a second of two cameras.
_MOST_KEPT = 64 << 20


class Content:
    """The bytes of one value, which must not change; later only a digest of them."""

    __slots__ = ("__weakref__", "_digest", "_pieces", "size")

    def __init__(self, head: bytes, body: Any = b"") -> None:
        self._pieces: tuple[bytes, Any] = head, body
        self._digest = b""
        self.size = len(head) + len(body)

    def digest(self) -> bytes:
        """Return 16 bytes that tell it from any other, and let go of its own."""
        if not self._digest:
            # The digest takes the place of the bytes, which may be a frame of a camera.
            self._digest = digest(*self._pieces)
            self._pieces = b"", b""
            self.size = 0
        return self._digest


class Recent:
    """The contents of the last moment. Does not keep them: those of values that were replaced are gone."""

    def __init__(self) -> None:
        self._queue: collections.deque[tuple[float, int, weakref.ref[Content]]] = collections.deque()
        self._kept = 0

    def add(self, content: Content) -> None:
        """Take note of a content; if too many bytes are kept, the oldest are let go of."""
        self._queue.append((time.monotonic(), content.size, weakref.ref(content)))
        self._kept += content.size
        while self._kept > _MOST_KEPT:
            self._settle()

    def tick(self) -> None:
        """Let go of bytes that have been kept for a moment."""
        late = time.monotonic() - _MOMENT
        while self._queue and self._queue[0][0] < late:
            self._settle()

    def _settle(self) -> None:
        _, size, reference = self._queue.popleft()
        self._kept -= size
        content = reference()
        if content is not None:
            content.digest()
