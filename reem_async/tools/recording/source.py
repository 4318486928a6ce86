"""Reading a file that somebody else may be cutting short or writing over at the same time."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path as FilePath

__all__ = ["Source"]

_BLOCK = 1 << 20
"""Bytes that are read at once where a file is gone through."""


class Source:
    """A file, read by position. Any thread may use it.

    It is not mapped into memory: the system kills a process that touches a mapped page which the file no longer has.

    Args:
        path: The file.

    Attributes:
        path: The file.
        size: Its bytes when it was opened; what is added later is not read.

    Raises:
        OSError: It cannot be read.
    """

    def __init__(self, path: FilePath) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._file = path.open("rb", buffering=0)
        self.size = os.fstat(self._file.fileno()).st_size
        self._block, self._block_start = b"", 0

    def read(self, start: int, size: int) -> bytes:
        """Return `size` bytes from `start`; OSError if the file has become shorter than it was."""
        pieces: list[bytes] = []
        with self._lock:
            self._file.seek(start)
            while size > 0:
                piece = self._file.read(size)
                if not piece:
                    raise OSError(errno.EIO, "cut short while it was being read; open it again", str(self.path))
                pieces.append(piece)
                size -= len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def peek(self, start: int, size: int) -> bytes:
        """Return what `read` does, or less at the end of the file; quick where the next call is for what follows."""
        size = max(min(size, self.size - start), 0)
        block, first = self._block, self._block_start
        if not first <= start or start + size > first + len(block):
            block, first = self.read(start, max(size, min(_BLOCK, self.size - start))), start
            self._block, self._block_start = block, first
        return block[start - first : start - first + size]

    def find(self, wanted: bytes, start: int) -> int:
        """Return where some bytes are from `start` on, -1 if nowhere."""
        while start + len(wanted) <= self.size:
            block = self.read(start, min(_BLOCK, self.size - start))
            place = block.find(wanted)
            if place >= 0:
                return start + place
            start += max(len(block) - len(wanted) + 1, 1)
        return -1

    def close(self) -> None:
        """Close the file. Idempotent; reading raises ValueError then."""
        with self._lock:
            self._file.close()
