"""Long work in slices, giving way after each: whoever is recorded must not notice."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from typing import Any

from ...concurrency.scheduling import give_way

__all__ = ["digest", "slices"]

# 64 KiB: about 50 us of compression, so that whoever waits for the processor waits no longer.
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
    """Return 16 bytes that tell what `head` and `body` are from anything else."""
    total = hashlib.blake2b(digest_size=16, salt=hashlib.blake2b(head, digest_size=16).digest())
    for part in slices([body]):
        total.update(part)
    return total.digest()
