"""The bytes of recorded values: worked on in slices, and compared by their digests.

A value that is read again is compared by a digest. Most are never read again: a frame of a camera is replaced long
before. So the bytes are kept until the next keyframe, which digests those that are still there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from typing import Any

from ...concurrency.tasks import give_way

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


class Content:
    """The bytes of one value, which must not change; later only a digest of them."""

    __slots__ = ("_digest", "_pieces")

    def __init__(self, head: bytes, body: Any = b"") -> None:
        self._pieces: tuple[bytes, Any] | None = head, body
        self._digest = b""

    def digest(self) -> bytes:
        """Return 16 bytes that tell it from any other, and let go of its own."""
        if self._pieces is not None:
            head, body = self._pieces
            total = hashlib.blake2b(digest_size=16, salt=hashlib.blake2b(head, digest_size=16).digest())
            for part in slices([body]):
                total.update(part)
            # The digest takes the place of the bytes, which may be a frame of a camera.
            self._digest, self._pieces = total.digest(), None
        return self._digest
