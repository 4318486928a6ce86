"""The file that a recording goes to."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path as FilePath
from typing import Any

from ..errors import BadValue
from .gentle import slices

__all__ = ["Output"]


class Output:
    """A file that is either extended by all that was written since the last `flush`, or left as it was.

    What is written has been handed to the operating system: it survives the end of the program, however
    it ends, but not a power cut in the next half minute.
    """

    def __init__(self, path: FilePath, *, overwrite: bool) -> None:
        flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if overwrite else os.O_EXCL)
        if path.is_dir():
            raise BadValue(f"{path} is a directory; name a file in it")
        if overwrite and path.is_file():  # whoever reads the old one goes on with it; cut short, it would kill him
            path = path.resolve()
            with contextlib.suppress(OSError):
                path.unlink()
        try:
            self._file = os.open(path, flags | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0), 0o666)
        except FileExistsError:
            raise BadValue(f"{path} is there already; choose another name, or say --force (overwrite=True)") from None
        except OSError as error:
            raise BadValue(f"{path} cannot be written: {error.strerror}") from None
        self._pieces: list[Any] = []
        self._written = 0
        self._waiting = 0

    def write(self, data: Any) -> None:
        """Take a piece; it is written by `flush`."""
        self._pieces.append(data)
        self._waiting += len(data)

    def tell(self) -> int:
        """Return where the next piece will be."""
        return self._written + self._waiting

    def flush(self) -> None:
        """Write all pieces; if that fails, the file ends where it did before, and OSError is raised."""
        pieces, self._pieces, self._waiting = self._pieces, [], 0
        done = 0
        try:
            for part in slices(pieces):
                left = memoryview(part)
                while left:
                    count = os.write(self._file, left)
                    done, left = done + count, left[count:]
        except OSError:
            with contextlib.suppress(OSError):  # a device has no length
                os.ftruncate(self._file, self._written)
            raise
        self._written += done

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
