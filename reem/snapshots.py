"""Snapshots: what a server holds, in a file, and back.

    saved = save(interface, "before.zip")
    restore(interface, "before.zip", replace=True)

They run on the interface's background event loop, where `progress` is called too.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from reem_async.tools import snapshots as core
from reem_async.tools.snapshots import Progress, RdbUnavailable, Restored, SavedKey, Snapshot

from .connection import RedisInterface

__all__ = [
    "Progress",
    "RdbUnavailable",
    "Restored",
    "SavedKey",
    "Snapshot",
    "describe",
    "described",
    "restore",
    "save",
    "save_rdb",
]

Path = str | os.PathLike[str]
described = core.described
describe = core.described


def save(
    interface: RedisInterface,
    path: Path,
    match: str = "*",
    *,
    overwrite: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> Snapshot:
    """Save the keys of REEM to one file."""
    call = core.save(interface._followers, path, match, overwrite=overwrite, progress=progress)
    return interface._wait(call)


def save_rdb(interface: RedisInterface, path: Path, *, overwrite: bool = False) -> Snapshot:
    """Have the server save its RDB file and copy it."""
    return interface._wait(core.save_rdb(interface._followers, path, overwrite=overwrite))


def restore(
    interface: RedisInterface,
    path: Path,
    match: str = "*",
    *,
    replace: bool = False,
    into: str = "",
    progress: Callable[[Progress], None] | None = None,
) -> Restored:
    """Write the keys of a portable snapshot to a server."""
    call = core.restore(interface._followers, path, match, replace=replace, into=into, progress=progress)
    return interface._wait(call)


# The texts of the core, which say what is raised and how long it takes.
for _twin in (save, save_rdb, restore):
    _twin.__doc__ = getattr(core, _twin.__name__).__doc__
