"""Data of REEM 0.0 and 0.1 into data of today.

done = migrate(interface, dry_run=True)
"""

from __future__ import annotations

from reem_async import migration as core
from reem_async.migration import Migrated, Migration

from .connection import blocking

__all__ = ["Migrated", "Migration", "migrate"]

migrate = blocking(core.migrate)
