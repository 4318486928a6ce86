"""Files that get their name once they are whole, and files that belong to one program as long as it lives."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import secrets
import stat
from pathlib import Path
from typing import Self

_NAME = re.compile(r"\..*\.[0-9a-f]{8}\.reem\.part", re.DOTALL)
_LONGEST = 200
"""Bytes of a target's name in that of the hidden file: file systems take 255 in all."""
# Anybody may put a FIFO or a link into a shared directory: neither waits here, nor leads elsewhere.
_OTHERS = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC


def _lock(descriptor: int, *, shared: bool = False) -> bool | None:
    """Lock an open file until it is closed, also by the end of the program; None if the file system has no locks.

    Other programs may read and write it nevertheless. A `shared` lock, with which one only looks whether a writer has
    it, is for a file that is open for reading: NFS refuses other locks of such a file.
    """
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:  # CIFS says EACCES of what is locked
        return False if error.errno in (errno.EAGAIN, errno.EACCES) else None
    return True


def is_locked(path: Path) -> bool:
    """Return whether some program, this one included, has locked a file."""
    try:
        descriptor = os.open(path, _OTHERS)
    except OSError:
        return False
    try:
        return _lock(descriptor, shared=True) is False
    finally:
        os.close(descriptor)


def there_already(path: Path) -> FileExistsError:
    """Return the error that says so, and what to do."""
    return FileExistsError(
        f"{path} is there already; choose another name, or replace it with overwrite=True or --force"
    )


class PartFile:
    """A file that gets the name `target` when it is whole, or never; until then it is hidden beside it.

    If `target` is a link, it stays one, and the file gets the name that it leads to. With `replace` it may take the
    place of a file of that name, and is readable by nobody who could not read that one.

    A context manager that finishes it at the end of the block, or removes it where the block fails. Making one removes
    those in the same directory whose program was killed.
    """

    def __init__(self, target: Path, *, replace: bool = False) -> None:
        self.descriptor = -1  # of the hidden file: open for reading and writing, and locked
        target = Path(os.path.realpath(target))  # unlike `resolve`, it takes a circle of links
        _remove_abandoned(target.parent)
        self._target = self.path = target
        self._replace = replace
        old = _to_replace(target) if replace else None
        # A part of a character at the end is left out: not every file system takes it.
        name = os.fsencode(target.name)[:_LONGEST].decode(errors="ignore")
        while self.descriptor < 0:
            self.path = target.with_name(f".{name}.{secrets.token_hex(4)}.reem.part")
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600 if old else 0o666)
            # Before it was locked, another program may have taken it for abandoned.
            if _lock(descriptor) is not False and os.fstat(descriptor).st_nlink:
                self.descriptor = descriptor
            else:
                os.close(descriptor)
        if old is not None:
            _make_as_private(self.descriptor, old)

    def appear(self) -> None:
        """Give the file its name; it stays open and locked.

        Raises FileExistsError if there is a file of that name by now, and it may not be replaced.
        """
        if self._replace:
            self.path.replace(self._target)
        else:
            try:
                _rename(self.path, self._target)
            except FileExistsError:
                raise there_already(self._target) from None
        self.path = self._target

    def finish(self) -> None:
        """Give the file its name once all of it is on the disk, and close it; raises as `appear` does."""
        # First the content, then the name: after a power failure there is never a name with half a file.
        os.fsync(self.descriptor)
        self.appear()
        # Make the new name survive a power failure too, where directories can be opened.
        with contextlib.suppress(OSError):
            directory = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(directory)
            finally:
                os.close(directory)
        self.close()

    def close(self) -> None:
        """Close the file, and remove it if it has not got its name. Idempotent."""
        if self.path != self._target:
            with contextlib.suppress(OSError):
                self.path.unlink()
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self.finish()
        finally:
            self.close()

    def __del__(self) -> None:
        if self.descriptor >= 0:
            self.close()


def _to_replace(target: Path) -> os.stat_result | None:
    """Return what a file is like that is to be replaced, None if there is none; OSError if it is no file."""
    try:
        old = target.lstat()
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(old.st_mode):
        raise OSError(errno.EINVAL, "not a file, and not replaced", str(target))
    return old


def _make_as_private(descriptor: int, old: os.stat_result) -> None:
    """Let those read and write a new file, which only its owner may, who may do so with the old one."""
    mode = stat.S_IMODE(old.st_mode) & 0o777 | 0o600  # its owner is about to write it
    with contextlib.suppress(OSError):
        os.fchown(descriptor, -1, old.st_gid)
    if os.fstat(descriptor).st_gid != old.st_gid:
        mode &= ~0o070  # this program may not give it to that group, and its own one is another
    with contextlib.suppress(OSError):  # what has no rights, such as FAT
        os.fchmod(descriptor, mode)


def _rename(part: Path, target: Path) -> None:
    """Give a file another name; FileExistsError if there is a file of that name."""
    try:
        target.hardlink_to(part)  # a rename would replace what came to be meanwhile
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links; of all else, the rename tells
        if os.path.lexists(target):
            raise FileExistsError from None
        part.rename(target)
    else:
        # If this fails, or the program is killed before it, the hidden name is removed later: the file keeps its other.
        with contextlib.suppress(OSError):
            part.unlink()


def _remove_abandoned(directory: Path) -> None:
    """Remove what programs have left that were killed."""
    for part in directory.glob(".*.reem.part"):
        if _NAME.fullmatch(part.name):
            with contextlib.suppress(OSError):
                _remove_if_abandoned(part)


def _remove_if_abandoned(part: Path) -> None:
    descriptor = os.open(part, _OTHERS | os.O_NOFOLLOW)
    try:
        if stat.S_ISREG(os.fstat(descriptor).st_mode) and _lock(descriptor, shared=True):
            part.unlink()
    finally:
        os.close(descriptor)
