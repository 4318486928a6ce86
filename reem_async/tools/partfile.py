"""Files that get their name once they are whole, and files that belong to one program as long as it lives."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import time
from pathlib import Path

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None  # type: ignore[assignment]

__all__ = ["PartFile", "is_locked", "lock"]

_NAME = re.compile(r"\..+\.[0-9a-f]{8}\.reem\.part")
_ABANDONED_SECONDS = 3600.0
"""Where there are no locks: a file that was not written to for so long is nobody's."""


def lock(descriptor: int) -> bool:
    """Lock an open file until it is closed, also by the end of the program; return False if another has locked it.

    Other programs may read and write it nevertheless: only those that ask are told.
    """
    if fcntl is not None:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks
            return True
    return True


def is_locked(path: Path) -> bool:
    """Return whether some program, this one included, has locked a file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
    except OSError:
        return False
    try:
        return not lock(descriptor)
    finally:
        os.close(descriptor)


class PartFile:
    """A file that gets the name `target` when it is whole, or never; until then it is hidden beside it.

    If `target` is a link, it stays one, and the file gets the name that it leads to.

    Making one removes those in the same directory whose program was killed.

    Attributes:
        path: The hidden file.
        descriptor: It, open for reading and writing, and locked; -1 once it is closed.

    Raises:
        OSError: It cannot be made.
    """

    def __init__(self, target: Path) -> None:
        self.descriptor = -1
        target = Path(os.path.realpath(target))  # unlike `resolve`, it takes a circle of links
        _remove_abandoned(target.parent)
        self._target = self.path = target
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
        while self.descriptor < 0:
            self.path = target.with_name(f".{target.name[:200]}.{secrets.token_hex(4)}.reem.part")
            descriptor = os.open(self.path, flags, 0o666)
            # Before it was locked, another program may have taken it for abandoned.
            if lock(descriptor) and os.fstat(descriptor).st_nlink:
                self.descriptor = descriptor
            else:
                os.close(descriptor)

    def appear(self) -> None:
        """Give the file its name; it stays open and locked."""
        self.path.replace(self._target)
        self.path = self._target

    def finish(self) -> None:
        """Give the file its name, and close it."""
        if fcntl is None:  # Windows renames no open file
            os.close(self.descriptor)
            self.descriptor = -1
        self.appear()
        self.close()

    def close(self) -> None:
        """Close the file, and remove it if it has not got its name. Idempotent."""
        if self.path != self._target:
            with contextlib.suppress(OSError):
                self.path.unlink()
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1

    def __del__(self) -> None:
        if self.descriptor >= 0:
            self.close()


def _remove_abandoned(directory: Path) -> None:
    """Remove what programs have left that were killed."""
    for part in directory.glob(".*.reem.part"):
        if _NAME.fullmatch(part.name):
            with contextlib.suppress(OSError), part.open("rb") as file:
                age = time.time() - os.fstat(file.fileno()).st_mtime
                if lock(file.fileno()) and (fcntl is not None or age > _ABANDONED_SECONDS):
                    part.unlink()
