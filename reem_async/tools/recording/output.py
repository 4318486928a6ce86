"""The file that a recording goes to, and work on its bytes in slices."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable, Iterator
from pathlib import Path as FilePath
from typing import Any

from ...concurrency.tasks import give_way
from ...errors import BadValue
from ..partfile import PartFile, is_locked, there_already

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


class FileGone(OSError):
    """Another program has deleted, replaced or changed the file; what was written to it is lost."""


class Output:
    """A file that is either extended by all that was written since the last `flush`, or left as it was.

    What is written has been handed to the operating system: it survives the end of the program, however
    it ends, but not a power cut in the next half minute. As long as it is open it is locked, so that no other
    recorder takes it. It is hidden until `appear`, so a file that it replaces stays until then.

    Raises BadValue if the file is there already, is being recorded, or cannot be made.
    """

    def __init__(self, path: FilePath, *, overwrite: bool) -> None:
        self._path = path
        self._overwrite = overwrite
        self._refuse_taken()
        try:
            self._part = PartFile(path, replace=overwrite)
        except OSError as error:
            raise BadValue(f"{path} cannot be written: {error.strerror}") from None
        self._pieces: list[Any] = []
        # Bytes in the file, and bytes that wait for `flush`.
        self._written = 0
        self._waiting = 0

    def _refuse_taken(self) -> None:
        if self._path.exists() and not self._overwrite:
            raise BadValue(str(there_already(self._path)))
        if is_locked(self._path):
            raise BadValue(f"{self._path} is being recorded by another recorder; end that one, or choose another name")

    def appear(self) -> None:
        """Give the file its name. Programs that read the file that it replaces go on with that.

        Raises BadValue if another program has taken the name by now, or the directory cannot be written.
        """
        self._refuse_taken()
        try:
            self._part.appear()
        except FileExistsError as error:
            raise BadValue(str(error)) from None
        except OSError as error:
            raise BadValue(f"{self._path} cannot be replaced: {error.strerror}") from None

    @property
    def directory(self) -> FilePath:
        return self._part.path.parent

    def write(self, data: Any) -> None:
        """Take a piece; it is written by `flush`."""
        self._pieces.append(data)
        self._waiting += len(data)

    def tell(self) -> int:
        return self._written + self._waiting

    def flush(self) -> None:
        """Write all pieces; if that fails, the file ends where it did before, and OSError is raised."""
        self._check()
        file = self._part.descriptor
        pieces, self._pieces, self._waiting = self._pieces, [], 0
        done = 0
        try:
            for part in slices(pieces):
                left = memoryview(part)
                # A disk that is full takes a part.
                while left:
                    count = os.write(file, left)
                    done, left = done + count, left[count:]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(file, self._written)
            raise
        self._written += done

    def _check(self) -> None:
        status = os.fstat(self._part.descriptor)
        # The system does not report that an open file was deleted, so each flush checks.
        if not status.st_nlink:
            raise FileGone(errno.ENOENT, "it was deleted or replaced by another program while it was recorded")
        if status.st_size != self._written:
            size = f"it has {status.st_size} bytes, {self._written} were written"
            raise FileGone(
                errno.EIO, f"it was cut short or written to by another program while it was recorded: {size}"
            )

    def close(self) -> None:
        """Close the file; if it has not appeared yet, it is removed. Idempotent."""
        self._part.close()
