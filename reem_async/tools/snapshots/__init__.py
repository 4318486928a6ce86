"""Snapshots: save the data of a server to a file, and restore it.

    saved = await save(interface, "before.zip")
    await restore(interface, "before.zip", replace=True)

A portable snapshot holds the keys of REEM. It can be restored to any server, with the right to write there; `archive`
describes the file. An RDB file is the server's own format and holds the whole server.
"""

from __future__ import annotations

import os
from pathlib import Path

import anyio.to_thread

from .archive import Archive
from .files import SavedKey, Snapshot, sniff
from .portable import Progress, Restored, restore, save
from .rdb import RdbUnavailable, describe_rdb, save_rdb

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


async def describe(path: str | os.PathLike[str]) -> Snapshot:
    """Return a summary of a snapshot of either kind, without a server. Reads the index of a portable one.

    Raises:
        BadData: Neither kind, or its index is damaged; `restore` checks the rest.
        OSError: It cannot be read.
    """
    return await anyio.to_thread.run_sync(described, path)


def described(path: str | os.PathLike[str]) -> Snapshot:
    """Return what `describe` returns, on this thread."""
    file = Path(path)
    if sniff(file) == "rdb":
        return describe_rdb(file)
    with Archive(file) as archive:
        return archive.summary
