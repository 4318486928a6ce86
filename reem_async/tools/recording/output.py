"""The file that a recording goes to."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from pathlib import Path as FilePath
from typing import Any

from ...errors import BadValue
from ..partfile import Lock, PartFile, is_locked, lock, there_already
from .contents import slices


class FileGone(OSError):
    """Another program has deleted, replaced or changed the file; what was written to it is lost."""


class Output:
    """A file that is either extended by all that was written since the last `flush`, or left as it was.

    What is written has been handed to the operating system: it survives the end of the program, however
    it ends, but not a power cut in the next half minute. As long as it is open it is locked, so that no other
    recorder takes it. A file that it is to replace stays until `appear`.

    Raises BadValue if the file is there already, is being recorded, or cannot be made.
    """

    def __init__(self, path: FilePath, *, overwrite: bool) -> None:
        if path.is_dir():
            raise BadValue(f"{path} is a directory; name a file in it")
        self._path = path
        self._part: PartFile | None = None
        try:
            if overwrite and path.is_file():
                self._refuse_recorded()
                # Beside the old file, which is complete and stays until the new one has something in it.
                self._part = PartFile(path, replace=True)
                self._file = self._part.descriptor
            else:
                # O_EXCL gives the name to one of two recorders that begin at once; the lock is for those that
                # come later.
                flags = os.O_WRONLY | os.O_CREAT | (0 if overwrite else os.O_EXCL)
                self._file = os.open(path, flags | os.O_CLOEXEC, 0o666)
                regular = stat.S_ISREG(os.fstat(self._file).st_mode)
                if regular and lock(self._file) is Lock.TAKEN:  # both have just begun
                    os.close(self._file)
                    raise self._taken()
        except FileExistsError:
            raise BadValue(str(there_already(path))) from None
        except OSError as error:
            raise BadValue(f"{path} cannot be written: {error.strerror}") from None
        status = os.fstat(self._file)
        self._is_regular, self._identity = stat.S_ISREG(status.st_mode), (status.st_dev, status.st_ino)
        self._directory = path.absolute().parent
        self._pieces: list[Any] = []
        # Bytes in the file, and bytes that wait for `flush`.
        self._written = 0
        self._waiting = 0

    def _refuse_recorded(self) -> None:
        if is_locked(self._path):
            raise self._taken()

    def _taken(self) -> BadValue:
        return BadValue(f"{self._path} is being recorded by another recorder; end that one, or choose another name")

    @property
    def replaces(self) -> bool:
        """Whether there is a file whose place it is to take."""
        return self._part is not None

    def appear(self) -> None:
        """Take the place of the file that is to be replaced. Programs that read that one go on with it.

        Raises BadValue if it is being recorded by now, or the directory cannot be written.
        """
        if self._part is not None:
            self._refuse_recorded()
            try:
                self._part.appear()
            except OSError as error:
                raise BadValue(f"{self._path} cannot be replaced: {error.strerror}") from None

    @property
    def spare(self) -> str | None:
        """Where a file for a while can be put: beside this one, None for the system's place for such files."""
        return str(self._directory) if os.access(self._directory, os.W_OK) else None

    def write(self, data: Any) -> None:
        """Take a piece; it is written by `flush`."""
        self._pieces.append(data)
        self._waiting += len(data)

    def tell(self) -> int:
        return self._written + self._waiting

    def flush(self) -> None:
        """Write all pieces; if that fails, the file ends where it did before, and OSError is raised."""
        self._check()
        pieces, self._pieces, self._waiting = self._pieces, [], 0
        done = 0
        try:
            for part in slices(pieces):
                left = memoryview(part)
                # A disk that is full takes a part.
                while left:
                    count = os.write(self._file, left)
                    done, left = done + count, left[count:]
        except OSError:
            with contextlib.suppress(OSError):  # a device has no length
                os.ftruncate(self._file, self._written)
            raise
        self._written += done

    def _check(self) -> None:
        if not self._is_regular:
            return
        status = os.fstat(self._file)
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
        if self._part is not None:
            self._part.close()
        elif self._file >= 0:
            os.close(self._file)
        self._file = -1

    def discard(self) -> None:
        """Close the file and remove it; one that it was to replace stays."""
        self.close()
        with contextlib.suppress(OSError):
            status = self._path.stat()
            if (status.st_dev, status.st_ino) == self._identity and self._is_regular:
                self._path.unlink()
