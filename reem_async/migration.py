"""Data of REEM 0.0 and 0.1 into data of today; see `reem_async.tools.migration`, whose names these are."""

from .tools.migration import *  # noqa: F403
from .tools.migration import __all__ as __all__
