"""A recording in several files: when the next one begins, and what each is called."""

from __future__ import annotations

import re
import time
import uuid
from pathlib import Path as FilePath
from typing import Any

from ...errors import BadType, BadValue
from ...plan.paths import shorten
from ..partfile import is_locked, there_already

_UNITS = {"kb": 1e3, "mb": 1e6, "gb": 1e9, "tb": 1e12, "s": 1.0, "min": 60.0, "h": 3600.0}
_TEXT = re.compile(rf"\s*(\d+(?:\.\d*)?)\s*({'|'.join(_UNITS)})\s*", re.IGNORECASE)
_LEAST_BYTES, _LEAST_SECONDS = 1e6, 1.0


class Split:
    """The files of one recording: run-0001.mcap, run-0002.mcap and so on."""

    def __init__(self, text: Any, path: FilePath) -> None:
        if not isinstance(text, str):
            raise BadType(f'split={shorten(text)} is no text such as "1GB" or "10min"')
        found = _TEXT.fullmatch(text)
        if found is None:
            raise BadValue(f'split={shorten(text)} is neither a size nor a time; write it like "1GB" or "10min"')
        unit = found[2].lower()
        amount = float(found[1]) * _UNITS[unit]
        is_size = unit.endswith("b")
        if not (_LEAST_BYTES if is_size else _LEAST_SECONDS) <= amount < float("inf"):
            raise BadValue(f"split={shorten(text)} is out of range; use 1MB or more, or 1s or more")
        self._most_bytes = amount if is_size else float("inf")
        self._most_seconds = float("inf") if is_size else amount
        self._path = path
        self._series = uuid.uuid4().hex  # the same in all files of this recording
        self._begun = time.monotonic()
        self.files: list[FilePath] = []

    def next(self) -> tuple[FilePath, str]:
        """Return the name of the next file, and what its metadata says of its place among the others."""
        number = len(self.files) + 1
        path = self._path.with_name(f"{self._path.stem}-{number:04}{self._path.suffix}")
        self.files.append(path)
        self._begun = time.monotonic()
        return path, f"{self._series} {number}"

    def is_due(self, size: int) -> bool:
        """Return whether the next file is to begin: this one has `size` bytes."""
        # The state that a file begins with may alone have the size at which files are split.
        seconds = time.monotonic() - self._begun
        return seconds >= _LEAST_SECONDS and (size >= self._most_bytes or seconds >= self._most_seconds)

    def refuse_others(self, *, overwrite: bool) -> None:
        """Raise BadValue if a file of another recording has one of the names: they would be read as one."""
        for path in self.others():
            if is_locked(path):
                raise BadValue(f"{path} is being recorded by another recorder; end that one, or choose another name")
            if not overwrite:
                raise BadValue(str(there_already(path)))

    def remove_others(self) -> None:
        """Remove the files of an earlier recording that this one replaces."""
        for path in self.others():
            path.unlink(missing_ok=True)

    def others(self) -> list[FilePath]:
        name = re.compile(rf"{re.escape(self._path.stem)}-\d{{4,}}{re.escape(self._path.suffix)}")
        found = self._path.parent.iterdir() if self._path.parent.is_dir() else ()
        return sorted(path for path in found if name.fullmatch(path.name) and path not in self.files)
