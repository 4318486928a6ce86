"""Data of REEM 0.0 and 0.1 into data of today: `done = await migrate(interface, dry_run=True)`."""

from .legacy.convert import Migrated, Migration, migrate

__all__ = ["Migrated", "Migration", "migrate"]
