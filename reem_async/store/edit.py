"""Changing a value in place: read, changed by the user's block, written back if nobody else changed it meanwhile."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import WrongType
from ..plan.paths import Path, show
from .document import DocumentWriter
from .reader import DocumentReader, opened

if TYPE_CHECKING:
    from ..plan.reads import RawRead

__all__ = ["Edit"]


class Edit:
    """What `Accessor.edit` returns."""

    def __init__(self, reader: DocumentReader, writer: DocumentWriter, path: Path) -> None:
        self._reader = reader
        self._writer = writer
        self._path = path
        self._before: RawRead | None = None
        self._value: Any = None

    async def __aenter__(self) -> Any:
        self._before = await self._reader.raw_read(self._path)
        await opened(self._before)
        for slot, _, _ in self._before.slots:
            value = slot.container[slot.key]
            # What was read shares its memory with the reply; the block may change arrays in place.
            if isinstance(value, np.ndarray) and not value.flags.writeable:
                slot.container[slot.key] = value.copy()
        self._value = self._before.holder[0]
        if not isinstance(self._value, dict | list | np.ndarray):
            where = show((self._reader.name, *self._path))
            raise WrongType(
                f"{where} is of type {type(self._value).__name__}, which cannot be changed in place; "
                "edit the dict or list that holds it, or use write()"
            )
        return self._value

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Compared with what was read, byte by byte, under WATCH: a change by anybody since then is a Conflict.
        if kind is None and self._before is not None:
            await self._writer.exchange(self._path, self._value, self._before)
