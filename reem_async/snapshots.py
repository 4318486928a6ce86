"""Snapshots of what a server holds; see `reem_async.tools.snapshots`, whose names these are."""

from .tools.snapshots import *  # noqa: F403
from .tools.snapshots import __all__ as __all__
