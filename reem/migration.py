"""Data of REEM 0.0 and 0.1 into data of today.

done = migrate(interface, dry_run=True)
"""

from __future__ import annotations

from collections.abc import Callable

from reem_async import migration as core
from reem_async.migration import Migrated, Migration

from .connection import RedisInterface

__all__ = ["Migrated", "Migration", "migrate"]


def migrate(
    interface: RedisInterface,
    match: str = "*",
    *,
    dry_run: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Migration:
    """Convert what REEM 0.0 and 0.1 have stored, in place, so that it reads as it did there."""
    return interface._wait(core.migrate(interface._followers, match, dry_run=dry_run, progress=progress))


migrate.__doc__ = core.migrate.__doc__
