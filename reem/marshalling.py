"""Names of REEM 0.1, so that its scripts run: ships were called marshallers then."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from reem_async.document import DocumentWriter
from reem_async.errors import PathRefused
from reem_async.plan.paths import Path
from reem_async.plan.writes import make_parents
from reem_async.ships import NumpyShip, SpecialDatatypeShip
from reem_async.store import KeyValueStore as CoreStore

from .accessor import Accessor
from .store import KeyValueStore

__all__ = ["NumpyMarshaller", "SpecialDatatypeMarshaller", "TolerantKeyValueStore"]


SpecialDatatypeMarshaller = SpecialDatatypeShip  # its `delete` is not needed any more, and ignored
NumpyMarshaller = NumpyShip


class _TolerantWriter(DocumentWriter):
    """Creates the parents of what it writes where they are missing."""

    async def set(self, path: Path, value: Any) -> None:
        """Store `value` at `path`; a second try, after making its parents, if they are missing."""
        try:
            await super().set(path, value)
        except PathRefused:
            await self.session.run(make_parents(self.keys, path))
            await super().set(path, value)


class _TolerantCore(CoreStore):
    _writer = _TolerantWriter


class TolerantKeyValueStore(KeyValueStore):
    """A store whose writes create missing parents, and that takes "a.b" or ["a", "b"] as a key.

    Reads are not throttled, as those of REEM 0.1.3 were: each returns the value as it is now.
    """

    _kind = _TolerantCore

    def __getitem__(self, key: str | Sequence[str | int]) -> Accessor:
        if isinstance(key, str):
            return self.at(key)
        accessor = super().__getitem__(str(key[0]))
        for element in key[1:]:
            accessor = accessor[element]
        return accessor
