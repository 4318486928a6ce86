"""Keys of other programs, for plain scripts."""

from __future__ import annotations

from typing import Any

from reem_async.plan.arguments import Handle
from reem_async.plan.paths import Path
from reem_async.pubsub import raw_watch
from reem_async.store import raw as core

from ._twin import FOLLOWER, documented_by, makes, runs
from .following import Watch


@documented_by(raw_watch.RawWatch)
class RawWatch(Watch):
    """Yields an update for each change of keys of other programs: an iterator."""


@documented_by(core.RawKeys)
class RawKeys:
    """Keys of programs without REEM, as these wrote them: `kvs.raw["sai::sensors::q"].read()`."""

    def __init__(self, interface: Any) -> None:
        self._interface = interface
        self._core = core.RawKeys(interface._core.session)

    def __getitem__(self, name: str) -> RawKey:
        return RawKey(self._interface, self._core[name])

    def __setitem__(self, name: str, value: Any) -> None:
        self[name].write(value)

    def _follower(self) -> core.RawKeys:
        return core.RawKeys(self._interface._followers.session)

    keys = runs(core.RawKeys.keys)
    watch = makes(core.RawKeys.watch, RawWatch, FOLLOWER)


@documented_by(core.RawKey)
class RawKey(Handle):
    """One key of another program, or one field of a hash: `kvs.raw["battery"]["volts"]`."""

    __slots__ = ("_core", "_interface")

    def __init__(self, interface: Any, inner: core.RawKey) -> None:
        self._interface = interface
        self._core = inner

    def __getitem__(self, field: str) -> RawKey:
        return RawKey(self._interface, self._core[field])

    def __setitem__(self, field: str, value: Any) -> None:
        self[field].write(value)

    @property
    def _place(self) -> tuple[object, Path]:
        return self._interface, self._core._path

    def _follower(self) -> core.RawKey:
        return core.RawKey(self._interface._followers.session, self._core._name, self._core._field)

    read = runs(core.RawKey.read)
    write = runs(core.RawKey.write)
    watch = makes(core.RawKey.watch, RawWatch, FOLLOWER)
