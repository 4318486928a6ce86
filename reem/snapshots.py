"""Snapshots: what a server holds, in a file, and back.

    saved = save(interface, "before.zip")
    restore(interface, "before.zip", replace=True)

They run on the interface's background event loop, where `progress` is called too.
"""

from __future__ import annotations

from reem_async.tools import snapshots as core
from reem_async.tools.snapshots import Progress, RdbUnavailable, Restored, SavedKey, Snapshot, described

from .connection import blocking

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

describe = described
save, save_rdb, restore = blocking(core.save), blocking(core.save_rdb), blocking(core.restore)
